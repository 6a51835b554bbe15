"""`fit`, `learn` and `compare` refuse flights with a fault, and a vehicle file that no craft is
like, as `discover` does, here and in Python; `validate` says the fault first; what was accepted
goes on and says so."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

import greybox as gb
from greybox.cli import main
from greybox.model.faults import BadDataError
from greybox.model.vehicle import Vehicle
from greybox.plants.flight_log import write_log
from greybox.plants.vehicle_file import write_vehicle
from tests.automatic.craft import flown, plant

COLUMNS = ("t", "u1", "u2", "u3", "u4", "qw", "qx", "qy", "qz", "p", "q", "r")
REFUSED = "BAD DATA: the data have faults that block "
FIT = "fit --vehicle v.toml --train sound.csv --manual --effects motor_lag --out fit"
LEARN = "learn fit/model.json --train sound.csv --points 5 --inputs p,q,r --out hybrid"
COMPARE = "compare --vehicle v.toml --train sound.csv --methods persistence --out table"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sound flights, one whose gyro is in degrees per second, and a model of the first."""
    folder = tmp_path_factory.mktemp("faulty")
    for name, columns in zip(("sound", "other", "faulty"), flown((1, 2, 3)), strict=True):
        scale = 57.29577951308232 if name == "faulty" else 1.0
        own = {k: scale * v if k in ("p", "q", "r") else v for k, v in columns.items()}
        write_log(folder / f"{name}.csv", {k: v for k, v in own.items() if k in COLUMNS})
    write_vehicle(folder / "v.toml", plant(), sigma={"inertia": 0.2, "thrust.c2": 0.2})
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        main(FIT.split())
    return folder


@pytest.fixture(autouse=True)
def inside(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)


@pytest.mark.parametrize(("command", "what"), [(LEARN, "learning"), (COMPARE, "a comparison")])
def test_a_fault_in_any_flight_is_refused_with_its_name(command, what, capsys):
    code = main([*command.split(), "--test", "faulty.csv"])
    first, *faults, following = capsys.readouterr().out.strip().splitlines()
    assert code == 1
    assert first == REFUSED + what
    assert faults and faults[0].startswith("  fault: faulty: ")
    assert all(line.startswith("  fault: ") for line in faults)
    assert "greybox check" in following and "--accept " in following
    assert not Path(command.split()[-1]).exists()


def test_fit_refuses_where_every_flight_has_a_fault_and_leaves_no_old_result(capsys):
    Path("again").mkdir()
    Path("again/fit.json").write_text("{}")
    assert main(["fit", "--vehicle", "v.toml", "--train", "faulty.csv", "--out", "again"]) == 1
    first, *faults, following = capsys.readouterr().out.strip().splitlines()
    assert first == f"{REFUSED}a fit"
    assert faults and all(line.startswith("  fault: faulty: ") for line in faults)
    assert "--accept " in following
    assert not list(Path("again").iterdir())


HEAVY = "--vehicle heavy.toml --train sound.csv"


def heavy() -> Vehicle:
    """A vehicle file in grams."""
    text = Path("v.toml").read_text()
    mass = re.search(r"^mass = .*$", text, re.MULTILINE)
    assert mass is not None
    Path("heavy.toml").write_text(text.replace(mass[0], "mass = 700.0"))
    return gb.read_vehicle("heavy.toml")


@pytest.mark.parametrize(
    "command",
    [
        f"fit {HEAVY} --manual --out none",
        f"compare {HEAVY} --test other.csv --methods persistence --out none",
        f"discover {HEAVY} --out searched",
    ],
)
def test_a_vehicle_file_that_no_craft_is_like_is_refused_by_all_alike(command, capsys):
    heavy()
    assert main(command.split()) == 1
    out = capsys.readouterr().out
    assert out.startswith("BAD DATA: ")
    assert "  fault: heavy.toml: mass: no craft of this size has this mass" in out
    assert "  next: greybox vehicle check heavy.toml" in out
    assert "--accept vehicle goes on all the same" in out
    assert not Path("none").exists()


def test_check_says_once_where_a_vehicle_file_is_wrong(capsys):
    heavy()
    assert main(["check", "--vehicle", "heavy.toml", "sound.csv"]) == 1
    out = capsys.readouterr().out
    assert "blocking heavy.toml [vehicle] mass: no craft of this size has this mass" in out


def test_a_vehicle_file_that_is_accepted_is_fitted_to(capsys):
    heavy()
    main(f"fit {HEAVY} --manual --accept vehicle --max-iterations 1 --out even_so".split())
    assert Path("even_so/fit.json").exists()


def test_so_do_the_functions(folder):
    vehicle, model = gb.read_vehicle("v.toml"), gb.load("fit/model.json")
    sound, faulty = (gb.read_logs([f"{n}.csv"], vehicle) for n in ("sound", "faulty"))
    for refused in (
        lambda: gb.fit(vehicle, faulty),
        lambda: gb.learn(model, faulty),
        lambda: gb.compare(vehicle, sound, faulty),
    ):
        with pytest.raises(BadDataError, match=r"block .*: faulty: .*accept="):
            refused()
    for refused in (lambda: gb.fit(heavy(), sound), lambda: gb.compare(heavy(), sound, faulty)):
        with pytest.raises(BadDataError, match=r"mass: no craft.*accept=\['vehicle'\]"):
            refused()
    assert gb.discover(heavy(), sound).verdict == "bad_data"


def test_the_findings_are_its_json(capsys):
    assert main([*LEARN.split(), "--test", "faulty.csv", "--json", "-"]) == 1
    assert json.loads(capsys.readouterr().out)["schema"] == "greybox.check/1"


def test_validate_says_the_fault_first_and_blames_it(capsys):
    code = main(["validate", "fit/model.json", "--log", "faulty.csv", "--json", "v.json"])
    captured = capsys.readouterr()
    assert "greybox validate: data fault in faulty: " in captured.err
    assert code == 1
    content = json.loads(Path("v.json").read_text())
    assert content["warnings"][0].startswith("data fault in faulty: ")
    assert content["verdict"]["anchor"] == "docs/bad_fit.md#a-log-has-a-fault"


def test_what_is_accepted_goes_on_and_says_so(capsys):
    accepted = "attitude,motors,alignment,ranges"
    main([*COMPARE.split(), "--test", "faulty.csv", "--accept", accepted])
    assert "greybox compare: accepted: faulty: " in capsys.readouterr().err
    assert Path("table/compare.json").exists()


def test_learn_begins_with_what_is_gained_over_the_physics(capsys):
    code = main([*LEARN.split(), "--test", "other.csv"])
    lines = capsys.readouterr().out.splitlines()
    content = json.loads(Path("hybrid/learn.json").read_text())
    beside, verdict = content["against_physics"], content["verdict"]
    at = lines.index(verdict["line"]), lines.index(beside["line"])
    assert min(at) == 0 and (at[0] < at[1]) is bool(code)
    assert at[1] <= 1 + len(verdict["why"])  # the reasons of a refusal stand between
    assert beside["says"] in ("better", "not clear", "worse")
    assert "than the physics alone (fit/model.json): " in beside["line"]
    assert {c["group"] for c in beside["changes"]} == {"rotation", "rate"}


def test_without_test_flights_it_says_what_judged(capsys):
    main(LEARN.split())
    assert "[judged on the flights that were fitted]" in capsys.readouterr().out
