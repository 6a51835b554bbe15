"""Before the first flight it is said how many there will be and what for, and the time that is left
is that of all of them."""

from types import SimpleNamespace

import pytest

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
def test_the_time_left_counts_what_is_flown_later(later, tmp_path, monkeypatch):
    shares = []

    class Left:
        def after(self, share):
            shares.append(share)
            return ""

    row = {"controller": "mean", "crashed": False, "margins": {}, "seconds": 1.0}
    monkeypatch.setattr(campaign, "TimeLeft", Left)
    monkeypatch.setattr(campaign, "_run", lambda *_: ({**row, "seed": s} for s in range(4)))
    hangar = SimpleNamespace(campaign=SimpleNamespace(out=tmp_path, key=lambda _: "k"))
    entries = [Entry(name="mean", text="", model="")]
    flights(hangar, entries, range(4), later=later, say=lambda _: None)
    assert shares == pytest.approx([n / (4 + later) for n in (1, 2, 3, 4)])
