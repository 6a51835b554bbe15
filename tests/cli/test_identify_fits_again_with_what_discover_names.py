"""After discover `greybox identify` fits again with what was named, and takes what foretells
better."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from greybox.cli import build_parser
from greybox.commands.chain.choice import best, best_physics
from greybox.commands.chain.record import StageRecord
from greybox.commands.chain.request import Request, Skip, SoFar, Work
from greybox.commands.chain.stages import NAMES, STAGES
from greybox.files import write_json
from greybox.model.verdict import GroupSkill, Outcome, Verdict
from greybox.validation.usefulness import LEFT_OUT

REFIT = next(s for s in STAGES if s.name == "refit")


def verdict(error: float) -> dict:
    skill = GroupSkill(
        name="rotation",
        unit="rad",
        seconds=0.5,
        error=error,
        last_value=1.0,
        measured_imu=None,
        covered=1 - error,
        worse_from=None,
        calm=False,
    )
    return Verdict(
        outcome=Outcome.USABLE,
        line="useful",
        useful_seconds=1.0,
        judged_seconds=1.0,
        judged_on=LEFT_OUT,
        flights=(),
        groups=(skill,),
    ).to_dict()


def after(out: Path, named: tuple[str, ...], errors: Mapping[str, float]) -> SoFar:
    """What is there when a fit, a search and, where `errors` has them, refit and learn are done."""
    folders = {n: out / f"{i}_{n}" for i, n in enumerate(NAMES, 1)}
    recipe = {"effects": ["motor_lag"], "options": {"per_flight": ["pose_delay.d"]}}
    for name in ("fit", "refit"):
        if name in errors:
            content = {"model": {"effects": ["motor_lag", "gyro_bias"]}, "recipe": recipe}
            write_json(folders[name] / "fit.json", {**content, "verdict": verdict(errors[name])})
    write_json(folders["discover"] / "discovery.json", {"effects": [{"name": n} for n in named]})
    if "learn" in errors:
        judged = {"before": errors["refit"], "after": errors["learn"]}
        validation = {k: {"verdict": verdict(v)} for k, v in judged.items()}
        write_json(folders["learn"] / "learn.json", {"null": False, "validation": validation})
    done = {
        n: StageRecord(name=n, folder=folders[n].name, exit_code=0) for n in (*errors, "discover")
    }
    request = Request(vehicle="v.toml", train=("a.csv", "b.csv"), test=("t.csv",), out=out)
    return SoFar(request=request, folders=folders, done=done)


def test_the_second_fit_has_the_effects_of_the_first_and_what_was_named(tmp_path):
    planned = REFIT.plan(after(tmp_path, ("rotor_drag", "gyro_bias", "nobody"), {"fit": 0.5}))
    assert isinstance(planned, Work)
    (words,) = planned.commands
    read = build_parser().parse_args(list(words))
    assert words[0] == "fit" and read.judge_left_out
    assert words[words.index("--effects") + 1] == "motor_lag,rotor_drag"
    assert words[words.index("--per-flight") + 1] == "pose_delay.d"


def test_there_is_none_where_nothing_new_was_named(tmp_path):
    assert isinstance(REFIT.plan(after(tmp_path, ("motor_lag",), {"fit": 0.5})), Skip)


def test_the_model_that_foretells_better_on_pieces_left_out_is_taken(tmp_path):
    for error, file in ((0.3, "refit"), (0.6, "fit")):
        chosen = best_physics(after(tmp_path / file, ("rotor_drag",), {"fit": 0.5, "refit": error}))
        assert chosen is not None and chosen.model.parent.name.endswith(f"_{file}")


def test_the_learned_part_is_taken_where_the_flight_it_did_not_see_says_so(tmp_path):
    for error, name in ((0.1, "hybrid.json"), (0.29, "hybrid.json"), (0.3, "model.json")):
        errors = {"fit": 0.5, "refit": 0.3, "learn": error}
        chosen = best(after(tmp_path / str(error), ("rotor_drag",), errors))
        assert chosen is not None and chosen.model.name == name
