"""Bad input to `greybox linear`: one clear line on standard error, exit code 2, nothing written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from greybox.cli import main
from scenarios.plants.linear_systems import random_system, simulate

HEADER = "t,volt,flow,speed,temp"
CHANNELS = ("--inputs", "volt,flow", "--outputs", "speed,temp")
Spoil = Callable[[np.ndarray], np.ndarray]


def log(path: Path, spoil: Spoil | None = None, count: int = 600, header: str = HEADER) -> Path:
    truth = random_system(np.random.default_rng(1), 3, 2, 2)
    u, y = simulate(np.random.default_rng(0), truth, count)
    table = np.column_stack([0.02 * np.arange(count), u, y])
    np.savetxt(
        path,
        table if spoil is None else spoil(table),
        delimiter=",",
        header=header,
        comments="",
        fmt="%.9g",
    )
    return path


def changed(column: int, value: Callable[[np.ndarray], np.ndarray | float]) -> Spoil:
    def spoil(table: np.ndarray) -> np.ndarray:
        table[:, column] = value(table)
        return table

    return spoil


def every_third(table: np.ndarray) -> np.ndarray:
    """The clock runs at 50 Hz in the first half and at 10 Hz in the second."""
    return np.vstack([table[:300], table[300:600:5]])


BAD: dict[str, tuple[Spoil | None, tuple[str, ...], str]] = {
    "rank-deficient input": (changed(2, lambda t: 3.0 * t[:, 1]), CHANNELS, "linearly dependent"),
    "constant input": (changed(1, lambda t: 2.0), CHANNELS, "input 'volt' is constant"),
    "constant output": (changed(4, lambda t: 2.0), CHANNELS, "output 'temp' is constant"),
    "output of NaN": (changed(3, lambda t: np.nan), CHANNELS, "'speed' holds no value"),
    "input of NaN": (changed(1, lambda t: np.nan), CHANNELS, "'volt' holds no value"),
    "infinite value": (changed(3, lambda t: np.inf), CHANNELS, "speed"),
    "exact order of none": (lambda t: t, (*CHANNELS, "--exact-order"), "--order 6"),
    "too short": (lambda t: t[:14], (*CHANNELS, "--order", "5"), "short|few"),
    "too short for auto": (lambda t: t[:8], CHANNELS, "short|few"),
    "unknown column": (None, ("--inputs", "vlot", "--outputs", "speed"), "volt"),
    "unknown output": (None, ("--inputs", "volt", "--outputs", "q"), "column 'q'|unknown column"),
    "time stands still": (changed(0, lambda t: 0.0), CHANNELS, "time"),
    "no time column": (None, CHANNELS, "'t'"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line_and_exit_code_two(
    case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import re

    spoil, words, expected = BAD[case]
    header = HEADER.replace("t,", "clock,", 1) if case == "no time column" else HEADER
    path = log(tmp_path / "a.csv", spoil, header=header)
    out = tmp_path / "out"
    assert main(["linear", "--train", str(path), *words, "--out", str(out)]) == 2
    said = capsys.readouterr().err.strip()
    assert said.startswith("greybox linear: ")
    assert "\n" not in said
    assert re.search(expected, said), said
    assert not out.exists()


def test_a_second_log_of_another_rate_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a = log(tmp_path / "a.csv")
    b = log(tmp_path / "b.csv", changed(0, lambda t: 2.0 * t[:, 0]))
    assert (
        main(
            [
                "linear",
                "--train",
                str(a),
                str(b),
                *CHANNELS,
                "--order",
                "2",
                "--out",
                str(tmp_path / "out"),
            ]
        )
        == 2
    )
    said = capsys.readouterr().err.strip()
    assert "--rate" in said
    assert "\n" not in said


def test_unequal_sampling_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = log(tmp_path / "a.csv", every_third)
    out = tmp_path / "out"
    code = main(["linear", "--train", str(path), *CHANNELS, "--order", "2", "--out", str(out)])
    said = capsys.readouterr()
    if code == 2:
        assert "\n" not in said.err.strip()
        assert re_sampling(said.err)
    else:
        assert re_sampling((out / "fit.json").read_text())


def re_sampling(text: str) -> bool:
    return any(w in text for w in ("sampl", "clock", "gap", "step"))
