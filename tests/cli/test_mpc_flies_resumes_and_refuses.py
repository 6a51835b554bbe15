"""greybox mpc: flights of a model file, kept and resumed, a page and a schema; bad input is one
line, nothing is left."""

import importlib.util
import json
import re
import shutil
import xml.etree.ElementTree as ET
from importlib import resources

import jsonschema
import pytest

from greybox.cli import main
from greybox.data.readers.ros import read_ros
from greybox.errors import ModelError
from greybox.residual.files import save_model
from mpc_export.mission import campaign, prepare
from tests.mpc_export import cases

COURSE = ["--course", "tests.cli.short_course:SHORT", "--pace", "1"]
BOOLE = ["--risk", "boole"]


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    save_model(cases.disturbed(), folder / "model.json")
    cases.linear().save(folder / "linear.json")
    return folder


@pytest.fixture(scope="module")
def flown(models, tmp_path_factory):
    """Folder of a finished run of two flights per controller."""
    out = tmp_path_factory.mktemp("flown")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prepare, "TUNING", 2)
        recorded = ["--mcap", str(out / "flights.mcap")] if importlib.util.find_spec("mcap") else []
        words = [
            str(models / "model.json"),
            *COURSE,
            *BOOLE,
            "--flights",
            "2",
            "--out",
            str(out),
            *recorded,
        ]
        assert main(["mpc", *words]) == 0
    return out


def rows(folder):
    return [json.loads(line) for line in (folder / "flights.jsonl").read_text().splitlines()]


def test_result_follows_its_schema_and_counts_its_rows(flown):
    content = json.loads((flown / "mpc.json").read_text())
    schema = json.loads((resources.files("greybox.schemas") / "mpc.json").read_text())
    jsonschema.validate(content, schema)
    assert content["what"]["mode"] == "model"
    assert list(content["controllers"]) == ["mean", "tube", "constant", "cascade"]
    for name, c in content["controllers"].items():
        mine = [r for r in rows(flown) if r["controller"] == name]
        assert c["flights"] == len(mine) == 2
        assert c["crossed"]["count"] == sum(bool(r["crossings"] or r["crashed"]) for r in mine)
        assert c["margins"]["wall"] == pytest.approx(min(r["margins"]["wall"] for r in mine))
    assert content["controllers"]["tube"]["kappa"] > 0
    assert content["controllers"]["tube"]["solve_ms"]["count"] > 50


def test_page_is_whole_and_runs_nothing_but_its_own_script(flown):
    page = (flown / "report.html").read_text()
    tree = ET.fromstring(page[len("<!DOCTYPE html>") :])
    ids = [e.get("id") for e in tree.iter() if e.get("id")]
    assert len(ids) == len(set(ids))
    assert "http:" not in page
    assert "https:" not in page
    assert not any(name.startswith("on") for e in tree.iter() for name in e.attrib)
    assert len(page.encode()) < 6_000_000
    data = json.loads(next(e.text for e in tree.iter("script") if e.get("id") == "flight-data"))
    assert [f["seed"] for f in data["flights"]] == [1000, 1001]
    assert data["flights"][0]["plans"]


@pytest.mark.skipif(
    importlib.util.find_spec("mcap") is None, reason="the extra `logs` is not installed"
)
def test_a_recording_has_every_watched_flight_with_its_plans_and_crossings(flown):
    streams = read_ros(flown / "flights.mcap").streams
    for row in rows(flown):
        root = f"/flight_{row['seed']}/{row['controller']}"
        assert streams[f"{root}/margin"].fields["value.tilt"].max() == pytest.approx(
            row["tilt"], abs=0.02
        )
        place = streams[f"{root}/pose"]
        assert place.t[-1] == pytest.approx(row["seconds"], abs=0.03)
        assert place.fields["pose.orientation.w"].min() < 1.0  # it tilts
        assert (f"{root}/crossings" in streams) == bool(row["crossings"])
    assert {"/flight_1000/tube/plan", "/flight_1001/mean/plan", "/flight_1000/tube/tf"} <= set(
        streams
    )


def test_what_the_report_warns_of_is_said(models, flown, tmp_path, monkeypatch, capsys):
    def fails(*_, **__):
        raise ModelError("rehearsed flights fail too often")

    monkeypatch.setattr(prepare, "TUNING", 2)
    monkeypatch.setattr(prepare, "rehearsed", fails)
    out = shutil.copytree(flown, tmp_path / "again")
    command = ["mpc", str(models / "model.json"), *COURSE, "--flights", "2", "--out", str(out)]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "warning: Rehearsals do not bound the risk, so that Boole's inequality does" in said


def test_a_second_run_keeps_the_old_flights_and_adds_the_new(models, flown, monkeypatch, capsys):
    monkeypatch.setattr(prepare, "TUNING", 2)
    before = (flown / "flights.jsonl").read_text()
    command = ["mpc", str(models / "model.json"), *COURSE, *BOOLE, "--out", str(flown)]
    assert main([*command, "--flights", "3", "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["controllers"]["tube"]["flights"] == 3
    after = (flown / "flights.jsonl").read_text()
    assert after.startswith(before)
    assert len(after.splitlines()) == len(before.splitlines()) + 4


@pytest.mark.slow
def test_an_interrupted_run_against_another_plant_reports_what_was_flown(
    models, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(prepare, "TUNING", 2)
    monkeypatch.setattr(prepare, "REHEARSED", (0.5, 2.0))
    monkeypatch.setattr(prepare, "REHEARSALS", 4)
    whole = campaign.Hangar.fly

    def stopped(self, entry, seed, **options):
        if entry.name == "constant":
            raise KeyboardInterrupt
        return whole(self, entry, seed, **options)

    monkeypatch.setattr(campaign.Hangar, "fly", stopped)
    command = [
        "mpc",
        str(models / "model.json"),
        *COURSE,
        "--flights",
        "2",
        "--level",
        "0.4",
        "--out",
        str(tmp_path),
    ]
    assert main([*command, "--plant", "greybox.plants.presets:nano"]) == 130
    assert "interrupted" in capsys.readouterr().err
    assert [r["controller"] for r in rows(tmp_path)] == ["mean", "tube"]
    content = json.loads((tmp_path / "mpc.json").read_text())
    assert content["what"]["mode"] == "plant"
    assert content["controllers"]["constant"]["flights"] == 0
    assert content["tuning"]["risk"] == "rehearsal"
    assert [(r["kappa"], r["flights"]) for r in content["tuning"]["rehearsed"]] == [
        (0.5, 4),
        (2.0, 4),
    ]
    assert "interrupted" in content["warnings"][0]
    page = (tmp_path / "report.html").read_text()
    assert "interrupted" in page
    assert "independent of the model" in page


BAD = {
    "no such file": ("nowhere.json", [], "no such file"),
    "a linear model": ("linear.json", [], "linear"),
    "level": ("model.json", ["--level", "1.5"], "--level"),
    "flights": ("model.json", ["--flights", "0"], "--flights"),
    "pace": ("model.json", ["--pace", "nan"], "--pace"),
    "jobs": ("model.json", ["--jobs", "0"], "--jobs"),
    "no such module": ("model.json", ["--plant", "nowhere:plant"], "nowhere"),
    "no such attribute": ("model.json", ["--plant", "mpc_export.mission.craft:nothing"], "nothing"),
    "no attribute": ("model.json", ["--plant", "mpc_export.mission"], "module:attribute"),
    "not a plant": ("model.json", ["--plant", "tests.cli.short_course:Nothing"], "reset"),
    "a plant that cannot be placed": (
        "model.json",
        ["--plant", "tests.cli.short_course:Blind"],
        "position",
    ),
    "not a course": ("model.json", ["--course", "tests.cli.short_course:NOT_A_COURSE"], "Course"),
    "a log beside a plant": (
        "model.json",
        ["--plant", "mpc_export.mission.craft:vehicle", "--log", "a.csv"],
        "--log",
    ),
    "no such log": ("model.json", ["--log", "nowhere.csv"], "nowhere.csv"),
}


def test_the_demo_refuses_before_it_identifies(tmp_path, capsys):
    assert main(["mpc", "demo", "--plant", "nowhere:plant", "--out", str(tmp_path / "out")]) == 2
    assert "nowhere" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_model_without_position_cannot_be_flown(models, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(prepare, "NEEDED", ("position", "altitude"))
    assert main(["mpc", str(models / "model.json"), *COURSE, "--out", str(tmp_path / "out")]) == 2
    assert "a model with altitude" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("case", list(BAD))
def test_bad_input_is_one_line(models, tmp_path, capsys, case):
    file, options, word = BAD[case]
    assert main(["mpc", str(models / file), *COURSE, *options, "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert len(re.findall(r"greybox mpc: ", said.err)) == len(said.err.strip().splitlines()) == 1
    assert word in said.err
    assert not (tmp_path / "out").exists()
