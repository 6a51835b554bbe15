"""The level is one that every learner reaches, and of each learner the quickest size within it
counts."""

from __future__ import annotations

import pytest

pytest.importorskip("gpytorch")

from benchmarks.learner_time import Size, chosen


def size(learner: str, number: int, error: float, microseconds: float) -> Size:
    return Size(
        learner=learner,
        size=number,
        numbers=number,
        validation=error,
        test=error,
        truth=error,
        microseconds={"mean": microseconds / 2, "mean and Jacobian": microseconds},
    )


def test_the_worst_learner_sets_the_level_and_larger_sizes_of_the_others_do_not_count() -> None:
    rows = [
        size("GP", 10, 0.5, 1.0),
        size("GP", 30, 0.3, 2.0),
        size("GP", 100, 0.1, 5.0),
        size("LSTM", 4, 0.6, 3.0),
        size("LSTM", 16, 0.35, 7.0),
        size("LSTM, 2 layers", 16, 0.4, 30.0),
        size("MLP", 4, 0.2, 4.0),
    ]
    level, best = chosen(rows)
    assert level == 0.35, "the best of the LSTM, which is worst"
    assert {(r.learner, r.size) for r in best} == {("GP", 30), ("LSTM", 16), ("MLP", 4)}


def test_of_two_sizes_within_the_level_the_quicker_counts_though_its_error_is_higher() -> None:
    level, best = chosen(
        [size("GP", 10, 0.3, 9.0), size("GP", 30, 0.2, 8.0), size("MLP", 4, 0.4, 1.0)]
    )
    assert level == 0.4
    assert {(r.learner, r.size) for r in best} == {("GP", 30), ("MLP", 4)}
