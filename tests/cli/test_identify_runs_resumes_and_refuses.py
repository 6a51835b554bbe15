"""`greybox identify` goes from logs to an export in one folder, goes on after kill -9, refuses what
is not usable."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema
import pytest

import greybox as gb
from greybox.cli import main
from greybox.commands.chain.choice import MARGIN, better
from greybox.commands.chain.left import TRUST, seconds_left, typical
from greybox.commands.chain.record import FILE, StageRecord
from greybox.commands.chain.stages import STAGES
from greybox.excitation.injection import rich_excitation
from greybox.excitation.waypoints import RandomWaypoints
from greybox.files import read_json, write_json
from greybox.model.verdict import GroupSkill, Outcome, Verdict
from greybox.plants.effects import MotorLag
from greybox.plants.flight_log import fly, member, write_log
from greybox.plants.presets import controller_for, x250
from greybox.plants.vehicle_file import write_vehicle
from greybox.progress import in_words
from greybox.residual.files import load_model, save_model
from tests.data.readers import writers as w

FIT = "stage 3 of 8: fit, "
DONE = "is done ("
SCHEMA = json.loads((Path(gb.__file__).parent / "schemas" / FILE).read_text())


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """v.toml, a.csv, b.csv, t.csv: three short flights of a racer with a motor lag, their attitude
    and IMU."""
    folder = tmp_path_factory.mktemp("identify")
    plant = x250([MotorLag(tau=0.04)])
    log = fly(
        plant,
        controller_for(plant),
        RandomWaypoints(),
        rich_excitation(),
        4.0,
        seed=[1, 2, 3],
        warm_up=1.0,
    )
    for i, name in enumerate(("a", "b", "t")):
        write_log(folder / f"{name}.csv", member(log, i), drop=["omega", *"xyz", "vx", "vy", "vz"])
    write_vehicle(folder / "v.toml", plant, sigma={"inertia": 0.2, "thrust.c2": 0.2})
    return folder


def line(flights: Path, out: Path, *more: str) -> list[str]:
    a, b, t, v = (str(flights / n) for n in ("a.csv", "b.csv", "t.csv", "v.toml"))
    return ["identify", v, a, b, "--test", t, "--skip", "discover,learn", "--out", str(out), *more]


def killed(arguments: Sequence[str], sign: str, how: int) -> tuple[int, list[str]]:
    """(exit code, lines on standard error) of a run that gets the signal `how` when it says
    `sign`."""
    said: list[str] = []
    with subprocess.Popen(
        [sys.executable, "-m", "greybox.cli", *arguments],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as process:
        patience = threading.Timer(120, process.kill)
        patience.start()
        sent = False
        for text in process.stderr or ():
            said.append(text)
            if sign in text and not sent:
                sent = True
                os.killpg(process.pid, how)
        patience.cancel()
        return process.wait(60), said


def went_on(flights: Path, out: Path) -> str:
    """What a chain in this folder says to its end, on both of its streams."""
    words = [sys.executable, "-m", "greybox.cli", *line(flights, out)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stderr + "\n--out--\n" + done.stdout


@pytest.fixture(scope="module")
def chain(flights: Path) -> tuple[Path, str]:
    """(folder of a chain that went to its end, what it said)."""
    out = Path(tempfile.mkdtemp(dir=flights)) / "out"
    return out, went_on(flights, out)


@pytest.fixture
def copy(chain: tuple[Path, str], tmp_path: Path) -> Path:
    return shutil.copytree(chain[0], tmp_path / "out")


def record(out: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((out / FILE).read_text())
    jsonschema.validate(content, SCHEMA)
    return content


def stages(out: Path) -> dict[str, dict[str, Any]]:
    return {s["name"]: s for s in record(out)["stages"]}


@pytest.mark.slow
def test_kill_9_in_the_fit_keeps_what_was_done_and_the_same_command_goes_on(flights, tmp_path):
    out = tmp_path / "out"
    code, _ = killed(line(flights, out), FIT, signal.SIGKILL)
    assert code == -signal.SIGKILL
    before = [StageRecord.from_dict(s) for s in read_json(out / FILE)["stages"]]
    said = went_on(flights, out)
    assert [r.name for r in before] == ["inspect", "check"]
    assert said.count(DONE) == 2
    assert FIT in said
    assert all(s["skipped"] or s["exit_code"] in (0, 1) for s in stages(out).values())


def test_the_first_line_is_the_verdict_and_the_folder_holds_model_export_and_page(chain):
    out, said = chain
    first = said.split("--out--\n")[1].splitlines()[0]
    found = record(out)["outcome"]
    assert first == found["line"] == load_model(found["model"]).verdict.line
    assert (out / "8_export" / "model" / "manifest.json").exists()
    page = (out / "report.html").read_text()
    assert page.index(first.split(";")[0]) < page.index("Stages")
    for stage in ("1_inspect", "3_fit", "7_validate"):
        assert stage in page
    assert 'href="3_fit/report.html"' in page
    assert "greybox fit --vehicle" in page


def test_every_stage_is_the_plain_command_and_result_files_quote_it(chain):
    out, _ = chain
    for stage in stages(out).values():
        assert all(c.startswith("greybox ") for c in stage["commands"])
    (typed,) = stages(out)["fit"]["commands"]
    assert read_json(out / "3_fit" / "fit.json")["command"] == typed


def test_what_is_done_is_not_done_again(chain, flights, capsys):
    out, _ = chain
    before = {
        p: p.stat().st_mtime_ns
        for p in out.rglob("*")
        if p.is_file() and p.name not in (FILE, "report.html")
    }
    assert main(line(flights, out)) == 0
    assert capsys.readouterr().err.count(DONE) == 5
    assert before == {p: p.stat().st_mtime_ns for p in before}


def test_another_log_runs_the_stages_again_and_the_old_fit_does_not_count(copy, flights, tmp_path):
    new = shutil.copytree(flights, tmp_path / "flights", ignore=shutil.ignore_patterns("tmp*"))
    rows = (new / "b.csv").read_text().splitlines()
    (new / "b.csv").write_text("\n".join(rows[:-5]) + "\n")
    _, said = killed(line(new, copy), FIT, signal.SIGKILL)
    assert not any(DONE in text for text in said)
    assert "fit" not in stages(copy)


def test_the_same_files_in_another_place_are_the_same_input(copy, flights, tmp_path, capsys):
    new = shutil.copytree(flights, tmp_path / "flights", ignore=shutil.ignore_patterns("tmp*"))
    assert main(line(new, copy)) == 0
    assert capsys.readouterr().err.count(DONE) == 5


def test_a_stage_whose_results_are_gone_is_done_again(copy, flights, capsys):
    (copy / "7_validate" / "validate.json").unlink()
    assert main(line(flights, copy)) == 0
    assert capsys.readouterr().err.count(DONE) == 4
    assert (copy / "7_validate" / "validate.json").exists()


def test_ctrl_c_ends_with_130_says_how_to_go_on_and_writes_the_page(flights, tmp_path):
    out = tmp_path / "out"
    code, said = killed(line(flights, out), "deciding what is open", signal.SIGINT)
    assert code == 130
    assert "stopped in stage fit: run the same command again to go on\n" in said
    assert not any("Traceback" in text for text in said)
    assert record(out)["outcome"]["stopped"] == "fit"
    assert list(stages(out)) == ["inspect", "check"]
    assert "stopped in stage fit" in (out / "report.html").read_text()


def refuse(out: Path) -> None:
    """Have the fit of a finished chain judged NOT USABLE."""
    content = read_json(out / "3_fit" / "fit.json")
    verdict = Verdict.from_dict(content["verdict"])
    verdict = replace(
        verdict,
        outcome=Outcome.NOT_USABLE,
        line="NOT USABLE: rotation is worse than the last value",
    )
    write_json(out / "3_fit" / "fit.json", {**content, "verdict": verdict.to_dict()})
    save_model(
        replace(load_model(out / "3_fit" / "model.json"), verdict=verdict),
        out / "3_fit" / "model.json",
    )
    shutil.rmtree(out / "8_export")


def test_not_usable_is_the_first_line_has_exit_code_1_and_exports_nothing(copy, flights, capsys):
    refuse(copy)
    assert main(line(flights, copy)) == 1
    said = capsys.readouterr()
    assert said.out.startswith("NOT USABLE: rotation")
    assert "--even-so" in stages(copy)["export"]["skipped"]
    assert not (copy / "8_export").exists()


def test_even_so_exports_and_still_says_it(copy, flights, capsys):
    refuse(copy)
    assert main(line(flights, copy, "--even-so")) == 1
    assert capsys.readouterr().out.startswith("NOT USABLE: rotation")
    assert (copy / "8_export" / "model" / "manifest.json").exists()


def test_python_gives_the_same_as_the_command_and_is_quiet(copy, flights, capsys):
    said: list[str] = []
    shutil.rmtree(copy / "8_export")
    found = gb.identify(
        flights / "v.toml",
        [flights / "a.csv", flights / "b.csv"],
        test=[flights / "t.csv"],
        out=copy,
        skip=["discover", "learn"],
        say=said.append,
    )
    assert sum(DONE in text for text in said) == 4
    assert capsys.readouterr() == ("", "")
    assert found.verdict == found.model.verdict
    assert found.model.values == found.fit.values
    assert (found.discovery, found.learned, found.folder) == (None, None, copy)
    assert found.verdict is not None
    assert found.verdict.line in repr(found)


BAD = {
    "no log": ["v.toml"],
    "a vehicle file that is not there": ["no.toml", "a.csv"],
    "a log that is not there": ["v.toml", "no.csv"],
    "a log twice": ["v.toml", "a.csv", "a.csv"],
    "a log that trains and tests": ["v.toml", "a.csv", "--test", "a.csv"],
    "an unknown stage": ["v.toml", "a.csv", "--skip", "lern"],
    "no fit": ["v.toml", "a.csv", "--skip", "fit"],
    "a rate of nothing": ["v.toml", "a.csv", "--rate", "0"],
    "a log that does not know its craft": ["a.csv"],
    "a vehicle file alone": ["v.toml"],
    "two vehicle files": ["v.toml", "a.csv", "v.toml"],
    "a vehicle file twice": ["v.toml", "a.csv", "--vehicle", "v.toml"],
    "nothing": [],
}


@pytest.mark.parametrize("words", BAD.values(), ids=BAD.keys())
def test_bad_input_is_one_line(words, flights, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(flights)
    assert main(["identify", *words, "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("greybox identify: ")
    assert said.err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_the_vehicle_file_may_stand_behind_the_logs(flights, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(flights)
    assert main(["identify", "a.csv", "no.toml", "--out", str(tmp_path / "out")]) == 2
    assert "no.toml: no such vehicle file" in capsys.readouterr().err


def test_an_out_of_no_name_is_not_the_working_folder(flights, tmp_path, monkeypatch, capsys):
    """`--out "$OUT"` of a variable that is not set."""
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    v, a = str(flights / "v.toml"), str(flights / "a.csv")
    for words in (["identify", v, a], ["fit", "--vehicle", v, "--train", a]):
        assert main([*words, "--out", ""]) == 2
        said = capsys.readouterr().err
        assert "no name of a file or folder" in said and said.count("\n") == 1
    assert not list(here.iterdir())


def test_files_can_be_said_as_to_the_other_commands(copy, flights, capsys):
    a, b, t, v = (str(flights / n) for n in ("a.csv", "b.csv", "t.csv", "v.toml"))
    words = [
        "identify",
        "--vehicle",
        v,
        "--train",
        a,
        b,
        "--test",
        t,
        "--skip",
        "discover,learn",
        "--out",
        str(copy),
    ]
    assert main(words) == 0
    assert (
        f"fit {DONE}" in capsys.readouterr().err
    )  # the request is the same one: nothing is done again


def test_a_folder_of_somebody_else_stays_as_it_is(flights, tmp_path, capsys):
    (tmp_path / FILE).write_text('{"mine": 1}')
    assert main(line(flights, tmp_path)) == 2
    assert "wrong schema" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == [FILE]


def test_without_a_vehicle_file_the_log_is_asked_and_a_person_told_what_to_measure(
    tmp_path, capsys
):
    pytest.importorskip("pyulog")
    log = w.write_ulog(tmp_path / "flight.ulg", w.channels(rows=2500))
    out = tmp_path / "out"
    assert main(["identify", str(log), "--out", str(out)]) == 2
    said = capsys.readouterr().err
    (last,) = [text for text in said.splitlines() if text.startswith("greybox identify: ")]
    assert "mass: weigh it" in last
    assert f"greybox identify {out / 'vehicle.toml'} {log}" in last
    gb.read_vehicle(out / "vehicle.toml")
    (out / "vehicle.toml").write_text("edited = 1\n")
    assert main(["identify", str(log), "--out", str(out)]) == 2
    assert (out / "vehicle.toml").read_text() == "edited = 1\n"


def verdict(error: float, outcome: Outcome = Outcome.USABLE) -> Verdict:
    skill = GroupSkill(
        name="rotation",
        unit="rad",
        seconds=0.5,
        error=error,
        last_value=1.0,
        measured_imu=None,
        covered=1 - error,
        worse_from=None,
        calm=False,
    )
    return Verdict(
        outcome=outcome,
        line="",
        useful_seconds=1.0,
        judged_seconds=1.0,
        judged_on="",
        flights=(),
        groups=(skill,),
    )


def test_a_larger_model_must_be_clearly_better():
    bad = Outcome.NOT_USABLE
    assert better(verdict(0.5), verdict(0.6))
    assert not better(verdict(0.6 * (1 - 0.5 * MARGIN)), verdict(0.6))
    assert better(verdict(0.9), verdict(0.3, bad))
    assert not better(verdict(0.3, bad), verdict(0.9))
    assert not better(None, verdict(0.9))
    assert better(verdict(0.9), None)
    assert not better(verdict(0.9, bad), None)


def test_the_time_left_follows_what_the_ended_stages_took():
    flown = 60.0
    by_name = {s.name: s for s in STAGES}
    rest = sum(typical(by_name[n], flown) for n in ("discover", "learn"))
    usual = typical(by_name["fit"], flown)
    slow = StageRecord(name="fit", folder="3_fit", seconds=2 * usual + TRUST)
    assert seconds_left(STAGES, ("discover", "learn"), {}, flown) == pytest.approx(rest)
    assert seconds_left(STAGES, ("discover", "learn"), {"fit": slow}, flown) == pytest.approx(
        2 * rest
    )
    assert in_words(31) == "about 30 s left"
    assert in_words(200) == "about 3 min left"


@pytest.mark.slow
def test_the_whole_chain_discovers_and_learns(flights, tmp_path):
    pytest.importorskip("gpytorch")
    a, b, t, v = (str(flights / n) for n in ("a.csv", "b.csv", "t.csv", "v.toml"))
    found = gb.identify(v, [a, b], test=[t], out=tmp_path)
    assert found.verdict is not None
    assert not found.verdict.refused
    assert found.discovery is not None
    assert found.learned is not None
    assert [s for s, r in stages(tmp_path).items() if r["skipped"]] in ([], ["refit"])
