"""Samples that a log carries on until the next one are those of a slower stream: of what is
measured the first counts, and held commands are said. What stands still by itself is neither."""

from __future__ import annotations

import functools
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from faults import real, vehicle

from greybox.automatic.fit import prepare
from greybox.data import RawLog, dataset_from_arrays, read_log, read_table
from greybox.data.checks import check
from greybox.data.checks.finding import Finding
from greybox.data.repeats import held_over, without_repeats
from greybox.excitation import RandomWaypoints, rich_excitation
from greybox.model.vehicle import Vehicle, read_vehicle
from greybox.plants.effects import MotorLag
from greybox.plants.flight_log import fly, write_log
from greybox.plants.presets import controller_for, x250
from greybox.plants.vehicle_file import write_vehicle

P, V, Q = ("x", "y", "z"), ("vx", "vy", "vz"), ("qw", "qx", "qy", "qz")
COMMANDS = ("u1", "u2", "u3", "u4")


class Slow:
    """A controller that sends a command at every so many steps only."""

    def __init__(self, inner, every: int) -> None:
        self.inner, self.every, self.feedback = inner, every, inner.feedback
        self.reset()

    def reset(self) -> None:
        self.inner.reset()
        self.steps, self.sent = 0, None

    def __call__(self, seen, goal, dt, inject):
        if self.steps % self.every == 0:
            self.sent = self.inner(seen, goal, dt * self.every, inject)
        self.steps += 1
        return self.sent


@functools.cache
def flown(every: int = 1) -> tuple[RawLog, Vehicle]:
    """Twenty seconds at 100 Hz of a craft that is sent a command at every so many rows."""
    plant = x250([MotorLag(tau=0.04)])
    controller = Slow(controller_for(plant), every)
    log = fly(plant, controller, RandomWaypoints(), rich_excitation(), 20.0, seed=5)
    with tempfile.TemporaryDirectory() as folder:
        write_vehicle(Path(folder) / "vehicle.toml", plant)
        craft = read_vehicle(Path(folder) / "vehicle.toml")
        return read_table(write_log(Path(folder) / "log.csv", log, drop=["omega"]), craft), craft


def carried_on(raw: RawLog, names: tuple[str, ...], pace: float) -> RawLog:
    """The log in which the first of every `pace` rows stands in all of them."""
    steps = np.arange(raw.n)
    first = np.ceil(np.floor(steps / pace) * pace).astype(int)
    return replace(raw, channels={**raw.channels, **{n: raw.channels[n][first] for n in names}})


def of_held(raw: RawLog, craft: Vehicle) -> tuple[Finding, ...]:
    return check([raw], craft).of("held")


@pytest.mark.parametrize(
    "pace", [2, 7.5, 20, *(pytest.param(p, marks=pytest.mark.slow) for p in (2.5, 3, 10))]
)
def test_of_a_pose_that_is_carried_on_only_the_first_of_each_run_counts(pace: float) -> None:
    raw, craft = flown()
    made = carried_on(raw, (*P, *Q), pace)
    out = without_repeats(made)
    first = np.unique(np.ceil(np.floor(np.arange(raw.n) / pace) * pace).astype(int))
    for name in (*P, *Q):
        kept = np.flatnonzero(np.isfinite(out.channels[name]))
        np.testing.assert_array_equal(kept, first)
        np.testing.assert_array_equal(out.channels[name][kept], raw.channels[name][kept])
    assert out.channels["vx"] is made.channels["vx"]
    assert len(out.notes) == len(made.notes) + 2
    said = {f.where: f for f in of_held(made, craft)}
    assert set(said) == {", ".join(P), ", ".join(Q)}
    assert all(f.severity == "info" and "of which the first counts" in f.message
               for f in said.values())  # fmt: skip
    assert without_repeats(out) is out


def test_a_log_that_is_read_has_no_repeats_either(tmp_path: Path) -> None:
    raw, craft = flown()
    made = carried_on(raw, P, 10)
    path = write_log(tmp_path / "log.csv", {"t": made.t, **made.channels})
    flight = read_log(path, craft)
    x = np.concatenate([s.matrix(["x"])[:, 0] for s in flight.segments])
    assert 0.08 < np.isfinite(x).mean() < 0.12
    assert any("position: every sample comes 10 times" in n for n in flight.notes)


def test_what_stands_still_by_itself_or_has_coarse_steps_is_not_held() -> None:
    raw, craft = flown()
    coarse = {n: np.round(raw.channels[n], 2) for n in (*P, *V, *Q)}
    coarse |= {n: np.round(raw.channels[n], 1) for n in "pqr"}
    coarse |= {n: np.round(raw.channels[n], 2) for n in COMMANDS}
    assert not of_held(replace(raw, channels={**raw.channels, **coarse}), craft)
    still = {n: np.where(np.arange(raw.n) < 900, v[900], v) for n, v in raw.channels.items()}
    assert without_repeats(replace(raw, channels=still)).channels["x"] is still["x"]
    walk = np.cumsum(np.random.default_rng(2).random((5000, 1)) < 0.4, axis=0).astype(float)
    assert held_over(walk) == 1


@pytest.mark.parametrize("flight", ["B2_circle_medium_rep1", "B8_star_fast_rep2"])
def test_real_flights_are_not_held(flight: str) -> None:
    assert not of_held(real("nanobench", flight), vehicle("nanobench"))


@pytest.mark.parametrize("pace", [5, 10])
def test_commands_that_were_sent_faster_than_logged_are_warned_of(pace: int) -> None:
    raw, craft = flown()
    (found,) = of_held(carried_on(raw, COMMANDS, pace), craft)
    assert found.severity == "warning"
    assert (
        f"change every {10 * pace} ms only ({pace} rows), but the motion follows" in found.message
    )
    assert f"{5 * pace} ms old on average" in found.message
    assert found.evidence["interval_s"] == pytest.approx(0.01 * pace)


@pytest.mark.parametrize("pace", [5, *(pytest.param(p, marks=pytest.mark.slow) for p in (3, 10))])
def test_commands_that_are_sent_slowly_are_as_logged(pace: int) -> None:
    (found,) = of_held(*flown(pace))
    assert found.severity == "info" and "and so does the motion" in found.message


def test_where_no_motion_tells_both_are_said() -> None:
    raw, craft = flown()
    blind = {n: v for n, v in raw.channels.items() if n not in "pqr"}
    (found,) = of_held(carried_on(replace(raw, channels=blind), COMMANDS, 10), craft)
    assert (
        found.severity == "warning" and "does not tell whether they were sent so" in found.message
    )


def test_an_imu_that_repeats_is_warned_of() -> None:
    raw, craft = flown()
    (found,) = of_held(carried_on(raw, ("p", "q", "r"), 2), craft)
    assert found.severity == "warning" and "every sample comes 2 times" in found.message


def test_equal_stamps_of_a_held_log_are_the_clocks_finding():
    """A rate of stamps that are equal was a division by zero."""
    raw, craft = flown()
    slow = carried_on(raw, (*P, *V, *Q), 10)
    for t in (np.floor(slow.t / 0.05) * 0.05, np.full(slow.n, 3.0)):
        found = check([replace(slow, t=t)], craft).findings
        assert any(f.check == "clock" and f.severity == "blocking" for f in found)


def test_a_slow_pose_that_freezes_is_found():
    raw, craft = flown()
    slow = carried_on(raw, (*P, *V, *Q), 10)
    stuck = {n: slow.channels[n].copy() for n in P}
    for v in stuck.values():
        v[800:1100] = v[800]
    found = check([replace(slow, channels={**slow.channels, **stuck})], craft).findings
    frozen = [f for f in found if f.check == "frozen"]
    assert [f.severity for f in frozen] == ["blocking"]
    assert frozen[0].evidence["longest_s"] == pytest.approx(3.0, abs=0.15)
    assert not any(f.check == "frozen" for f in check([slow], craft).findings)


def test_flights_in_memory_lose_their_repeats_too():
    raw, craft = flown()
    slow = carried_on(raw, (*P, *V, *Q), 10)
    data = dataset_from_arrays(slow.t, dict(slow.channels))
    kept = prepare(craft, data, decide_rate=False).data
    x = np.concatenate([s.channels["x"] for f in kept for s in f.segments])
    assert 0.05 < np.isfinite(x).mean() < 0.2


@pytest.mark.parametrize("names", [V, Q])
def test_a_stream_that_stands_still_is_frozen_and_of_no_unit(names):
    """Zeros for a velocity were 8.1e+150 times as small as the motion, and a unit was blamed."""
    raw, craft = flown()
    still = {n: np.zeros(raw.n) for n in names} | ({"qw": np.ones(raw.n)} if names == Q else {})
    found = check([replace(raw, channels={**raw.channels, **still})], craft).findings
    blocked = {f.check for f in found if f.severity == "blocking"}
    assert "frozen" in blocked
    assert not blocked & {"motion", "attitude"}
