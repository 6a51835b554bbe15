"""Logs as the firmware wrote them (the beginnings of files): disarmed, a VTOL, too slow, or
usable."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from greybox.cli import main
from greybox.data.fitness import unfit, untold
from greybox.data.inspection import inspect_log
from tests.data.faults import real

FOLDER = Path(__file__).parent / "firmware"


@pytest.mark.parametrize(
    ("name", "library", "words"),
    [
        (
            "sample.ulg",
            "pyulog",
            ("disarmed: no motor ever turns",),
        ),
        ("sample_px4_events.ulg", "pyulog", ("disarmed", "too slow: commands come at 10 Hz")),
        ("sample_log_small.ulg", "pyulog", ("no commands of rotors",)),
    ],
)
def test_the_verdict_comes_first_with_its_exit_code(
    name: str, library: str, words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip(library)
    assert main(["inspect", str(FOLDER / name)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].startswith("  NOT USABLE: ")
    assert all(w in lines[1] for w in words)
    assert not any("fits: rotation" in line for line in lines)


def test_servos_of_a_vtol_are_no_rotors() -> None:
    pytest.importorskip("pyulog")
    found = inspect_log(FOLDER / "sample_log_small.ulg")
    assert "command" not in {g.group for g in found.groups}
    assert any("servos stand among its outputs" in n for n in found.notes)


def test_intervals_in_seconds_are_no_microseconds() -> None:
    pytest.importorskip("pyulog")
    (rate,) = [g for g in inspect_log(FOLDER / "sample.ulg").groups if g.group == "rate"]
    assert "2 ms earlier than its stamps" in rate.origin


def test_frames_before_the_first_whole_one_are_left_out() -> None:
    pytest.importorskip("orangebox")
    found = inspect_log(FOLDER / "btfl_002.bbl")
    assert any(n.startswith("14 frame(s) before the first whole one") for n in found.notes)
    assert found.raw is not None
    assert np.nanmin(np.diff(found.raw.t)) > 0
    assert np.nanmax(np.diff(found.raw.t)) < 1.0
    assert found.unfit == ()


def test_what_makes_a_log_unfit() -> None:
    raw = real("nanobench", "B2_circle_medium_rep1")
    rates = {"command": 100.0, "rate": 100.0}
    assert list(unfit(raw, rates)) == []
    assert [w.partition(":")[0] for w in unfit(raw, rates | {"command": 10.0})] == ["too slow"]
    assert [w.partition(":")[0] for w in unfit(raw, {"command": 100.0, "rate": 10.0})] == [
        "too slow"
    ]

    # The quickest craft are fitted as well from rows of 40 ms.
    assert list(unfit(raw, dict.fromkeys(rates, 25.0))) == []

    def with_commands(level: float) -> list[str]:
        idle = {f"u{i}": np.full(raw.n, level) for i in range(1, 5)}
        return [
            w.partition(":")[0]
            for w in unfit(type(raw)(**{**vars(raw), "channels": {**raw.channels, **idle}}), rates)
        ]

    assert with_commands(0.0) == ["disarmed"]
    assert with_commands(0.05) == ["on the ground"]
    assert with_commands(0.5) == []


def test_rows_slower_than_fast_rotors_say_what_they_do_not_tell() -> None:
    for rates in ({"command": 25.0, "rate": 100.0}, {"command": 100.0, "position": 25.0}):
        (said,) = untold(rates)
        assert "rows come every 40 ms" in said and "only together" in said
    assert not list(untold({"command": 49.9, "rate": 100.0}))
    assert not list(untold({"command": 10.0, "rate": 100.0}))  # not usable at all
    # Rotor speeds beside commands show the rotors.
    assert not list(untold({"command": 25.0, "rotor_speed": 100.0, "rate": 100.0}))


def test_a_craft_that_hardly_turns_flies_all_the_same_where_it_moves() -> None:
    raw = real("nanobench", "B2_circle_medium_rep1")
    calm = {n: 1e-3 * raw.channels[n] for n in "pqr"}
    rates = {"command": 100.0, "rate": 100.0}

    def said(velocity: float) -> list[str]:
        changed = calm | {n: velocity * raw.channels[n] for n in ("vx", "vy", "vz")}
        return list(
            unfit(type(raw)(**{**vars(raw), "channels": {**raw.channels, **changed}}), rates)
        )

    assert said(1.0) == []
    assert said(0.05) == said(np.nan) == ["on the ground: motors run, but the gyro shows no motion"]
