"""A log of motion capture alone does not say with which rates a flight begins; this must not decide about names."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.data import Dataset
from greybox.discovery.candidates import candidates
from greybox.discovery.lead import led
from greybox.discovery.name import next_addition
from greybox.discovery.nested import Nest
from greybox.discovery.veto import HeldOut
from scenarios.studies.discovery_cells import Cell, flown, nominal
from tests.discovery.small_world import shorten

SEED = 42


def searched(*hidden: str) -> tuple[Nest, Dataset]:
    """A short catalogue on flights of 8 s with pose and velocity alone, and a test flight."""
    cell = Cell(hidden=hidden, columns="mocap", seconds=8.0)
    _, plant, _, train, test = next(flown(cell, [SEED]))
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch, "products_of_inertia", "command_delay", "pose_delay", "sensor_delay")
        offered = candidates(nominal(plant, "off", SEED), train.channels, sample_time=0.01)
    return Nest(candidates=offered, data=led(train)), test


@pytest.mark.parametrize(
    ("columns", "late"), [("mocap", "pose_delay"), ("imu", "sensor_delay"), ("full", None), ("rotors", None), ("pose", None)]
)
def test_all_that_is_measured_is_late_alike_in_few_logs(columns: str, late: str | None):
    cell = Cell(columns=columns, seconds=1.0)
    _, plant, _, train, _ = next(flown(cell, [SEED]))
    assert candidates(nominal(plant, "off", SEED), train.channels, sample_time=0.01).late_alike == late


def test_flights_that_begin_turning_do_not_contradict_what_is_there():
    nest, test = searched("products_of_inertia")
    bare = nest.refit(())
    named = nest.refit(("products_of_inertia",), start=bare)
    assert bare.bic - named.bic > 100
    judge = HeldOut(test)
    assert judge.withheld(bare, named) is None
    gain = judge.foresight(named).logliks - judge.foresight(bare).logliks
    assert (gain > 0).all()
    # The seconds that tell how the flight begins are not judged: the first of these had outweighed all others.
    assert np.size(gain) < 4


def test_poses_that_are_late_are_commands_that_are_late():
    nest, _ = searched("pose_delay")
    assert nest.candidates.late_alike == "pose_delay"
    found = next_addition(nest, (at := nest.refit(())), nest.screen(at), 0.05)
    assert found is not None
    assert found.rivals == {"command_delay": 0.5, "pose_delay": 0.5}
