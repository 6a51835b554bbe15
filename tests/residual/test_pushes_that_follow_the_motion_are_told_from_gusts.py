"""A push that follows the motion is a law that is missing; gusts are not, and what moves the craft
by less than the model errs ahead is not worth a word."""

from __future__ import annotations

import argparse
import functools
import shlex
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import greybox as gb
from greybox.commands import discover
from greybox.commands.fit_said import discover_command, next_step, with_pushes
from greybox.data import Dataset, dataset_from_arrays
from greybox.estimation.fit import fit
from greybox.excitation.waypoints import RandomWaypoints
from greybox.model.identified import IdentifiedModel
from greybox.model.parameter import ParameterValues
from greybox.model.vehicle import read_vehicle
from greybox.plants.effects import ParasiticDrag
from greybox.plants.flight_log import fly, member
from greybox.plants.presets import controller_for, x250
from greybox.plants.vehicle_file import write_vehicle
from greybox.residual import discrepancy
from greybox.residual.discrepancy import Discrepancy
from greybox.residual.followed import Followed, Pushes, _felt, _moved, pushes, told_of_pushes
from greybox.residual.learn import disturbed_model
from greybox.symbolic import Layout, Signal

ERRORS = {"velocity": 0.2, "rate": 0.5}
"""Mean errors half a second ahead, of the size that such a model has."""
TIME = 1.0
"""Correlation time of the gusts [s]."""


@functools.cache
def flown(drag: float, gust: float) -> tuple[IdentifiedModel, Dataset]:
    """Two flights of a craft with drag [N s^2/m^2] in gusts [N], and its model, which knows
    neither."""
    effects = [ParasiticDrag(c_x=drag, c_y=drag, c_z=drag)] if drag else []
    calm = x250().process
    blown = replace(calm, drift_force=gust * (2 / TIME) ** 0.5, drift_time=TIME)
    plant = x250(effects, process=blown)
    log = fly(plant, controller_for(plant), RandomWaypoints(), None, 15.0, seed=[1, 2], warm_up=1.0)
    data = Dataset(flights=())
    for i in range(2):
        columns = {k: np.asarray(v) for k, v in member(log, i).items()}
        t = columns.pop("t")
        data = data + dataset_from_arrays(t, columns, name=f"run{i}")
    with tempfile.TemporaryDirectory() as folder:
        vehicle = read_vehicle(write_vehicle(Path(folder) / "v.toml", plant))
    model = gb.build_model(vehicle, data.channels)
    return disturbed_model(fit(model, data, free=()).model, data), data


def followed(
    model: IdentifiedModel, data: Dataset, errors: dict[str, float], ahead: float
) -> tuple[Followed, ...]:
    found = pushes(model, data, errors)
    return found.followed(errors, ahead) if found else ()


def test_drag_that_is_missing_follows_the_motion_and_is_felt() -> None:
    (found,) = followed(*flown(0.1, 0.0), ERRORS, 0.5)
    assert found.group == "force" and found.channel == "velocity"
    assert found.share > 0.7 and 0.02 < found.change < 0.2


def test_a_steady_velocity_is_no_push_of_its_own() -> None:
    """At 8 m/s and half a metre per second about it, what drag leaves is about zero."""
    model, _ = flown(0.1, 0.0)
    rng, n = np.random.default_rng(0), 2000
    z = 0.01 * rng.standard_normal((n, 6))
    z[:, 0] = 8.0 + 0.5 * np.sin(np.arange(n) * model.sample_time)
    push = np.column_stack([-0.05 * (z[:, 0] - 8.0), np.zeros(n), np.zeros(n)])
    outputs = Layout([Signal(name=f"force.{a}", unit="N") for a in "xyz"])
    inputs = Layout([Signal(name=f"feature.{i}", unit="m/s") for i in range(6)])
    seen = Discrepancy(inputs=inputs, outputs=outputs, z=z, y=push, flights=("run0",) * n)
    (felt,) = _felt(model, seen, [z], "force", 1.0, {"velocity": 0.02}, 0.5)
    true = _moved(push / model.values["mass"], model, "force", 0.5).mean(axis=0)[0]
    assert felt.change == pytest.approx(true, rel=1e-6)


def test_gusts_of_the_same_size_do_not() -> None:
    """Although the craft in its loop answers them."""
    assert not followed(*flown(0.0, 0.1), ERRORS, 0.5)


@pytest.mark.parametrize("scale", [0.1, 100.0])
def test_what_the_errors_refute_or_nobody_feels_is_not_said(scale: float) -> None:
    errors = {k: scale * v for k, v in ERRORS.items()}
    assert not followed(*flown(0.1, 0.0), errors, 0.5)


def test_a_model_without_disturbances_and_a_channel_that_nobody_judged_say_nothing() -> None:
    model, data = flown(0.1, 0.0)
    assert not followed(model, data, {}, 0.5)
    assert not followed(fit(model.physics, data, free=()).model, data, ERRORS, 0.5)


@pytest.mark.parametrize("broken", ["features", "pushes"])
def test_what_is_not_finite_has_no_law(monkeypatch: pytest.MonkeyPatch, broken: str) -> None:
    model, data = flown(0.1, 0.0)
    smoothed = discrepancy.smoothed_features

    def spoilt(*arguments: Any) -> tuple[np.ndarray, np.ndarray]:
        states, seen = smoothed(*arguments)
        (seen if broken == "features" else states)[3] = np.nan
        return states, seen

    monkeypatch.setattr(discrepancy, "smoothed_features", spoilt)
    assert not followed(model, data, ERRORS, 0.5)


def test_each_flight_is_smoothed_once_and_none_where_no_channel_was_judged(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model, data = flown(0.1, 0.0)
    smoothed, calls = discrepancy.smoothed_features, []

    def counted(*arguments: Any) -> tuple[np.ndarray, np.ndarray]:
        calls.append(arguments)
        return smoothed(*arguments)

    monkeypatch.setattr(discrepancy, "smoothed_features", counted)
    assert followed(model, data, ERRORS, 0.5)
    assert len(calls) == sum(len(f.segments) for f in data)
    calls.clear()
    assert not followed(model, data, {}, 0.5) and not calls


def seen_in(model: IdentifiedModel, data: Dataset, errors: dict[str, float] = ERRORS) -> Pushes:
    found = pushes(model, data, errors)
    assert found is not None
    return found


@pytest.mark.parametrize("off", [0.9, 1.1])
def test_a_thrust_that_is_off_leaves_a_force_that_carries_the_craft(off: float) -> None:
    model, data = flown(0.0, 0.1)
    assert seen_in(model, data).weight_carried() == 0.0
    values = {**model.values, "thrust.c2": off * model.values["thrust.c2"]}
    wrong = replace(model, values=ParameterValues(values))
    assert seen_in(wrong, data).weight_carried() == pytest.approx(1.0 - off, abs=0.03)
    assert seen_in(wrong, data, {"rate": 0.5}).weight_carried() == 0.0


def test_what_carries_one_flight_and_pulls_at_the_other_carries_nothing() -> None:
    model, data = flown(0.0, 0.1)
    found = seen_in(model, data)
    names, weight = np.array(found.seen.flights), model.values["mass"] * 9.81
    for signs, carried in (((1.0, 1.0), 0.05), ((1.0, -1.0), 0.0)):
        push = np.zeros((len(names), found.seen.y.shape[1]))
        push[:, 2] = 0.05 * weight * np.where(names == names[0], *signs)
        own = replace(found, seen=replace(found.seen, y=push))
        assert own.weight_carried() == pytest.approx(carried, rel=0.01)
        push[::2, 2] *= -1.0
        assert own.weight_carried() == 0.0


@pytest.mark.parametrize(
    ("off", "last_value", "said"), [(0.6, 0.8, True), (0.6, 3.0, False), (0.95, 0.8, False)]
)
def test_a_model_that_falls_without_its_force_is_used_with_its_filter_only(
    off: float, last_value: float, said: bool
) -> None:
    """A sure inertia that was wrong halved the thrust: a force carried half of the weight, and the
    fit was useful. 0.4 of the weight is 2 m/s in half a second."""
    model, data = flown(0.0, 0.1)
    values = {**model.values, "thrust.c2": off * model.values["thrust.c2"]}
    wrong = replace(model, values=ParameterValues(values))
    judged: Any = SimpleNamespace(
        name="velocity", unit="m/s", error=0.1, last_value=last_value, seconds=0.5
    )
    told, reserve = told_of_pushes(wrong, data, [judged])
    assert any("carries" in line for line in told)
    assert reserve.startswith("a force without a name carries 4") == said


@dataclass
class Judged:
    """A verdict, as far as the next step looks at it."""

    refused: bool
    groups: tuple[SimpleNamespace, ...]
    line: str = "useful"


def raising(*arguments: object) -> None:
    raise np.linalg.LinAlgError("SVD did not converge")


@pytest.mark.parametrize("groups", [(), (SimpleNamespace(name="rate", error=0.1, seconds=0.5),)])
def test_the_next_step_is_left_out_where_it_cannot_be_told(
    monkeypatch: pytest.MonkeyPatch, groups: tuple[SimpleNamespace, ...]
) -> None:
    """The files of the fit are written by then."""
    monkeypatch.setattr("greybox.residual.followed.pushes", raising)
    verdict = Judged(refused=False, groups=groups)
    job: Any = SimpleNamespace(prepared=SimpleNamespace(data=None))
    sure = SimpleNamespace(beyond="", form="", changed=())
    result: Any = SimpleNamespace(verdict=verdict, converged=True, model=None, covariance=sure)
    result.judged = lambda new: new
    kept, pushed = with_pushes(job, result)
    assert pushed == [] and (kept is result or kept.line == "useful")
    assert next_step(job, result, pushed) == []


def test_the_next_step_is_a_command_with_the_same_flights() -> None:
    arguments = argparse.Namespace(
        vehicle="my craft.toml",
        train=["a.csv", "b.csv"],
        test=["c.csv"],
        mapping="m.toml",
        effects_file=[],
        keep_impossible=True,
        accept="",
    )
    assert discover_command(arguments) == (
        "greybox discover --vehicle 'my craft.toml' --train a.csv b.csv --test c.csv "
        "--mapping m.toml --keep-impossible"
    )
    parser = argparse.ArgumentParser()
    discover.add(parser.add_subparsers())
    parser.parse_args(shlex.split(discover_command(arguments))[1:])
