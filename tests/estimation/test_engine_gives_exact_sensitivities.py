"""The recursion's derivatives are those of its own numbers; compiled C, virtual machine and open
loop tell one story."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from greybox.estimation.build import compiler
from greybox.estimation.engine import Engine, engine_for
from greybox.estimation.recursion import GainTable
from greybox.model.dynamics import Dynamics
from greybox.model.effects import CATALOGUE
from greybox.model.layer import physics_of
from greybox.model.model import PhysicsModel
from greybox.model.noise import with_disturbance
from greybox.model.sensors import SENSORS
from greybox.model.vehicle import read_vehicle
from greybox.plants.presets import X250
from greybox.plants.quadrotor import Quadrotor
from greybox.plants.vehicle_file import write_vehicle

DT = 0.01
N = 25
CROOKED = replace(
    X250,
    products=(2e-4, -1e-4, 1.5e-4),
    center_of_mass=(3e-3, -2e-3, 4e-3),
    imu_position=(0.02, -0.01, 0.015),
)
needs_compiler = pytest.mark.skipif(compiler() is None, reason="no C compiler here")


@cache
def everything() -> PhysicsModel:
    with tempfile.TemporaryDirectory() as folder:
        vehicle = read_vehicle(write_vehicle(Path(folder) / "v.toml", Quadrotor(CROOKED)))
    return PhysicsModel(vehicle=vehicle, effects=CATALOGUE, sensors=SENSORS, sample_time=DT)


@cache
def middling() -> Dynamics:
    with tempfile.TemporaryDirectory() as folder:
        vehicle = read_vehicle(write_vehicle(Path(folder) / "v.toml", Quadrotor(X250)))
    inner = PhysicsModel(vehicle=vehicle, sensors=SENSORS[:5], sample_time=DT)
    return with_disturbance(
        inner.with_effect("motor_lag", "command_delay", "rotor_drag"), ("torque",)
    )


def values(model) -> np.ndarray:
    """Every parameter away from its null, a delay away from a whole number of samples."""
    out = []
    for i, p in enumerate(model.parameters):
        moved = p.nominal + (
            0.4 * p.scale * (1 if i % 2 or p.lower == p.nominal else -1)
            if p.null is not None
            else 0
        )
        out.append(
            0.0137 if p.name == "command_delay.d" else float(np.clip(moved, p.lower, p.upper))
        )
    return np.array(out)


def scales(model) -> np.ndarray:
    return np.array([p.scale for p in model.parameters])


class Scene:
    """A short record with missing cells, a mild random gain for each of two patterns, and the run
    of an engine on it."""

    def __init__(self, model, *, seed=0, gain_size=1.0) -> None:
        rng = np.random.default_rng(seed)
        self.model = model
        self.p = values(model)
        ne, nd = len(model.innovations), len(model.error_states)
        self.u = rng.uniform(0.45, 0.6, size=(N, len(model.inputs)))
        self.u[[6, 12], [0, 1]] = 0.005, 0.995  # both limits of the command are felt
        if "vbat" in model.inputs:
            self.u[:, model.inputs["vbat"]] = rng.uniform(10.5, 12, size=N)
        x0, _ = model.initial_state({})
        moved = 0.3 * rng.normal(size=nd)
        self.plus = boxplus(model)
        self.x0 = self.plus(x0, moved)
        self.y = rng.normal(size=(N, len(model.outputs)))
        at = [model.outputs[n] for n in ("qw", "qx", "qy", "qz")]
        self.y[:, at] += 4 * self.x0[[model.states[f"attitude.{a}"] for a in "wxyz"]]
        self.y[:, at] /= np.linalg.norm(self.y[:, at], axis=1, keepdims=True)
        self.pattern = (np.arange(N) % 3 == 0).astype(np.int32)
        patterns = (rng.uniform(size=(2, ne)) > 0.3).astype(float)
        groups = np.array(physics_of(model).channel_groups)
        patterns[0, (groups == "rotation") | (groups == "position")] = 0.0  # as with a slow camera
        patterns[1, groups == "rotor_speed"] = 1.0  # nothing else feels their scale
        patterns[1, ~patterns.any(axis=0)] = 1.0  # every channel is seen in one of them
        self.mask = patterns[self.pattern]
        mild = gain_size * 2e-3 * np.where(groups == "rotor_speed", 1e-3, 1.0)  # rad/s are many
        self.gain = mild * rng.normal(size=(2, nd, ne)) * patterns[:, None, :]
        self.noise_gain = mild * rng.normal(size=(2, nd, ne)) * patterns[:, None, :]

    def table(self, noise=0.0, derivative=None):
        zero = np.zeros(2, dtype=np.int32)
        return GainTable(gain=self.gain + noise * self.noise_gain, zero=zero, derivative=derivative)

    def run(self, engine, *, x0=None, p=None, y=None, noise=0.0, s0=None, derivative=None, **more):
        want = frozenset({"states", "innovations", "outputs", "sensitivity", "state_sensitivity"})
        return engine.run(
            x0=self.x0 if x0 is None else x0,
            inputs=engine.padded_inputs(self.u),
            outputs=self.y if y is None else y,
            mask=self.mask,
            pattern=self.pattern,
            gains=self.table(noise, derivative),
            p=self.p if p is None else p,
            dt=DT,
            s0=s0,
            want=want if s0 is not None else frozenset({"states", "innovations", "outputs"}),
            **more,
        )


def boxplus(model):
    import casadi as ca

    x, d = ca.SX.sym("x", len(model.states)), ca.SX.sym("d", len(model.error_states))
    move = ca.Function("plus", [x, d], [model.boxplus(x, d)])
    return lambda a, b: move(a, b).full().ravel()


def close(exact, numeric, *, rel=2e-6):
    """Per column of sensitivities, relative to the largest number in it."""
    size = np.abs(numeric).max()
    assert size > 0
    assert np.abs(exact - numeric).max() <= rel * size


@pytest.fixture(scope="module")
def all_parameters():
    model = everything()
    active = tuple(p.name for p in model.parameters)
    return Engine(model, active, use_compiler=False), Scene(model)


NAMES = [p.name for p in everything().parameters]


@pytest.mark.parametrize("name", NAMES)
def test_sensitivity_to_every_parameter_is_the_central_difference(all_parameters, name):
    engine, scene = all_parameters
    if not hasattr(scene, "exact"):
        scene.exact = scene.run(engine, s0=np.zeros((engine.nd, len(engine.active)))).sensitivity
    j = engine.active.index(name)
    h = 1e-5 * scales(scene.model)[j]
    e = np.eye(len(scene.p))[j]
    ahead, behind = (scene.run(engine, p=scene.p + s * h * e).innovations for s in (1, -1))
    close(scene.exact[:, :, j], (ahead - behind) / (2 * h))


@pytest.fixture(scope="module")
def medium():
    model = middling()
    active = (
        "mass",
        "inertia.yy",
        "motor_lag.tau",
        "command_delay.d",
        "rotor_drag.k_x",
        "disturbance.torque.T",
    )
    return engine_for(model, active), Scene(model, seed=1)


def test_sensitivity_to_the_initial_state_is_the_central_difference(medium):
    engine, scene = medium
    na, nd = len(engine.active), engine.nd
    s0 = np.concatenate([np.zeros((nd, na)), np.eye(nd)], axis=1)
    run = scene.run(engine, s0=s0)
    for j, e in enumerate(np.eye(nd)):
        h = 1e-5
        ahead, behind = (scene.run(engine, x0=scene.plus(scene.x0, s * h * e)) for s in (1, -1))
        numeric = (ahead.innovations - behind.innovations) / (2 * h)
        if np.abs(numeric).max() < 1e-12:  # a rotor that a later command has made forget
            assert np.abs(run.sensitivity[:, :, na + j]).max() < 1e-9
        else:
            close(run.sensitivity[:, :, na + j], numeric)


def test_sensitivity_through_the_gain_is_the_central_difference(medium):
    """A noise level moves nothing but the gain: its column lives on dK alone."""
    engine, scene = medium
    na = len(engine.active)
    derivative = tuple(
        np.concatenate([np.zeros((na, *g.shape)), g[None]]) for g in scene.noise_gain
    )
    run = scene.run(engine, s0=np.zeros((engine.nd, na + 1)), derivative=derivative)
    h = 1e-4
    ahead, behind = (scene.run(engine, noise=s * h).innovations for s in (1, -1))
    close(run.sensitivity[:, :, na], (ahead - behind) / (2 * h))


def test_state_sensitivity_and_end_are_the_central_difference(medium):
    engine, scene = medium
    run = scene.run(engine, s0=np.zeros((engine.nd, len(engine.active))))
    j = engine.active.index("motor_lag.tau")
    index = [p.name for p in scene.model.parameters].index("motor_lag.tau")
    h = 1e-6
    e = np.eye(len(scene.p))[index]
    ahead, behind = (scene.run(engine, p=scene.p + s * h * e) for s in (1, -1))
    rows = [scene.model.states[f"rate.{a}"] for a in "xyz"]
    errors = [scene.model.error_states[f"d_rate.{a}"] for a in "xyz"]
    close(
        run.state_sensitivity[:, errors, j],
        (ahead.states[:, rows] - behind.states[:, rows]) / (2 * h),
    )
    close(run.end_sensitivity[errors, j], (ahead.end[rows] - behind.end[rows]) / (2 * h))


@needs_compiler
def test_compiled_and_virtual_machine_agree(medium):
    engine, scene = medium
    assert engine.compiled
    plain = engine_for(engine.dynamics, engine.active, use_compiler=False)
    assert not plain.compiled
    s0 = np.concatenate([np.zeros((engine.nd, len(engine.active))), np.eye(engine.nd)], axis=1)
    a, b = scene.run(engine, s0=s0), scene.run(plain, s0=s0)
    for name in (
        "states",
        "innovations",
        "outputs",
        "sensitivity",
        "state_sensitivity",
        "end",
        "end_sensitivity",
    ):
        got, expected = getattr(a, name), getattr(b, name)
        np.testing.assert_allclose(
            got, expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max(), err_msg=name
        )
    rows = np.array([0, 3, 7])
    starts = a.states[rows]
    for got, expected in zip(
        *(
            e.rollout(
                starts=starts,
                rows=rows,
                horizon=12,
                inputs=e.padded_inputs(scene.u),
                p=scene.p,
                dt=DT,
                want_states=True,
            )
            for e in (engine, plain)
        ),
        strict=True,
    ):
        np.testing.assert_allclose(got, expected, rtol=1e-10, atol=1e-12)


def test_a_missing_value_has_no_influence_whatsoever(medium):
    engine, scene = medium
    s0 = np.zeros((engine.nd, len(engine.active)))
    wild = scene.y.copy()
    names = scene.model.outputs.names
    untouched = np.ones(wild.shape, dtype=bool)
    for i, columns in enumerate(scene.model.innovation_columns):
        for c in columns:
            untouched[scene.mask[:, i] != 0, names.index(c)] = False
    assert untouched[:, names.index("qw")].any(), "whole attitudes are missing too"
    wild[untouched] = 1e6
    empty = np.where(untouched, np.nan, scene.y)
    runs = [scene.run(engine, y=y, s0=s0) for y in (scene.y, wild, empty)]
    for other in runs[1:]:
        for name in ("states", "innovations", "outputs", "sensitivity", "end"):
            np.testing.assert_array_equal(getattr(other, name), getattr(runs[0], name))
    assert np.abs(runs[0].innovations[scene.mask == 0]).max() == 0.0
    assert np.abs(runs[0].sensitivity[scene.mask == 0]).max() == 0.0


def test_a_value_that_is_there_has_influence(medium):
    engine, scene = medium
    y = scene.y.copy()
    y[:, scene.model.outputs["p"]] += 0.1
    moved, before = scene.run(engine, y=y), scene.run(engine)
    assert np.abs(moved.end - before.end).max() > 1e-8


def windows(engine, scene, **more):
    """Open-loop runs of uneven length, of which the ends of some are kept."""
    rows, lengths, tails = np.array([0, 3, 7, 9]), np.array([12, 5, 8, 1]), np.array([4, 5, 1, 0])
    x = scene.run(engine).states[rows]
    inputs = engine.padded_inputs(scene.u)
    given = {"starts": x, "rows": rows, "inputs": inputs, "lengths": lengths, "tails": tails}
    given |= {"outputs": scene.y, "mask": scene.mask, "p": scene.p, "dt": DT}
    return engine.windows(**given | more)


@needs_compiler
@pytest.mark.parametrize("steps", [None, np.array([0, 4, 9])])
def test_compiled_and_virtual_machine_agree_on_many_short_runs(medium, steps):
    engine, scene = medium
    plain = engine_for(engine.dynamics, engine.active, use_compiler=False)
    rng = np.random.default_rng(0)
    s0 = rng.standard_normal((4, engine.nd, len(engine.active) + 2))
    for start in (None, s0):
        a, b = (windows(e, scene, s0=start, steps=steps) for e in (engine, plain))
        for name in ("innovations", "sensitivity", "ends", "end_sensitivity"):
            got, expected = getattr(a, name), getattr(b, name)
            assert (got is None) == (expected is None)
            if got is not None:
                assert got.shape == expected.shape
                np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-11, err_msg=name)


@pytest.mark.parametrize("use_compiler", [pytest.param(True, marks=needs_compiler), False])
def test_the_first_short_run_that_stops_being_finite_is_named(medium, use_compiler):
    engine = engine_for(medium[0].dynamics, medium[0].active, use_compiler=use_compiler)
    scene = medium[1]
    u = engine.padded_inputs(scene.u)
    assert windows(engine, scene).failed_in is None
    u[engine.past + 10] = np.nan
    # Runs 0 and 2 see it; the second sooner after its start.
    assert windows(engine, scene, inputs=u).failed_in == 0


@pytest.mark.parametrize("use_compiler", [pytest.param(True, marks=needs_compiler), False])
def test_a_run_that_corrects_nothing_is_a_rollout(medium, use_compiler):
    engine = engine_for(medium[0].dynamics, medium[0].active, use_compiler=use_compiler)
    scene = medium[1]
    run = engine.run(
        x0=scene.x0,
        inputs=engine.padded_inputs(scene.u),
        outputs=scene.y,
        mask=scene.mask,
        pattern=scene.pattern,
        gains=GainTable(gain=np.zeros_like(scene.gain), zero=np.ones(2, dtype=np.int32)),
        p=scene.p,
        dt=DT,
        want=frozenset({"states", "outputs"}),
    )
    with_zero_gain = engine.run(
        x0=scene.x0,
        inputs=engine.padded_inputs(scene.u),
        outputs=scene.y,
        mask=scene.mask,
        pattern=scene.pattern,
        gains=GainTable(gain=np.zeros_like(scene.gain), zero=np.zeros(2, dtype=np.int32)),
        p=scene.p,
        dt=DT,
        want=frozenset({"states", "outputs"}),
    )
    outputs, states = engine.rollout(
        starts=scene.x0[None],
        rows=np.array([0]),
        horizon=N,
        inputs=engine.padded_inputs(scene.u),
        p=scene.p,
        dt=DT,
        want_states=True,
    )
    np.testing.assert_allclose(run.states, states[0], rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(run.outputs, outputs[0], rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(with_zero_gain.states, states[0], rtol=1e-9, atol=1e-12)


def test_a_rollout_from_a_later_row_continues_the_first(medium):
    engine, scene = medium
    inputs = engine.padded_inputs(scene.u)
    whole, states = engine.rollout(
        starts=scene.x0[None],
        rows=np.array([0]),
        horizon=N,
        inputs=inputs,
        p=scene.p,
        dt=DT,
        want_states=True,
    )
    tail, _ = engine.rollout(
        starts=states[0, 10:11],
        rows=np.array([10]),
        horizon=N - 10,
        inputs=inputs,
        p=scene.p,
        dt=DT,
    )
    np.testing.assert_allclose(tail[0], whole[0, 10:], rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("use_compiler", [pytest.param(True, marks=needs_compiler), False])
def test_numbers_that_stop_being_finite_are_reported_with_their_sample(medium, use_compiler):
    engine = engine_for(medium[0].dynamics, medium[0].active, use_compiler=use_compiler)
    scene = medium[1]
    u = scene.u.copy()
    u[6, 0] = np.nan
    run = engine.run(
        x0=scene.x0,
        inputs=engine.padded_inputs(u),
        outputs=scene.y,
        mask=scene.mask,
        pattern=scene.pattern,
        gains=scene.table(),
        p=np.where(scene.p == 0.0137, 0.0, scene.p),
        dt=DT,
    )
    assert run.failed_at == 6


def test_a_filter_that_is_told_the_truth_has_no_innovations(medium):
    engine, scene = medium
    inputs = engine.padded_inputs(scene.u)
    y, states = engine.rollout(
        starts=scene.x0[None],
        rows=np.array([0]),
        horizon=N,
        inputs=inputs,
        p=scene.p,
        dt=DT,
        want_states=True,
    )
    run = scene.run(engine, y=y[0])
    assert np.abs(run.innovations).max() < 1e-11
    np.testing.assert_allclose(run.states, states[0], atol=1e-11)


def test_inputs_are_not_changed(medium):
    engine, scene = medium
    before = [a.copy() for a in (scene.x0, scene.y, scene.u, scene.mask, scene.p)]
    scene.run(engine, s0=np.zeros((engine.nd, len(engine.active))))
    for a, b in zip((scene.x0, scene.y, scene.u, scene.mask, scene.p), before, strict=True):
        np.testing.assert_array_equal(a, b)


def test_an_engine_without_sensitivities_stands_in_for_none_that_has_them():
    model = PhysicsModel(
        vehicle=everything().vehicle, effects=CATALOGUE[:1], sensors=SENSORS[:5], sample_time=DT
    )
    assert not engine_for(model, (), sensitive=False).sensitive
    assert engine_for(model, ()).sensitive
