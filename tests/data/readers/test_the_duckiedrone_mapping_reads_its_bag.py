"""The mapping of the Duckiedrone's simulation in docs/logs.md reads a bag with those topics: rotor
speeds as commands, and an odometry whose velocity has world axes."""

import re
from pathlib import Path

import numpy as np
import pytest

from greybox.data import read_log
from tests.data.readers import writers

ROOT = Path(__file__).parents[3]


def test_rotor_speeds_become_commands_and_velocity_stays_in_the_world(tmp_path):
    pytest.importorskip("rosbags")
    text = (ROOT / "docs" / "logs.md").read_text(encoding="utf-8")
    block = next(b for b in re.findall(r"```toml\n(.*?)```", text, re.S) if "/cmd_motors" in b)
    mapping = tmp_path / "dd21.toml"
    mapping.write_text(
        block.replace("/cmd_motors", "/motors")
    )  # as the writer of the tests calls it
    flown = writers.channels(rows=400)
    # The writer turns velocity into body axes, as the message says; this simulation does not.
    turns = [
        writers.rotation(q) for q in np.column_stack([flown[n] for n in ("qw", "qx", "qy", "qz")])
    ]
    world = np.column_stack([flown[n] for n in ("vx", "vy", "vz")])
    rotated = np.array([r @ v for r, v in zip(turns, world, strict=True)])
    sent = flown | dict(zip(("vx", "vy", "vz"), rotated.T, strict=True))
    sent |= {f"u{i}": 1000.0 * flown[f"u{i}"] for i in (1, 2, 3, 4)}
    bag = writers.write_ros(tmp_path / "dd21", sent)
    read = read_log(bag, mapping=mapping, trim=False).segments[0].channels
    at = slice(20, 300)
    for name in ("u1", "u2", "u3", "u4", "p", "q", "r", "vx", "vy", "vz"):
        expected = flown[name][at]
        best = min(
            np.abs(read[name][at.start + k : at.stop + k] - expected).max() for k in (-1, 0, 1)
        )
        assert best < 1e-5, name
