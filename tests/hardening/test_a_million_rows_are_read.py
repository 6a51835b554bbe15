"""A log of a million rows is inspected, checked and read within the memory of a small machine."""

from __future__ import annotations

import gzip
import subprocess
import sys
from pathlib import Path

import pytest

from greybox.examples import flight_path, vehicle_path

ROWS, MOST = 10**6, 2_000_000
"""Rows of the log; most memory that a command may take [KiB]."""
MEASURED = """
import resource, sys
from greybox.cli import main
try:
    code = main(sys.argv[1:])
except SystemExit as end:
    code = end.code
print(code, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def long_log(path: Path) -> None:
    """A real flight again and again, on one clock."""
    with gzip.open(flight_path("nanobench", "B2_circle_medium_rep1"), "rt") as flight:
        head, *rows = flight.read().splitlines()
    rest = [row.partition(",")[2] for row in rows]
    with path.open("w", encoding="utf-8") as out:
        out.write(head + "\n")
        out.writelines(f"{0.01 * k:.2f},{rest[k % len(rest)]}\n" for k in range(ROWS))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "says"), [("inspect", "0"), ("check", "1")]
)  # a flight again and again
def test_a_million_rows(tmp_path: Path, command: str, says: str) -> None:
    log = tmp_path / "long.csv"
    long_log(log)
    words = [command, str(log), "--vehicle", str(vehicle_path("nanobench"))]
    done = subprocess.run(
        [sys.executable, "-c", MEASURED, *words],
        capture_output=True,
        text=True,
        check=False,
        timeout=1800,
    )
    code, kib = done.stdout.splitlines()[-1].split()
    assert code == says, done.stdout + done.stderr
    assert int(kib) < MOST
