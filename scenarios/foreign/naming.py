"""Judge `greybox discover` on craft that foreign simulators fly: one row per cell and seed.

    python -m scenarios.foreign.naming --cells clean single wind --seeds 1 12 --out DIR [--jobs 2]
    python -m scenarios.foreign.naming --out DIR --summary
    python -m scenarios.foreign.naming --summary --rows scenarios/results/naming*.jsonl.gz

Every log is written into a folder of DIR and searched by the plain command with its vehicle file,
its training flights and its test flight, and nothing else (`--greybox COMMAND` names another
installation). DIR/rows.jsonl keeps one row per log as it is done; what is there is not repeated.
Cells: see `naming_cells`; verdicts: see `verdicts`; whether a log shows what is hidden: see
`power`. Shares have exact 95 % intervals (Clopper and Pearson 1934). Seeds below 1000 are for
development, those from 1000 on judge; a judged log that was looked at is retired by a line
"CELL SEED" in scenarios/results/naming_retired.txt, and is neither flown nor counted again.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import gzip
import json
import math
import os
import resource
import shlex
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from scenarios.foreign.naming_cells import (
    KINDS,
    SECONDS,
    Case,
    case_of,
    cells,
    described,
    fly_case,
    write,
)
from scenarios.foreign.naming_summary import summary
from scenarios.foreign.power import power
from scenarios.foreign.verdicts import Said, judge, judge_outside, speed_error

RETIRED = Path(__file__).parents[1] / "results" / "naming_retired.txt"
"""Judged logs that were looked at, as lines "cell seed"; # begins a comment."""
LIMIT = 600.0
"""CPU time [s] after which a search counts as failed."""
GREYBOX = f"{shlex.quote(sys.executable)} -m greybox"


def read_rows(paths: Iterable[Path]) -> list[dict[str, Any]]:
    """Rows of these files (.gz: results that are kept); none where one is not there."""
    rows = []
    for path in paths:
        if path.exists():
            data = path.read_bytes()
            text = (gzip.decompress(data) if path.suffix == ".gz" else data).decode()
            rows += [json.loads(line) for line in text.splitlines() if line.endswith("}")]
    return rows


def append_row(path: Path, row: dict[str, Any]) -> None:
    """One line in one write; a line that was cut off before it stays alone."""
    whole = not path.exists() or path.read_bytes()[-1:] in (b"", b"\n")
    with path.open("a", encoding="utf-8") as stream:
        stream.write(("" if whole else "\n") + json.dumps(row) + "\n")


def retired(path: Path = RETIRED) -> set[tuple[str, int]]:
    """Cells and seeds that no longer judge."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    pairs = (line.split("#")[0].split() for line in lines)
    return {(pair[0], int(pair[1])) for pair in pairs if pair}


def run(folder: Path, command: str, limit: float) -> dict[str, Any]:
    """Run a command line of discover on the logs of a folder, within `limit` seconds of CPU: how it
    went."""
    train = sorted((p.name for p in folder.glob("train*.csv")), key=lambda n: (len(n), n))
    test = sorted(p.name for p in folder.glob("test*.csv"))
    line = [*shlex.split(command), "--vehicle", "vehicle.toml", "--train", *train]
    line += ["--test", *test, "--out", "found"]
    for old in (
        "discovery.json",
        "unfinished.jsonl",
    ):  # what an earlier run was killed in counts for nothing
        (folder / "found" / old).unlink(missing_ok=True)
    began = time.monotonic()
    with (folder / "said.txt").open("w", encoding="utf-8") as stream:
        process = subprocess.Popen(line, cwd=folder, stdout=stream, stderr=subprocess.STDOUT)
        resource.prlimit(process.pid, resource.RLIMIT_CPU, (math.ceil(limit),) * 2)
        _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    return {
        "code": process.returncode,
        "seconds": round(used.ru_utime + used.ru_stime, 2),
        "elapsed": round(time.monotonic() - began, 1),
    }


def search(folder: Path, greybox: str, limit: float) -> tuple[Said | None, dict[str, Any]]:
    """Run the plain command on a folder: what it said (None without a result), and how it went."""
    how = run(folder, f"{greybox} discover", limit)
    try:
        said = Said.read(folder / "found" / "discovery.json") if how["code"] == 0 else None
    except (OSError, ValueError):
        said = None
    return said, how


def row_of(
    cell: str, seed: int, out: Path, greybox: str, seconds: float, limit: float
) -> dict[str, Any]:
    """Fly, search and judge one log."""
    case = case_of(cell, seed)
    folder = out / "logs" / f"{cell.replace(':', '_')}_{seed}"
    flights = write(case, folder, seconds=seconds)
    said, how = search(folder, greybox, limit)
    row = {"asked": cell, "length": seconds} | described(case) | how
    row.pop("realism")
    return row | power(case, flights) | judged(case, said)


def with_power(row: dict[str, Any]) -> dict[str, Any]:
    """A row with what the oracle says now, of the same log flown again."""
    case = case_of(row["asked"], row["seed"])
    return row | power(case, fly_case(case, seconds=row["length"]))


def judged(case: Case, said: Said | None) -> dict[str, Any]:
    """What was said and what it is worth, as plain values."""
    if case.kind == "outside":
        verdict = judge_outside(said, case.axes, case.family, case.true)
    else:
        verdict = judge(said, case.hidden, case.true)
    out: dict[str, Any] = {"judged": verdict}
    if said is None:
        return out
    out |= {
        "verdict": said.verdict,
        "names": {n: dict(v) for n, v in said.effects.items()},
        "errors": {n: dict(v) for n, v in said.errors.items()},
        "denied": list(said.denied),
        "status": dict(said.status),
        "sets": [["+".join(sorted(c)) for c in some] for some in said.sets],
        "traces": list(said.traces),
        "unnamed": list(said.unnamed),
        "in_base": sorted(set(said.base) & set(case.hidden)),
        "faults": list(said.faults),
        "log10_e": dict(said.evidence),
        "largest_log10_e": said.largest,
        "closed": said.closed,
    }
    if case.kind == "wind":
        out["speed_error"] = speed_error(said, case.truth())
    return out


def say(row: dict[str, Any]) -> str:
    """One line of the table."""
    names = [*row.get("names", ()), *("|".join(s) for s in row.get("sets", ()))]
    traces = f" traces: {', '.join(row['traces'])}" if row.get("traces") else ""
    shown = "" if row.get("power") is None or row["power"] else " (no power)"
    return (
        f"{row['asked']:28s} {row['seed']:5d} {row['simulator']:12s} "
        f"{'gusts' if row['gusts'] else 'still'} {row['sensors']:5s} {row['file']:5s} "
        f"{row['judged']:9s}{shown} {'+'.join(row['hidden']) or '-'} -> "
        f"{', '.join(names) or row.get('verdict', 'no result')}{traces} ({row['seconds']:.0f} s)"
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run what is not there yet and print the table; exit code 1 when a search gave no result."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cells", nargs="+", default=["clean"], help=", ".join(KINDS))
    parser.add_argument("--seeds", type=int, nargs=2, default=(1, 12), metavar=("FIRST", "LAST"))
    parser.add_argument("--out", type=Path, default=Path("naming"), help="folder")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=SECONDS, help="length of a flight")
    parser.add_argument("--limit", type=float, default=LIMIT, help="CPU time [s] of a search")
    parser.add_argument("--greybox", default=GREYBOX, help="the command that is judged")
    parser.add_argument("--summary", action="store_true", help="only print the table")
    parser.add_argument("--rows", type=Path, nargs="+", help="with --summary: of these files")
    parser.add_argument(
        "--oracle", action="store_true", help="with --summary: ask the oracle of power anew"
    )
    options = parser.parse_args(argv)
    if options.rows and not options.summary:
        parser.error("--rows goes with --summary: results that are kept are not added to")
    path = options.out / "rows.jsonl"
    spent = retired()
    sources = [path] if not options.rows else options.rows
    rows = [r for r in read_rows(sources) if (r["asked"], r["seed"]) not in spent]
    if options.summary:
        print(summary([with_power(r) for r in rows] if options.oracle else rows))
        return 0
    options.out.mkdir(parents=True, exist_ok=True)
    try:
        asked = cells(options.cells)
    except ValueError as error:
        parser.error(str(error))
    done = {(r["asked"], r["seed"], r["length"]) for r in rows} | {
        (c, s, options.seconds) for c, s in spent
    }
    first, last = options.seeds
    work = [(c, s) for s in range(first, last + 1) for c in asked]
    work = [(c, s) for c, s in work if (c, s, options.seconds) not in done]
    with concurrent.futures.ThreadPoolExecutor(options.jobs) as pool:
        futures = [
            pool.submit(row_of, c, s, options.out, options.greybox, options.seconds, options.limit)
            for c, s in work
        ]
        for future in concurrent.futures.as_completed(futures):
            row = future.result()
            rows.append(row)
            append_row(path, row)
            print(say(row), flush=True)
    print(summary(rows))
    return 1 if any(r["judged"] == "failed" for r in rows) else 0


if __name__ == "__main__":
    raise SystemExit(main())
