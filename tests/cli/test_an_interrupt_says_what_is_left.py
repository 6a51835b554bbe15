"""What the last line says after Ctrl-C is what the folder holds: training flights count too."""

from __future__ import annotations

from pathlib import Path

import pytest

from greybox.cli import main
from greybox.files import append_json_line


def stopped(monkeypatch: pytest.MonkeyPatch, flown: int) -> None:
    """The user stops `mpc` after so many training flights."""

    def prepared(arguments, console):
        for seed in range(flown):
            append_json_line(Path(arguments.out) / "tuning.jsonl", {"seed": seed})
        raise KeyboardInterrupt

    monkeypatch.setattr("greybox.commands.mpc._prepared", prepared)


@pytest.mark.parametrize(
    ("flown", "said"),
    [(0, "nothing was written; the same command starts again"), (2, "the same command goes on")],
)
def test_training_flights_are_kept_and_said(
    flown: int,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    stopped(monkeypatch, flown)
    assert main(["mpc", "demo", "--out", str(tmp_path / "out")]) == 130
    assert capsys.readouterr().err.strip().endswith(said)
