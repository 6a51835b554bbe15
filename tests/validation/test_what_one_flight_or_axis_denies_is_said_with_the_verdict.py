"""Errors pooled over flights are those of the fast ones, and a vector's those of the axes that move
most: what a flight or an axis alone denies is said with the verdict, and so is what hardly moves."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from greybox.files import dump_json
from greybox.model.verdict import Outcome, Verdict
from greybox.validation.advice import Hint, Symptom
from greybox.validation.finding import in_words
from greybox.validation.groups import GROUPS
from greybox.validation.horizon import HorizonAccumulator
from greybox.validation.horizon_table import GroupErrors, HorizonTable
from greybox.validation.usefulness import LEFT_OUT, TEST_FLIGHTS, judge

DT = 0.01
SECONDS = DT * np.arange(1, 101)
CHANGE = {"rotation": 0.6, "rate": 3.0}
"""Change of a fast flight within half a second."""

Shares = dict[str, np.ndarray | float]


def errors(curve: np.ndarray, blocks: int = 10) -> GroupErrors:
    counts = np.full((blocks, len(curve)), 100.0)
    n = counts.sum(axis=0).astype(np.int64)
    return GroupErrors(
        mae=curve,
        rmse=curve,
        n=n,
        diverged=0 * n,
        origins=int(n[0]),
        left_out=0,
        block_sums=counts * curve,
        block_counts=counts,
    )


def pooled(parts: list[GroupErrors]) -> GroupErrors:
    sums, counts = (
        np.concatenate([getattr(p, n) for p in parts]) for n in ("block_sums", "block_counts")
    )
    whole = errors(sums.sum(axis=0) / counts.sum(axis=0))
    axes = tuple(pooled(list(same)) for same in zip(*(p.axes for p in parts), strict=True))
    return replace(whole, block_sums=sums, block_counts=counts, axes=axes)


def table(flights: dict[str, dict[str, GroupErrors]], label: str) -> HorizonTable:
    groups = {g: pooled([f[g] for f in flights.values()]) for g in CHANGE}
    return HorizonTable(label=label, sample_time=DT, required=50, groups=groups, flights=flights)


def held(size: float, *, blocks: int = 10) -> dict[str, GroupErrors]:
    """The last value on a flight of `size` times the pace of a fast one."""
    return {g: errors(size * c * (SECONDS / 0.5) ** 0.8, blocks) for g, c in CHANGE.items()}


def verdict_of(
    sizes: dict[str, float],
    shares: dict[str, Shares],
    *,
    blocks: int = 10,
    judged_on: str = TEST_FLIGHTS,
    hints: tuple[Hint, ...] = (),
) -> Verdict:
    """Of a model whose errors are 0.4 times those of the last value, or the `shares` by flight and
    group."""
    last = {f: held(s, blocks=blocks) for f, s in sizes.items()}
    own = {
        f: {
            g: errors(e.mae * np.asarray(shares.get(f, {}).get(g, 0.4)), blocks)
            for g, e in groups.items()
        }
        for f, groups in last.items()
    }
    tables = table(own, "model"), table(last, "persistence")
    return judge(*tables, judged_on=judged_on, hints=hints)


def until(seconds: float, after: float = 1.5) -> np.ndarray:
    return np.where(seconds < SECONDS + DT / 2, after, 0.4)


FAST_AND_SLOW = {"star_fast": 1.0, "star_slow": 0.15}


def test_a_slow_flight_that_denies_the_verdict_is_named_with_how_far_it_goes() -> None:
    found = verdict_of(FAST_AND_SLOW, {"star_slow": {"rotation": until(0.12)}})
    assert found.outcome is Outcome.USABLE and found.useful_seconds == pytest.approx(1.0)
    assert found.line == "useful for 1 s and more (down to 0.11 s on 1 flight)"
    assert found.why[:2] == (
        "only 0.11 s on star_slow",
        "taken together, errors stay below holding the last value",
    )
    assert in_words(found)[-1] == "flights alone: star_slow rotation worse from 0.12 s"
    (fast, slow) = found.parts
    assert (fast.kind, fast.worse_from) == ("flight", None)
    assert slow.groups == ("rotation",) and slow.useful_seconds == pytest.approx(0.11)
    assert Verdict.from_dict(json.loads(dump_json(found.to_dict()))) == found


def test_what_a_flight_alone_is_told_is_what_is_said_of_it_among_others() -> None:
    shares: Shares = {"rate": until(0.06)}
    alone = verdict_of({"star_slow": 0.15}, {"star_slow": shares})
    assert alone.outcome is Outcome.NOT_USABLE and not alone.parts
    among = verdict_of(FAST_AND_SLOW, {"star_slow": shares})
    assert among.line == "useful for 1 s and more (not usable on 1 of 2 flights)"
    assert among.why[0] == "not usable on star_slow"
    slow = among.parts[1]
    assert (slow.outcome, slow.useful_seconds) == (alone.outcome, alone.useful_seconds)


def test_where_no_flight_denies_it_the_line_stays_short() -> None:
    found = verdict_of(FAST_AND_SLOW, {})
    assert found.line == "useful for 1 s and more"
    assert found.why[0] == "errors stay below holding the last value"
    assert found.exit_code == 0 and not [w for w in in_words(found) if "alone" in w]


def test_a_model_that_fails_on_most_flights_is_not_made_usable_by_the_largest() -> None:
    sizes = {"fast": 1.0, "slow1": 0.15, "slow2": 0.15}
    bad: Shares = {"rate": until(0.06)}
    one = verdict_of(sizes, {"slow1": bad})
    assert one.exit_code == 0 and "not usable on 1 of 3 flights" in one.line
    assert one.why[0] == "not usable on slow1"
    two = verdict_of(sizes, {"slow1": bad, "slow2": {"rate": until(0.05)}})
    assert two.exit_code == 1 and two.useful_seconds == pytest.approx(0.04)
    assert two.line == "NOT USABLE on 2 of 3 flights alone"
    assert two.why[0].startswith("as on slow2: rate is worse than holding the last value")
    assert two.why[-1] == "alone it is useful on fast for 1 s"
    assert two.reason and two.action and two.anchor


def test_a_model_that_is_not_usable_says_where_it_would_be() -> None:
    found = verdict_of(FAST_AND_SLOW, {"star_fast": {"rate": until(0.06)}})
    assert found.outcome is Outcome.NOT_USABLE
    assert found.why[-1] == "alone it is useful on star_slow for 1 s"


@pytest.mark.parametrize("others", [{}, {"fast1": {"rate": until(0.06)}}])
def test_what_was_seen_of_a_flight_on_which_it_is_useful_is_no_reason(others) -> None:
    """Of one flight that spoils the whole, and of two of three alone."""
    sizes = FAST_AND_SLOW | ({"fast1": 0.15} if others else {})
    bad: dict[str, Shares] = {"star_fast": {"rate": until(0.06)}, **others}

    def reason(flight: str, judged_on: str = TEST_FLIGHTS) -> str:
        seen = Hint(symptom=Symptom.SATURATED, detail=flight, flight=flight)
        return verdict_of(sizes, bad, hints=(seen,), judged_on=judged_on).anchor

    assert reason("star_fast") == reason("") == reason("trained") == Symptom.SATURATED.anchor
    assert reason("star_slow") == verdict_of(sizes, bad).anchor != Symptom.SATURATED.anchor
    assert reason("star_slow", LEFT_OUT) == Symptom.SATURATED.anchor, "it taught, and may spoil"


def test_a_flight_that_hardly_moves_denies_nothing_and_is_named_as_not_judged() -> None:
    found = verdict_of({"star": 1.0, "hover": 0.05}, {"hover": {"rotation": 1.3, "rate": 1.3}})
    assert found.outcome is Outcome.USABLE
    assert found.line == "useful for 1 s and more (1 flight too calm)"
    assert found.why[0] == "too calm to judge hover"


def test_the_first_line_counts_in_a_hundred_columns_what_the_lines_below_name() -> None:
    sizes = {f"B{i}_figure8_slow_rep1": 0.15 for i in range(8)} | {"fast": 1.0, "hover": 0.05}
    calm: Shares = {"rotation": 1.3, "rate": 1.3}
    shares = {n: {"rotation": until(0.12)} for n in sizes if "slow" in n} | {"hover": calm}
    found = verdict_of(sizes, shares, judged_on=LEFT_OUT)
    assert found.line == (
        "useful for 1 s and more (down to 0.11 s on 8 flights; 1 flight too calm) "
        "[on pieces left out]"
    )
    assert len(found.line) <= 100 and max(map(len, found.lines())) <= 110
    assert "B0_figure8_slow_rep1" in found.why[0] and "hover" in found.why[1]


def test_a_flight_of_one_block_is_not_told_from_chance() -> None:
    found = verdict_of(FAST_AND_SLOW, {"star_slow": {"rate": until(0.06)}}, blocks=1)
    assert not found.parts


def test_the_worst_of_many_flights_are_named_and_the_others_counted() -> None:
    sizes = {f"f{i}": 0.15 for i in range(6)} | {"fast": 1.0}
    shares: dict[str, Shares] = {f"f{i}": {"rotation": until(0.21 + 0.1 * i)} for i in range(6)}
    found = verdict_of(sizes, shares)
    assert found.line.endswith("(down to 0.2 s on 6 flights)")
    assert found.why[0] == "only 0.2 s on f0, only 0.3 s on f1, 0.4 s or more on 4 more"
    assert all(f"f{i} rotation worse" in in_words(found)[-1] for i in range(6))


def axes_of(size: float, yaw: np.ndarray | float, change: float) -> Verdict:
    """Roll and pitch rate are foretold; the yaw rate changes by `change` rad/s, foretold as well as
    `yaw` times the last value."""
    last = held(size)
    own = {g: errors(0.4 * e.mae) for g, e in last.items()}
    rise = change * (SECONDS / 0.5) ** 0.8
    rolled = last["rate"].mae
    last["rate"] = replace(last["rate"], axes=tuple(map(errors, (rolled, rolled, rise))))
    own["rate"] = replace(
        own["rate"], axes=tuple(map(errors, (0.4 * rolled, 0.4 * rolled, yaw * rise)))
    )
    return judge(table({"a": own}, "model"), table({"a": last}, "persistence"))


@pytest.mark.parametrize(
    ("yaw", "first", "said"),
    [
        (until(0.21), "down to 0.2 s on 1 axis", "yaw rate worse from 0.21 s"),
        (until(0.05), "down to 0.04 s on 1 axis", "yaw rate worse from 0.05 s"),
        (np.ones(100), "not on 1 axis", "yaw rate no better than the last value"),
    ],
)
def test_an_axis_that_roll_and_pitch_hide_is_named(yaw: np.ndarray, first: str, said: str) -> None:
    found = axes_of(1.0, yaw, change=0.6)
    assert found.outcome is Outcome.USABLE
    assert found.line == f"useful for 1 s and more ({first})"
    assert found.why[0] == said and found.why[1].startswith("taken together, errors stay")
    assert in_words(found)[-1].startswith("axes alone: yaw rate")


def test_an_axis_that_hardly_moves_is_not_judged_and_one_that_is_foretold_is_not_named() -> None:
    calm = axes_of(1.0, np.full(100, 1.3), change=0.05)
    assert calm.line == "useful for 1 s and more (1 axis too calm)"
    assert calm.why[0] == "too calm to judge yaw rate"
    assert "yaw" not in " ".join(axes_of(1.0, np.full(100, 0.5), change=0.6).lines())


def test_errors_of_an_axis_are_those_of_the_component() -> None:
    rng = np.random.default_rng(0)
    rows = HorizonAccumulator(label="m", sample_time=DT, steps=5, required=5)
    origins = np.arange(20)
    parts = []
    for flight in ("a", "b"):
        reference, predicted = rng.normal(size=(40, 3)), rng.normal(size=(20, 5, 3))
        rows.add(flight, {"rate": predicted}, {"rate": reference}, origins)
        at = origins[:, None] + np.arange(1, 6)
        parts.append(np.abs(reference[at] - predicted))
    found = rows.table().groups["rate"]
    assert GROUPS["rate"].axes == ("roll rate", "pitch rate", "yaw rate")
    for i, axis in enumerate(found.axes):
        np.testing.assert_allclose(axis.mae, np.concatenate(parts)[..., i].mean(axis=0))
        assert axis.origins == found.origins == 40
        assert len(axis.block_sums) == len(found.block_sums)
