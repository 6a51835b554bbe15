"""Betaflight's own code flew a simulated craft and wrote the log: every channel against the truth."""

from __future__ import annotations

import csv
import gzip
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from greybox.cli import main
from greybox.data.readers import read_recording
from greybox.data.readers.assemble import assemble
from greybox.data.readers.betaflight import _frames
from tests.data.readers import writers as w

FOLDER = Path(__file__).parent / "firmware"
LOG = FOLDER / "betaflight_sitl.bfl"


def flown() -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """What was read and what was, at the rows that have both; `t` [s] is the firmware's clock."""
    pytest.importorskip("orangebox")
    recording = read_recording(LOG)
    table = assemble(recording)
    with gzip.open(FOLDER / "betaflight_sitl_truth.csv.gz", "rt") as stream:
        rows = list(csv.DictReader(stream))
    truth = {k: np.array([float(r[k]) for r in rows]) for k in rows[0]}
    t = recording.streams["main"].t
    both = (t > truth["t"][0] + 0.1) & (t < truth["t"][-1] - 0.1)
    return {k: np.asarray(v)[both] for k, v in table.columns.items()} | {"t": t[both]}, truth


def gain(read: np.ndarray, known: np.ndarray) -> tuple[float, float, float]:
    """Slope and offset of what was read over what was, and the standard deviation of the rest."""
    design = np.column_stack([known, np.ones_like(known)])
    (slope, offset), *_ = np.linalg.lstsq(design, read, rcond=None)
    return slope, offset, float(np.std(read - design @ (slope, offset)))


def test_every_rate_force_and_command_has_its_unit_sign_and_place() -> None:
    read, truth = flown()
    for name, late, rest in (
        ("p", 1.0, 0.01),
        ("q", 1.0, 0.01),
        ("r", 1.0, 0.01),
        ("az", 8.5, 0.1),
    ):
        known = np.interp(read["t"] - 1e-3 * late, truth["t"], truth[name])
        slope, offset, left = gain(read[name], known)
        assert slope == pytest.approx(1.0, abs=0.01) and abs(offset) < 0.15, name
        assert left < rest, name
    for k in range(1, 5):
        sent = np.interp(read["t"], truth["t"], truth[f"motor{k}"])
        # What the simulated ESC took: no throttle at 1000 us, not at the idle of 1055 us.
        assert np.median(np.abs(read[f"u{k}"] - (sent - 1000) / 1000)) < 0.002, k


def test_the_attitude_is_that_of_the_craft_and_leads_by_half_its_step() -> None:
    """The firmware adds the newest rate times the whole step, so that it is ahead; both axes of the
    tilt agree, and the heading too."""
    read, truth = flown()
    q = np.column_stack([read[k] for k in ("qw", "qx", "qy", "qz")])
    assert np.isfinite(q).all()
    known = np.column_stack(
        [np.interp(read["t"], truth["t"], truth[k]) for k in ("qw", "qx", "qy", "qz")]
    )
    known /= np.linalg.norm(known, axis=1)[:, None]
    apart = np.degrees(2 * np.arccos(np.minimum(np.abs(np.sum(q * known, axis=1)), 1.0)))
    assert np.median(apart) < 2.0
    up = np.array([w.rotation(one)[2] for one in known[::10]])
    assert np.ptp(up[:, 0]) > 0.3 and np.ptp(up[:, 1]) > 0.3
    turned = np.array([w.rotation(one)[2] for one in q[::10]])
    for axis in (0, 1):
        assert gain(turned[:, axis], up[:, axis])[0] == pytest.approx(1.0, abs=0.05)


def test_a_stranger_gets_a_vehicle_file_and_no_false_alarm(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("orangebox")
    vehicle = str(tmp_path / "v.toml")
    new = ["vehicle", "new", "--from", str(LOG), "--set", "mass=0.68", "arm=0.135"]
    assert main([*new, "--out", vehicle]) == 0
    spins = [line for line in Path(vehicle).read_text().splitlines() if line.startswith("spin")]
    assert spins == ["spin = -1", "spin = 1", "spin = 1", "spin = -1"]
    capsys.readouterr()
    assert main(["check", "--vehicle", vehicle, str(LOG)]) == 0
    said = capsys.readouterr().out
    assert "[ranges]" not in said and "clips" not in said
    assert "blocking" not in said


@pytest.mark.parametrize("seed", [0, 8])
def test_where_bytes_are_lost_no_value_is_another(seed: int, tmp_path: Path) -> None:
    """A P frame is a difference: behind a lost one all would be wrong up to the next whole one."""
    pytest.importorskip("orangebox")
    data, rng = LOG.read_bytes(), np.random.default_rng(seed)
    begin = data.index(b"\n", data.rindex(b"\nH ") + 1)
    cuts = np.sort(rng.integers(begin + 5000, len(data) - 500, 20))
    lengths = rng.integers(1, 60, cuts.size)
    parts = np.split(np.frombuffer(data, dtype=np.uint8), cuts)
    kept = [parts[0], *(part[n:] for part, n in zip(parts[1:], lengths, strict=True))]
    (tmp_path / "lost.bfl").write_bytes(np.concatenate(kept).tobytes())
    whole, rest = (
        read_recording(path).streams["main"].fields for path in (LOG, tmp_path / "lost.bfl")
    )
    at = np.searchsorted(whole["time"], rest["time"])
    assert 0.7 * whole["time"].size < at.size < whole["time"].size
    for name in [n for n in whole if n.startswith(("time", "gyro", "acc", "motor", "imu"))]:
        np.testing.assert_array_equal(rest[name], whole[name][at], err_msg=name)
    assert any(
        "others before them are lost" in n for n in read_recording(tmp_path / "lost.bfl").notes
    )


class Frame:
    """A frame of orangebox."""

    def __init__(self, kind: str, number: int) -> None:
        self.type = type("Kind", (), {"value": kind})
        self.data = (number,)


class Log:
    """A parser of frames, of which some P frames are lost: `sizes` are left from an I frame on."""

    field_names = ("number",)

    def __init__(self, headers: dict[str, int | str], sizes: list[int]) -> None:
        self.headers, self.sizes = headers, sizes

    def frames(self) -> Iterator[Frame]:
        for k, size in enumerate(self.sizes):
            yield from (Frame("P" if i else "I", 100 * k + i) for i in range(size))


@pytest.mark.parametrize(
    "headers",
    [
        {"I interval": 256, "P interval": 8},
        {"I interval": 64, "P interval": "1/2"},
        {"I interval": 32, "P interval": "1/1"},
        {},
    ],
)
def test_frames_are_lost_where_fewer_came_than_the_firmware_writes(
    headers: dict[str, int | str],
) -> None:
    sizes = [31, 32, 31, 31, 32, 31, 31, 31, 20]
    found = _frames(Log(headers, sizes))
    whole = [k for k, size in enumerate(sizes) if size == 32]
    kept = {k: sum(row[0] // 100 == k for row in found.rows) for k in range(len(sizes))}
    assert {k: kept[k] for k in whole} == dict.fromkeys(whole, 32)
    assert all(kept[k] == 1 for k in range(8) if k not in whole)
    assert found.doubtful == 6 * 30
