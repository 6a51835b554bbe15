"""`greybox check` prints a report, writes JSON that its published schema accepts, and answers by
its exit code."""

from __future__ import annotations

import gzip
import json
import re
from importlib.resources import files

import jsonschema
import pytest

import greybox
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


@pytest.mark.parametrize(
    ("factor", "severity", "code"), [(10.0, "blocking", 1), (3.0, "warning", 0)]
)
def test_a_vehicle_file_that_a_fit_doubts_is_not_clean(factor, severity, code, tmp_path, capsys):
    """What `fit` refuses or warns of is a finding of `check`, of Python's too."""
    longer = re.sub(
        r"position = \[([^]]*)\]",
        lambda m: f"position = {[factor * float(v) for v in m[1].split(',')]}",
        vehicle_path("nanobench").read_text(),
    )
    file = tmp_path / "arms.toml"
    file.write_text(longer)
    log = NANO[2]
    assert main(["check", "--vehicle", str(file), log, "--json", str(tmp_path / "c.json")]) == code
    result = json.loads((tmp_path / "c.json").read_text())
    jsonschema.validate(result, SCHEMA)
    assert severity in {f["severity"] for f in result["findings"] if f["check"] == "vehicle"}
    vehicle = greybox.read_vehicle(file)
    data = greybox.read_logs([log], vehicle)
    assert greybox.check(data, vehicle).of("vehicle")[0].severity == severity


def test_missing_arguments_are_usage_errors(capsys):
    with pytest.raises(SystemExit) as caught:
        main(["check", "log.csv"])
    assert caught.value.code == 2
    assert "--vehicle" in capsys.readouterr().err
