"""What was decided can be repeated: the explicit command and the Python source give the same
numbers to the last digit."""

from __future__ import annotations

import json
import shlex
import subprocess
from importlib import resources
from pathlib import Path

import jsonschema
import pytest

import greybox as gb
from greybox.cli import main
from greybox.files import dump_json
from greybox.plants.flight_log import write_log
from greybox.plants.vehicle_file import write_vehicle
from tests.automatic.craft import flown, plant

COLUMNS = ("t", "u1", "u2", "u3", "u4", "p", "q", "r")
NUMBERS = ("parameters", "noise", "cost", "correlations", "derived", "status")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two training flights and one to test, and the plain command's results in `fit`."""
    folder = tmp_path_factory.mktemp("plain")
    for name, columns in zip("abc", flown((1, 2, 3)), strict=True):
        write_log(folder / f"{name}.csv", {k: v for k, v in columns.items() if k in COLUMNS})
    write_vehicle(
        folder / "v.toml", plant(), sigma={"inertia": 0.2, "thrust.c2": 0.2, "mass": 0.01}
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        command = "fit --vehicle v.toml --train a.csv b.csv --test c.csv --out fit --seed 3"
        assert main(command.split()) == 0
    return folder


def read(path: Path) -> dict:
    return json.loads(path.read_text())


def numbers(content: dict) -> dict:
    kept = {k: content[k] for k in NUMBERS}
    kept["status"] = {k: v for k, v in kept["status"].items() if k != "seconds"}
    return kept


def test_fit_json_holds_decisions_recipe_and_what_repeats_them(folder):
    content = read(folder / "fit" / "fit.json")
    schema = json.loads(resources.files("greybox.schemas").joinpath("fit.json").read_text())
    jsonschema.validate(content, schema)
    assert {d["about"] for d in content["decisions"]} >= {
        "effects",
        "disturbance states",
        "criterion",
        "mass",
    }
    assert all(d["reason"] and d["option"].startswith("--") for d in content["decisions"])
    assert set(content["recipe"]["effects"]) == set(content["model"]["effects"])
    assert content["explicit"]["command"].startswith(
        "greybox fit --vehicle v.toml --train a.csv b.csv --test c.csv --manual"
    )


def test_the_explicit_command_gives_the_same_numbers(folder, monkeypatch):
    monkeypatch.chdir(folder)
    first = read(folder / "fit" / "fit.json")
    words = shlex.split(first["explicit"]["command"])
    assert main([*words[1:], "--out", "again"]) == 0
    again = read(folder / "again" / "fit.json")
    assert numbers(again) == numbers(first)
    assert "decisions" not in again
    seen, once_more = (read(folder / f / "validate.json") for f in ("fit", "again"))
    assert once_more["horizons"] == seen["horizons"]
    assert again["verdict"] == first["verdict"]


def test_the_script_says_the_explicit_command_and_hands_on_what_is_added(folder):
    typed = "greybox() { printf '%s\\n' \"$@\"; }; . fit/command.sh"
    ran = ["sh", "-c", typed, "sh", "--out", "elsewhere"]
    said = subprocess.run(ran, cwd=folder, capture_output=True, text=True, check=True).stdout
    command = read(folder / "fit" / "fit.json")["explicit"]["command"]
    assert said.splitlines() == [*shlex.split(command)[1:], "--out", "elsewhere"]


@pytest.mark.slow
def test_without_test_flights_it_is_judged_on_the_same_pieces_with_the_same_first_line(
    folder, monkeypatch, capsys
):
    monkeypatch.chdir(folder)
    plain = "fit --vehicle v.toml --train a.csv --out alone --seed 3"
    assert main(plain.split()) == 0
    said = capsys.readouterr().out.splitlines()[0]
    words = shlex.split(read(folder / "alone" / "fit.json")["explicit"]["command"])
    assert "--judge-left-out" in words
    assert main([*words[1:], "--out", "alone_again"]) == 0
    assert capsys.readouterr().out.splitlines()[0] == said
    assert said.endswith("[on pieces left out]")
    verdicts = [read(folder / f / "fit.json")["verdict"] for f in ("alone", "alone_again")]
    assert verdicts[0] == verdicts[1]


def test_so_does_the_python_source(folder, monkeypatch):
    monkeypatch.chdir(folder)
    first = read(folder / "fit" / "fit.json")
    vehicle = gb.read_vehicle("v.toml")
    known = {"gb": gb, "vehicle": vehicle, "data": gb.read_logs(["a.csv", "b.csv"], vehicle)}
    exec(first["explicit"]["python"], known)
    assert numbers(json.loads(dump_json(known["result"].to_dict()))) == numbers(first)


def test_the_same_flights_give_the_same_decisions_and_numbers_in_python(folder, monkeypatch):
    monkeypatch.chdir(folder)
    first = read(folder / "fit" / "fit.json")
    vehicle = gb.read_vehicle("v.toml")
    train, test = (gb.read_logs(paths, vehicle) for paths in (["a.csv", "b.csv"], ["c.csv"]))
    said: list[str] = []
    result = gb.fit(vehicle, train, test=test, say=said.append, seed=3)
    content = json.loads(dump_json(result.to_dict()))
    assert content["decisions"] == first["decisions"]
    assert content["recipe"] == first["recipe"]
    assert numbers(content) == numbers(first)
    assert result.verdict is not None
    assert content["verdict"] == first["verdict"]
    assert any("effects: motor_lag" in line for line in said)
