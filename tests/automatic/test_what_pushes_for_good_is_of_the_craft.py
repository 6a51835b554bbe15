"""A craft that changes in flight is told from one in gusts, with the time and the size, and a force
that lasts is in the errors of what it may be: of thrust, and of what is told by its side."""

from __future__ import annotations

import argparse
import functools
import tempfile
from dataclasses import replace
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
from greybox.automatic.widened import widened
from greybox.commands.fit_said import next_step
from greybox.data import Dataset, dataset_from_arrays
from greybox.estimation.fit import fit
from greybox.estimation.result import Fit
from greybox.excitation.waypoints import RandomWaypoints
from greybox.model.known import known_numbers
from greybox.model.model import build_model
from greybox.model.vehicle import read_vehicle
from greybox.plants.flight_log import fly, member
from greybox.plants.presets import controller_for, x250
from greybox.plants.vehicle_file import write_vehicle

LOST = 0.12
"""Of the thrust, in the second flight from `WHEN` [s] on."""
WHEN = 9.0
COMMANDS = ("u1", "u2", "u3", "u4")


@functools.cache
def fitted(lost: tuple[str, ...] = (), seed: int = 1) -> tuple[Fit, Dataset]:
    """Two flights in gusts, where the thrust of the rotors that are `lost` falls; the plain fit."""
    calm = x250().process
    plant = x250(process=replace(calm, drift_force=0.1 * 2**0.5, drift_time=1.0))
    log = fly(
        plant,
        controller_for(plant),
        RandomWaypoints(),
        None,
        15.0,
        seed=[seed, seed + 1],
        warm_up=1.0,
    )
    data = Dataset(flights=())
    for i in range(2):
        columns = {k: np.array(v) for k, v in member(log, i).items()}
        t = columns.pop("t")
        if i:  # what is logged is more than what the rotors get
            for name in lost:
                columns[name] = columns[name] / np.where(t >= t[0] + WHEN, (1 - LOST) ** 0.5, 1.0)
        data = data + dataset_from_arrays(t, columns, name=f"run{i}")
    with tempfile.TemporaryDirectory() as folder:
        path = write_vehicle(
            Path(folder) / "v.toml", plant, sigma={"inertia": 0.2, "thrust.c2": 0.2}
        )
        vehicle = read_vehicle(path)
    model = build_model(vehicle, data.channels)
    found = fit(model, data, disturbance=("force", "torque"), fixed=("mass", "torque.c2"))
    return found, data


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
    assert relative == pytest.approx(np.hypot(share, _relative(found, "thrust.c2")), rel=0.1)
    assert all(told[n].value == e.value for n, e in found.parameters.items())
    known = known_numbers(told.model)
    assert known["thrust.c2"][1] == pytest.approx(told["thrust.c2"].std, rel=1e-9)
    np.testing.assert_array_equal(told.model.covariance, found.model.covariance)


@pytest.mark.parametrize("seed", [1, 3, 5])
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
    steps, (line,) = said_of_changes(seen, falls)
    assert not steps and "force.z -6.0 % of the weight in a, b" in line and "battery" in line


def test_what_cannot_be_smoothed_stays_as_it_is() -> None:
    found, data = fitted()
    lost = replace(found.status, code=type(found.status.code).MAX_ITERATIONS)
    other = replace(found, diagnostics=replace(found.diagnostics, status=lost))
    assert with_lasting(other, data) is other
    calm = fit(found.problem.dynamics, data, free=()).model.physics
    assert unnamed(fit(calm, data, free=()).model, data) is None


def test_the_next_step_is_to_fit_the_parts_apart_and_to_name_what_is_missing() -> None:
    arguments = argparse.Namespace(
        vehicle="v.toml",
        train=["a.csv"],
        test=[],
        mapping=None,
        accept="",
        effects_file=[],
        keep_impossible=False,
    )
    job: Any = SimpleNamespace(arguments=arguments)
    changed = ("in run1 from 9.0 s on force.z -12.0 %",)
    apart = "next: fit apart what was flown before and after: in run1 from 9.0 s on force.z -12.0 %"
    sure: Any = SimpleNamespace(covariance=SimpleNamespace(form="", changed=changed))
    assert next_step(job, sure, []) == [apart]
    form = "thrust.c2 is no measurement"
    result: Any = SimpleNamespace(covariance=SimpleNamespace(form=form, changed=changed))
    assert next_step(job, result, []) == [
        f"next: greybox discover --vehicle v.toml --train a.csv: {form}",
        apart,
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
