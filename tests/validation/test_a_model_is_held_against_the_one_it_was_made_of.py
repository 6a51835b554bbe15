"""Two models on the same flights differ where the difference is more than chance and worth
something."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.errors import DataError
from greybox.model.verdict import Outcome, Verdict
from greybox.validation.against import against
from greybox.validation.horizon_table import GroupErrors, HorizonTable
from greybox.validation.result import Validation
from greybox.validation.usefulness import FITTED_FLIGHTS, judge

STEPS, COUNT = 100, 200
GROUPS = ("position", "rotation")


def table(
    blocks: dict[str, list[float]], label: str = "model", sample_time: float = 0.01
) -> HorizonTable:
    """Mean errors of each block of a group at one step ahead, growing with the horizon."""
    growth = np.arange(1, STEPS + 1) / STEPS
    groups = {}
    for name, means in blocks.items():
        sums = COUNT * np.outer(means, growth)
        mean = np.asarray(np.mean(means) * growth)
        groups[name] = GroupErrors(
            mae=mean,
            rmse=mean,
            n=np.full(STEPS, COUNT * len(means)),
            diverged=np.zeros(STEPS, dtype=np.int64),
            origins=COUNT * len(means),
            left_out=0,
            block_sums=sums,
            block_counts=np.full(sums.shape, float(COUNT)),
        )
    return HorizonTable(
        label=label, sample_time=sample_time, required=50, groups=groups, flights={"c": groups}
    )


def seen(position: list[float], rotation: list[float], sample_time: float = 0.01) -> Validation:
    own = table({"position": position, "rotation": rotation}, sample_time=sample_time)
    held = table({"position": [10.0] * 6, "rotation": [10.0] * 6}, sample_time=sample_time)
    return Validation(
        model="m",
        file=None,
        flights=[{"name": "c", "samples": 1000, "seconds": 10.0, "notes": []}],
        sample_time=sample_time,
        horizons=(1, 10, 50, 100),
        table=own,
        persistence=held,
        verdict=judge(own, held),
    )


LEVEL = [1.0, 1.1, 0.9, 1.2, 0.8, 1.0]
BEFORE = seen(LEVEL, LEVEL)


def verdict_of(after: Validation) -> Verdict:
    assert after.verdict is not None
    return against(BEFORE, after).judged(after.verdict, "physics.json")


def test_what_grows_in_every_block_is_worse_and_not_usable() -> None:
    after = seen([1.0 * e for e in LEVEL], [1.5 * e + 0.01 * k for k, e in enumerate(LEVEL)])
    found = against(BEFORE, after)
    assert found.says == "worse"
    assert [c.group for c in found.worse] == ["rotation"]
    verdict = verdict_of(after)
    assert verdict.outcome is Outcome.NOT_USABLE
    assert verdict.line.startswith("NOT USABLE: worse than the physics alone on c: rotation")
    assert "use the physics model: physics.json" in verdict.line


def test_what_falls_in_every_block_is_better_and_changes_no_verdict() -> None:
    after = seen([0.8 * e + 0.01 * k for k, e in enumerate(LEVEL)], LEVEL)
    assert against(BEFORE, after).says == "better"
    assert verdict_of(after) == after.verdict


def test_the_line_names_every_group_at_a_sample_time_that_no_decimal_ends() -> None:
    """A log at 120 Hz whose stamps have nine digits: 60 of its steps are 0.4999999998 s."""
    both = seen(LEVEL, LEVEL, sample_time=0.00833333333)
    line = against(both, both).line("physics.json")
    assert "0.5 s ahead position 0.6 -> 0.6 m, rotation" in line


def test_what_grows_in_one_block_only_is_chance() -> None:
    after = seen([*LEVEL[:-1], 2.0], LEVEL)
    assert against(BEFORE, after).says == "not clear"


def test_what_grows_everywhere_by_less_than_a_trace_is_no_difference() -> None:
    assert against(BEFORE, seen([1.009 * e for e in LEVEL], LEVEL)).says == "not clear"
    assert against(BEFORE, seen([1.011 * e for e in LEVEL], LEVEL)).says == "worse"


@pytest.mark.parametrize("times", [0.8, 1.2])
def test_less_than_one_reading_is_no_difference_one_sample_ahead_and_is_one_later(
    times: float,
) -> None:
    """One sample ahead an error is mostly the sensor's own: 1.7 % of that made a model worse whose
    errors were half as large a second ahead. Later it is the model's."""
    after, says = seen([times * e for e in LEVEL], LEVEL), ("better", "worse")[times > 1]
    squares = abs(times**2 - 1) * 0.01**2  # of the errors one step ahead
    for reading, level in ((0.99 * squares, False), (1.01 * squares, True), (1.0, True)):
        found = against(BEFORE, after, {"position": reading})
        first, *later = (c for c in found.changes if c.group == "position")
        assert (first.seconds, first.level, first.clear) == (0.01, level, not level)
        assert found.says == says and all(c.clear for c in later)
    first = against(BEFORE, after, {"rotation": 1.0}).changes[0]
    assert first.clear


def test_a_prediction_that_diverges_is_worse() -> None:
    after = seen(LEVEL, [*LEVEL[:-1], np.inf])
    found = against(BEFORE, after)
    assert found.says == "worse"
    assert [c.group for c in found.worse] == ["rotation"]
    assert found.to_dict("the physics alone")["changes"][-1]["after"] is None


def test_the_line_names_every_group_half_a_second_ahead_and_what_judged() -> None:
    after = seen(LEVEL, LEVEL)
    assert after.verdict is not None
    after = replace(after, verdict=replace(after.verdict, judged_on=FITTED_FLIGHTS))
    line = against(BEFORE, after).line("the physics alone (physics.json)")
    assert line == (
        "not clearly better or worse than the physics alone (physics.json): 0.5 s ahead position 0.5 -> 0.5 m, "
        "rotation 28.6 -> 28.6 deg [judged on the flights that were fitted]"
    )


def test_flights_that_were_learned_from_do_not_show_that_it_is_better_on_others() -> None:
    """A push learned from one real flight was "better" there, and worse on three of four others."""
    after = seen([0.8 * e for e in LEVEL], LEVEL)
    assert after.verdict is not None
    assert against(BEFORE, after).says == "better"
    after = replace(after, verdict=replace(after.verdict, judged_on=FITTED_FLIGHTS))
    found = against(BEFORE, after)
    assert found.says == "not clear"
    assert found.line("the physics alone").startswith(
        "not known to be better, on flights that it has not learned from, than the physics alone: "
        "0.5 s ahead position 0.5 -> 0.4 m"
    )
    grown = seen([1.2 * e for e in LEVEL], LEVEL)
    grown = replace(grown, verdict=replace(after.verdict, judged_on=FITTED_FLIGHTS))
    assert against(BEFORE, grown).says == "worse"


def test_what_is_better_elsewhere_than_half_a_second_ahead_is_said_with_where() -> None:
    after = seen([0.8 * e + 0.01 * k for k, e in enumerate(LEVEL)], LEVEL)
    line = against(BEFORE, after).line("the physics alone")
    assert line.startswith("better than the physics alone: 0.5 s ahead position 0.5 -> ")
    found = replace(against(BEFORE, after), ahead=0.7)
    assert "; most position " in found.line("the physics alone")


def test_what_may_be_chance_is_no_proof_of_no_better_and_no_rise_is_hidden() -> None:
    wild = [0.2, 0.1, 0.3, 2.9, 0.2, 0.3]  # a third less on average, of one block
    before = replace(seen(LEVEL, LEVEL), horizons=(10, 50))
    after = replace(seen([1.2, 0.4, 0.3, 0.5, 0.4, 1.2], LEVEL), horizons=(10, 50))
    assert after.table is not None
    rotation = after.table.groups["rotation"]
    sums = rotation.block_sums.copy()
    sums[:, 9] = COUNT * np.array(wild) * 0.3  # twice the error, at one horizon
    risen = replace(rotation, block_sums=sums, mae=sums.sum(axis=0) / (COUNT * 6))
    groups = {**after.table.groups, "rotation": risen}
    after = replace(after, table=replace(after.table, groups=groups))
    found = against(before, after)
    assert found.says == "not clear"
    line = found.line("the physics alone")
    assert line.startswith("not clearly better or worse than the physics alone: 0.5 s ahead")
    assert "may be chance: rotation 5.73 -> 11.5 deg 0.1 s ahead, position " in line


def test_chance_calls_few_pairs_of_equal_models_different() -> None:
    rng = np.random.default_rng(0)
    said = []
    for _ in range(300):
        first, second = (
            seen(*(rng.uniform(0.5, 1.5, 6).tolist() for _ in range(2))) for _ in range(2)
        )
        said.append(against(first, second).says)
    assert said.count("worse") / 300 < 0.06
    assert said.count("better") / 300 < 0.06


def test_other_flights_are_no_comparison() -> None:
    other = replace(BEFORE, flights=[])
    with pytest.raises(DataError, match="same flights"):
        against(BEFORE, other)
