"""The gap's shares are arithmetic on squared errors: hand-made blocks give hand-made numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.validation.gap import (
    HeldOutErrors,
    Squares,
    closing,
    doubt,
    gap,
    groups_of,
    outgrown,
    worsened,
)

KEY = ("rate", 0.5)


def blocks(level: float, count: int = 20, seed: int = 0, spread: float = 0.0) -> Squares:
    """`count` seconds of squared errors with mean `level`."""
    rng = np.random.default_rng(seed)
    return {KEY: [level * (1 + spread * rng.uniform(-1, 1)) * np.ones(20) for _ in range(count)]}


def test_closed_is_the_share_of_the_excess_over_the_floor():
    rows = gap((blocks(9.0), blocks(1.0)), (blocks(3.0), blocks(1.0)))
    assert len(rows) == 1
    row = rows[0]
    assert (row.before, row.after, row.floor) == pytest.approx((3.0, np.sqrt(3.0), 1.0))
    assert row.closed == pytest.approx(1 - (3 - 1) / (9 - 1))
    assert row.ci95 == pytest.approx((0.75, 0.75))
    assert row.unit == "rad/s"


def test_a_model_without_change_closes_nothing_and_one_at_the_floor_all():
    same, done = (
        gap((blocks(4.0), blocks(1.0)), (blocks(level), blocks(1.0)))[0] for level in (4.0, 1.0)
    )
    assert same.closed == pytest.approx(0.0)
    assert done.closed == pytest.approx(1.0)


def test_worse_than_before_is_negative():
    assert gap((blocks(4.0), blocks(1.0)), (blocks(7.0), blocks(1.0)))[0].closed == pytest.approx(
        -1.0
    )


@pytest.mark.parametrize(("before", "judged"), [(1.19, False), (1.21, True)])
def test_there_is_no_gap_to_close_next_to_the_floor(before: float, judged: bool):
    row = gap((blocks(before), blocks(1.0)), (blocks(1.0), blocks(1.0)))[0]
    assert (row.closed is not None) == judged
    assert (row.ci95 is not None) == judged


@pytest.mark.parametrize(("after", "opened"), [(1.15, False), (1.3, True)])
def test_what_was_at_the_floor_and_is_beyond_it_now_is_said(after: float, opened: bool):
    """A test flight in wind took the drag of calm ones: 64 -> 116 mm, and nothing was said."""
    row = gap((blocks(1.1), blocks(1.0)), (blocks(after), blocks(1.0)))[0]
    assert row.opened is row.worse is opened
    assert any("it was at the floor: worse" in line for line in closing([row])) is opened
    assert bool(worsened([row])) is opened


def test_without_an_imu_the_floor_is_unknown_and_counts_as_zero():
    row = gap((blocks(4.0), {KEY: []}), (blocks(1.0), {KEY: []}))[0]
    assert row.floor is None
    assert row.closed == pytest.approx(0.75)


def test_the_interval_holds_the_share_and_follows_its_seed():
    before, after, floor = (
        blocks(9.0, seed=1, spread=0.5),
        blocks(3.0, seed=2, spread=0.5),
        blocks(1.0, seed=3),
    )
    a, b, c = (gap((before, floor), (after, floor), seed=s)[0] for s in (0, 0, 1))
    assert a.ci95 == b.ci95
    assert a.ci95 != c.ci95
    assert a.ci95 is not None
    assert a.closed is not None
    assert a.ci95[0] < a.closed < a.ci95[1]
    assert a.ci95[1] - a.ci95[0] < 0.2


def test_every_group_of_the_table_is_listed_once_in_order():
    rows = gap(
        ({("rotation", s): blocks(2.0)[KEY] for s in (0.1, 0.5)} | blocks(2.0), {}),
        ({("rotation", s): blocks(1.0)[KEY] for s in (0.1, 0.5)} | blocks(1.0), {}),
    )
    assert groups_of(rows) == ("rotation", "rate")
    assert [r.horizon_s for r in rows] == [0.1, 0.5, 0.5]


def test_laws_with_which_errors_grow_are_found_by_group():
    def errors(position: float, rate: float) -> HeldOutErrors:
        own = {("position", 0.5): blocks(position)[KEY], KEY: blocks(rate)[KEY]}
        return HeldOutErrors(own=own, floor=dict.fromkeys(own, blocks(0.1)[KEY]))

    before, named = errors(4.0, 4.0), errors(1.0, 1.0)
    assert outgrown(before, named, errors(0.5, 1.0)) == []
    assert outgrown(before, named, errors(1.0, 1.3)) == [], "less than a tenth of the gap"
    assert outgrown(before, named, errors(0.5, 9.0)) == ["rate 0.5 s ahead"]
    assert outgrown(before, named, None) == ["nothing is foretold"]


@pytest.mark.parametrize(
    ("lawful", "reading", "spread", "grown"),
    [
        (1.3, 0.0, 0.0, True),
        (1.3, 0.5, 0.0, False),  # the sensor would not show it
        (1.6, 0.5, 0.0, True),
        (1.2, 0.0, 1.0, False),  # nor is it beyond chance
    ],
)
def test_laws_are_not_held_against_what_is_less_than_a_reading_or_chance(
    lawful: float, reading: float, spread: float, grown: bool
):
    """A tenth of a gap that is next to nothing is next to nothing."""

    def errors(level: float, spread: float = 0.0) -> HeldOutErrors:
        own, floor = blocks(level, seed=2, spread=spread), blocks(0.9)
        return HeldOutErrors(own=own, floor=floor, reading={"rate": reading})

    found = outgrown(errors(1.5), errors(1.0), errors(lawful, spread))
    assert bool(found) == grown


@pytest.mark.parametrize(("count", "times"), [(20, 1e2), (20, 1e8), (20, np.inf), (1, 1e2)])
def test_laws_that_diverge_in_one_second_are_not_excused_by_chance(count: int, times: float):
    """One of twenty seconds is never beyond two standard errors: its spread grows with it."""

    def errors(level: float, worst: float = 1.0) -> HeldOutErrors:
        own = [level * np.full(20, 1.0 + 0.01 * i) for i in range(count)]
        own[0] = worst * own[0]
        return HeldOutErrors(own={KEY: own}, floor={KEY: [np.full(20, 0.1)] * count})

    assert outgrown(errors(4.0), errors(1.0), errors(1.0, times)) == ["rate 0.5 s ahead"]


@pytest.mark.parametrize(("seen", "why"), [(0.5, "stands against"), (3.0, "of a feedback")])
def test_what_got_worse_has_a_reason(seen: float, why: str):
    """Errors that fall with what the filter sees stand against it; others are a feedback's."""
    worse, better = (
        gap((blocks(a, spread=0.1), {}), (blocks(b, spread=0.1), {}), filtered=blocks(seen**2))
        for a, b in ((4.0, 9.0), (9.0, 4.0))
    )
    assert worse[0].filtered == pytest.approx(seen)
    (said,) = worsened(worse)
    assert said.startswith("rate 0.5 s ahead: worse") and why in said
    assert worsened(better) == []
    assert doubt(better) == ""
    assert ("alone it foretells rate worse" in doubt(worse)) is (why == "stands against")
    assert ("`greybox fit --from`" in doubt(worse)) is (why == "stands against")
    assert doubt([replace(r, after=1.05 * r.before) for r in worse]) == ""
    assert worsened([replace(r, after=1.004 * r.before) for r in worse]) == [], "a trace"


def test_what_got_worse_is_said_where_no_filter_could_be_asked():
    (row,) = gap((blocks(4.0, spread=0.1), {}), (blocks(9.0, spread=0.1), {}))
    assert worsened([row]) == ["rate 0.5 s ahead: worse than without the names"]
