"""Score tests of candidates keep their level where nothing is missing, find what is there, and estimate it."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats

from greybox.discovery.screen import screen
from greybox.estimation.fit import fit, noise_of
from tests.discovery import toy

SEEDS = range(40)


@pytest.fixture(scope="module")
def clean() -> list[dict[str, toy.Score]]:
    return [toy.scores(seed, draws=199) for seed in SEEDS]


def test_the_largest_of_all_passes_as_often_as_alpha_says(clean: list[dict[str, toy.Score]]):
    passed = sum(min(s.p_family for s in one.values() if s.judged) <= 0.1 for one in clean)
    low, high = scipy.stats.binom.interval(0.999, len(clean), 0.1)
    assert low <= passed <= high


@pytest.mark.parametrize("name", ["square", "bend"])
def test_p_values_of_one_candidate_are_uniform(clean: list[dict[str, toy.Score]], name: str):
    assert scipy.stats.kstest([one[name].p for one in clean], "uniform").pvalue > 1e-3


def test_family_wise_p_values_are_never_below_those_of_one_test(clean: list[dict[str, toy.Score]]):
    # One in 200 is the smallest that 199 draws can say; the bootstrap's own error is 0.03 at p = 0.5.
    assert all(s.p_family > s.p - 0.12 for one in clean for s in one.values() if s.judged)


@pytest.mark.parametrize(("name", "truth"), [("square", {"q": 0.15}), ("bend", {"s1": 0.25})])
def test_what_is_there_is_found_and_ranks_first(name: str, truth: dict[str, float]):
    found = [toy.scores(seed, truth, draws=199) for seed in range(100, 110)]
    assert sum(one[name].p_family <= 0.05 for one in found) >= 9
    assert sum(next(iter(one)) == name for one in found) >= 9


def test_the_limit_parts_those_that_pass_from_those_that_do_not():
    for seed in range(5):
        for s in toy.scores(seed, {"q": 0.05}, draws=999).values():
            if s.judged and abs(s.p_family - 0.05) > 0.005:
                assert (s.p < s.limit) == (s.p_family < 0.05)


@pytest.mark.parametrize(("q", "off"), [(0.02, 0.3), (0.1, 2.0)])
def test_one_step_estimate_is_that_of_a_refit_to_first_order(q: float, off: float):
    data = toy.record(7, {"q": q})
    null = toy.null_fit(data)
    one = {s.name: s for s in screen(*toy.evaluated(null, data), toy.GROUPS)}["square"]
    full = fit(toy.model(), data, free=(*toy.CORE, "q"), values=toy.NULL, build=toy.EVERY, noise=noise_of(null.model))
    assert full.converged
    assert abs(one.estimate["q", None] - full["q"].value) < off * full["q"].std
    # What is missing inflates the noise levels of the fit without it, and with them the first error bar.
    assert 0.8 * full["q"].std < one.std["q", None] < (1.25 if q < 0.05 else 3) * full["q"].std


def test_what_the_free_parameters_imitate_is_not_judged(clean: list[dict[str, toy.Score]]):
    for one in clean[:5]:
        assert not one["copy"].judged
        assert "collinear" in one["copy"].reason
        assert list(one)[-1] == "copy"


def test_the_bootstrap_is_deterministic_and_follows_its_seed():
    data = toy.record(3)
    problem, value = toy.evaluated(toy.null_fit(data), data)
    a, b, c = (
        [(s.name, s.p, s.p_family) for s in screen(problem, value, toy.GROUPS, draws=99, seed=k)] for k in (1, 1, 2)
    )
    assert a == b
    assert a != c
    assert [x[:2] for x in a] == [x[:2] for x in c]
    assert np.isfinite([x[2] for x in a]).all()
