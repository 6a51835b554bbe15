"""Input that is wrong ends in a usable model with what was done about it, or NOT USABLE with
why."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

import greybox as gb
from greybox.automatic.fit import read_flights
from greybox.data.raw import RawLog
from greybox.errors import VehicleError
from greybox.estimation.result import Fit
from greybox.model.plausibility import vehicle_findings
from greybox.model.vehicle import Vehicle
from greybox.model.verdict import Outcome
from greybox.plants.vehicle_file import write_vehicle
from greybox.validation.sanity import sanity_of
from tests.automatic.craft import IMU, POSE, RATES, flown, plant, raw, vehicle

TRUE = {n: float(v) for n, v in plant().truth()["parameters"].items()}
LAG = ("motor_lag.tau", "command_delay.d")


def logs(*seeds: int, sensors: Sequence[str] = RATES) -> list[RawLog]:
    names = {"u1", "u2", "u3", "u4", *sensors}
    flights = [raw(c, f"run{s}") for s, c in zip(seeds, flown(seeds, 7.0), strict=True)]
    kept = [{n: v for n, v in r.channels.items() if n in names} for r in flights]
    return [replace(r, channels=c) for r, c in zip(flights, kept, strict=True)]


def fitted(flights: Sequence[RawLog], of: Vehicle) -> Fit:
    return gb.fit(of, read_flights(flights, of), accept=["vehicle"])


def usable(found: Fit) -> bool:
    return found.verdict is not None and found.verdict.outcome is Outcome.USABLE


@pytest.mark.slow
def test_sample_times_that_differ_by_0_04_percent_are_one_clock_and_change_nothing():
    one, two = logs(1, 2)
    found = fitted([one, replace(two, t=two.t * 1.0004)], vehicle())
    assert usable(found)
    assert all(any("clock: uniform, 100 Hz" in n for n in f["notes"]) for f in found.flights)
    for name in ("inertia.xx", "inertia.yy", *LAG):
        assert found[name].value == pytest.approx(TRUE[name], rel=0.02)


@pytest.mark.slow
def test_a_log_of_another_vehicle_is_left_out_named_and_does_not_bend_the_rest():
    own = logs(1, 2, 3)
    commands = {n: v * (0.55 if n[0] == "u" else 1.0) for n, v in own[1].channels.items()}
    found = fitted([own[0], replace(own[1], channels=commands), own[2]], vehicle())
    assert usable(found)
    assert [f["name"] for f in found.flights] == ["run1", "run3"]
    (said,) = [d for d in found.decisions if d.about == "flights"]
    assert said.choice == "run2 left out" and "another craft" in said.reason
    for name in ("inertia.xx", *LAG):
        assert found[name].value == pytest.approx(TRUE[name], rel=0.02)


def off_by(name: str, factor: float) -> Vehicle:
    """The vehicle file with one number that is not true."""
    with tempfile.TemporaryDirectory() as folder:
        sigma = {"inertia": 0.2, "thrust.c2": 0.2, "mass": 0.03}
        path = Path(folder) / "v.toml"
        write_vehicle(path, plant(), sigma=sigma, errors={name: factor}, schema="greybox.vehicle/2")
        return gb.read_vehicle(path)


def holds(found: Fit, stated: Vehicle, *names: str) -> None:
    """NOT USABLE and why; else one of these numbers is said to be wrong (by the estimates or,
    before the fit, by the file itself), or all of them came out right."""
    assert found.verdict is not None
    if found.verdict.refused:
        assert found.verdict.reason and found.verdict.action
        return
    said = {p for f in sanity_of(found).findings for p in f.parameters}
    said |= {f.where for f in vehicle_findings(stated)}
    known = {n: found.parameters[n] for n in names if n in found.parameters}
    right = len(known) == len(names) and all(
        abs(e.value / TRUE[n] - 1) < 0.15 for n, e in known.items()
    )
    assert said & set(names) or right, (sanity_of(found).lines(), known)


PARTNERS = {
    "mass": ("mass", "thrust.c2"),
    "thrust.c2": ("mass", "thrust.c2"),
    "inertia.yy": ("inertia.yy",),
    "torque.c2": ("torque.c2", "inertia.zz"),
    "inertia.zz": ("torque.c2", "inertia.zz"),
}
"""Number of the file -> those that can stand for it."""
CASES = [(n, f) for n in PARTNERS for f in (3.0, 1 / 3) if (n, f) != ("inertia.zz", 3.0)]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "factor"), CASES)
def test_a_vehicle_file_off_by_three_in_one_number_is_said_or_comes_right_or_is_not_usable(
    name, factor
):
    stated = off_by(name, factor)
    holds(fitted(logs(1, 2, sensors=(*IMU, *POSE)), stated), stated, *PARTNERS[name])


def test_a_moment_three_times_too_large_for_any_body_is_refused_by_name():
    with pytest.raises(VehicleError, match="inertia: no body has the principal moments"):
        off_by("inertia.zz", 3.0)
