"""A bad log or vehicle file gives one clear line, exit code 2, a usual fix, and leaves no file
behind."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest

from greybox.cli import main

HEADER = "t,u1,u2,u3,u4,p,q,r,ax,ay,az"
ROW = "{t},0.5,0.5,0.5,0.5,0.0,0.0,0.0,0.0,0.0,9.81"
GOOD_ROWS = [ROW.format(t=f"{0.01 * k:.2f}") for k in range(200)]
GOOD_LOG = "\n".join([HEADER, *GOOD_ROWS]) + "\n"

VEHICLE = """schema = "greybox.vehicle/1"
name = "test"
mass = 0.03
inertia = [[1.4e-5, 0.0, 0.0], [0.0, 1.4e-5, 0.0], [0.0, 0.0, 2.2e-5]]

[[rotor]]
position = [0.03, -0.03, 0.0]
spin = 1
[[rotor]]
position = [-0.03, -0.03, 0.0]
spin = -1
[[rotor]]
position = [-0.03, 0.03, 0.0]
spin = 1
[[rotor]]
position = [0.03, 0.03, 0.0]
spin = -1

[actuator]
thrust = [0.0, 0.0, 0.15]
torque = [0.0, 0.0, 0.001]

[columns.rate]
fields = ["p", "q", "r"]
"""


def rows(*changed: tuple[int, str]) -> str:
    lines = GOOD_LOG.splitlines()
    for index, text in changed:
        lines[index] = text
    return "\n".join(lines) + "\n"


def without_column(name: str) -> str:
    j = HEADER.split(",").index(name)
    return "\n".join(
        ",".join(c for i, c in enumerate(line.split(",")) if i != j)
        for line in GOOD_LOG.splitlines()
    )


def with_cell(name: str, text: str, row: int | None = None) -> str:
    j = HEADER.split(",").index(name)
    out = []
    for k, line in enumerate(GOOD_LOG.splitlines()):
        cells = line.split(",")
        if k and (row is None or k + 1 == row):
            cells[j] = text
        out.append(",".join(cells))
    return "\n".join(out)


BAD_LOGS = {
    "empty file": ("", "the file is empty"),
    "blank lines only": ("\n\n  \n", "the file is empty"),
    "header only": (HEADER + "\n", "a header but no rows"),
    "one row": ("\n".join([HEADER, GOOD_ROWS[0]]), "at least 2"),
    "no header": ("\n".join(GOOD_ROWS), "no header row"),
    "text in a number": (with_cell("u3", "abc", 17), "row 17, column 'u3'"),
    "a word for missing": (with_cell("p", "n/a", 4), "'n/a' is not a number"),
    "text everywhere": ("t,u1,u2,u3,u4\n" + "\n".join(["a,b,c,d,e"] * 30), "row 2, column 't'"),
    "command of NaN": (with_cell("u2", "nan"), "column 'u2' (u2) holds no value"),
    "empty command column": (with_cell("u4", ""), "column 'u4' (u4) holds no value"),
    "time of NaN": (with_cell("t", "nan"), "column 't' (t) holds no value"),
    "one time missing": (with_cell("t", "", 9), "row 9, column 't'"),
    "infinite value": (with_cell("q", "inf", 30), "infinite value"),
    "minus infinity in time": (with_cell("t", "-inf", 3), "infinite value"),
    "missing command": (without_column("u3"), "no column 'u3'"),
    "missing time": (without_column("t"), "no column 't'"),
    "column twice": (GOOD_LOG.replace("ay", "ax"), "given twice: ax"),
    "ragged, short": (rows((50, "0.49,0.5")), "row 51: 2 cells"),
    "ragged, long": (rows((60, GOOD_ROWS[59] + ",1.0")), "row 61: 12 cells"),
    "cut off": (GOOD_LOG[:-20], "row 201: 7 cells"),
    "open quote": (rows((5, '"0.04,' + GOOD_ROWS[4])), "row 6"),
    "html instead of a log": ("<!DOCTYPE html>\n<html><body>404</body></html>\n", "row"),
}

BAD_LOG_BYTES = {
    "binary": (bytes(range(256)) * 20, "log.csv", "not a text file"),
    "not UTF-8": (b"\xff\xfe" + GOOD_LOG.encode("utf-16-le"), "log.csv", "not a text file"),
    "latin-1": (GOOD_LOG.replace("p,", "\xe9,", 1).encode("latin-1"), "log.csv", "not a text file"),
    "gz that is none": (GOOD_LOG.encode(), "log.csv.gz", "not a gzip file"),
    "gz cut off": (gzip.compress(GOOD_LOG.encode())[:-30], "log.csv.gz", "gzip file is damaged"),
    "gz broken inside": (
        gzip.compress(GOOD_LOG.encode())[:40] + b"\0" * 300,
        "log.csv.gz",
        "gzip file is damaged",
    ),
    "empty gz": (gzip.compress(b""), "log.csv.gz", "the file is empty"),
}

BAD_VEHICLES = {
    "empty file": ("", "schema: missing"),
    "wrong schema": (VEHICLE.replace("vehicle/1", "vehicle/9"), "wrong schema"),
    "syntax": (VEHICLE.replace("mass = 0.03", "mass = = 0.03"), "line 3"),
    "key twice": (VEHICLE.replace("mass = 0.03", "mass = 0.03\nmass = 0.04"), "not valid TOML"),
    "typo at the top": (VEHICLE.replace("mass =", "mas ="), "did you mean mass"),
    "typo in a table": (VEHICLE.replace("thrust =", "trust ="), "did you mean thrust"),
    "typo in a rotor": (VEHICLE.replace("spin", "spinn", 1), "did you mean spin"),
    "typo in a column": (VEHICLE.replace("fields =", "field ="), "did you mean fields"),
    "typo in a group": (VEHICLE.replace("columns.rate", "columns.rates"), "unknown key 'rates'"),
    "fifth command": (
        VEHICLE + '[columns.command]\nfields = ["a", "b", "c", "d", "e"]\n',
        "4 rotors",
    ),
    "no mass": (VEHICLE.replace("mass = 0.03", ""), "mass: missing"),
    "zero mass": (VEHICLE.replace("mass = 0.03", "mass = 0.0"), "mass: must be positive"),
    "negative mass": (VEHICLE.replace("mass = 0.03", "mass = -0.03"), "mass: must be positive"),
    "mass in quotes": (VEHICLE.replace("mass = 0.03", 'mass = "0.03"'), "without quotes"),
    "mass of NaN": (VEHICLE.replace("mass = 0.03", "mass = nan"), "finite"),
    "mass without value": (
        VEHICLE.replace("mass = 0.03", "mass = { sigma = 0.1 }"),
        "mass.value: missing",
    ),
    "negative sigma": (
        VEHICLE.replace("mass = 0.03", "mass = { value = 0.03, sigma = -1.0 }"),
        "mass.sigma",
    ),
    "singular inertia": (
        VEHICLE.replace("0.0, 0.0, 2.2e-5", "0.0, 0.0, 0.0"),
        "singular or not positive",
    ),
    "negative inertia": (VEHICLE.replace("2.2e-5", "-2.2e-5"), "not positive definite"),
    "asymmetric inertia": (VEHICLE.replace("[[1.4e-5, 0.0,", "[[1.4e-5, 1e-6,"), "not symmetric"),
    "impossible inertia": (VEHICLE.replace("2.2e-5", "2.2e-4"), "sum of the other two"),
    "inertia as a vector": (
        VEHICLE.replace(
            "[[1.4e-5, 0.0, 0.0], [0.0, 1.4e-5, 0.0], [0.0, 0.0, 2.2e-5]]", "[1, 1, 1]"
        ),
        "row",
    ),
    "no rotor": (
        VEHICLE[: VEHICLE.index("[[rotor]]")] + VEHICLE[VEHICLE.index("[actuator]") :],
        "rotor: missing",
    ),
    "rotor without spin": (VEHICLE.replace("spin = 1\n", "", 1), "rotor[0].spin: missing"),
    "spin of 2": (VEHICLE.replace("spin = 1\n", "spin = 2\n", 1), "must be 1 or -1"),
    "position of two numbers": (
        VEHICLE.replace("[0.03, -0.03, 0.0]", "[0.03, -0.03]"),
        "2 entries",
    ),
    "two rotors at one place": (VEHICLE.replace("[-0.03, -0.03", "[0.03, -0.03"), "same position"),
    "command range": (
        VEHICLE.replace("[actuator]", "[actuator]\nu_min = 1.0\nu_max = 0.0"),
        "not below u_max",
    ),
    "unknown hold": (
        VEHICLE.replace("[actuator]", '[actuator]\nhold = "previos"'),
        "did you mean previous",
    ),
    "thrust downward": (VEHICLE.replace("0.15]", "-0.15]"), "the thrust map gives"),
    "thrust of text": (
        VEHICLE.replace("[0.0, 0.0, 0.15]", '["a", "b", "c"]'),
        "a number is needed",
    ),
    "no actuator": (VEHICLE[: VEHICLE.index("[actuator]")], "actuator: missing"),
    "scale of zero": (VEHICLE + "scale = 0.0\n", "must not be zero"),
    "causal as text": (VEHICLE + 'causal = "no"\n', "boolean"),
    "table in place of a number": (VEHICLE.replace("name =", "gravity = {}\nname =", 1), "gravity"),
    "column not in the log": (
        VEHICLE + '[columns.command]\nfields = ["motor_1", "u2", "u3", "u4"]\n',
        "unknown column 'motor_1'",
    ),
}


def run(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of `greybox check`."""
    code = main(["check", *arguments])
    out, err = capsys.readouterr()
    return code, out, err


def demand_one_clear_line(
    folder: Path, log: Path, vehicle: Path, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(p.name for p in folder.iterdir())
    code, out, err = run(
        ["--vehicle", str(vehicle), str(log), "--json", str(folder / "out.json")], capsys
    )
    assert code == 2, out
    assert out == ""
    assert err.count("\n") == 1
    assert err.endswith("\n")
    assert "Traceback" not in err
    assert words in err
    assert "Usual fix: " in err
    assert sorted(p.name for p in folder.iterdir()) == before


@pytest.fixture
def good_vehicle(tmp_path: Path) -> Path:
    path = tmp_path / "vehicle.toml"
    path.write_text(VEHICLE)
    return path


@pytest.fixture
def good_log(tmp_path: Path) -> Path:
    path = tmp_path / "log.csv"
    path.write_text(GOOD_LOG)
    return path


@pytest.mark.parametrize("case", BAD_LOGS)
def test_bad_log(case, tmp_path, good_vehicle, capsys):
    text, words = BAD_LOGS[case]
    log = tmp_path / "bad.csv"
    log.write_text(text)
    demand_one_clear_line(tmp_path, log, good_vehicle, words, capsys)


@pytest.mark.parametrize("case", BAD_LOG_BYTES)
def test_bad_bytes(case, tmp_path, good_vehicle, capsys):
    content, name, words = BAD_LOG_BYTES[case]
    log = tmp_path / name
    log.write_bytes(content)
    demand_one_clear_line(tmp_path, log, good_vehicle, words, capsys)


@pytest.mark.parametrize("case", BAD_VEHICLES)
def test_bad_vehicle(case, tmp_path, good_log, capsys):
    text, words = BAD_VEHICLES[case]
    vehicle = tmp_path / "bad.toml"
    vehicle.write_text(text)
    demand_one_clear_line(tmp_path, good_log, vehicle, words, capsys)


def test_files_that_are_not_there(tmp_path, good_log, good_vehicle, capsys):
    demand_one_clear_line(tmp_path, tmp_path / "none.csv", good_vehicle, "no such log", capsys)
    demand_one_clear_line(
        tmp_path, good_log, tmp_path / "none.toml", "no such vehicle file", capsys
    )


def test_folders_in_place_of_files(tmp_path, good_log, good_vehicle, capsys):
    demand_one_clear_line(tmp_path, tmp_path, good_vehicle, "a folder, not a log", capsys)
    demand_one_clear_line(tmp_path, good_log, tmp_path, "a folder, not a vehicle file", capsys)


def test_vehicle_that_is_a_log_and_the_other_way_round(tmp_path, good_log, good_vehicle, capsys):
    demand_one_clear_line(tmp_path, good_log, good_log, "not valid TOML", capsys)
    demand_one_clear_line(tmp_path, good_vehicle, good_vehicle, "row", capsys)


def test_the_same_log_twice(tmp_path, good_log, good_vehicle, capsys):
    code, _, err = run(["--vehicle", str(good_vehicle), str(good_log), str(good_log)], capsys)
    assert code == 2
    assert "given twice: log" in err


def test_time_that_goes_back_is_a_finding_with_exit_code_one(tmp_path, good_vehicle, capsys):
    log = tmp_path / "bad.csv"
    log.write_text(rows((100, GOOD_ROWS[10])))
    code, out, err = run(["--vehicle", str(good_vehicle), str(log)], capsys)
    assert code == 1
    assert err == ""
    assert "time goes back" in out
    assert "row 101" in out
