"""Ctrl-C at a long command in a process of its own: exit code 130, one last line, no half-written
file, nobody left behind.

The whole process group is asked, as a terminal does it, as soon as the command says that it is at
work. What `discover` and `mpc` keep: tests/cli/test_discover_writes_what_it_finds.py and
tests/cli/test_mpc_flies_resumes_and_refuses.py; interrupts inside a fit:
tests/estimation/test_an_interrupt_keeps_the_best_so_far.py.
"""

from __future__ import annotations

import importlib.util
import io
import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from greybox.cli import main
from greybox.examples import flight_path, vehicle_path
from greybox.journal import FILE

ARPL = "arpl_crazyflie"
LOG = str(flight_path(ARPL, "log15"))
FLIGHT = ["--vehicle", str(vehicle_path(ARPL)), "--train", LOG]
FIT = ["fit", *FLIGHT, "--rate", "100", "--effects", "motor_lag"]
COMMANDS = {
    "discover": (["discover", *FLIGHT, "--rate", "100"], " % "),
    "plan": (["plan", "--vehicle", str(vehicle_path(ARPL))], "\n"),
    "mpc": (["mpc", "demo", "--flights", "2"], "\n"),
    "compare": (
        [
            "compare",
            *FLIGHT,
            "--test",
            str(flight_path(ARPL, "log16")),
            "--rate",
            "100",
            "--effects",
            "motor_lag",
        ],
        "...",
    ),
    "linear": (
        [
            "linear",
            *FLIGHT,
            "--rate",
            "100",
            "--inputs",
            "u3+u4-u1-u2,u2+u3-u1-u4",
            "--outputs",
            "p,q",
            "--order",
            "3",
            "--siso",
        ],
        "linear-p",
    ),
}
"""Command -> (arguments, what it says when it is at work)."""


def interrupted(arguments: list[str], sign: str, folder: Path) -> str:
    """What `greybox ARGUMENTS --out out` in `folder` says, which is interrupted when it says
    `sign`."""
    said: list[str] = []
    at_work = threading.Event()
    with subprocess.Popen(
        [sys.executable, "-u", "-m", "greybox.cli", *arguments, "--out", "out"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=folder,
        start_new_session=True,
        # Who starts the tests in the background of a script has them ignore the signal.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as process:

        def listen() -> None:
            for line in process.stdout or ():
                said.append(line)
                if sign in line:
                    at_work.set()
            at_work.set()

        listener = threading.Thread(target=listen)
        listener.start()
        try:
            assert at_work.wait(120), "it never began"
            assert process.poll() is None, "".join(said)
            os.killpg(process.pid, signal.SIGINT)
            code = process.wait(60)
        finally:
            process.kill()
        listener.join(10)
    text = "".join(said)
    # A shell calls both 130: Python ends itself with the signal where the interrupt passed through
    # an import.
    assert code in (130, -signal.SIGINT), text
    assert "Traceback" not in text
    assert said[-1].startswith(f"greybox {arguments[0]}: interrupted; ")
    assert said[-1].count("\n") == 1
    # What is said to have been kept is there, and nothing is where nothing is said to be.
    assert ("nothing was written" in said[-1]) == (
        not any(p.is_file() for p in (folder / "out").rglob("*"))
    )
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)
    return text


class CutShort(io.StringIO):
    """A terminal at which the interrupt comes before the end of the first line."""

    cut = False

    def write(self, text: str) -> int:
        if text == "\n" and not self.cut:
            self.cut = True
            raise KeyboardInterrupt
        return super().write(text)


def test_a_line_that_was_cut_does_not_swallow_the_last_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    terminal = CutShort()
    monkeypatch.setattr(sys, "stderr", terminal)
    arguments, _ = COMMANDS["plan"]
    assert main([*arguments, "--out", str(tmp_path / "out")]) == 130
    progress, last = terminal.getvalue().splitlines()
    assert not progress.startswith("greybox")
    assert last.startswith("greybox plan: interrupted; ")


def files(folder: Path) -> set[str]:
    """Names of all files below; every JSON file among them is whole."""
    found = [p for p in folder.rglob("*") if p.is_file()]
    for path in found:
        if path.suffix == ".json":
            json.loads(path.read_text())
    return {p.name for p in found}


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an interrupted fit."""
    folder = tmp_path_factory.mktemp("fit")
    (folder / "out").mkdir()
    (folder / "out" / "report.html").write_text(
        "<p>the report of an earlier fit, with other numbers</p>"
    )
    (folder / "out" / "validate.json").write_text("{}")
    assert "best values so far" in interrupted(FIT, "iteration   1", folder)
    return folder


def test_fit_keeps_the_best_values(fitted: Path) -> None:
    assert files(fitted) - {FILE} == {"fit.json", "model.json"}
    kept = json.loads((fitted / "out" / "fit.json").read_text())
    assert not kept["status"]["converged"]
    assert kept["verdict"]["line"].startswith("UNFINISHED")
    assert "interrupted" in kept["warnings"][0]


@pytest.mark.parametrize(
    "command",
    [
        c if c in ("discover", "linear") else pytest.param(c, marks=pytest.mark.slow)
        for c in COMMANDS
    ],
)
def test_nothing_half_written_is_left(command: str, tmp_path: Path) -> None:
    interrupted(*COMMANDS[command], tmp_path)
    assert not {n for n in files(tmp_path) if n.endswith((".part", ".html"))}


@pytest.mark.skipif(
    importlib.util.find_spec("gpytorch") is None, reason="the extra gp is not installed"
)
def test_learn_leaves_no_hybrid(fitted: Path, tmp_path: Path) -> None:
    learn = ["learn", str(fitted / "out" / "model.json"), "--train", LOG]
    command = [sys.executable, "-m", "greybox.cli", *learn, "--out", "out"]
    refused = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert refused.returncode == 1 and "UNFINISHED" in refused.stderr
    interrupted([*learn, "--even-so"], " % ", tmp_path)
    assert files(tmp_path) == set()
