"""The halves of one flight are what lies well before its middle and well after it, whatever holes
it has."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.data import Dataset, Segment
from greybox.data.dataset import Flight
from greybox.data.halves import APART, halves

DT = 0.01


def stretch(begin: float, rows: int) -> Segment:
    t = begin + DT * np.arange(rows)
    return Segment(t=t, channels={"p": t}, flight="one")


def stamps(data: Dataset) -> np.ndarray:
    return np.concatenate([s.t for f in data for s in f.segments])


@pytest.mark.parametrize("lengths", [(800,), (400, 400), (100, 30, 500, 60, 250), (20,) * 40])
@pytest.mark.parametrize("hole", [0.05, 3.0])
def test_nothing_is_lost_but_around_the_middle(lengths: tuple[int, ...], hole: float) -> None:
    begins = np.cumsum([0.0, *(DT * n + hole for n in lengths[:-1])])
    flight = Flight(
        name="one", segments=tuple(stretch(b, n) for b, n in zip(begins, lengths, strict=True))
    )
    whole = stamps(Dataset(flights=(flight,)))
    sides = halves(Dataset(flights=(flight,)))
    assert [{s.flight for s in f.segments} for h in sides for f in h] == [{"one"}, {"one (late)"}]
    early, late = map(stamps, sides)
    assert late[0] - early[-1] >= APART - 1e-9
    middle = whole[whole.size // 2]
    lost = np.setdiff1d(whole, np.concatenate([early, late]))
    # a row that is alone in a segment goes with them
    assert (np.abs(lost - middle) <= APART / 2 + DT).all()
    assert len(early) + len(late) >= whole.size - APART / DT - 3
