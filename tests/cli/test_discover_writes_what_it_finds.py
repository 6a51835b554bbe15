"""`greybox discover` writes discovery.json, model.json and report.html, keeps them when
interrupted, refuses bad input."""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import shutil
from importlib import resources
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

import greybox.discovery.cause
import greybox.discovery.workflow
from greybox.cli import main
from greybox.commands.flight_logs import read_flight_logs
from greybox.estimation.record import sample_time
from greybox.examples import flight_path, vehicle_path
from greybox.excitation.injection import rich_excitation
from greybox.excitation.waypoints import RandomWaypoints
from greybox.files import set_aside
from greybox.model.effects_file import load_effects
from greybox.model.identified import IdentifiedModel
from greybox.model.vehicle import read_vehicle
from greybox.plants.effects import RotationalDamping
from greybox.plants.flight_log import fly, member, write_log
from greybox.plants.presets import controller_for, x250
from greybox.plants.vehicle_file import write_vehicle
from tests.friction import FRICTION
from tests.one_run import results_of_one_run


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("discover")
    plant = x250([RotationalDamping(d_p=4e-3, d_q=4e-3, d_r=4e-3)])
    log = fly(
        plant,
        controller_for(plant),
        RandomWaypoints(),
        rich_excitation(),
        4.0,
        seed=[1, 2, 3],
        warm_up=1.0,
    )
    for i, name in enumerate(("a", "b", "c")):
        write_log(folder / f"{name}.csv", member(log, i), drop=["omega"])
    write_vehicle(folder / "v.toml", plant, sigma={"inertia": 0.2, "thrust.c2": 0.2})
    (folder / "friction.py").write_text(FRICTION)
    lines = (folder / "a.csv").read_text().splitlines()
    one, two = (lines[0].split(",").index(u) for u in ("u1", "u2"))
    swapped = [lines[0]]
    for line in lines[1:]:
        cells = line.split(",")
        cells[one], cells[two] = cells[two], cells[one]
        swapped.append(",".join(cells))
    (folder / "swapped.csv").write_text("\n".join(swapped) + "\n")
    return folder


def command(files: Path, *more: str) -> list[str]:
    out = ["discover", "--vehicle", str(files / "v.toml")]
    return [*out, *(str(files / m) if m.endswith((".csv", ".py")) else m for m in more)]


def valid(path: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(path.read_text())
    schema = json.loads(resources.files("greybox.schemas").joinpath("discovery.json").read_text())
    jsonschema.validate(content, schema)
    return content


@pytest.fixture(scope="module")
def unnamed(files: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Folder of a search with nothing to name, and what it said."""
    out = tmp_path_factory.mktemp("unnamed") / "found"
    said = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(said):
        patch.setattr(greybox.discovery.cause, "CATALOGUE", ())
        assert (
            main(
                [*command(files, "--train", "a.csv", "b.csv", "--test", "c.csv"), "--out", str(out)]
            )
            == 0
        )
    return out, said.getvalue()


def laws_in(folder: Path) -> list[Path]:
    return sorted(folder.glob("proposal_*.py"))


def test_an_own_effect_is_named_and_everything_is_written(
    files: Path,
    unnamed: tuple[Path, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    """Also over an earlier search: one that finds no law leaves no model of the earlier one, and
    laws, which may have been edited, under another name."""
    monkeypatch.setattr(greybox.discovery.cause, "CATALOGUE", ())
    shutil.copytree(unnamed[0], tmp_path, dirs_exist_ok=True)
    law = laws_in(tmp_path)[0]
    law.write_text(law.read_text() + "# mine\n")
    (tmp_path / "proposal_mine.py").write_text("")
    arguments = command(
        files, "--train", "a.csv", "b.csv", "--test", "c.csv", "--effects-file", "friction.py"
    )
    assert (
        main(
            [
                *arguments,
                "--out",
                str(tmp_path),
                "--json",
                str(tmp_path / "again.json"),
                "--max-effects",
                "2",
            ]
        )
        == 0
    )
    said = capsys.readouterr()
    assert "step 2: friction" in said.err
    assert said.out.startswith("MISSING: friction (d_p")
    content = valid(tmp_path / "discovery.json")
    assert content == json.loads((tmp_path / "again.json").read_text())
    assert content["verdict"] == "named"
    assert [e["name"] for e in content["effects"]] == ["friction"]
    assert content["trained_on"] == ["a", "b"]
    assert content["tested_on"] == ["c"]
    assert content["settings"]["max_effects"] == 2
    assert content["model_with_laws"] is None
    assert content["effects_files"] == [str(files / "friction.py")]
    assert not (tmp_path / "model_with_laws.json").exists()
    assert [path.name for path in laws_in(tmp_path)] == ["proposal_mine.py"]
    assert (tmp_path / f"{law.name}.old").read_text().endswith("# mine\n")
    own = load_effects(files / "friction.py")
    model = IdentifiedModel.load(tmp_path / "model.json", effects=own)
    assert model.effects == ("friction",)
    assert model.values["friction.d_p"] == pytest.approx(
        content["effects"][0]["parameters"]["d_p"]["value"]
    )
    page = (tmp_path / "report.html").read_text()
    for text in (
        "friction",
        "What has a name",
        "Where simulation and data disagree",
        "How far the gap closed",
    ):
        assert text in page
    # Bad data search nothing and leave what was there.
    assert main(command(files, "--train", "swapped.csv", "--out", str(tmp_path))) == 1
    assert (tmp_path / "model.json").exists()


def test_laws_come_with_a_model_that_has_them(
    files: Path, unnamed: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Of a search with nothing to name: the model loads with the files beside it, and other
    commands take both."""
    out, said = unnamed
    laws = laws_in(out)
    assert laws
    assert all(law.name in said for law in laws)
    assert f"greybox learn {out / 'model_with_laws.json'}" in said
    model = IdentifiedModel.load(
        out / "model_with_laws.json", effects=[e for law in laws for e in load_effects(law)]
    )
    assert sum(n.startswith("proposal_") for n in model.effects) == len(laws)
    assert any(e["proposal"] for e in valid(out / "discovery.json")["unnamed"])
    before, after = (
        [
            "validate",
            str(out / name),
            "--log",
            str(files / "c.csv"),
            "--horizons",
            "0.1",
            "--json",
            str(tmp_path / name),
        ]
        for name in ("model.json", "model_with_laws.json")
    )
    assert main(before) == 0
    assert main([*after, "--effects-file", *map(str, laws)]) == 0

    def error(name: str) -> float:
        (row,) = json.loads((tmp_path / name).read_text())["horizons"]
        return float(row["groups"]["rate"]["rmse"])

    assert error("model_with_laws.json") < 0.7 * error("model.json")
    # A search into the same folder would write over laws that were edited there.
    again = command(files, "--train", "a.csv", "--effects-file", str(laws[0]), "--out", str(out))
    capsys.readouterr()
    assert main(again) == 2
    assert "may write over it" in capsys.readouterr().err


def test_files_that_are_set_aside_are_never_written_over(tmp_path: Path):
    for text in ("first", "second", "third"):
        path = tmp_path / "proposal_1.py"
        path.write_text(text)
        assert set_aside(path).read_text() == text
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {
        "proposal_1.py.old": "first",
        "proposal_1.py.old2": "second",
        "proposal_1.py.old3": "third",
    }


def test_an_interruption_keeps_what_was_found(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def stop(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(greybox.discovery.cause, "CATALOGUE", ())
    monkeypatch.setattr(greybox.discovery.workflow, "certificates", stop)
    arguments = command(
        files, "--train", "a.csv", "--effects-file", "friction.py", "--out", str(tmp_path)
    )
    with results_of_one_run(tmp_path, "discovery.json", "model.json", "report.html"):
        assert main(arguments) == 130
    said = capsys.readouterr().err.splitlines()[-1]
    assert f"what was found until then, not judged, is in {tmp_path}" in said
    assert "fits kept; the same command goes on: greybox discover" in said
    content = valid(tmp_path / "discovery.json")
    assert content["verdict"] == "stopped"
    assert content["effects"] == []  # nothing is judged yet
    assert "stopped before its end" in content["warnings"][0]
    model = IdentifiedModel.load(
        tmp_path / "model.json", effects=load_effects(files / "friction.py")
    )
    assert np.isfinite(model.values["friction.d_p"])
    assert "stopped before its end" in (tmp_path / "report.html").read_text()
    assert main([*arguments, "--alpha", "0.01"]) == 130
    assert "other input (--alpha): all starts anew" in capsys.readouterr().err
    assert main([*arguments, "--alpha", "0.01"]) == 130
    assert "going on where it was stopped" in capsys.readouterr().err


def test_bad_data_are_an_answer_and_not_an_error(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert (
        main(command(files, "--train", "swapped.csv", "--out", str(tmp_path), "--json", "-")) == 1
    )
    content = json.loads(capsys.readouterr().out)
    assert content == valid(tmp_path / "discovery.json")
    assert content["verdict"] == "bad_data"
    assert content["faults"][0].startswith("swapped: ")
    assert not (tmp_path / "model.json").exists()
    assert "would be read as physics" in (tmp_path / "report.html").read_text()


def test_one_bad_log_among_good_ones_is_named(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    logs = ("--train", "b.csv", "swapped.csv", "--test", "c.csv")
    assert main(command(files, *logs, "--out", str(tmp_path))) == 1
    said = capsys.readouterr().out
    assert said.startswith("BAD DATA")
    assert "fault: swapped: the motor order is wrong" in said
    assert "2 other flight(s) do not show it" in said


def test_a_vehicle_file_that_no_craft_is_like_is_not_searched(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    vehicle = tmp_path / "far.toml"
    vehicle.write_text((files / "v.toml").read_text().replace("[0.088, -0.088,", "[9.5, -0.088,"))
    words = ["discover", "--vehicle", str(vehicle), "--train", str(files / "a.csv")]
    assert main([*words, "--out", str(tmp_path / "out")]) == 1
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("BAD DATA")
    assert "rotor.position: arms of no small multirotor" in said[1]
    assert "got 9.5" in said[1]
    assert "--accept vehicle" in said[2]
    assert valid(tmp_path / "out" / "discovery.json")["verdict"] == "bad_data"


def test_what_a_log_lacks_is_said_below_the_first_line(
    files: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.setattr(greybox.discovery.cause, "CATALOGUE", ())
    header, *rows = (files / "a.csv").read_text().splitlines()
    p = header.split(",").index("p")
    cells = [row.split(",") for row in rows]
    lines = [",".join([*c[:p], "", *c[p + 1 :]]) for c in cells]
    (tmp_path / "half.csv").write_text("\n".join([header, *lines]))
    code = main(command(files, "--train", str(tmp_path / "half.csv"), "--out", str(tmp_path)))
    said = capsys.readouterr().out.splitlines()
    assert code == 0
    assert said[1].startswith("warning: half [gaps] channel p: column p is missing")
    assert "the rate (p, q, r) is left out" in said[1]


BAD = {
    "no such log": (["--train", "nothing.csv"], "nothing.csv"),
    "alpha": (["--train", "a.csv", "--alpha", "2"], "--alpha"),
    "max effects": (["--train", "a.csv", "--max-effects", "-1"], "--max-effects"),
    "adapt": (["--train", "a.csv", "--adapt", "-1"], "--adapt"),
    "both": (["--train", "a.csv", "--test", "a.csv"], "both train and test"),
    "no such effects file": (["--train", "a.csv", "--effects-file", "none.py"], "none.py"),
    "a model beside a vehicle": (
        ["--train", "a.csv", "--from", "model.json"],
        "one of --vehicle, --model-file and --from",
    ),
    "a vehicle to go on with": (["--train", "a.csv", "--continue", "found"], "its own model"),
}


@pytest.mark.parametrize("case", list(BAD))
def test_bad_input_is_one_line_and_exit_code_2(
    files: Path, tmp_path: Path, case: str, capsys: pytest.CaptureFixture[str]
):
    more, needle = BAD[case]
    out = tmp_path / "out"
    assert main([*command(files, *more), "--out", str(out)]) == 2
    err = capsys.readouterr().err.strip()
    assert err.startswith("greybox discover: ")
    assert "\n" not in err
    assert needle in err
    assert not out.exists()


@pytest.mark.parametrize(
    ("arguments", "needle"),
    [
        (["--train", "a.csv"], "one of --vehicle, --model-file and --from"),
        (["--train", "a.csv", "--from", "none.json"], "none.json"),
        (["--continue", "found"], "further flights"),
        (["--continue", "nowhere", "--train", "a.csv"], "nowhere"),
    ],
)
def test_nothing_to_start_from_is_one_line_and_exit_code_2(
    files: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    needle: str,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.chdir(files)
    before = sorted(p.name for p in files.iterdir())
    assert main(["discover", *arguments]) == 2
    err = capsys.readouterr().err.strip()
    assert "\n" not in err and needle in err
    assert sorted(p.name for p in files.iterdir()) == before


def test_fast_logs_are_searched_at_the_rate_that_the_response_needs(
    capsys: pytest.CaptureFixture[str],
):
    """A real log of 1 kHz, whose craft answers within what 100 Hz show; a rate that is asked for
    is kept."""
    arguments = argparse.Namespace(mapping=None, keep_impossible=False)
    vehicle = read_vehicle(vehicle_path("arpl_crazyflie"))
    log = [str(flight_path("arpl_crazyflie", "log16"))]
    found = read_flight_logs(arguments, log, vehicle, rate="needed")
    assert sample_time(found) == pytest.approx(0.01)
    assert "taken at 100 Hz" in capsys.readouterr().err
    assert sample_time(read_flight_logs(arguments, log, vehicle, rate=500.0)) == pytest.approx(2e-3)
    assert not capsys.readouterr().err
