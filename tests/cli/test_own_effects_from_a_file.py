"""An effect from a user's file is listed, fitted, saved by name, asked for at loading, validated
and cited."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib import resources
from pathlib import Path

import jsonschema
import pytest

from greybox.cli import main
from greybox.excitation.hover import Hover
from greybox.excitation.injection import rich_excitation
from greybox.model.effects_file import load_effects
from greybox.model.identified import IdentifiedModel
from greybox.model.model import PhysicsModel
from greybox.model.vehicle import read_vehicle
from greybox.plants.flight_log import fly, member, write_log
from greybox.plants.presets import controller_for
from greybox.plants.vehicle_file import write_vehicle
from scenarios.studies.recovery import plant
from tests.friction import FRICTION
from tests.one_run import results_of_one_run
from tests.residual import hybrid_cases


def valid(kind: str, content: dict) -> dict:
    schema = json.loads(resources.files("greybox.schemas").joinpath(f"{kind}.json").read_text())
    jsonschema.validate(content, schema)
    return content


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("own")
    true_plant = plant()
    log = fly(
        true_plant,
        controller_for(true_plant),
        Hover(),
        rich_excitation(),
        3.0,
        seed=[1, 2],
        warm_up=0.5,
    )
    write_log(folder / "a.csv", member(log, 0), drop=["omega"])
    write_log(folder / "b.csv", member(log, 1), drop=["omega"])
    write_vehicle(folder / "v.toml", true_plant, sigma={"inertia": 0.2, "thrust.c2": 0.2})
    (folder / "friction.py").write_text(FRICTION)
    return folder


@pytest.mark.slow
def test_from_listing_to_citation(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(files)
    assert main(["effects", "friction", "--effects-file", "friction.py", "--json"]) == 0
    listed = valid("effects", json.loads(capsys.readouterr().out))
    assert [e["name"] for e in listed["effects"]] == ["friction"]

    fit = [
        "fit",
        "--vehicle",
        "v.toml",
        "--train",
        "a.csv",
        "--test",
        "b.csv",
        "--out",
        str(tmp_path / "own"),
    ]
    fit += ["--effects", "motor_lag,command_delay,rotor_drag", "--effects-file", "friction.py"]
    with results_of_one_run(
        tmp_path / "own", "report.html", "validate.json", "fit.json", "model.json"
    ):
        code = main(fit)
    assert code == 0
    fitted = json.loads((tmp_path / "own" / "fit.json").read_text())["parameters"]
    truth = plant().truth()["parameters"]
    for axis in "pq":
        mine = fitted[f"friction.d_{axis}"]
        assert abs(mine["value"] - truth[f"rotational_damping.d_{axis}"]) < 4 * mine["std"]
    path = tmp_path / "own" / "model.json"
    content = valid("model", json.loads(path.read_text()))
    assert content["own_effects"]["friction"]["file"] == "friction.py"
    assert "ca.vertcat" not in path.read_text(), "a model file holds no code"
    capsys.readouterr()

    assert main(["validate", str(path), "--log", "b.csv"]) == 2
    assert "--effects-file friction.py" in capsys.readouterr().err
    assert (
        main(
            [
                "validate",
                str(path),
                "--log",
                "b.csv",
                "--effects-file",
                "friction.py",
                "--json",
                "-",
            ]
        )
        == 0
    )
    capsys.readouterr()
    model = IdentifiedModel.load(path, effects=load_effects("friction.py"))
    assert "friction" in model.effects
    assert main(["cite", str(path)]) == 0
    assert "Doe 2024, Friction of air" in capsys.readouterr().out


def test_a_bad_effects_file_is_one_line_and_exit_code_two(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(files)
    (tmp_path / "bad.py").write_text(FRICTION.replace("flow.omega", "flow.omeg"))
    for command in (
        ["effects"],
        ["fit", "--vehicle", "v.toml", "--train", "a.csv", "--out", str(tmp_path / "out")],
    ):
        assert main([*command, "--effects-file", str(tmp_path / "bad.py")]) == 2
        shown = capsys.readouterr().err.splitlines()[-1]
        assert "bad.py:16" in shown
        assert "omeg" in shown
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", ["fit", "compare"])
def test_a_model_with_an_own_effect_is_read_with_its_file(
    command: str,
    files: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """--from and --fitted ask for the effects file by name, and take it."""
    monkeypatch.chdir(files)
    vehicle = read_vehicle("v.toml")
    own = PhysicsModel(vehicle=vehicle).with_effect("motor_lag", *load_effects("friction.py"))
    path = tmp_path / "model.json"
    replace(hybrid_cases.craft_model(own), trained_on=("other",)).save(path)
    option, test = {"fit": ("--from", []), "compare": ("--fitted", ["--test", "b.csv"])}[command]
    logs = ["--train", "nowhere.csv" if command == "fit" else "a.csv", *test]
    line = [command, "--vehicle", "v.toml", option, str(path), *logs, "--out", str(tmp_path / "o")]
    assert main(line) == 2
    assert "--effects-file friction.py" in capsys.readouterr().err
    assert main([*line, "--effects-file", "friction.py"]) == 2
    said = capsys.readouterr().err
    assert "friction" not in said and ("nowhere.csv" in said or "other flights" in said)
