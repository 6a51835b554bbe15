"""Opened: how much of a gap an effect outside the catalogue opens, and how much of that is closed.

    python -m scenarios.foreign.naming --cells outside --seeds 1 12 --out DIR
    python -m scenarios.foreign.opened DIR [DIR ...] [--jobs 2]

The floor of a gap is dead reckoning with the measured IMU, which feels every gust. No model can
foretell a gust, so that in gusts most of that gap stays, whatever law is found. Here the same craft
flies the same plans in the same gusts without the effect, and the base model is fitted to that twin
(`greybox discover --max-effects 0`). With E the error half a second ahead,

    closed = (E_before^2 - E_after^2) / (E_before^2 - E_twin^2),

in the channel group in which the effect opens most, where it opens any gap worth the name
(`OPENS`). E_after is that of what the search delivers: names, and laws where it wrote any. A log
that was refused or not searched to its end has closed nothing. DIR/opened.jsonl keeps one row per
log.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

from scenarios.foreign.naming import GREYBOX, LIMIT, append_row, read_rows, retired, run
from scenarios.foreign.naming_cells import Case, case_of, write
from scenarios.foreign.verdicts import AHEAD

Row = dict[str, Any]
OPENS = 1.2
"""Ratio of squared errors, with the effect over without it, below which it opens no gap."""


def twin(case: Case) -> Case:
    """The same log without what is outside the catalogue."""
    base = replace(case.base, fitted=None) if case.own == "rotor_law" else case.base
    return replace(case, effects=(), own=None, base=base)


def opened(found: Mapping[str, Any], base: Mapping[str, Any]) -> Row:
    """From the discovery.json of a log and of its twin: the `group` in which the effect opens most,
    by which `ratio` of squared errors, and the share of it that was `closed`; all None where it
    opens none."""
    without = {r["group"]: float(r["before"]) ** 2 for r in base["gap"] if r["horizon_s"] == AHEAD}
    best: Row = {"group": None, "ratio": None, "closed": None}
    for row in found["gap"]:
        if row["horizon_s"] != AHEAD or row["group"] not in without:
            continue
        before, twin_ = float(row["before"]) ** 2, without[row["group"]]
        if before < OPENS * twin_ or before / twin_ <= (best["ratio"] or 0.0):
            continue
        after = float(row["after"]) ** 2
        if found.get("model_with_laws") and row.get("with_proposals") is not None:
            floor = float(row["floor"] or 0.0) ** 2
            after = before - float(row["with_proposals"]) * (before - floor)
        closed = (before - after) / (before - twin_)
        best = {"group": row["group"], "ratio": before / twin_, "closed": closed}
    return best


def row_of(asked: str, seed: int, seconds: float, folder: Path, greybox: str) -> Row:
    """Fly the twin of one log, fit the base and compare. The log was searched before."""
    name = f"{asked.replace(':', '_')}_{seed}"
    case, beside = case_of(asked, seed), folder / "twins" / f"{name}_{seconds:g}"
    write(twin(case), beside, seconds=seconds)
    run(beside, f"{greybox} discover --max-effects 0", LIMIT)
    row: Row = {"asked": asked, "seed": seed, "length": seconds, "cell": case.cell}
    row |= {"gusts": case.gusts, "sensors": case.sensors}
    try:
        found, base = (
            json.loads((place / "found" / "discovery.json").read_text(encoding="utf-8"))
            for place in (folder / "logs" / name, beside)
        )
    except (OSError, ValueError):
        return row | {"group": None, "ratio": None, "closed": None, "failed": "no result"}
    if not found["gap"] or not base["gap"]:
        verdict = found["verdict"] if not found["gap"] else f"twin {base['verdict']}"
        return row | {"group": None, "ratio": None, "closed": None, "failed": verdict}
    return row | opened(found, base) | {"failed": None}


def lines(rows: Sequence[Row]) -> list[str]:
    """What there was to close and what was closed, in all logs, in gusts and in still air."""
    out = []
    for label, some in (
        ("all", rows),
        ("gusts", [r for r in rows if r["gusts"]]),
        ("still air", [r for r in rows if not r["gusts"]]),
    ):
        shares = [r["closed"] for r in some if r["closed"] is not None]
        failed = sum(r["failed"] is not None for r in some)
        told = f", closed {median([*shares, *[0.0] * failed]):.2f} (median)" if shares else ""
        more = f", {failed} without a result" if failed else ""
        out.append(f"{label}: {len(shares)} of {len(some)} open a gap{more}{told}")
    return out


def main(argv: Sequence[str] | None = None) -> int:
    """Fly the twins that are not there yet and print what was closed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", type=Path, nargs="+", metavar="DIR")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--greybox", default=GREYBOX, help="the command that is judged")
    options = parser.parse_args(argv)
    rows: list[Row] = []
    spent = retired()
    for folder in options.folders:
        kept = folder / "opened.jsonl"
        mine = read_rows([kept])
        done = {(r["asked"], r["seed"], r["length"]) for r in mine}
        work = [
            (r["asked"], r["seed"], r["length"], folder, options.greybox)
            for r in read_rows([folder / "rows.jsonl"])
            if r["cell"].startswith("outside")
            if (r["asked"], r["seed"], r["length"]) not in done
            if (r["asked"], r["seed"]) not in spent
        ]
        with concurrent.futures.ThreadPoolExecutor(options.jobs) as pool:
            for future in concurrent.futures.as_completed([pool.submit(row_of, *w) for w in work]):
                row = future.result()
                append_row(kept, row)
                mine.append(row)
                print(json.dumps(row), flush=True)
        rows += mine
    print("\n".join(lines(rows)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
