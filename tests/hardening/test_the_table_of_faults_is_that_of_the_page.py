"""docs/hardening.md has every fault of channels and vehicle files with what became of it; none is
silent."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.hardening.channel_faults import CHANNEL_FAULTS, have
from tests.hardening.fault_table import NONE, SILENT, flights, table
from tests.hardening.vehicle_faults import VEHICLE_FAULTS

PAGE = Path(__file__).parents[2] / "docs" / "hardening.md"
SOME = ("gyro times 2", "one sample of the gyro")


def rows_of_page() -> dict[str, tuple[str, str]]:
    """Fault -> (class, outcome) as the page's table has them."""
    (block,) = re.findall(
        r"^```text\nclass \| fault \| outcome\n(.*?)^```", PAGE.read_text("utf-8"), re.S | re.M
    )
    rows = [line.split(" | ") for line in block.splitlines()]
    assert len({fault for _, fault, _ in rows}) == len(rows)
    return {fault: (kind, outcome) for kind, fault, outcome in rows}


def found(names: tuple[str, ...] | None) -> dict[str, tuple[str, str]]:
    ((_, raw, vehicle),) = flights(())
    return {
        fault: (kind, outcome)
        for kind, fault, outcome in table(raw, vehicle, names)
        if outcome != NONE
    }


def test_every_fault_has_a_row_and_none_is_silent() -> None:
    rows = rows_of_page()
    ((_, raw, _),) = flights(())
    assert set(rows) == {n for n, f in CHANNEL_FAULTS.items() if have(raw, f.needs)} | set(
        VEHICLE_FAULTS
    )
    assert not [fault for fault, (_, outcome) in rows.items() if SILENT in outcome]


def test_some_rows_are_what_is_found() -> None:
    rows = rows_of_page()
    assert found(SOME) == {fault: rows[fault] for fault in SOME}


@pytest.mark.slow
def test_all_rows_are_what_is_found() -> None:
    assert found(None) == rows_of_page()
