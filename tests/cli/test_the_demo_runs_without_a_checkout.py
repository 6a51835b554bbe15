"""`greybox demo` types what a user would, from the packages alone, and its exit code is that of
what it ran."""

from __future__ import annotations

import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from greybox.cli import main
from greybox.commands import demo, missing_effect


@pytest.mark.parametrize(
    ("codes", "ran", "code"),
    [
        ((0, 0, 0), 3, 0),
        ((1, 0, 0), 3, 1),
        ((0, 1, 0), 3, 1),
        ((0, 2, 0), 2, 2),
        ((0, 130, 0), 2, 130),
    ],
)
def test_its_exit_code_is_that_of_what_it_ran(
    codes: tuple[int, ...], ran: int, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    typed: list[tuple[str, ...]] = []

    def command(*words: str) -> int:
        typed.append(words)
        return codes[len(typed) - 1]

    monkeypatch.setattr(demo, "_command", command)
    # Nothing looks at these flights here: a second of them says as much as sixteen.
    monkeypatch.setattr(
        missing_effect, "write_story", partial(missing_effect.write_story, seconds=1.0)
    )
    assert main(["demo", "--out", str(tmp_path / "d")]) == code
    assert [words[0] for words in typed] == ["check", "fit", "discover"][:ran]
    assert all(
        Path(w).exists() for words in typed for w in words if w.endswith((".gz", ".toml", ".csv"))
    )


def test_every_command_is_printed_before_it_runs(capsys: pytest.CaptureFixture[str]):
    assert demo._command("examples") == 0
    assert capsys.readouterr().out.startswith("$ greybox examples\n")


@pytest.mark.slow
def test_the_demo(tmp_path: Path):
    done = subprocess.run(
        [sys.executable, "-m", "greybox", "demo", "--out", "d"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "rotor_drag.k_x" in done.stdout
    for page in ("report.html", "missing_effect/report.html"):
        assert (tmp_path / "d" / page).stat().st_size > 10_000
