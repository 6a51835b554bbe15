"""greybox twin: what it writes, and one clear line for each kind of bad input."""

from __future__ import annotations

import json
import locale
import re
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from greybox.cli import main
from greybox.model.verdict import Outcome, Verdict
from greybox.residual.files import save_model
from tests.simulators.identified import identified


def written(folder: Path, values: dict[str, float], outcome: Outcome | None = None) -> str:
    model = identified({"motor_lag.tau": 0.05, **values})
    if outcome is not None:
        verdict = Verdict(
            outcome=outcome,
            line="NOT USABLE: worse than holding the last value",
            useful_seconds=0.0,
            judged_seconds=1.0,
            judged_on="flights",
            flights=("a",),
            groups=(),
        )
        model = replace(model, verdict=verdict)
    path = folder / "model.json"
    save_model(model, path)
    return str(path)


def test_a_vehicle_file_alone_is_enough(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    vehicle = str(tmp_path / "v.toml")
    assert main(["vehicle", "new", "--template", "crazyflie", "--out", vehicle]) == 0
    assert main(["twin", vehicle, "--target", "rotorpy", "--out", str(tmp_path / "t")]) == 0
    said = capsys.readouterr()
    assert "no flight was fitted" in said.err
    assert "RotorPy" in said.out
    assert (tmp_path / "t" / "rotorpy" / "vehicle.py").exists()


@pytest.mark.parametrize(
    ("values", "line"),
    [
        ({"inertia.zz": 1.0}, "no body has the principal moments"),
        ({"inertia.xx": -0.01}, "no body has the principal moments"),
        ({"thrust.c2": -1.0}, "cannot hover"),
    ],
)
def test_what_no_body_is_like_is_refused_in_one_line(
    values: dict[str, float], line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path, values)
    assert main(["twin", path, "--target", "rotorpy", "--out", str(tmp_path / "t")]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert line in said[-1]
    assert not (tmp_path / "t").exists()


def test_a_folder_of_somebody_else_is_left_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, own = written(tmp_path, {}), tmp_path / "thesis"
    own.mkdir()
    (own / "thesis.tex").write_text("years of work")
    command = ["twin", path, "--target", "rotorpy", "--out", str(own)]
    assert main(command) == 2
    assert "something else than a twin" in capsys.readouterr().err
    assert [p.name for p in own.iterdir()] == ["thesis.tex"]
    assert main([*command, "--force"]) == 0
    assert (own / "thesis.tex").read_text() == "years of work"


def test_an_unknown_target_gets_the_nearest_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path, {})
    assert main(["twin", path, "--target", "mujocco", "--out", str(tmp_path / "t")]) == 2
    assert "did you mean mujoco" in capsys.readouterr().err


def test_a_model_that_is_not_usable_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path, {}, Outcome.NOT_USABLE)
    out = str(tmp_path / "t")
    assert main(["twin", path, "--target", "rotorpy", "--out", out]) == 1
    assert "--even-so" in capsys.readouterr().err
    assert not Path(out).exists()
    assert main(["twin", path, "--target", "rotorpy", "--out", out, "--even-so"]) == 0


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (["--target", "rotorpy", "--draws", "0"], "number of draws; expected 1"),
        (
            ["--target", "rotorpy", "--draws", "5", "--seed", "-1"],
            "seed takes a whole number from 0",
        ),
        (["--target", "rotorpy,rotorpy"], "target rotorpy twice"),
        (["--target", ","], "names none"),
        (["--target", "rotorpy", "--check", "a.csv"], "--check without draws"),
        (["--target", "rotorpy", "--train", "a.csv"], "--train without draws"),
    ],
)
def test_options_that_cannot_be_are_refused_in_one_line(
    options: list[str], line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path, {})
    assert main(["twin", path, "--out", str(tmp_path / "t"), *options]) == 2
    assert line in capsys.readouterr().err.strip().splitlines()[-1]
    assert not (tmp_path / "t").exists()


def test_existing_files_stay_and_nothing_is_half_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = written(tmp_path, {}), tmp_path / "t"
    (out / "rotorpy").mkdir(parents=True)
    (out / "rotorpy" / "sensors.toml").write_text("mine")
    arguments = ["twin", path, "--target", "numpy,rotorpy", "--out", str(out)]
    assert main(arguments) == 2
    assert "rotorpy/sensors.toml exist" in capsys.readouterr().err
    assert [p for p in out.rglob("*") if p.is_file()] == [out / "rotorpy" / "sensors.toml"]
    assert (out / "rotorpy" / "sensors.toml").read_text() == "mine"
    assert main([*arguments, "--force"]) == 0


def test_a_forced_twin_leaves_no_files_of_the_old_one(tmp_path: Path) -> None:
    out, mine = tmp_path / "t", tmp_path / "mine"
    lossy, whole = tmp_path / "lossy", tmp_path / "whole"
    for folder in (lossy, whole):
        folder.mkdir()
    old = written(lossy, {"rotational_damping.d_p": 0.01})
    arguments = ["--target", "rotorpy", "--out", str(out), "--force"]
    assert main(["twin", old, *arguments, "--draws", "3"]) == 0
    assert (out / "rotorpy" / "rest.py").exists() and (out / "draws").is_dir()
    lost = (out / "rotorpy" / "LOST.txt").read_text()
    assert "unexplained pushes and effects with a memory are not in it" in lost
    for path in (mine, out / "rotorpy" / "notes.txt"):
        path.write_text("mine")
    listing = json.loads((out / "twin.json").read_text())
    listing["files"] += ["../mine", str(mine), "rotorpy/../../mine", 7]
    (out / "twin.json").write_text(json.dumps(listing))
    assert main(["twin", written(whole, {}), *arguments]) == 0
    left = {p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file()}
    listed = json.loads((out / "twin.json").read_text())["files"]
    assert left == {*listed, "twin.json", "rotorpy/notes.txt"}
    assert "rotorpy/rest.py" not in left
    assert not (out / "draws").exists()
    assert mine.read_text() == "mine"


@pytest.mark.parametrize("target", ["px4", "ardupilot", "pybullet", "flightgoggles"])
def test_a_layout_that_a_target_cannot_express_is_refused_by_name_and_noted_otherwise(
    target: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    vehicle = tmp_path / "hexa.toml"
    assert main(["vehicle", "new", "--template", "racer250", "--out", str(vehicle)]) == 0
    extra = "\n[[rotor]]\nposition = [0.0, 0.2, 0.0]\nspin = 1\n"
    extra += "\n[[rotor]]\nposition = [0.0, -0.2, 0.0]\nspin = 1\n"
    vehicle.write_text(vehicle.read_text().replace("\n[actuator]", extra + "\n[actuator]"))
    out = ["--even-so", "--out", str(tmp_path / "t")]
    assert main(["twin", str(vehicle), "--target", f"numpy,{target}", *out]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert f"nothing is written, no files for {target}: " in said
    assert "four rotors" in said or "6" in said
    assert "Usual fix: choose a target that takes any layout" in said
    assert not (tmp_path / "t").exists()
    if target == "px4":  # all targets once: the others are written
        assert main(["twin", str(vehicle), *out]) == 0
        assert "no files for px4: " in capsys.readouterr().out
        assert (tmp_path / "t" / "gazebo").is_dir() and not (tmp_path / "t" / "px4").exists()


def test_a_vehicle_file_in_grams_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    vehicle, out = tmp_path / "v.toml", str(tmp_path / "t")
    assert main(["vehicle", "new", "--template", "crazyflie", "--out", str(vehicle)]) == 0
    text = vehicle.read_text().splitlines()
    at = next(i for i, row in enumerate(text) if row.startswith("mass"))
    vehicle.write_text("\n".join([*text[:at], "mass = 27.0", *text[at + 1 :]]))
    assert main(["twin", str(vehicle), "--target", "numpy", "--out", out]) == 1
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert "grams" in said and "--even-so" in said
    assert not Path(out).exists()


@pytest.fixture
def decimal_commas(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A locale that writes 0,5; built here, as few machines have one installed."""
    name, kept = "de_DE", locale.setlocale(locale.LC_ALL)
    built = tmp_path / "locales"
    built.mkdir()
    if shutil.which("localedef"):
        command = ["localedef", "-i", "de_DE", "-f", "ISO-8859-1", str(built / name)]
        subprocess.run(command, check=False, capture_output=True)
        if (built / name).is_dir():
            monkeypatch.setenv("LOCPATH", str(built))
    try:
        locale.setlocale(locale.LC_ALL, name)
    except locale.Error:
        pytest.skip("no locale with decimal commas can be had here")
    yield
    locale.setlocale(locale.LC_ALL, kept)


@pytest.mark.usefixtures("decimal_commas")
def test_decimal_commas_of_the_locale_change_nothing(tmp_path: Path) -> None:
    assert locale.localeconv()["decimal_point"] == ","
    path, targets = written(tmp_path, {}), "gazebo,px4,ardupilot,mujoco,pybullet"
    assert main(["twin", path, "--target", targets, "--out", str(tmp_path / "b")]) == 0
    locale.setlocale(locale.LC_ALL, "C")
    assert main(["twin", path, "--target", targets, "--out", str(tmp_path / "a")]) == 0
    for one in (p for p in (tmp_path / "a").rglob("*") if p.is_file()):
        other = tmp_path / "b" / one.relative_to(tmp_path / "a")
        assert one.read_bytes() == other.read_bytes()
        if one.suffix in (".sdf", ".params", ".xml", ".urdf", ".parm"):
            assert not re.search(r"\d,\d{2,}", one.read_text()), one
