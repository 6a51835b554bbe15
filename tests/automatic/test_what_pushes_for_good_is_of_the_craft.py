"""A craft that changes in flight is told from one in gusts, with the time and the size, and a force
that lasts is in the errors of what it may be: of thrust, and of what is told by its side."""

from __future__ import annotations

import argparse
import functools
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from greybox.automatic.changed import (
    Changed,
    Stretch,
    Unnamed,
    changes,
    lasting_share,
    said_of_changes,
    steady_share,
    unnamed,
)
from greybox.automatic.lasting import _with_share, with_lasting
from greybox.automatic.shifted import Asked, with_shift
from greybox.automatic.widened import widened
from greybox.commands.fit_said import next_step
from greybox.data import Dataset, dataset_from_arrays
from greybox.estimation.fit import fit
from greybox.estimation.result import Estimate, Fit
from greybox.excitation.trajectory import Reference, Trajectory, from_positions
from greybox.excitation.waypoints import RandomWaypoints
from greybox.model.known import known_numbers
from greybox.model.model import build_model
from greybox.model.vehicle import read_vehicle
from greybox.plants.effects import GroundEffect, TranslationalLift
from greybox.plants.flight_log import fly, member
from greybox.plants.presets import controller_for, x250
from greybox.plants.quadrotor import Quadrotor
from greybox.plants.vehicle_file import write_vehicle
from greybox.statistics.lasting import Cause
from greybox.symbolic import FloatArray

LOST = 0.12
"""Of the thrust, in the second flight from `WHEN` [s] on."""
WHEN = 9.0
COMMANDS = ("u1", "u2", "u3", "u4")


def fitted(lost: tuple[str, ...] = (), seed: int = 1) -> tuple[Fit, Dataset]:
    """Two flights in gusts, where the thrust of the rotors that are `lost` falls; the plain fit."""
    return _fitted(lost, seed)


@functools.cache
def _fitted(lost: tuple[str, ...], seed: int) -> tuple[Fit, Dataset]:
    """However they are asked for, one fit."""
    calm = x250().process
    plant = x250(process=replace(calm, drift_force=0.1 * 2**0.5, drift_time=1.0))
    data = flown(plant, RandomWaypoints(), 15.0, seed, lost)
    return plain_fit(plant, data), data


def flown(
    plant: Quadrotor, motion: Reference, seconds: float, seed: int = 1, lost: tuple[str, ...] = ()
) -> Dataset:
    """Two flights, where the thrust of the rotors that are `lost` falls in the second."""
    log = fly(
        plant, controller_for(plant), motion, None, seconds, seed=[seed, seed + 1], warm_up=1.0
    )
    data = Dataset(flights=())
    for i in range(2):
        columns = {k: np.array(v) for k, v in member(log, i).items()}
        t = columns.pop("t")
        if i:  # what is logged is more than what the rotors get
            for name in lost:
                columns[name] = columns[name] / np.where(t >= t[0] + WHEN, (1 - LOST) ** 0.5, 1.0)
        data = data + dataset_from_arrays(t, columns, name=f"run{i}")
    return data


def plain_fit(plant: Quadrotor, data: Dataset) -> Fit:
    """A fit that knows no effect of the air."""
    with tempfile.TemporaryDirectory() as folder:
        path = write_vehicle(
            Path(folder) / "v.toml", plant, sigma={"inertia": 0.2, "thrust.c2": 0.2}
        )
        vehicle = read_vehicle(path)
    model = build_model(vehicle, data.channels)
    return fit(model, data, disturbance=("force", "torque"), fixed=("mass", "torque.c2"))


@dataclass(frozen=True, kw_only=True)
class ThenFast:
    """Slow flight about a place, and from 10 s on a circle at 6 m/s."""

    def sample(self, time: FloatArray, rng: np.random.Generator) -> Trajectory:
        slow = RandomWaypoints(speed=0.8).sample(time, rng).position
        ramp = np.clip((time - 10.0) / 2.0, 0.0, 1.0)
        angle = np.cumsum(3.0 * ramp**2 - 2.0 * ramp**3) * (time[1] - time[0])
        circle = 6.0 * np.column_stack([np.cos(angle) - 1.0, np.sin(angle), 0.0 * angle])
        return from_positions(time, slow + circle, 0.0 * time)


@dataclass(frozen=True, kw_only=True)
class ThenHigh:
    """Slow flight by the ground, and from 10 s on far above it."""

    def sample(self, time: FloatArray, rng: np.random.Generator) -> Trajectory:
        slow = RandomWaypoints(speed=0.8).sample(time, rng).position
        slow[:, 2] *= 0.15 / np.abs(slow[:, 2]).max()
        ramp = np.clip((time - 10.0) / 3.0, 0.0, 1.0)
        slow[:, 2] += 0.25 + 2.5 * (3.0 * ramp**2 - 2.0 * ramp**3)
        return from_positions(time, slow, 0.0 * time)


@functools.cache
def fast(lift: float, lost: tuple[str, ...] = ()) -> tuple[Fit, Dataset]:
    """Two flights that get fast, with a lift of the rotors' forward flight that the fit lacks."""
    data = flown(x250([TranslationalLift(k_h=lift)] if lift else []), ThenFast(), 20.0, lost=lost)
    return plain_fit(x250(), data), data


def seen_in(found: Fit, data: Dataset) -> Unnamed:
    seen = unnamed(found.model, data)
    assert seen is not None
    return seen


def test_thrust_that_is_lost_in_flight_is_told_with_its_time_and_size() -> None:
    found, data = fitted(COMMANDS)
    told = with_lasting(found, data)
    (line,) = told.covariance.changed
    start = data.flights[1].segments[0].t[0]
    assert line.startswith(f"in run1 from {start + WHEN:.1f} s on force.z -")
    (change,) = changes(seen_in(found, data))
    assert change.sizes["force.z"] / seen_in(found, data).weight == pytest.approx(-LOST, abs=0.03)
    assert told.warnings[0] == line and told.summary().splitlines()[2] == f"warning: {line}"
    assert told.summary().count(line) == 1


@pytest.mark.slow
def test_a_rotor_that_is_lost_in_part_is_told_by_its_torque() -> None:
    found, data = fitted(("u1",))
    (change,) = changes(seen_in(found, data))
    assert change.flight == "run1" and {"torque.x", "torque.y"} <= set(change.sizes)
    assert "N m" in with_lasting(found, data).covariance.changed[0]


def test_the_errors_hold_what_changed() -> None:
    found, data = fitted(COMMANDS)
    told, share = (
        with_lasting(found, data),
        lasting_share(seen_in(found, data), changes(seen_in(found, data))),
    )
    assert 0.02 < share < LOST
    relative = told["thrust.c2"].std / told["thrust.c2"].value
    assert 0.95 * np.hypot(share, _relative(found, "thrust.c2")) < relative < LOST
    assert all(told[n].value == e.value for n, e in found.parameters.items())
    known = known_numbers(told.model)
    assert known["thrust.c2"][1] >= (1 - 1e-9) * told["thrust.c2"].std
    np.testing.assert_array_equal(told.model.covariance, found.model.covariance)


@functools.cache
def weaker(both: bool) -> tuple[Fit, Dataset]:
    """Two calm flights in which a rotor gets weaker, the first only where `both` do; the plain fit
    with a lag."""
    plant = x250()
    data = flown(plant, RandomWaypoints(), 15.0, lost=("u1",))
    if both:
        again = flown(plant, RandomWaypoints(), 15.0, seed=3, lost=("u1",))
        data = Dataset(flights=(replace(again.flights[1], name="run0"), data.flights[1]))
    return plain_fit(plant, data), data


@pytest.mark.slow
def test_what_a_change_moves_is_held_by_the_errors_and_no_measurement() -> None:
    """The fit bends a rotor that gets weaker into what it has."""
    found, data = weaker(both=False)
    told, truth = with_lasting(found, data), x250().truth()["parameters"]
    for n in ("thrust.c2", "inertia.xx", "inertia.yy"):
        assert told[n].std > 1.3 * found[n].std
        assert abs(told[n].value - truth[n]) < 2.0 * told[n].std
    seen = seen_in(found, data)
    sharp = replace(found, estimates=replace(found.estimates, parameters=_sharper(found)))
    held, line = with_shift(sharp, seen, changes(seen))
    assert "thrust.c2" in line and "no measurement: that would move" in line
    assert held["thrust.c2"].std > 10 * sharp["thrust.c2"].std


def _sharper(found: Fit) -> dict[str, Estimate]:
    """The estimates with a tenth of their errors."""
    return {n: replace(e, std=0.1 * e.std) for n, e in found.parameters.items()}


@pytest.mark.slow
def test_a_change_that_is_told_in_one_flight_is_found_in_another() -> None:
    """By the likelihood, which knows the place to a few samples; in flights without one it is
    nowhere."""
    for both in (True, False):
        found, data = weaker(both)
        seen = seen_in(found, data)
        start = [f.segments[0].t[0] for f in data]
        (c,) = [c for c in changes(seen) if c.flight == data.flights[1].name]
        rivals = list(Asked(found=found, seen=seen, told=[c]).rivals())
        when = {r.when for r in rivals}
        assert f"{c.flight} from {start[1] + WHEN:.1f} s on" in when
        other = [r for r in rivals if r.price]
        assert bool(other) is both
        for r in other:
            begin = start[0] + r.felt.push.share.argmax() * found.problem.dt
            assert begin == pytest.approx(start[0] + WHEN, abs=0.05)


@pytest.mark.slow
def test_an_effect_that_is_missing_is_no_change_of_the_craft() -> None:
    found, data = fast(2e-3)
    told = with_lasting(found, data)
    assert not told.covariance.changed and not any("drift" in w for w in told.warnings)
    for flight in data.names:
        assert f"in {flight} from 10." in told.covariance.form
    assert "as it flies otherwise: an effect is missing" in told.covariance.form
    step, reason = next_step(job(), told, [])
    assert step.startswith("next: greybox discover") and "flies otherwise" in reason


@pytest.mark.slow
def test_the_ground_that_is_left_is_no_change_of_the_craft() -> None:
    """It is gone within an arm or two of a climb of many."""
    plant = x250([GroundEffect(rotor_radius=0.12, k=3.0)])
    data = flown(plant, ThenHigh(), 20.0)
    found = plain_fit(x250(), data)
    changed = changes(seen_in(found, data))
    assert changed and all(c.flown for c in changed)


@pytest.mark.slow
def test_thrust_that_is_lost_before_the_flight_gets_fast_is_of_the_craft() -> None:
    """A good second at rest tells it; what comes with the speed would not."""
    found, data = fast(0.0, COMMANDS)
    (change,) = (c for c in changes(seen_in(found, data)) if c.flight == "run1")
    when = data.flights[1].segments[0].t[0] + WHEN
    assert change.at == pytest.approx(when, abs=0.6)
    assert change.sizes["force.z"] < 0


def test_a_drift_that_goes_with_the_motion_is_no_battery() -> None:
    seen = seen_in(*fitted())
    rng, n = np.random.default_rng(0), 40
    speed = np.linspace(0.0, 3.0, n)[:, None] + 0.2 * rng.standard_normal((n, 1))
    y = 0.01 * seen.weight * (0.1 * rng.standard_normal((n, 1)) - speed)
    for motion, flown_so in ((speed, True), (rng.standard_normal((n, 1)), False)):
        one = Stretch(flight="a", start=0.0, step=0.5, y=y, motion=(Cause(z=motion),))
        drifting = replace(seen, names=("force.z",), stretches=(one,))
        (change,) = changes(drifting)
        assert change.at is None and change.flown is flown_so
        said = said_of_changes(drifting, [change])
        assert bool(said.flown) is flown_so and bool(said.drifts) is not flown_so


@pytest.mark.parametrize("seed", [1, *(pytest.param(s, marks=pytest.mark.slow) for s in (3, 5))])
def test_in_gusts_nothing_is_said_and_no_error_changes(seed: int) -> None:
    found, data = fitted(seed=seed)
    assert with_lasting(found, data) is found


def _relative(found: Fit, name: str) -> float:
    return found[name].std / found[name].value


def test_a_share_of_the_weight_is_in_thrust_and_in_what_is_told_by_its_side() -> None:
    found, _ = fitted()
    told = _with_share(found, 0.1, 0.1 * 9.81)
    for n in ("thrust.c2", "inertia.xx", "inertia.yy"):
        assert _relative(told, n) == pytest.approx(0.1, rel=0.15)
        assert n in told.covariance.form
    assert "which may be thrust" in told.warnings[0]
    assert "10.0 % of the weight" in told.covariance.form
    assert told["disturbance.torque.T"] == found["disturbance.torque.T"]
    twice = _with_share(told, 0.1, 0.1 * 9.81)
    assert _relative(twice, "thrust.c2") == pytest.approx(0.1 * 2**0.5, rel=0.15)
    assert twice.covariance.form == told.covariance.form  # the errors held it already


def test_what_is_no_measurement_for_two_reasons_is_one_warning() -> None:
    found, _ = fitted()
    rows = {"thrust.c2": [0]}
    told = widened(widened(found, np.eye(1), rows, "one"), np.eye(1), rows, "other")
    assert told.covariance.form == told.warnings[0] == "one; other"
    assert told.warnings[1:] == found.warnings
    assert told["thrust.c2"].std == pytest.approx(np.hypot(found["thrust.c2"].std, 2**0.5))
    assert told["inertia.xx"] == found["inertia.xx"]


def test_a_force_that_the_whole_flight_carries_is_no_change() -> None:
    found, data = fitted()
    seen = seen_in(found, data)
    carried = [replace(s, y=s.y + 0.1 * seen.weight * (np.arange(4) == 0)) for s in seen.stretches]
    lifted = replace(seen, stretches=tuple(carried))
    assert not changes(lifted)
    assert lasting_share(lifted, ()) == pytest.approx(0.1, abs=0.02)


def test_levels_on_two_sides_are_not_the_thrust() -> None:
    level, rng = 0.05, np.random.default_rng(0)
    one, other = (sign * level + 0.01 * rng.standard_normal(30) for sign in (1, -1))
    assert steady_share([one, one]) == pytest.approx(level, rel=0.1)
    assert steady_share([one, other]) == 0.0
    assert steady_share([10 * (one - level) + level]) == 0.0


def test_a_drift_is_said_with_all_its_flights() -> None:
    seen = seen_in(*fitted())
    falls = [
        Changed(flight=f, at=None, sizes={"force.z": -x * seen.weight})
        for f, x in (("a", 0.03), ("b", 0.06))
    ]
    said = said_of_changes(seen, falls)
    (line,) = said.drifts
    assert (
        not said.steps
        and not said.flown
        and "force.z -6.0 % of the weight in a, b" in line
        and "battery" in line
    )


def test_what_cannot_be_smoothed_stays_as_it_is() -> None:
    found, data = fitted()
    lost = replace(found.status, code=type(found.status.code).MAX_ITERATIONS)
    other = replace(found, diagnostics=replace(found.diagnostics, status=lost))
    assert with_lasting(other, data) is other
    calm = fit(found.problem.dynamics, data, free=()).model.physics
    assert unnamed(fit(calm, data, free=()).model, data) is None


def job() -> Any:
    arguments = argparse.Namespace(
        vehicle="v.toml",
        train=["a.csv"],
        test=[],
        mapping=None,
        accept="",
        effects_file=[],
        keep_impossible=False,
    )
    return SimpleNamespace(arguments=arguments)


def test_the_next_step_is_to_fit_the_parts_apart_and_then_to_name_what_is_missing() -> None:
    changed = ("in run1 from 9.0 s on force.z -12.0 %",)
    apart = "next: fit apart what was flown before and after: in run1 from 9.0 s on force.z -12.0 %"
    sure: Any = SimpleNamespace(covariance=SimpleNamespace(beyond="", form="", changed=changed))
    assert next_step(job(), sure, []) == [apart]
    form = "thrust.c2 is no measurement"
    result: Any = SimpleNamespace(covariance=SimpleNamespace(beyond="", form=form, changed=changed))
    assert next_step(job(), result, []) == [
        apart,
        "then: greybox discover --vehicle v.toml --train a.csv",
        f"  {form}",
    ]


def test_what_is_flown_after_a_gap_is_of_the_level_after_the_change() -> None:
    model = fitted()[0].model
    weight = model.values["mass"] * model.physics.vehicle.gravity
    high, low = 0.06 * weight * np.ones((10, 1)), -0.06 * weight * np.ones((10, 1))
    cut = [Changed(flight="a", at=5.0, sizes={"force.z": -0.12 * weight})]

    def share(*parts: np.ndarray) -> float:
        starts = np.cumsum([0, *(0.5 * len(p) for p in parts[:-1])])
        stretches = tuple(
            Stretch(
                flight="a",
                start=float(t),
                step=0.5,
                y=p + 1e-6 * weight * np.arange(len(p))[:, None],
            )
            for t, p in zip(starts, parts, strict=True)
        )
        return lasting_share(Unnamed(model=model, names=("force.z",), stretches=stretches), cut)

    assert share(np.concatenate([high, low])) == pytest.approx(0.06, rel=0.01)
    assert share(high, low) == pytest.approx(0.06, rel=0.01)
