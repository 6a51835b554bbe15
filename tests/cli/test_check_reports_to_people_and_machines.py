"""`greybox check` prints a report, writes JSON that its published schema accepts, and answers by
its exit code."""

from __future__ import annotations

import gzip
import json
from importlib.resources import files

import jsonschema
import pytest

from greybox.cli import main
from greybox.examples import flight_path, vehicle_path

SCHEMA = json.loads(files("greybox").joinpath("schemas/check.json").read_text())
NANO = (
    "--vehicle",
    str(vehicle_path("nanobench")),
    str(flight_path("nanobench", "B2_circle_fast_rep1")),
)


def test_schema_is_itself_valid():
    jsonschema.Draft202012Validator.check_schema(SCHEMA)


def test_clean_flight_to_standard_output(capsys):
    assert main(["check", *NANO, "--json", "-"]) == 0
    result = json.loads(capsys.readouterr().out)
    jsonschema.validate(result, SCHEMA)
    assert result["verdict"] == "warnings"
    assert result["counts"]["blocking"] == 0
    assert result["flights"][0]["name"] == "B2_circle_fast_rep1"


def test_report_and_file(tmp_path, capsys):
    target = tmp_path / "deep" / "check.json"
    log = str(flight_path("arpl_crazyflie", "log16"))
    assert (
        main(
            ["check", "--vehicle", str(vehicle_path("arpl_crazyflie")), log, "--json", str(target)]
        )
        == 0
    )
    jsonschema.validate(json.loads(target.read_text()), SCHEMA)
    out = capsys.readouterr().out
    assert "cannot be judged: attitude (no attitude" in out
    assert "motion follows the commands by" in out


def test_blocking_fault_gives_exit_code_one(tmp_path, capsys):
    text = gzip.decompress(flight_path("nanobench", "B2_circle_fast_rep1").read_bytes()).decode()
    log = tmp_path / "swapped.csv"
    log.write_text(
        text.replace("motor_motor_m1", "M")
        .replace("motor_motor_m2", "motor_motor_m1")
        .replace("M,", "motor_motor_m2,")
    )
    target = tmp_path / "check.json"
    assert main(["check", *NANO[:2], str(log), "--json", str(target)]) == 1
    result = json.loads(target.read_text())
    jsonschema.validate(result, SCHEMA)
    assert result["verdict"] == "blocking"
    (finding,) = [f for f in result["findings"] if f["severity"] == "blocking"]
    assert finding["check"] == "motors"
    assert "u1 drives rotor 2" in finding["message"]
    assert "usual fix" in capsys.readouterr().out


def test_missing_arguments_are_usage_errors(capsys):
    with pytest.raises(SystemExit) as caught:
        main(["check", "log.csv"])
    assert caught.value.code == 2
    assert "--vehicle" in capsys.readouterr().err
