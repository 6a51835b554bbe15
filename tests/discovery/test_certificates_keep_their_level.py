"""E-values: under any rival as the truth one beyond 1/alpha comes up in alpha of all logs at most,
however many nuisances, and they grow with what the flights show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import cast

import numpy as np
import pytest

from greybox.discovery.certificate import (
    Certificate,
    certificates,
    certificates_beside,
    regret,
)
from greybox.discovery.evidence import Flights
from greybox.discovery.search import Rival
from greybox.estimation.solvers.levenberg_marquardt import BEYOND
from greybox.estimation.status import Code, Status
from greybox.statistics.betting import bar_of_several, betting
from tests.discovery.linear_world import World, drawn, split

ALPHA = 0.05
LOGS = 600
Truth = Mapping[str, np.ndarray]


def certified(
    one: World, other: World, name: str, rivals: tuple[tuple[str, ...], ...], bar: float
) -> Certificate:
    at = one.fit({name})
    rows = [Rival(instead=r, fitted=one.fit(set(r))) for r in rivals]
    return certificates(at, {name: rows}, [split(one, other)], bar)[name]


def parts(
    one: World, other: World, name: str, instead: tuple[str, ...] = ()
) -> tuple[float, float, float]:
    """Log of the strict and of the sharper e-value against a rival of the name, and the regret."""
    judges = split(one, other)
    gained = judges.both.fit({name}).log_evidence - judges.first.fit({name}).log_evidence
    first, both = (f.fit(set(instead)) for f in (judges.first, judges.both))
    keys = [k for k in both.known if k[0].split(".")[0] in instead]
    paid = regret(first, both, keys) if keys else 0.0
    lost = both.log_evidence - first.log_evidence + paid
    return gained + judges.judge.fit(set(instead)).value.likelihood, gained - lost, paid


@pytest.mark.parametrize("seed", range(40))
def test_the_supremum_is_sought_only_where_it_could_decide(seed: int):
    """The strict e-value is at most the sharper one without its regret. Against what is dropped the
    sharper one therefore counts alone; else the certificate is their mean where the bar is between
    the sharper one and its half, and that half where it decides."""
    worlds = drawn(seed, {"a": np.array([0.9])})
    strict, sharp, paid = parts(*worlds, "a")
    assert strict < sharp and paid == 0.0
    for bar in (sharp - 0.3, sharp + 0.1, sharp - 1.0):
        assert certified(*worlds, "a", ((),), bar).log_e == pytest.approx(sharp)
    strict, sharp, paid = parts(*worlds, "a", ("b",))
    assert strict < sharp + paid and paid > 0.0
    mean, half = np.logaddexp(strict, sharp) - np.log(2), sharp - np.log(2)
    for bar, expected in ((max(sharp, 0.0) - 0.3, mean), (sharp - 1.0, half)):
        if sharp + paid >= 0.0:
            found = certified(*worlds, "a", (("b",),), bar)
            assert found.log_e == pytest.approx(expected)


@pytest.mark.parametrize(
    ("truth", "rivals"),
    [
        pytest.param({}, ((),), marks=pytest.mark.slow),
        ({"b": np.array([1.5])}, ((), ("b",))),
        pytest.param({"c": np.array([0.5, -0.5, 0.0])}, ((), ("c",)), marks=pytest.mark.slow),
    ],
    ids=["nothing", "look-alike", "another"],
)
def test_false_certificates_are_rare(truth: Truth, rivals: tuple[tuple[str, ...], ...]):
    bar = np.log(1 / ALPHA)
    beyond = sum(
        certified(*drawn(seed, truth), "a", rivals, bar).log_e >= bar for seed in range(LOGS)
    )
    # 95 % of binomial draws at alpha lie below this; e-values are far below alpha in practice.
    assert beyond <= ALPHA * LOGS + 2 * np.sqrt(ALPHA * (1 - ALPHA) * LOGS)


@pytest.mark.parametrize("there", [0, 3])
def test_of_what_several_names_say_the_share_that_is_false_is_below_alpha(there: int):
    """The bar of n hypotheses falls with how many pass it (e-BH). Each log here has its own e-value
    of the worst kind: with probability 1/E it is E, where E is what one name among k needs."""
    draw = np.random.default_rng(there)
    n, shares = 20, []
    for _ in range(4000):
        passing = draw.integers(1, n, size=n - there)
        e = n / ALPHA / passing
        false = np.where(draw.random(n - there) < 1 / e, np.log(e), -np.inf)
        true = np.full(there, 30.0)
        bar = bar_of_several([*false, *true], float(np.log(n / ALPHA)))
        said = int((false >= bar).sum())
        shares.append(said / max(said + there, 1))
    assert np.mean(shares) <= ALPHA + 2 * np.std(shares) / np.sqrt(len(shares))


def test_the_bar_falls_only_with_names_that_reach_it():
    alone = float(np.log(620))
    assert bar_of_several([], alone) == alone
    assert bar_of_several([3.0, 2.0], alone) == alone
    assert bar_of_several([9.0, 5.8], alone) == pytest.approx(np.log(310))
    assert bar_of_several([9.0, 5.5, 5.5], alone) == pytest.approx(np.log(620 / 3))


def test_what_is_there_is_certified_and_more_of_it_more():
    sizes = [
        np.median(
            [
                certified(*drawn(s, {"a": np.array([k])}), "a", ((), ("b",)), np.inf).log_e
                for s in range(20)
            ]
        )
        for k in (0.3, 1.0, 3.0)
    ]
    assert sizes[0] < sizes[1] < sizes[2]
    assert sizes[2] > 6.0


def test_a_name_that_bent_into_what_a_law_says_is_none_beside_it():
    """b looks like a, which is there; next to it nothing of b is needed, and a is as certain as
    before."""
    one, other = drawn(3, {"a": np.array([3.0])})
    judge = split(one, other)
    assert certified(one, other, "b", ((),), 6.0).log_e > 6.0
    both = one.fit({"a", "b"})
    beside = certificates_beside(cast(Flights, one), both, ("a", "b"), [judge], 6.0)
    assert beside["b"].log_e < 6.0
    assert beside["a"].log_e >= 6.0


@pytest.mark.parametrize("code", [Code.MAX_ITERATIONS, Code.NO_PROGRESS, Code.BEHIND])
@pytest.mark.parametrize("promised", [0.1, 1.0, 100.0])
def test_what_a_fit_may_still_gain_counts_against_the_name(promised: float, code: Code):
    """A rival's fit did not converge, however it ended: a motor lag worth 99 % had no e-value at
    all. The optimum is believed deeper than the last step promised, and a fit that predicts nothing
    certifies nothing."""
    one, other = drawn(3, {"a": np.array([5.0])})
    strict, sharp, _ = parts(one, other, "a", ("b",))
    early = Status(code=code, iterations=60, evaluations=90, decrement=promised)
    lost = BEYOND * promised

    def found(world: str, bar: float) -> float:
        judges = split(one, other)
        some = cast(World, getattr(judges, world))
        some.kept[frozenset({"b"})] = replace(some.fit({"b"}), status=early)
        return certificates(one.fit({"a"}), {"a": [rival]}, [judges], bar)["a"].log_e

    rival = Rival(instead=("b",), fitted=one.fit({"b"}))

    assert sharp - found("both", -np.inf) == pytest.approx(lost + np.log(2))
    mean = np.logaddexp(strict - lost, sharp) - np.log(2)
    assert found("judge", sharp - 0.3) == pytest.approx(mean)
    judges = split(one, other)
    whole = judges.both.fit({"a"})
    cast(World, judges.both).kept[whole.structure] = replace(
        whole, value=replace(whole.value, valid=False)
    )
    assert certificates(one.fit({"a"}), {"a": [rival]}, [judges], 6.0)["a"].log_e == -np.inf


def test_a_rival_that_was_hopeless_where_the_name_was_learned_still_counts():
    """On the flights that taught b is far behind a; on the one that judges b is the truth, and a is
    still far better than nothing: a is no name."""
    one, other = drawn(3, {"a": np.array([12.0])})[0], drawn(3, {"b": np.array([12.0])})[1]
    at, rival = one.fit({"a"}), one.fit({"b"})
    assert rival.log_evidence < at.log_evidence - one.effort.behind
    found = certified(one, other, "a", ((), ("b",)), 6.0)
    assert found.rivals[()] > 6.0 > found.log_e
    assert found.against == ("b",)


@pytest.mark.parametrize(
    ("away", "exact"), [(1.0, True), (-1.0, True), (9.0, False), (-9.0, False)]
)
def test_only_near_the_bar_are_optima_needed_to_the_last_digit(away: float, exact: bool):
    one, other = drawn(3, {"a": np.array([1.0])})
    judges = split(one, other)
    rival = Rival(instead=(), fitted=one.fit(()))
    bar = parts(one, other, "a")[1] + away
    certificates(one.fit({"a"}), {"a": [rival]}, [judges], bar)
    assert (0.0 in judges.both.asked) is exact  # type: ignore[attr-defined]


def test_look_alikes_stay_a_set_where_the_flights_cannot_tell():
    one, other = drawn(3, {"a": np.array([2.0])})
    same = {**one.columns, "twin": one.columns["a"]}, {**other.columns, "twin": other.columns["a"]}
    one, other = (
        World(columns=c, shared=w.shared, y=w.y) for c, w in zip(same, (one, other), strict=True)
    )
    found = certified(one, other, "a", ((), ("twin",)), 6.0)
    assert found.rivals[()] >= 6.0
    assert found.unbeaten(6.0, ALPHA) == ([("twin",)], [])
    assert found.against == ("twin",)


def test_what_is_nearly_the_name_at_its_worst_is_unlikely_by_all_flights():
    """An inflow stayed one of a set with a drag and a damping, whose nine numbers can be nearly
    what it is; their probability was 0 %."""
    one, other = drawn(3, {"a": np.array([2.0])})
    near = [
        {**w.columns, "many": np.column_stack([w.columns["a"] + 0.1 * w.shared[:, :1], w.shared])}
        for w in (one, other)
    ]
    one, other = (
        World(
            columns=c, shared=w.shared[:, :2], y=w.y - w.shared[:, 2:] @ np.linspace(-2, 2, 6)[2:]
        )
        for c, w in zip(near, (one, other), strict=True)
    )
    found = certified(one, other, "a", ((), ("many",)), 6.0)
    assert found.rivals["many",] < 6.0 < found.whole["many",].log_e
    assert found.unbeaten(6.0, ALPHA) == ([], [("many",)])
    assert found.whole["many",].log_e == found.whole["many",].odds
    for judge, alike in ((-2.0, []), (-4.0, [("many",)])):
        told = replace(found, whole={("many",): replace(found.whole["many",], judge=judge)})
        assert told.unbeaten(6.0, ALPHA)[0] == alike, "flights that judge speak for it"


def test_a_rival_that_is_no_larger_counts_at_its_worst_on_all_flights():
    one, other = drawn(3, {"a": np.array([1.0])})
    found = certified(one, other, "a", ((), ("b",)), 6.0)
    assert found.whole["b",].log_e < found.whole["b",].odds


def test_nuisances_cost_no_name():
    """The strict e-value alone pays half a nat for every shared unknown; their mean does not."""
    logs = [
        certified(*drawn(s, {"a": np.array([0.9])}), "a", ((),), np.inf).log_e for s in range(40)
    ]
    strict = [parts(*drawn(s, {"a": np.array([0.9])}), "a")[0] for s in range(40)]
    assert np.median(logs) > np.median(strict) + 1.0


def test_a_forecaster_that_is_no_better_wins_no_bet():
    rng = np.random.default_rng(0)
    won = sum(
        betting(np.clip(rng.normal(0.0, 0.4, 30), -1, 1)) >= np.log(1 / ALPHA) for _ in range(2000)
    )
    assert won <= ALPHA * 2000
    assert betting(np.full(30, 0.3)) > np.log(1 / ALPHA)
    assert betting(np.zeros(0)) == 0.0
