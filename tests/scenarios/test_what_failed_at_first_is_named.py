"""The flights on which the first search failed, drawn again: the plain command names what hides
there and nothing else."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from scenarios.foreign.naming import main
from scenarios.foreign.naming_cells import case_of

FAILED = {
    "a constant force in still air": ("single:constant_force", 288, "rotorpy"),
    "an attitude that is off in still air, once a wind": ("single:mocap_misalignment", 202, None),
    "a motor lag in gusts under a file without sigmas": ("single:motor_lag", 210, None),
}
"""Claim -> cell and seed of the judge (development seeds), and the simulator that must be there."""


@pytest.mark.slow
@pytest.mark.parametrize("claim", list(FAILED))
def test_the_truth_is_named_and_nothing_else(claim: str, tmp_path: Path) -> None:
    cell, seed, simulator = FAILED[claim]
    case = case_of(cell, seed)
    pytest.importorskip(case.simulator, reason="foreign simulators come with the extra judge")
    assert simulator in (None, case.simulator)
    asked = [
        "--cells",
        cell,
        "--seeds",
        str(seed),
        str(seed),
        "--seconds",
        "8",
        "--out",
        str(tmp_path),
    ]
    assert main(asked) == 0
    (row,) = map(json.loads, (tmp_path / "rows.jsonl").read_text(encoding="utf-8").splitlines())
    assert row["judged"] in ("right", "set")
    assert not row["traces"]
