"""export and mpc refuse a model that was judged not usable in one line, unless told --even-so; old
files pass. What begins with a model and is judged in its turn refuses one that is not finished."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest

import greybox as gb
from greybox.cli import main
from greybox.commands.judgement import gate
from greybox.errors import FileFormatError, ModelError
from greybox.files import read_json, write_json
from greybox.model.identified import IdentifiedModel
from greybox.model.linear import LinearModel
from greybox.model.matrices import Matrices
from greybox.model.verdict import NOT_JUDGED, UNFINISHED, GroupSkill, Outcome, Verdict
from greybox.residual.files import load_model, save_model
from greybox.symbolic import Layout, Signal
from tests.mpc_export import cases
from tests.simulators.identified import identified

LINES = {
    Outcome.USABLE: "useful for 0.42 s: errors stay below holding the last value",
    Outcome.TOO_CALM: "too calm to judge rotation",
    Outcome.NOT_USABLE: "NOT USABLE: rotation is worse than holding the last value from 0.03 s on",
}


def verdict(outcome: Outcome, error: float = 0.2) -> Verdict:
    skill = GroupSkill(
        name="rotation",
        unit="rad",
        seconds=0.5,
        error=error,
        last_value=0.15,
        measured_imu=0.05,
        covered=(0.15 - error) / 0.1,
        worse_from=0.03,
        calm=False,
    )
    return Verdict(
        outcome=outcome,
        line=LINES[outcome],
        useful_seconds=0.02,
        judged_seconds=1.0,
        judged_on="flights",
        flights=("a",),
        groups=(skill,),
    )


def written(folder: Path, outcome: Outcome | None, kind: str = "physics") -> Path:
    model = cases.hybrid() if kind == "hybrid" else cases.physics()
    path = folder / "model.json"
    save_model(replace(model, verdict=None if outcome is None else verdict(outcome)), path)
    return path


@pytest.mark.parametrize("kind", ["physics", "hybrid"])
def test_a_verdict_stays_with_its_file_and_leaves_with_a_change(kind: str, tmp_path: Path) -> None:
    model = load_model(written(tmp_path, Outcome.USABLE, kind))
    assert model.verdict == verdict(Outcome.USABLE)
    assert model.with_values({"mass": 1.1 * model.values["mass"]}).verdict is None
    schema = json.loads((Path(__file__).parents[2] / "greybox/schemas/model.json").read_text())
    jsonschema.validate(read_json(tmp_path / "model.json"), schema)


def test_errors_that_are_not_finite_survive_the_file(tmp_path: Path) -> None:
    wild = verdict(Outcome.NOT_USABLE, float("inf"))
    save_model(replace(cases.physics(), verdict=wild), tmp_path / "model.json")
    assert load_model(tmp_path / "model.json").verdict == wild


@pytest.mark.parametrize("command", ["export", "mpc"])
@pytest.mark.parametrize("kind", ["physics", "hybrid"])
def test_what_is_not_usable_is_refused_in_one_line(
    command: str, kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path, Outcome.NOT_USABLE, kind)
    out = tmp_path / "out"
    assert main([command, str(path), "--out", str(out)]) == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert LINES[Outcome.NOT_USABLE] in line
    assert "--even-so" in line
    assert not out.exists()


def test_even_so_goes_on_and_still_says_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path, Outcome.NOT_USABLE)
    assert (
        main(
            ["export", str(path), "--out", str(tmp_path / "out"), "--target", "casadi", "--even-so"]
        )
        == 0
    )
    assert f"warning: {path}: {LINES[Outcome.NOT_USABLE]}" in capsys.readouterr().err


@pytest.mark.parametrize("outcome", [Outcome.USABLE, Outcome.TOO_CALM, None])
def test_everything_else_passes_and_says_what_it_is_worth(
    outcome: Outcome | None, tmp_path: Path
) -> None:
    path = written(tmp_path, outcome)
    found = gate(read_json(path), str(path), even_so=False)
    assert found.open
    assert (NOT_JUDGED if outcome is None else LINES[outcome]) in found.line
    assert ("warning" in found.line) is (outcome is not Outcome.USABLE)


NO_LOG = "nowhere.csv"
BEGIN = {
    "learn": "learn MODEL --train LOG",
    "profile": "profile MODEL --train LOG --of mass",
    "plan": "plan --model MODEL --for rotor_drag --seconds -1",
    "frf": "frf --model MODEL --train LOG --inputs roll --outputs p",
    "compare": "compare --vehicle VEHICLE --fitted MODEL --train LOG --test LOG",
    "fit": "fit --vehicle VEHICLE --from MODEL --train LOG",
    "discover": "discover --from MODEL --train LOG",
}


@pytest.mark.parametrize("command", BEGIN)
@pytest.mark.parametrize("said", [UNFINISHED, verdict(Outcome.NOT_USABLE), None])
def test_what_is_not_finished_is_no_beginning(
    command: str, said: Verdict | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "model.json", tmp_path / "out"
    save_model(replace(cases.physics(), verdict=said), path)
    words = {"MODEL": path, "LOG": NO_LOG, "VEHICLE": gb.examples.vehicle_path("nanobench")}
    line = [str(words.get(w, w)) for w in [*BEGIN[command].split(), "--out", str(out)]]
    code, found = main(line), capsys.readouterr().err
    assert not list(out.rglob("*"))
    assert (code == 1) is (said is UNFINISHED), found
    if said is None:
        assert "warning" not in found
        return
    assert f"{path}: {said.line}" in found
    if said is UNFINISHED:
        assert "--even-so" in found and len(found.strip().splitlines()) == 1
        assert main([*line, "--even-so"]) == 2
        assert f"warning: {path}: {said.line}" in capsys.readouterr().err


PYTHON = {
    "learn": lambda model, flight: gb.learn(model, flight),
    "fit": lambda model, flight: gb.fit(model.physics.vehicle, flight, source=model),
    "discover": lambda model, flight: gb.discover(model.physics.vehicle, flight, since=model),
    "plan": lambda model, _flight: gb.plan(model=model, seconds=5.0),
}


@pytest.mark.parametrize("name", PYTHON)
def test_python_begins_with_no_unfinished_model_either(name: str) -> None:
    model = replace(cases.physics(), verdict=UNFINISHED)
    flight = gb.dataset_from_arrays(np.arange(3) / 100, {"u1": np.zeros(3)})
    with pytest.raises(ModelError, match="UNFINISHED"):
        PYTHON[name](model, flight)


UNSETTLED = "not converged: iteration limit reached"


@pytest.mark.parametrize("count", [1, 2])
def test_a_linear_model_that_did_not_converge_says_so_wherever_it_goes(
    count: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    models = [
        LinearModel(
            name=f"linear-{o}",
            matrices=Matrices(*[np.full((1, 1), v) for v in (0.9, 1.0, 1.0, 0.0, 0.1)]),
            noise=np.eye(1),
            dt=0.01,
            inputs=Layout([Signal(name=f"u{o}", unit="1")]),
            outputs=Layout([Signal(name=o, unit="rad/s")]),
            unsettled="" if o == "r" else UNSETTLED,
        )
        for o in ("q", "r")[:count]
    ]
    rows = [m.to_dict() for m in models]
    path = tmp_path / "model.json"
    write_json(
        path, rows[0] if count == 1 else {"schema": "greybox.linear_models/1", "models": rows}
    )
    out = tmp_path / "out"
    assert main(["export", str(path), "--out", str(out), "--target", "casadi"]) == 0
    assert f"warning: {path}: {UNSETTLED}" in capsys.readouterr().err
    (note,) = [n for n in read_json(out / "manifest.json")["notes"] if UNSETTLED in n]
    assert "Beware" in (text := (out / "README.md").read_text()) and note[1:] in text


def test_one_step_errors_learned_on_a_linear_model_are_not_sent_to_validate() -> None:
    """`validate` does not take them: they are judged where they were learned."""
    base = {"schema": "greybox.linear_model/1"}
    content: dict[str, object] = {"schema": "greybox.model/1", "kind": "output-hybrid"}
    assert gate({**content, "base": base}, "h.json", even_so=False).line == ""
    unsettled = {**base, "unsettled": UNSETTLED}
    found = gate({**content, "base": unsettled}, "h.json", even_so=False)
    assert found.line == f"warning: h.json: {UNSETTLED}"


def test_a_bundle_carries_a_verdict_that_is_not_usable(tmp_path: Path) -> None:
    path = written(tmp_path, Outcome.NOT_USABLE)
    out = tmp_path / "out"
    assert main(["export", str(path), "--out", str(out), "--target", "casadi", "--even-so"]) == 0
    assert LINES[Outcome.NOT_USABLE] in read_json(out / "manifest.json")["notes"]
    assert LINES[Outcome.NOT_USABLE] in (out / "README.md").read_text()


def test_a_broken_verdict_is_bad_input(tmp_path: Path) -> None:
    content = dict(read_json(written(tmp_path, Outcome.USABLE)))
    content["verdict"] = {"outcome": "usable"}
    with pytest.raises(FileFormatError, match="verdict"):
        gate(content, "model.json", even_so=False)
    with pytest.raises(FileFormatError):
        IdentifiedModel.from_dict(content)


def _exported(model: IdentifiedModel, out: Path, **options: bool) -> object:
    return gb.export(model, out, targets=["casadi"], **options)


def _twin(model: IdentifiedModel, out: Path, **options: bool) -> object:
    return gb.twin(model, ["numpy"], out=out, **options)


@pytest.mark.parametrize(
    ("build", "model"),
    [(_exported, cases.physics), (_exported, cases.hybrid), (_twin, lambda: identified({}))],
)
def test_python_refuses_like_the_command(
    build: Callable[..., object], model: Callable[[], IdentifiedModel], tmp_path: Path
) -> None:
    out, refused = tmp_path / "out", replace(model(), verdict=verdict(Outcome.NOT_USABLE))
    with pytest.raises(ModelError, match=r"NOT USABLE: rotation .*even_so=True"):
        build(refused, out)
    assert not out.exists()
    build(refused, out, even_so=True)
    assert out.exists()
