"""What users read about effects (terminal, JSON, docs page, list of citations) is what the
declarations say."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

import jsonschema
import pytest

from greybox.commands import cite, effects, effects_output
from greybox.errors import FileFormatError, UnknownNameError
from greybox.model.effects import CATALOGUE
from greybox.model.example import example_vehicle

ROOT = Path(__file__).resolve().parents[2]


def call(command, *arguments):
    parser = argparse.ArgumentParser()
    command.add(parser.add_subparsers())
    chosen = parser.parse_args([command.__name__.rsplit(".", 1)[1], *map(str, arguments)])
    return chosen.run(chosen)


def valid(result):
    schema = json.loads(
        (ROOT / "greybox" / "schemas" / f"{result['schema'].split('.')[1][:-2]}.json").read_text()
    )
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.validate(result, schema)
    return result


def test_the_docs_page_is_up_to_date():
    assert (ROOT / "docs" / "effects.md").read_text() == effects_output.markdown(), (
        "write it again: python -m greybox.commands.effects --markdown > docs/effects.md"
    )


def test_the_docs_writer_runs_as_its_page_says():
    done = subprocess.run(
        [sys.executable, "-m", "greybox.commands.effects", "--markdown"],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=True,
    )
    assert done.stdout == effects_output.markdown()


def test_json_holds_the_whole_catalogue_and_fits_its_schema(capsys):
    assert call(effects, "--json") == 0
    result = valid(json.loads(capsys.readouterr().out))
    assert [e["name"] for e in result["effects"]] == [e.name for e in CATALOGUE]
    by_name = {e["name"]: e for e in result["effects"]}
    assert by_name["motor_lag"]["parameters"][0]["name"] == "motor_lag.tau"
    assert by_name["motor_lag"]["parameters"][0]["lower"] == 0.0
    assert by_name["blade_flapping"]["parameters"][0]["lower"] is None
    nothing = {"sensors": [], "other_sensors": [], "effects": []}
    assert (
        by_name["battery_sag"]["needs"]
        == {"columns": ["vbat"], "vehicle": ["nominal_voltage"]} | nothing
    )
    assert "parasitic_drag" in by_name["steady_wind"]["needs"]["effects"]


def test_the_terminal_shows_every_effect_with_its_units_and_sources(capsys):
    assert call(effects) == 0
    shown = capsys.readouterr().out
    for effect in CATALOGUE:
        assert f"  {effect.name}: {effect.summary}" in shown
        assert all(f"{p.name} [{p.unit}]" in shown for p in effect.parameters(example_vehicle()))
    assert max(map(len, shown.splitlines())) <= 120


def test_a_name_or_a_stage_narrows_the_list(capsys, tmp_path):
    out = tmp_path / "e.json"
    assert call(effects, "rotor_drag", "--json", out) == 0
    assert [e["name"] for e in valid(json.loads(out.read_text()))["effects"]] == ["rotor_drag"]
    assert call(effects, "--stage", "body", "--json") == 0
    shown = capsys.readouterr().out
    assert {e["stage"] for e in json.loads(shown[shown.index('{\n "schema"') :])["effects"]} == {
        "body"
    }
    with pytest.raises(UnknownNameError, match=r"rotor_drga.*did you mean rotor_drag"):
        call(effects, "rotor_drga")


def model_file(tmp_path, **more):
    path = tmp_path / "model.json"
    path.write_text(
        json.dumps(
            {"schema": "greybox.model/1", "kind": "physics", "name": "m", "effects": []} | more
        )
    )
    return path


def test_a_model_is_cited_with_method_effects_data_and_software(tmp_path, capsys):
    path = model_file(
        tmp_path, effects=["rotor_drag", "motor_lag"], vehicle={"name": "Crazyflie (ARPL)"}
    )
    assert call(cite, path, "--json") == 0
    result = valid(json.loads(capsys.readouterr().out))
    reasons = {w["text"]: w["for"] for w in result["works"]}
    assert len(reasons) == len(result["works"]), "every work once"
    for effect in CATALOGUE:
        for reference in effect.references:
            if effect.name in ("rotor_drag", "motor_lag"):
                assert f"effect {effect.name}" in reasons[reference]
    # The paper behind the ARPL logs is also that of the motor lag: one entry, two reasons.
    eschmann = next(r for t, r in reasons.items() if t.startswith("Eschmann"))
    assert eschmann == "effect motor_lag, data set ARPL Crazyflie logs"
    assert any(t.startswith("Ljung") for t in reasons)
    assert any(t.startswith("Ghoul") for t in reasons)
    assert not any(t.startswith("Bangura") for t in reasons), "blade_flapping is not in the model"


def test_data_sets_that_the_model_names_are_cited(tmp_path, capsys):
    path = model_file(tmp_path, data_sets=["NanoBench", "Doe 2025, Flights of a barn door"])
    assert call(cite, path) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "arXiv:2603.09908" in shown
    assert "Doe 2025, Flights of a barn door" in shown


def test_disturbance_states_bring_their_source(tmp_path):
    assert not any(
        "Kristensen" in w.text for w in cite.works(json.loads(model_file(tmp_path).read_text()))
    )
    some = cite.works(json.loads(model_file(tmp_path, disturbance=["force"]).read_text()))
    assert any("Kristensen" in w.text for w in some)


@pytest.mark.parametrize(
    ("content", "error"),
    [
        ({"schema": "greybox.fit/1"}, FileFormatError),
        ({}, FileFormatError),
        ({"schema": "greybox.model/1", "effects": "motor_lag"}, FileFormatError),
        ({"schema": "greybox.model/1", "effects": ["motor_lagg"]}, UnknownNameError),
    ],
)
def test_what_is_not_a_model_is_refused(tmp_path, content, error):
    path = tmp_path / "wrong.json"
    path.write_text(json.dumps(content))
    with pytest.raises(error):
        call(cite, path)
    with pytest.raises(FileFormatError, match="no such file"):
        call(cite, tmp_path / "absent.json")
