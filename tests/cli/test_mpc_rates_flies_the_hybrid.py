"""greybox mpc rates: the paper's hybrid flies; a page, a table and a schema; what does not belong
to it is one line."""

import json
import xml.etree.ElementTree as ET
from importlib import resources

import jsonschema
import pytest

from greybox.cli import main


@pytest.mark.parametrize(
    "extra",
    [
        ["--course", "a:b"],
        ["--log", "a.csv"],
        ["--pace", "2"],
        ["--plant", "a:b"],
        ["--risk", "boole"],
        ["--jobs", "2"],
        ["--even-so"],
        ["--mcap", "f.mcap"],
    ],
)
def test_what_belongs_to_a_course_is_refused_in_one_line(extra, tmp_path, capsys):
    assert main(["mpc", "rates", *extra, "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err.strip()
    assert extra[0] in said and "rates" in said and "\n" not in said
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_the_tube_keeps_rates_that_plain_plans_and_pid_pass(tmp_path, capsys):
    command = ["mpc", "rates", "--flights", "3", "--out", str(tmp_path)]
    assert main(command) == 0
    printed = capsys.readouterr().out
    content = json.loads((tmp_path / "mpc_rates.json").read_text())
    jsonschema.validate(
        content, json.loads((resources.files("greybox.schemas") / "mpc_rates.json").read_text())
    )
    found = content["controllers"]
    assert {n: c["flights"] for n, c in found.items()} == dict.fromkeys(found, 3)
    for plain in ("pid", "linear", "hybrid"):
        assert found[plain]["beyond"]["count"] == 3
    assert found["tube"]["beyond"]["count"] == 0
    assert found["tube"]["samples_beyond"] < found["linear-tube"]["samples_beyond"]
    assert content["verdict"] in printed
    assert all(n in printed for n in found)
    page = (tmp_path / "report.html").read_text()
    ids = [e.get("id") for e in ET.fromstring(page[len("<!DOCTYPE html>") :]).iter() if e.get("id")]
    assert {"rates", "rates-play", "rates-p", "rates-q", "rates-r"} <= set(ids)
    assert len(ids) == len(set(ids))
    # A second run finds every flight there, and says the same.
    rows = (tmp_path / "flights.jsonl").read_text()
    assert main(command) == 0
    assert (tmp_path / "flights.jsonl").read_text() == rows
    again = json.loads((tmp_path / "mpc_rates.json").read_text())
    assert again == content
