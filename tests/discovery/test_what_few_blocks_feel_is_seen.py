"""Candidates that are felt in a few stretches of a flight are tested where block scores are blind, and keep their level."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats

from greybox.discovery.burst import effective_blocks, information, overdispersion
from greybox.discovery.screen import Score, screen
from greybox.estimation.predictors.innovation import Innovation
from tests.discovery import toy

SEEDS = range(60)


def scores(seed: int, truth: dict[str, float] | None = None, *, seen: bool = True) -> dict[str, Score]:
    """Score tests on one record with bursts; `seen`: with the information of its blocks."""
    data = toy.record(seed, truth, bursts=True)
    problem, value = toy.evaluated(toy.null_fit(data), data)
    predicted = list(Innovation().blocks(problem, problem.start, True)) if seen else []
    found = screen(problem, value, toy.GROUPS, draws=199, predicted=predicted, samples=toy.BLOCK)
    return {s.name: s for s in found}


@pytest.mark.parametrize("blocks", [1, 2, 7, 40])
def test_equal_blocks_are_counted(blocks: int):
    told = np.zeros((40, 2))
    told[:blocks] = 0.3, 0.7
    assert effective_blocks(told, np.array([0.5, 2.0])) == pytest.approx(blocks)


def test_a_weak_direction_counts_as_much_as_a_strong_one():
    told = np.zeros((40, 2))
    told[0, 0], told[:, 1] = 1.0, 1.0  # one direction in one block, one everywhere
    found = effective_blocks(told, np.array([1.0, 40.0]))
    assert found == pytest.approx(effective_blocks(1e-6 * told, np.array([1e-6, 4e-5])))
    assert 1.0 < found < 40.0


def test_information_of_the_blocks_adds_up_to_the_hessian():
    data = toy.record(1, bursts=True)
    problem, value = toy.evaluated(toy.null_fit(data), data)
    names = [u.name for u in problem.unknowns]
    way = np.zeros((problem.n, 1))
    way[names.index("q")] = 1.0
    told = information(list(Innovation().blocks(problem, problem.start, True)), way, toy.BLOCK)
    assert value.data_hessian is not None
    at = names.index("q")
    # Nominal values are twenty per cent off the estimate at which the Hessian was taken.
    assert told.sum() == pytest.approx(value.data_hessian[at, at], rel=0.7)
    assert len(told) == len(value.scores if value.scores is not None else ())


@pytest.mark.parametrize("spread", [1.0, 3.0])
def test_scores_that_spread_more_than_they_should_are_measured(spread: float):
    rng = np.random.default_rng(0)
    blocks = {n: spread * rng.standard_normal((200, 2)) for n in "abcdef"}
    shares = {n: np.full(2, 200.0) for n in blocks}
    assert overdispersion(blocks, shares) == pytest.approx(spread**2, rel=0.15)
    assert overdispersion({n: 0.1 * b for n, b in blocks.items()}, shares) == 1.0
    assert overdispersion({}, {}) == 1.0


def test_where_nothing_is_missing_it_passes_as_often_as_alpha_says():
    passed = sum(scores(seed)["square"].p_family <= 0.1 for seed in SEEDS)
    assert passed <= scipy.stats.binom.ppf(0.999, len(SEEDS), 0.1)


def test_the_metric_of_block_scores_stands_still_where_fishers_grows():
    """However large an effect that two bursts tell of: the blocks that make up the sum make up its spread."""
    small, large = scores(100, {"q": 0.2})["square"], scores(100, {"q": 1.0})["square"]
    assert large.statistic > 2 * small.statistic
    assert max(small.robust, large.robust) < 15
    blind = scores(100, {"q": 1.0}, seen=False)["square"]
    assert (blind.statistic, blind.robust) == (large.statistic, large.robust)
    assert large.p_family < 1e-20 < 1e-3 < blind.p_family


def test_what_is_felt_everywhere_is_tested_as_before():
    data = toy.record(3, n=1000)
    problem, value = toy.evaluated(toy.null_fit(data), data)
    predicted = list(Innovation().blocks(problem, problem.start, True))
    plain = {s.name: s for s in screen(problem, value, toy.GROUPS, draws=199)}
    told = screen(problem, value, toy.GROUPS, draws=199, predicted=predicted, samples=toy.BLOCK)
    assert all((s.p_family, s.burst) == (plain[s.name].p_family, False) for s in told)
