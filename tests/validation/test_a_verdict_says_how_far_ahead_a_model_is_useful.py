"""A model is useful as far ahead as it beats the last value; calm flights excuse small errors,
never large ones."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from greybox.errors import DataError
from greybox.files import dump_json
from greybox.model.verdict import Outcome, Verdict
from greybox.validation.advice import ADVICE, Hint, Symptom, likely, symptom_of_group
from greybox.validation.comparison import Standard, standard_error
from greybox.validation.finding import in_words
from greybox.validation.groups import GROUPS
from greybox.validation.horizon_table import GroupErrors, HorizonTable
from greybox.validation.usefulness import FITTED_FLIGHTS, judge

DT = 0.01
SECONDS = DT * np.arange(1, 101)
LIVELY = {"position": 0.44, "velocity": 0.65, "rotation": 0.15, "rate": 0.77}
"""Change within half a second of the flights in the unit of each group."""


def errors(
    curve: np.ndarray, *, blocks: int = 20, spread: float = 0.0, seed: int = 0
) -> GroupErrors:
    """Errors that grow along `curve` (H,), with a relative `spread` from block to block."""
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal(blocks)
    factors = 1.0 + spread * (noise - noise.mean())
    counts = np.full((blocks, len(curve)), 200.0)
    sums = counts * curve * factors[:, None]
    mae = sums.sum(axis=0) / counts.sum(axis=0)
    n = counts.sum(axis=0).astype(np.int64)
    return GroupErrors(
        mae=mae,
        rmse=mae,
        n=n,
        diverged=0 * n,
        origins=int(n[0]),
        left_out=0,
        block_sums=sums,
        block_counts=counts,
    )


def table(label: str, curves: dict[str, np.ndarray], **options: float) -> HorizonTable:
    groups = {g: errors(c, **options) for g, c in curves.items()}
    return HorizonTable(
        label=label, sample_time=DT, required=50, groups=groups, flights={"a": groups}
    )


def held(scale: float = 1.0) -> dict[str, np.ndarray]:
    """The last value's error: grows with the horizon."""
    return {g: scale * size * (SECONDS / 0.5) ** 0.8 for g, size in LIVELY.items()}


def floor(scale: float = 1.0) -> dict[str, np.ndarray]:
    return {g: 0.1 * c for g, c in held(scale).items() if g != "rate"}


def own(ratio: float = 0.4, **groups: np.ndarray) -> dict[str, np.ndarray]:
    """The model's error: `ratio` of the last value's, in the given groups times another curve."""
    return {g: ratio * c * groups.get(g, 1.0) for g, c in held().items()}


def verdict_of(
    model: dict[str, np.ndarray], last: dict[str, np.ndarray] | None = None, **options: object
) -> Verdict:
    last = held() if last is None else last
    return judge(
        table("model", model),
        table("persistence", last),
        table("dead reckoning", floor()),
        **options,
    )


def test_a_model_that_beats_the_last_value_everywhere_is_useful_as_far_as_was_judged() -> None:
    found = verdict_of(own())
    assert found.outcome is Outcome.USABLE
    assert found.exit_code == 0
    assert found.useful_seconds == pytest.approx(1.0)
    assert found.line == "useful for 1 s and more"
    assert found.why[0] == "errors stay below holding the last value"
    assert found.why[1].startswith("0.5 s ahead position ")
    assert found.why[1].endswith("(last value 0.44, measured IMU 0.044)")
    assert len(found.why) == 1 + len(found.groups)
    assert found.lines() == [found.line, *(f"  {w}" for w in found.why)]
    assert found.sentence == found.line
    skill = {g.name: g.covered for g in found.groups}
    assert skill["rate"] == pytest.approx(0.6)
    assert skill["rotation"] == pytest.approx(0.6 / 0.9)


def test_what_is_only_level_with_the_last_value_is_not_called_below_it() -> None:
    level = np.where(SECONDS < 0.3, 1.0, 2.53)  # 0.4 times this is 1 % above: nobody would notice
    found = verdict_of(own(rotation=level))
    assert found.outcome is Outcome.USABLE and found.useful_seconds == pytest.approx(1.0)
    assert found.why[0] == (
        "no error is above holding the last value by more than chance (rotation: level with it)"
    )
    own_angle, last = (np.degrees(v) for v in (0.4 * 2.53 * LIVELY["rotation"], LIVELY["rotation"]))
    assert any(f"rotation {own_angle:.2g} deg (last value {last:.2g}" in w for w in found.why)
    said = next(line for line in in_words(found) if line.startswith("rotation"))
    assert said == "rotation 0.5 s ahead: no better than holding the last value"


def test_the_useful_horizon_ends_where_the_first_group_is_worse() -> None:
    crossing = np.where(SECONDS < 0.425, 1.0, 3.0)
    found = verdict_of(own(rotation=crossing))
    assert found.outcome is Outcome.USABLE
    assert found.useful_seconds == pytest.approx(0.42)
    assert {g.name: g.worse_from for g in found.groups}["rotation"] == pytest.approx(0.43)
    assert any("rotation" in line and "worse" in line for line in in_words(found))


def test_worse_within_a_tenth_of_a_second_is_not_usable_and_says_from_where() -> None:
    found = verdict_of(own(rotation=np.where(SECONDS < 0.025, 1.0, 4.0)))
    assert found.outcome is Outcome.NOT_USABLE
    assert found.exit_code == 1
    assert found.line == "NOT USABLE: rotation is worse than holding the last value from 0.03 s on"
    assert found.why[0].startswith("0.5 s ahead rotation ")
    assert found.why[1:] == (f"likely: {found.reason}", f"next: {found.action} ({found.anchor})")
    assert found.anchor == "docs/bad_fit.md#rotation-worse-than-the-last-value"
    assert found.sentence == "; ".join([found.line, *found.why])
    assert found.sentence.count("\n") == 0


@pytest.mark.parametrize("too", [True, False])
def test_forces_are_not_to_blame_where_dead_reckoning_loses_as_well(too: bool) -> None:
    """A position whose sensor errs for seconds, taken for white noise: the start is off."""
    curve = held()["position"] + 0.5
    best = {**floor(), "position": curve} if too else floor()
    found = judge(
        table("model", {**own(), "position": curve}),
        table("persistence", held()),
        table("dead reckoning", best),
        hints=[Hint(symptom=Symptom.CLOCKS)] if too else [],
    )
    assert found.outcome is Outcome.NOT_USABLE
    assert found.anchor == (Symptom.START if too else Symptom.POSITION).anchor
    assert ("forces are wrong" in found.sentence) is not too


def test_far_worse_at_half_a_second_is_not_usable_even_where_the_start_is_good() -> None:
    late = np.where(SECONDS < 0.3, 1.0, 8.0)
    assert verdict_of(own(rotation=late)).outcome is Outcome.NOT_USABLE
    assert verdict_of(own(rotation=np.where(SECONDS < 0.3, 1.0, 4.0))).outcome is Outcome.USABLE


def test_a_model_that_equals_the_last_value_is_not_useful() -> None:
    found = verdict_of(held())
    assert found.outcome is Outcome.NOT_USABLE
    assert "rotation is no better than holding the last value" in found.line


def test_knowing_how_it_moves_does_not_excuse_not_knowing_how_it_turns() -> None:
    found = verdict_of(own() | {g: 0.95 * held()[g] for g in ("rotation", "rate")})
    assert found.outcome is Outcome.NOT_USABLE
    assert found.anchor.endswith("no-better-than-the-last-value")


def test_predictions_that_are_not_finite_are_not_usable() -> None:
    wild = own()
    wild["rate"] = np.where(SECONDS < 0.2, wild["rate"], np.inf)
    found = verdict_of(wild)
    assert found.outcome is Outcome.NOT_USABLE
    assert found.anchor.endswith(Symptom.DIVERGED.value)
    again = Verdict.from_dict(json.loads(dump_json(found.to_dict())))
    assert again == found


def test_chance_excuses_a_little_and_only_where_blocks_differ() -> None:
    slightly = {g: 1.06 * c if g == "rate" else 0.4 * c for g, c in held().items()}
    calm_blocks = verdict_of(slightly)
    assert calm_blocks.useful_seconds == 0.0
    noisy = judge(
        table("model", slightly, spread=0.3, seed=1),
        table("persistence", held()),
        table("dead reckoning", floor()),
    )
    rate = next(g for g in noisy.groups if g.name == "rate")
    assert rate.worse_from is None
    far = {g: 1.3 * c if g == "rate" else 0.4 * c for g, c in held().items()}
    wild = judge(table("model", far, spread=0.8, seed=1), table("persistence", held()))
    assert wild.outcome is Outcome.NOT_USABLE


def test_the_standard_error_is_that_of_repeated_draws() -> None:
    rng = np.random.default_rng(0)
    means, stated = [], []
    for _ in range(400):
        factors = 1.0 + 0.2 * rng.standard_normal(20)
        counts = np.full((20, 1), 50.0)
        sums = counts * factors[:, None]
        n = np.array([1000])
        model = GroupErrors(
            mae=np.array([factors.mean()]),
            rmse=np.array([1.0]),
            n=n,
            diverged=0 * n,
            origins=1000,
            left_out=0,
            block_sums=sums,
            block_counts=counts,
        )
        last = replace(model, mae=np.array([1.0]), block_sums=counts * 1.0)
        means.append(factors.mean() - 1.0)
        stated.append(standard_error(model, last, 1)[0])
    assert np.mean(stated) == pytest.approx(np.std(means), rel=0.1)


def test_calm_flights_are_too_calm_to_judge_and_the_line_says_which_flight_would_tell() -> None:
    hover = held(0.1)
    model = {g: 1.5 * c for g, c in hover.items()}
    found = judge(
        table("model", model), table("persistence", hover), table("dead reckoning", floor(0.1))
    )
    assert found.outcome is Outcome.TOO_CALM
    assert found.exit_code == 0
    assert found.line == "too calm to judge position, velocity, rotation and rate"
    assert "figures of eight" in found.why[-1]
    assert found.anchor == "docs/bad_fit.md#too-calm-to-judge"


def test_a_calm_flight_does_not_excuse_a_model_that_tips_over() -> None:
    hover = held(0.1)
    model = {g: 1.5 * c for g, c in hover.items()} | {"rotation": 1.2 * (SECONDS / 0.5)}
    found = judge(table("model", model), table("persistence", hover))
    assert found.outcome is Outcome.NOT_USABLE


def test_only_the_groups_that_hardly_move_are_excused() -> None:
    last = held() | {"rotation": held(0.1)["rotation"]}
    found = verdict_of(own() | {"rotation": 2.0 * last["rotation"]}, last)
    assert found.outcome is Outcome.TOO_CALM
    assert found.line == "too calm to judge rotation; the rest is useful for 1 s and more"


def test_logs_of_an_imu_alone_are_judged_a_shorter_time_ahead() -> None:
    last = {g: held()[g] for g in ("rate",)}
    late = {"rate": last["rate"] * np.where(SECONDS < 0.35, 0.4, 4.0)}
    found = judge(table("model", late), table("persistence", last))
    assert found.outcome is Outcome.USABLE
    assert found.groups[0].seconds == pytest.approx(0.3)


def test_an_offset_of_the_accelerometer_spoils_no_model_that_sees_thrust() -> None:
    last = {"rate": held()["rate"], "specific_force": 0.35 + 2.0 * SECONDS}
    offset = {"rate": 0.4 * last["rate"], "specific_force": np.full(100, 0.5)}
    assert judge(table("model", offset), table("persistence", last)).outcome is Outcome.USABLE
    blind = {"rate": 0.4 * last["rate"], "specific_force": np.full(100, 2.0)}
    assert judge(table("model", blind), table("persistence", last)).outcome is Outcome.NOT_USABLE


def test_the_flights_that_were_fitted_are_named_as_such() -> None:
    assert verdict_of(own(), judged_on=FITTED_FLIGHTS).line.endswith(
        "[judged on the flights that were fitted]"
    )


def test_a_group_that_was_measured_and_could_not_be_judged_is_named() -> None:
    known = {g: c for g, c in own().items() if g != "position"}
    last = {g: held()[g] for g in known}
    found = judge(
        replace(table("model", known), unjudged=("position",)), table("persistence", last)
    )
    assert found.outcome is Outcome.PARTLY_JUDGED
    assert found.exit_code == 0
    assert found.line == (
        "position could not be judged: too many samples missing; "
        "the rest is useful for 1 s and more"
    )
    assert found.why[0].startswith("next: greybox check names the gaps")
    assert Verdict.from_dict(json.loads(dump_json(found.to_dict()))) == found
    bad = {g: 3.0 * c for g, c in last.items()}
    found = judge(replace(table("model", bad), unjudged=("position",)), table("persistence", last))
    assert found.outcome is Outcome.NOT_USABLE
    assert found.why[0] == "position could not be judged: too many samples missing"


def test_a_group_without_an_error_where_skill_is_stated_is_not_part_of_usable() -> None:
    def lacking(label: str, curves: dict[str, np.ndarray], gone: np.ndarray) -> HorizonTable:
        made = table(label, curves)
        whole = made.groups["position"]
        mae = np.where(gone, np.nan, whole.mae)
        less = replace(whole, mae=mae, rmse=mae, n=np.where(gone, 0, whole.n))
        return replace(made, groups={**made.groups, "position": less})

    odd = np.arange(1, 101) % 2 == 0
    for gone in (odd, np.ones(100, dtype=bool)):
        found = judge(lacking("model", own(), gone), lacking("persistence", held(), gone))
        assert found.outcome is Outcome.PARTLY_JUDGED
        assert found.line.startswith("position could not be judged")
        assert "nan" not in " ".join(found.lines())
        assert "position" not in {g.name for g in found.groups}


def test_too_little_data_is_refused() -> None:
    short = {g: c[:5] for g, c in held().items()}
    with pytest.raises(DataError, match="not enough to judge"):
        judge(table("model", short), table("persistence", short))


def test_causes_come_before_consequences() -> None:
    hints = [
        Hint(symptom=Symptom.NOT_CONVERGED),
        Hint(symptom=Symptom.BOUNDS, detail="mass, inertia.xx"),
    ]
    reason, _, anchor = likely(hints, Symptom.RATE)
    assert "mass, inertia.xx" in reason
    assert anchor == Symptom.BOUNDS.anchor
    _, _, anchor = likely([*hints, Hint(symptom=Symptom.LATE_MOTORS)], Symptom.RATE)
    assert anchor == Symptom.LATE_MOTORS.anchor


def test_every_symptom_has_advice_and_every_group_a_symptom() -> None:
    assert {a.symptom for a in ADVICE} | {Symptom.CALM} == set(Symptom)
    assert len(ADVICE) == len({a.symptom for a in ADVICE})
    for group in GROUPS:
        assert symptom_of_group(group) in Symptom


def test_every_anchor_that_is_printed_is_a_section_of_the_page() -> None:
    page = Path(__file__).resolve().parents[2] / "docs" / "bad_fit.md"
    headings = re.findall(r"^#+ (.+)$", page.read_text(), flags=re.MULTILINE)
    anchors = {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}
    assert {s.value for s in Symptom} <= anchors


def test_the_standard_is_one_record_whose_numbers_can_be_changed() -> None:
    strict = Standard(minimum=0.5)
    crossing = own(rotation=np.where(SECONDS < 0.425, 1.0, 3.0))
    assert verdict_of(crossing, standard=strict).outcome is Outcome.NOT_USABLE


VIBRATION = 0.15
"""Of a sensor, as a share of the motion within half a second."""


def vibrating(line: float, size: float, motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors (H,) of a perfect model and of the last value in a sensor that shakes at `line` [Hz]."""
    time = np.arange(0.0, 4.0, 1.0 / 250.0)
    shake = size * np.sin(2 * np.pi * line * time)
    noise = np.random.default_rng(5).normal(scale=0.05 * size, size=time.size)
    seen = shake + noise
    model, last = [], []
    for h in range(1, len(motion) + 1):
        model.append(np.abs(seen).mean())
        last.append(np.hypot(np.abs(seen[h:] - seen[:-h]).mean(), motion[h - 1]))
    return np.array(model), np.array(last)


@pytest.mark.parametrize("line", [41.0, 50.0, 90.0])
@pytest.mark.parametrize("group", ["rate", "rotation", "position"])
def test_a_noise_that_repeats_itself_is_no_motion_that_the_last_value_knows(group, line) -> None:
    """At 90 Hz a value of 12 ms ago is the same value again: that is no worse model."""
    seconds = np.arange(1, 251) / 250.0
    motion = {g: size * seconds / 0.5 for g, size in LIVELY.items()}
    errors = {g: 0.1 * m for g, m in motion.items()}
    size = VIBRATION * LIVELY[group]
    errors[group], motion[group] = vibrating(line, size, motion[group])
    assert (errors[group] > 1.1 * motion[group]).any()
    tables = (table("model", errors), table("persistence", motion))
    found = judge(*(replace(t, sample_time=1 / 250) for t in tables))
    assert found.outcome is Outcome.USABLE, found.line


def test_from_then_on_is_said_where_it_is_so() -> None:
    often = np.where((SECONDS > 0.025) & (SECONDS < 0.045), 4.0, 1.0)
    assert verdict_of(own(rotation=often)).line.endswith("the last value from 0.03 to 0.04 s")
    once = np.where((SECONDS > 0.025) & (SECONDS < 0.035), 4.0, 1.0)
    found = verdict_of(own(rotation=once))
    assert found.line.endswith("than holding the last value at 0.03 s")
    assert any("the last value is first better 0.03 s ahead" in line for line in in_words(found))
