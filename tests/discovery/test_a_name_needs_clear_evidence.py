"""Which addition is named is decided by BIC among refits: clearly, or not at all. Hand-made refits stand for fits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any, cast

import pytest

from greybox.discovery.name import Addition, next_addition, prune, stands_in, still_needed
from greybox.discovery.nested import Nest, NestedFit
from greybox.discovery.screen import Score, unscored


@dataclass(frozen=True)
class Refits:
    """A nest whose refits have a BIC by the set of effects that is free."""

    bic: Mapping[tuple[str, ...], float]
    failed: tuple[tuple[str, ...], ...] = ()
    overtaken: tuple[tuple[str, ...], ...] = ()
    bound: tuple[str, ...] = ()
    asked: list[tuple[str, ...]] = field(default_factory=list)
    theta: Mapping[tuple[str, None], float] = field(default_factory=dict)
    found: Mapping[str, Any] = field(default_factory=dict)
    firsts: list[Any] = field(default_factory=list)
    candidates: Any = field(
        default_factory=lambda: SimpleNamespace(
            physics=SimpleNamespace(sample_time=0.01), late_alike=None,
            parameters=dict.fromkeys(("motor_lag", "command_delay")),
        )
    )

    def task(
        self, effects: Any, start: Any = None, first: Any = None, also: Any = None, shares: Any = None
    ) -> Any:  # fmt: skip
        self.firsts.append(first)
        return tuple(sorted(effects))

    def refits(self, tasks: Any) -> Any:
        self.asked.extend(tasks)
        return [
            SimpleNamespace(
                effects=chosen, theta=dict(self.theta), bic=self.bic.get(chosen, 1e9),
                at_bound=lambda name: name in self.bound,
                comparable=chosen not in self.failed, converged=chosen not in self.failed,
                overtaken=chosen in self.overtaken,
                loglik=-0.5 * self.bic.get(chosen, 1e9), evidence=-0.5 * self.bic.get(chosen, 1e9),
                n_parameters=5 + len(chosen),
                fit=SimpleNamespace(
                    converged=chosen not in self.failed, parameters=dict(self.found), n_samples=1000,
                ),
            )
            for chosen in tasks
        ]  # fmt: skip

    def from_each(self, task: Any) -> Any:
        return task

    def contest(self, tasks: Any, held: float = 0.0) -> Any:
        return self.refits(tasks)

    def settle(self, refit: Any) -> Any:
        return refit

    def refit(self, effects: Any, start: Any = None, first: Any = None) -> Any:
        return self.refits([self.task(effects)])[0]


def score(name: str, p_family: float, judged: bool = True, statistic: float = 30.0) -> Score:
    return Score(
        name=name, statistic=statistic, robust=10, dof=1, p=p_family / 10, p_family=p_family,
        estimate={(f"{name}.k", None): 1.0}, std={(f"{name}.k", None): 0.1}, left=1.0, judged=judged,
    )  # fmt: skip


def choose(refits: Refits, *scores: Score, alpha: float = 0.05) -> Addition | None:
    at = cast(NestedFit, refits.refit(()))
    return next_addition(cast(Nest, refits), at, scores, alpha)


def limit(p_family: float, *, burst: bool = True) -> Score:
    """The score of an effect with a threshold, which few blocks feel."""
    return replace(score("limit", p_family), threshold=True, burst=burst)


def test_a_limit_that_few_blocks_feel_must_gain_plainly():
    """0.1 per sample of 1000, in twice the log likelihood; one that many blocks feel is an effect like any other."""
    refits = Refits({(): 1000.0, ("limit",): 500.0, ("drag",): 900.0})
    found = choose(refits, limit(1e-9), score("drag", 0.001))
    assert found is not None
    assert found.effects == ("limit",)
    assert found.p_value < 1e-10
    small = Refits({(): 1000.0, ("limit",): 850.0, ("drag",): 900.0})
    found = choose(small, limit(1e-9), score("drag", 0.001))
    assert found is not None
    assert found.effects == ("drag",)
    found = choose(small, limit(1e-9, burst=False), score("drag", 0.001))
    assert found is not None
    assert found.effects == ("limit",)
    assert choose(Refits({(): 1000.0, ("limit",): 500.0}), limit(0.8)) is None


def test_a_rival_that_was_given_up_far_behind_is_a_rival_but_no_name():
    refits = Refits({(): 1000.0, ("a",): 500.0, ("b",): 900.0}, failed=(("b",),), overtaken=(("b",),))
    found = choose(refits, score("a", 0.001), score("b", 0.001))
    assert found is not None
    assert (found.effects, found.delta_bic_rival) == (("a",), 400.0)
    refits = Refits({(): 1000.0, ("b",): 900.0}, failed=(("b",),), overtaken=(("b",),))
    assert choose(refits, score("b", 0.001)) is None


def test_a_late_command_contends_whatever_its_score():
    refits = Refits({(): 1000.0, ("command_delay",): 300.0})
    others = [score(n, 0.001, statistic=500.0) for n in "abcde"]
    found = choose(refits, *others, score("command_delay", 0.001, statistic=40.0))
    assert found is not None
    assert found.effects == ("command_delay",)
    assert ("e",) not in refits.asked
    assert choose(Refits({(): 1000.0, ("e",): 300.0}), *others) is None


def test_the_best_refit_wins_whatever_the_rank_of_its_score():
    found = choose(
        Refits({(): 1000.0, ("drag",): 950.0, ("damping",): 900.0}), score("drag", 0.001), score("damping", 0.002)
    )
    assert found is not None
    assert found.effects == ("damping",)
    assert found.rivals == {}
    assert (found.delta_bic, found.delta_bic_rival, found.p_value) == (100.0, 50.0, 0.002)


def test_rivals_within_ten_are_a_group_with_weights():
    found = choose(
        Refits({(): 1000.0, ("drag",): 902.0, ("damping",): 900.0}), score("drag", 0.001), score("damping", 0.002)
    )
    assert found is not None
    assert list(found.rivals) == ["damping", "drag"]
    assert sum(found.rivals.values()) == pytest.approx(1.0)
    assert found.rivals["damping"] / found.rivals["drag"] == pytest.approx(2.718, rel=1e-3)


@pytest.mark.parametrize(("bic", "named"), [(991.0, False), (989.0, True)])
def test_a_gain_of_less_than_ten_is_no_name(bic: float, named: bool):
    assert (choose(Refits({(): 1000.0, ("drag",): bic}), score("drag", 0.001)) is not None) == named


def test_what_does_not_pass_the_test_is_not_even_refitted():
    refits = Refits({(): 1000.0, ("drag",): 1.0})
    assert choose(refits, score("drag", 0.06)) is None
    assert choose(refits, score("drag", 0.001, judged=False)) is None
    assert refits.asked == [(), ()]


def test_what_would_have_to_be_negative_is_not_even_refitted():
    refits = Refits({(): 1000.0, ("drag",): 1.0})
    assert choose(refits, replace(score("drag", 0.001), allowed=False)) is None
    assert refits.asked == [()]


def test_contenders_are_those_that_promise_most_likelihood():
    others = [score(name, 0.001) for name in "abcd"]
    bic = {(): 1000.0, **{(name,): 990.0 - k for k, name in enumerate("abcd")}, ("drag",): 500.0}
    found = choose(Refits(bic), *others, score("drag", 0.04, statistic=400.0))
    assert found is not None
    assert found.effects == ("drag",)
    assert found.p_value == 0.04


def test_refits_that_fail_or_end_at_a_bound_do_not_count():
    bic = {(): 1000.0, ("drag",): 1.0, ("damping",): 900.0}
    scores = (score("drag", 0.001), score("damping", 0.001))
    for refits in (Refits(bic, failed=(("drag",),)), Refits(bic, bound=("drag",))):
        found = choose(refits, *scores)
        assert found is not None
        assert found.effects == ("damping",)


def test_lag_and_delay_are_refitted_alone_and_together_and_are_no_rivals_of_their_pair():
    bic = {(): 1000.0, ("motor_lag",): 700.0, ("command_delay",): 600.0, ("command_delay", "motor_lag"): 500.0}
    found = choose(Refits(bic), score("motor_lag", 0.001), score("command_delay", 0.9))
    assert found is not None
    assert sorted(found.effects) == ["command_delay", "motor_lag"]
    assert found.rivals == {}
    assert found.delta_bic_rival is None


def test_of_a_pair_that_was_refused_either_may_stand_alone():
    bic = {(): 1000.0, ("motor_lag",): 700.0, ("command_delay",): 600.0, ("command_delay", "motor_lag"): 500.0}
    scores = (score("motor_lag", 0.001), score("command_delay", 0.001))
    at = cast(NestedFit, Refits(bic).refit(()))
    pair = frozenset(("motor_lag", "command_delay"))
    found = next_addition(cast(Nest, Refits(bic)), at, scores, 0.05, {pair})
    assert found is not None
    assert found.effects == ("command_delay",)


def test_two_names_must_be_clearly_better_than_one():
    bic = {(): 1000.0, ("motor_lag",): 505.0, ("command_delay",): 600.0, ("command_delay", "motor_lag"): 500.0}
    found = choose(Refits(bic), score("motor_lag", 0.001), score("command_delay", 0.001))
    assert found is not None
    assert found.effects == ("motor_lag",)
    assert found.rivals == {}
    assert (found.delta_bic, found.delta_bic_rival) == (495.0, 95.0)


def test_earlier_additions_are_kept_only_while_they_help_clearly():
    refits = Refits({("a", "b"): 100.0, ("a",): 109.0, ("b",): 120.0})
    at = cast(NestedFit, refits.refit(("a", "b")))
    assert still_needed(cast(Nest, refits), at, "a") == (None, 20.0)
    smaller, gain = still_needed(cast(Nest, refits), at, "b")
    assert smaller is not None
    assert (smaller.effects, gain) == (("a",), 9.0)
    failed = Refits(refits.bic, failed=(("a",),))
    assert still_needed(cast(Nest, failed), at, "b")[0] is None


def test_a_delay_that_goes_hands_its_time_to_those_that_stay():
    found = {n: SimpleNamespace(value=v) for n, v in (("command_delay.d", 0.019), ("pose_delay.d", 0.001), ("thrust.c2", 4))}
    refits = Refits({("command_delay",): 95.0, ("command_delay", "pose_delay"): 100.0}, found=found)
    at = cast(NestedFit, refits.refit(("command_delay", "pose_delay")))
    assert still_needed(cast(Nest, refits), at, "pose_delay")[0] is not None
    assert refits.firsts[1:] == [None, {("command_delay.d", None): pytest.approx(0.02)}]


def test_of_a_pair_the_one_that_is_needed_stays():
    pair = ("command_delay", "motor_lag")
    whole = ("center_of_mass_offset", *pair)
    bic = {(): 1000.0, pair: 500.0, whole: 100.0, ("center_of_mass_offset", "motor_lag"): 92.0}
    bic |= {("center_of_mass_offset", "command_delay"): 400.0, ("center_of_mass_offset",): 900.0, ("motor_lag",): 800.0}
    refits = Refits(bic)
    additions = [added(pair), added(("center_of_mass_offset",))]
    at, kept, notes = prune(cast(Nest, refits), cast(NestedFit, refits.refit(whole)), additions)
    assert [a.effects for a in kept] == [("motor_lag",), ("center_of_mass_offset",)]
    assert at.effects == ("center_of_mass_offset", "motor_lag")
    assert len(notes) == 1
    assert notes[0].startswith("command_delay")


def added(effects: tuple[str, ...]) -> Addition:
    fit = cast(NestedFit, SimpleNamespace(effects=effects))
    return Addition(
        effects=effects, p_value=0.001, delta_bic=100.0, delta_bic_rival=None, rivals={}, before=fit, after=fit,
        scores=(),
    )  # fmt: skip


@pytest.mark.parametrize(("tau", "grouped"), [(0.0003, True), (0.0024, True), (0.0026, False), (0.03, False)])
def test_a_lag_far_below_a_sample_is_not_told_from_a_delay(tau: float, grouped: bool):
    bic = {(): 1000.0, ("motor_lag",): 200.0, ("command_delay",): 900.0, ("command_delay", "motor_lag"): 199.0}
    refits = Refits(bic, theta={("motor_lag.tau", None): tau})
    found = choose(refits, score("motor_lag", 0.001), score("command_delay", 0.001))
    assert found is not None
    assert found.effects == ("motor_lag",)
    assert found.rivals == ({"motor_lag": 0.5, "command_delay": 0.5} if grouped else {})


def test_next_to_a_lag_that_is_known_a_short_delay_keeps_its_name():
    bic = {(): 1000.0, ("motor_lag",): 900.0, ("command_delay",): 200.0, ("command_delay", "motor_lag"): 199.0}
    refits = Refits(bic, theta={("command_delay.d", None): 0.0003})
    refits.candidates.parameters = {"command_delay": ()}
    found = choose(refits, score("command_delay", 0.001))
    assert found is not None
    assert (found.effects, found.rivals) == (("command_delay",), {})


@dataclass(frozen=True)
class Likely:
    """A fit with a likelihood, BIC from it without a price."""

    evidence: float
    effects: tuple[str, ...] = ()
    n_parameters: int = 5
    fit: Any = field(default_factory=lambda: SimpleNamespace(n_samples=1000))

    @property
    def bic(self) -> float:
        return -2 * self.evidence


@dataclass(frozen=True)
class Likelihoods(Refits):
    """The same with the likelihood that belongs to the BIC."""

    def refits(self, tasks: Any) -> Any:
        found = super().refits(tasks)
        for f in found:
            f.evidence, f.n_parameters = -f.bic / 2, 6
        return found


def test_what_has_no_score_is_refitted_in_any_case_and_tested_by_its_likelihood_ratio():
    refits = Likelihoods({(): 1000.0, ("drag",): 980.0, ("lift",): 1004.0})
    at = cast(NestedFit, Likely(-500.0))
    scores = [score("bias", 0.5), unscored("drag", {("drag.k", None): 1.0}), unscored("lift", {("lift.k", None): 1.0})]
    found = next_addition(cast(Nest, refits), at, scores, 0.05)
    assert found is not None
    assert found.effects == ("drag",)
    # chi^2 of 20 with one degree of freedom, two candidates: two tails of 4.472 standard deviations each.
    assert found.p_value == pytest.approx(2 * 7.744e-6, rel=1e-3)
    assert refits.asked == [("drag",), ("lift",)]
    assert next_addition(cast(Nest, refits), at, scores, 1e-5) is None


@pytest.mark.parametrize(
    ("drag", "both", "refused"), [(800.0, 795.0, True), (800.0, 780.0, False), (895.0, 894.0, False)]
)
def test_the_look_alike_of_a_withheld_name_does_not_take_its_place(drag: float, both: float, refused: bool):
    refits = Refits({("drag", "wind"): both})

    def step(name: str, bic: float) -> Addition:
        return replace(added((name,)), after=cast(NestedFit, SimpleNamespace(effects=(name,), bic=bic)))

    found = stands_in(cast(Nest, refits), step("wind", 900.0), [step("drag", drag)])
    assert (found is not None) == refused


@pytest.mark.parametrize("late", ["sensor_delay", "pose_delay"])
def test_where_all_that_is_measured_is_late_alike_commands_may_be_as_well(late: str):
    refits = Refits(
        {(): 1000.0, ("command_delay",): 600.0, ("motor_lag",): 700.0, ("command_delay", "motor_lag"): 599.0}
    )
    found = choose(refits, score("command_delay", 0.001), score("motor_lag", 0.001))
    assert found is not None
    assert found.rivals == {}
    refits.candidates.late_alike = late
    found = choose(refits, score("command_delay", 0.001), score("motor_lag", 0.001))
    assert found is not None
    assert found.rivals == {"command_delay": 0.5, late: 0.5}
    # No command is early.
    early = Refits({(): 1000.0, (late,): 600.0}, theta={(f"{late}.d", None): -0.015})
    early.candidates.late_alike = late
    found = choose(early, score(late, 0.001))
    assert found is not None
    assert found.rivals == {}
