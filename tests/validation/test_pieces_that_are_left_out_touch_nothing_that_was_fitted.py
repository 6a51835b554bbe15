"""Left-out pieces are a guard away from what was fitted, lose nothing else, and keep the names of
their flights."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from greybox.data import Dataset, Flight, Segment
from greybox.errors import DataError
from greybox.validation.pieces import GUARD, SHORTEST, Split, alternating, folds, leave_out

DT = 0.02


def flight(name: str, seconds: float = 30.0, *, start: float = 100.0, gap: bool = False) -> Flight:
    t = start + DT * np.arange(round(seconds / DT))
    parts = (t,) if not gap else (t[: len(t) // 2], t[len(t) // 2 + 25 :])
    return Flight(
        name=name,
        segments=tuple(Segment(t=p, channels={"p": np.sin(p)}, flight=name) for p in parts),
    )


def times(data: Dataset, name: str) -> np.ndarray:
    return np.concatenate([s.t for s in data[name].segments]) if name in data.names else np.zeros(0)


DATA = Dataset(flights=(flight("a"), flight("b", 40.0, gap=True)))
SPLITS: dict[str, Callable[[Dataset], list[Split]]] = {
    "last third": lambda data: [leave_out(data)],
    "folds": lambda data: list(folds(data, count=3)),
    "alternating": lambda data: [alternating(data, seconds=6.0)],
}


@pytest.mark.parametrize("how", SPLITS)
def test_every_left_out_sample_is_a_guard_away_from_every_fitted_one(how: str) -> None:
    for split in SPLITS[how](DATA):
        for name in ("a", "b"):
            fitted, left = times(split.fitted, name), times(split.left_out, name)
            assert len(fitted) > 0
            assert len(left) > 0
            assert np.abs(fitted[:, None] - left[None, :]).min() >= GUARD - 1e-6
        for side in (split.fitted, split.left_out):
            assert all(s.n * s.dt >= SHORTEST - 1e-9 for f in side for s in f.segments)


def test_a_third_is_left_out_at_the_end() -> None:
    split = leave_out(DATA)
    assert split.fitted.names == split.left_out.names == ("a", "b")
    assert times(split.left_out, "a")[-1] == times(DATA, "a")[-1]
    assert len(times(split.left_out, "a")) * DT == pytest.approx(10.0 - GUARD / 2, abs=2 * DT)


def test_folds_cover_the_flights_but_for_the_cuts() -> None:
    seen = np.concatenate([times(s.left_out, "a") for s in folds(DATA, count=3)])
    assert len(seen) == len(np.unique(seen))
    assert len(times(DATA, "a")) - len(seen) == pytest.approx(2 * GUARD / DT, abs=4)


def test_samples_are_those_of_the_flight() -> None:
    part = folds(DATA, count=3)[1].left_out["a"].segments[0]
    np.testing.assert_array_equal(part.channels["p"], np.sin(part.t))


def test_what_cannot_be_split_is_refused() -> None:
    with pytest.raises(DataError, match="too short"):
        leave_out(Dataset(flights=(flight("a", 4.0),)))
    with pytest.raises(DataError, match="between 0 and 1"):
        leave_out(DATA, share=1.0)
    with pytest.raises(DataError, match="two or more"):
        folds(DATA, count=1)
    with pytest.raises(DataError, match="alternating"):
        alternating(DATA, seconds=1.0)
