"""Noise states of sensors move nothing but their own sensor; a filter is the one that smooths a
record."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from greybox.errors import ModelError, UnknownNameError
from greybox.frames import numeric
from greybox.model.dynamics import Dynamics
from greybox.model.layer import physics_of
from greybox.model.model import build_model, sensors_for
from greybox.model.noise import Augmented, Coloured, Drift, Line, LowPass, with_white_sensors
from greybox.model.vehicle import read_vehicle
from greybox.plants.presets import x250
from greybox.plants.vehicle_file import write_vehicle
from scenarios.plants.sensor_faults import low_passed

DT = 0.01
COLUMNS = ("p", "q", "r", "ax", "ay", "az", "qw", "qx", "qy", "qz")
PARTS = (
    Coloured(sensor="gyro", time=0.05),
    Drift(sensor="gyro"),
    Line(sensor="accelerometer", time=0.5, frequency=13.0),
    LowPass(sensor="accelerometer", time=0.008),
)


@pytest.fixture(scope="module")
def physics(tmp_path_factory):
    vehicle = read_vehicle(
        write_vehicle(tmp_path_factory.mktemp("v") / "v.toml", x250(), sigma={"thrust.c2": 0.1})
    )
    return build_model(vehicle, COLUMNS, (), sample_time=DT)


def functions(model):
    x, u = (
        ca.SX.sym("x", len(model.states)),
        ca.SX.sym("u", len(model.inputs), sum(model.window) + 1),
    )
    w, p, y = (
        ca.SX.sym("w", len(model.noises)),
        ca.SX.sym("p", len(model.parameters)),
        ca.SX.sym("y", len(model.outputs)),
    )
    out = model.output(0, x, u, p, w, DT)
    return (
        ca.Function("step", [x, u, p, w], [model.step(0, x, u, p, w, DT)]),
        ca.Function("output", [x, u, p, w], [out]),
        ca.Function("innovation", [y, x, u, p, w], [model.innovation(y, out, x)]),
    )


def start(model):
    level = {n: np.array([0.0]) for n in COLUMNS} | {"qw": np.array([1.0])}
    return model.initial_state(level)[0], np.array([d.nominal for d in model.parameters])


def test_it_is_a_dynamics_and_comes_off_again(physics):
    model = Augmented(core=physics, parts=PARTS)
    assert isinstance(model, Dynamics)
    assert with_white_sensors(model) is physics
    assert with_white_sensors(physics) is physics
    assert len(model.states) - len(physics.states) == 3 + 3 + 6 + 3
    assert model.noise_scale(DT).shape == (len(model.noises),)
    assert model.reference({"qw": 1.0}).shape == (len(model.states),)
    assert "rotor_drag" in {e.name for e in physics_of(model.with_effect("rotor_drag")).effects}
    assert model.with_effect("rotor_drag").without_effect("rotor_drag") == model


def test_noise_adds_to_the_innovation_of_its_sensor_alone(physics):
    model = Augmented(core=physics, parts=PARTS[:3])
    step, _, innovation = functions(model)
    x, p = start(model)
    u, quiet = np.full(4, 0.5), np.zeros(len(model.noises))
    y = np.zeros(len(model.outputs))
    y[model.outputs["qw"]] = 1.0
    base = np.asarray(innovation(y, x, u, p, quiet).full()).ravel()
    noisy = x.copy()
    noisy[model.states["coloured.gyro.c.q"]] = 0.3
    noisy[model.states["drift.gyro.c.q"]] = 0.2
    noisy[model.states["line.accelerometer.c.az"]] = 0.7
    change = np.asarray(innovation(y, noisy, u, p, quiet).full()).ravel() - base
    expected = np.zeros_like(change)
    expected[model.innovations["q"]], expected[model.innovations["az"]] = -0.5, -0.7
    assert change == pytest.approx(expected, abs=1e-12)
    after, plain = (np.asarray(step(v, u, p, quiet).full()).ravel() for v in (noisy, x))
    n = len(physics.states)
    assert after[:n] == pytest.approx(plain[:n], abs=0)
    assert after[model.states["coloured.gyro.c.q"]] == pytest.approx(0.3 * np.exp(-DT / 0.05))
    assert after[model.states["drift.gyro.c.q"]] == pytest.approx(0.2)
    turn, decay = 2 * np.pi * 13.0 * DT, np.exp(-DT / 0.5)
    assert after[model.states["line.accelerometer.c.az"]] == pytest.approx(
        0.7 * decay * np.cos(turn)
    )
    assert after[model.states["line.accelerometer.s.az"]] == pytest.approx(
        0.7 * decay * np.sin(turn)
    )


def test_errors_of_a_world_vector_stay_in_the_world_while_the_craft_turns(physics):
    """A craft that turns by 3 rad/s: what GPS is off by stays where it is, the filter corrects it
    alike at all headings, and a gyro's error goes along."""
    sensors = sensors_for((*COLUMNS, "x", "y", "z"), physics.vehicle)
    parts = (Coloured(sensor="position", time=10.0), Line(sensor="position", time=0.5))
    model = Augmented(core=replace(physics, sensors=sensors), parts=parts)
    step, _, innovation = functions(model)
    x, p = start(model)
    u, quiet = np.full(4, 0.5), np.zeros(len(model.noises))
    own, seen = model.states["coloured.position.c.x"], model.innovations["position.x"]
    x[own : own + 3], x[model.states["rate.z"]] = (0.3, -0.2, 0.1), 3.0
    for _ in range(40):
        x = step(x, u, p, quiet).full().ravel()
    decayed = np.exp(-40 * DT / 10.0) * np.array([0.3, -0.2, 0.1])
    assert x[own : own + 3] == pytest.approx(decayed, rel=1e-9)
    y = np.zeros(len(model.outputs))
    y[model.outputs["qw"]] = 1.0
    without = x.copy()
    without[own : own + 3] = 0.0
    change = (innovation(y, x, u, p, quiet) - innovation(y, without, u, p, quiet)).full().ravel()
    turn = numeric("matrix", x[[model.states[f"attitude.{c}"] for c in "wxyz"]]).reshape(3, 3)
    assert abs(turn[0, 1]) > 0.5
    assert change[seen : seen + 3] == pytest.approx(-turn.T @ decayed, abs=1e-12)
    assert np.abs(np.delete(change, range(seen, seen + 3))).max() < 1e-12

    d = np.zeros(len(model.error_states))
    at = model.error_states["d_coloured.position.c.x"]
    d[at : at + 9] = np.linspace(-0.4, 0.4, 9)
    state, error = ca.SX.sym("x", x.size), ca.SX.sym("d", d.size)
    plus = ca.Function("plus", [state, error], [model.boxplus(state, error)])
    moved = plus(x, d).full().ravel()
    assert moved[own : own + 3] - x[own : own + 3] == pytest.approx(turn @ d[at : at + 3])
    other = ca.SX.sym("y", x.size)
    minus = ca.Function("minus", [other, state], [model.boxminus(other, state)])
    assert minus(moved, x).full().ravel() == pytest.approx(d, abs=1e-12)
    corrected = (innovation(y, moved, u, p, quiet) - innovation(y, x, u, p, quiet)).full().ravel()
    line = model.error_states["d_line.position.c.x"]
    pushed = d[at : at + 3] + d[line : line + 3]
    assert corrected[seen : seen + 3] == pytest.approx(-pushed, abs=1e-12)


def test_a_filter_is_the_one_that_smooths_a_record(physics):
    model = Augmented(core=physics, parts=PARTS[3:])
    (step, output, _), (_, bare, _) = functions(model), functions(physics)
    x, p = start(model)
    rng = np.random.default_rng(0)
    quiet, n = np.zeros(len(model.noises)), len(physics.states)
    seen, true = [], []
    for _ in range(60):
        u = rng.uniform(0.4, 0.6, 4)
        seen.append(output(x, u, p, quiet).full().ravel()[model.outputs["az"]])
        true.append(
            bare(x[:n], u, p[: len(physics.parameters)], quiet[: len(physics.noises)])
            .full()
            .ravel()
        )
        x = step(x, u, p, quiet).full().ravel()
    record = {"t": DT * np.arange(60), "az": np.array([v[physics.outputs["az"]] for v in true])}
    smooth = low_passed(record, ["az"], 1 / (2 * np.pi * 0.008))["az"]
    assert np.array(seen)[20:] == pytest.approx(smooth[20:], abs=1e-8)
    assert np.ptp(record["az"]) > 0.5


def test_mistakes_are_named(physics):
    with pytest.raises(UnknownNameError, match="barometer"):
        Augmented(core=physics, parts=(Coloured(sensor="barometer"),))
    with pytest.raises(ModelError, match=r"drift\.gyro"):
        Augmented(core=physics, parts=(PARTS[1], PARTS[1]))
