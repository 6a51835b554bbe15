"""Before the first flight it is said how many there will be and what for, and the time that is left
is that of all of them."""

import time
from types import SimpleNamespace

import pytest

from greybox.progress import in_words
from mpc_export.mission import campaign
from mpc_export.mission.campaign import Entry, flights
from mpc_export.mission.prepare import (
    OF_A_MODEL,
    REHEARSALS,
    REHEARSED,
    TUNING,
    MissionOptions,
    _ahead,
    _tightened,
)


def test_the_flights_are_counted_before_the_first():
    every = REHEARSALS * len(REHEARSED)
    told = _ahead(MissionOptions(flights=2), len(OF_A_MODEL))
    assert (told.rehearsals, told.judging) == (every, 8)
    assert f"{TUNING} training flights, then {every} rehearsals" in told.words
    assert f"{TUNING + every + 8} flights in all" in told.words
    boole = _ahead(MissionOptions(flights=2, risk="boole"), len(OF_A_MODEL))
    assert boole.rehearsals == 0 and f"{TUNING + 8} flights in all" in boole.words


def test_the_controllers_that_are_counted_are_those_that_fly():
    plain = Entry(name="mean", text="", model="")
    tuning = {"kappa": 1.0, "moved": 0.01}
    assert tuple(e.name for e in (plain, *_tightened(plain, tuning, 0.1))) == OF_A_MODEL


@pytest.mark.parametrize("later", [0, 36])
@pytest.mark.parametrize("jobs", [1, 2])
def test_the_time_left_counts_what_is_flown_later(jobs, later, tmp_path, monkeypatch):
    row = {"controller": "mean", "crashed": False, "margins": {"a": 0.001}, "seconds": 1.0}
    took = (60.0, 180.0, 120.0, 120.0)
    rows = [({**row, "seed": s}, seconds) for s, seconds in enumerate(took)]
    monkeypatch.setattr(campaign, "_run", lambda *_: iter(rows))
    hangar = SimpleNamespace(campaign=SimpleNamespace(out=tmp_path, key=lambda _: "k"))
    entries = [Entry(name="mean", text="", model="")]
    said = []
    flights(hangar, entries, range(4), jobs=jobs, later=later, say=said.append)
    means = (60.0, 120.0, 120.0, 120.0)
    seconds = [m * (4 + later - n) / jobs for n, m in enumerate(means, 1)]
    expected = [f"1 mm from the nearest limit, {in_words(s)}" for s in seconds if s]
    assert [line.partition(": mean, flight ")[2][3:] for line in said[: len(expected)]] == expected
    assert len(said) == 4 and ("left" in said[-1]) == bool(later)


def test_a_controller_that_is_compiled_first_is_no_part_of_a_flight():
    clock = []

    class Slow:
        def pilot(self, entry):
            time.sleep(0.2)
            clock.append(time.monotonic())

        def fly(self, entry, seed, **_):
            self.pilot(entry) if not clock else None
            return {"seed": seed}

    row, seconds = campaign._flown(Entry(name="mean", text=""), 3, None, False, Slow())
    assert row == {"seed": 3} and clock and seconds < 0.1
