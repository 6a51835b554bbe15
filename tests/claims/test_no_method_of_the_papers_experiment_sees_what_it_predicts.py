"""Replace everything that was measured or commanded at one instant of the test part: no method's
prediction of it moves.

The paper's literal form does move: that is the leak which the study shows apart.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.data import Dataset
from scenarios.studies.paper_data import CHANNELS, EULER, paper_data
from scenarios.studies.paper_methods import LEAKS, METHODS, Bench

ROW = 2600
QUICK = ("PEM nonlinear",)


def tampered(data):
    """The record with every channel of one row replaced by that of another instant, four seconds
    before."""
    segment, now = data.segment, np.arange(data.segment.n) == ROW
    moved = segment.replace(
        {
            n: np.where(now, segment.channels[n][ROW - 400], segment.channels[n])
            for n in (*CHANNELS, *EULER)
        }
    )
    flight = replace(data.record.flights[0], segments=(moved,))
    return replace(data, record=Dataset(flights=(flight,)))


def predictions(method, budget=1):
    data = paper_data(5)
    return [method(Bench(data=d, budget=budget)).mean for d in (data, tampered(data))]


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in METHODS]
)
def test_the_instant_itself_does_not_matter_but_the_next_one_feels_it(name):
    before, after = predictions(METHODS[name])
    assert after[ROW] == pytest.approx(before[ROW], rel=1e-9, abs=1e-9)
    assert np.abs(after[ROW + 1] - before[ROW + 1]).max() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("name", LEAKS)
def test_a_leak_is_caught_by_the_same_test(name):
    pytest.importorskip("gpytorch")
    before, after = predictions(LEAKS[name])
    assert np.abs(after[ROW] - before[ROW]).max() > 1e-2
