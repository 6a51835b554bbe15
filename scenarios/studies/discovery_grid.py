"""The grid that judges discover: effects hidden one, two, three and five at a time, at several
sizes, and clean flights.

    python -m scenarios.studies.discovery_grid --out F.jsonl --cells clean --seeds 1000:1100 python
    -m scenarios.studies.discovery_grid --out F.jsonl --cells single --sizes large,medium,near
    --seeds 1000:1004 python -m scenarios.studies.discovery_grid --out F.jsonl --summary [--docs
    tables]

Two training flights of 16 s at 100 Hz and a test flight of 8 s per case (see discovery_cells).
Every case is written as one line when it is done, so that a study that was stopped goes on where it
was. Seeds below 1000 are for development; figures in the documentation come from seeds from 1000
on, on which nothing was tuned. Verdicts per case:

    right      the hidden effects, and nothing else, have names
    group      every hidden effect has its name or stands in a set of look-alikes, and no name is false
    part       some of several hidden effects are named, the others are not, and no name is false
    silent     no name at all
    extra      the hidden effects have their names, and so has something that is not there
    wrong      something else has a name

`clean` hides nothing: right is "nothing missing", silent any other verdict without a name.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import contextlib
import itertools
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from greybox.discovery.result import Discovery
from greybox.discovery.workflow import discover
from greybox.errors import GreyboxError
from greybox.files import append_json_line
from scenarios.studies.discovery_cells import (
    COLUMNS,
    ERRORS,
    FIVES,
    MAKERS,
    PAIRS,
    SIGMA,
    SIZES,
    TRIPLES,
    X250,
    Cell,
    cases,
    flights,
    flown,
    nominal,
    vehicle_of,
)
from scenarios.studies.discovery_oracle import oracle
from scenarios.studies.discovery_summary import summary, write_docs
from scenarios.studies.rows import open_ended, read_rows

__all__ = ["ERRORS", "MAKERS", "SIGMA", "cases", "flights", "judge", "main", "run", "vehicle_of"]
CHUNK = 24
"""Seeds of one cell that fly side by side."""


def judge(found: Discovery, truth: Sequence[str]) -> str:
    """One of the verdicts above."""
    if found.fit is None:
        return "silent" if truth or found.verdict != "nothing_missing" else "right"
    names = {e["name"] for e in found.effects()}
    groups = [{n for c in a["candidates"] for n in c["name"].split("+")} for a in found.ambiguous()]
    wanted = set(truth)
    if names - wanted:
        return "extra" if wanted and wanted <= names else "wrong"
    # A group without a hidden effect is a false name that was not decided.
    if any(not g & wanted for g in groups):
        return "wrong"
    if not wanted:
        return "right" if found.verdict == "nothing_missing" else "silent"
    if names == wanted and not groups:
        return "right"
    covered = names.union(*groups) & wanted
    if covered == wanted:
        return "group"
    return "part" if covered else "silent"


def run(cell: Cell, seeds: Sequence[int]) -> Iterator[dict[str, Any]]:
    """One row of plain values per seed."""
    for seed, plant, size, train, test in flown(cell, seeds):
        row: dict[str, Any] = cell.to_dict() | {"seed": seed, "kind": cell.kind, "in_noise": size}
        row["truth"] = {k: float(v) for e in plant.effects for k, v in e.parameters().items()}
        said = nominal(plant, cell.nominal, seed)
        try:
            found = discover(said, train, test)
            row |= _outcome(found, cell.hidden)
        except GreyboxError as error:
            row |= {"judged": "failed", "error": str(error)}
        else:
            if cell.hidden and found.fit is not None:
                groups = [[c["name"] for c in a["candidates"]] for a in found.ambiguous()]
                with contextlib.suppress(
                    GreyboxError
                ):  # a failed oracle says nothing of the search
                    row["oracle"] = oracle(said, train, test, row["truth"], found.fit, groups)
        yield row


def _outcome(found: Discovery, truth: Sequence[str]) -> dict[str, Any]:
    content = found.to_dict()
    # The group of channels that the hidden effects move most, half a second ahead.
    gaps = [r for r in content["gap"] if r["horizon_s"] == 0.5 and r["closed"] is not None]
    most = max(
        gaps,
        key=lambda r: r["before"] ** 2 / max(r["floor"] or 0.0, 0.1 * r["before"]) ** 2,
        default=None,
    )
    return {
        "judged": judge(found, truth),
        "verdict": found.verdict,
        "effects": {
            e["name"]: {n: [p["value"], p["std"]] for n, p in e["parameters"].items()}
            for e in content["effects"]
        },
        "log10_e": {n.name: n.to_dict()["log10_e"] for n in found.names},
        "offered": len(content["minimum_detectable"]) + len(found.names),
        "status": {n.name: n.status for n in found.names},
        "worth": {n.name: n.worth.share for n in found.names if n.worth is not None},
        "ambiguous": [
            {c["name"]: c["weight"] for c in a["candidates"]} for a in content["ambiguous"]
        ],
        "traces": [t["name"] for t in content["traces"]],
        "unnamed": [[u["channel"], u["proposal"]] for u in content["unnamed"]],
        "not_judged": {n: why for n, why in content["not_judged"].items() if n in truth},
        "faults": content["faults"],
        "warnings": content["warnings"],
        "closed": None if most is None else [most["group"], most["closed"], *(most["ci95"] or ())],
        "took": found.seconds,
    }


def planned(options: argparse.Namespace) -> list[Cell]:
    """The cells that the command line asks for."""
    common = {"seconds": options.seconds, "noise": options.noise, "rate": options.rate}
    out = []
    for kind, vehicle, nom, columns in itertools.product(
        options.cells.split(","),
        options.vehicle.split(","),
        options.nominal.split(","),
        options.columns.split(","),
    ):
        base = Cell(vehicle=vehicle, nominal=nom, columns=columns, **common)
        names = [n for n in cases(X250) if n != "clean"]
        sets: dict[str, Sequence[tuple[str, ...]]] = {
            "clean": [()],
            "single": [(n,) for n in names],
            "pair": PAIRS,
            "triple": TRIPLES,
            "five": FIVES,
        }
        chosen = sets[kind] if kind in sets else [tuple(kind.split("+"))]
        sizes = options.sizes.split(",") if len(chosen[0]) == 1 else ["flight"]
        out += [_with(base, hidden=h, size=s) for s in sizes for h in chosen]
    return out


def _with(cell: Cell, **changes: Any) -> Cell:
    return Cell(**{**cell.to_dict(), **changes})


def _key(row: dict[str, Any]) -> str:
    # Rows of earlier studies do not say what had one value then.
    return json.dumps(
        [*(row.get(n, default) for n, default in Cell().to_dict().items()), row["seed"]]
    )


def _seeds(text: str) -> list[int]:
    low, _, high = text.partition(":")
    return list(range(int(low), int(high))) if high else [int(s) for s in text.split(",")]


def _whole(cell: Cell, seeds: Sequence[int]) -> list[dict[str, Any]]:
    return list(run(cell, seeds))


def _say(row: dict[str, Any]) -> None:
    names = ", ".join(row.get("effects", ())) or " | ".join(
        " or ".join(a) for a in row.get("ambiguous", ())
    )
    print(
        f"{row['vehicle']} {row['nominal']} {row['noise']} {row['columns']} {row['rate']:g} Hz "
        f"{row['size']:6s} "
        f"{row['seed']:5d} {'+'.join(row['hidden']) or 'clean':26s} {row['judged']:7s} "
        f"{names or row.get('verdict', row.get('error'))} ({row.get('took', 0):.0f} s)",
        flush=True,
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what is not in the file yet, or print what is."""
    parser = argparse.ArgumentParser(
        description="The grid that judges discover on simulated flights."
    )
    parser.add_argument("--out", default="discovery_grid.jsonl")
    parser.add_argument(
        "--cells", default="clean", help="clean, single, pair, triple, five, or effects (a or a+b)"
    )
    parser.add_argument(
        "--sizes", default="flight", help=f"for one effect: flight, {', '.join(SIZES)}"
    )
    parser.add_argument("--seeds", type=_seeds, default=[1], help="1,2,5 or 1000:1020")
    parser.add_argument("--vehicle", default="x250", help=", ".join(MAKERS))
    parser.add_argument("--nominal", default="off", help="exact, off")
    parser.add_argument("--noise", default="white", choices=("white", "coloured", "gusts"))
    parser.add_argument("--columns", default="full", help=", ".join(COLUMNS))
    parser.add_argument("--rate", type=float, default=100.0, help="samples per second")
    parser.add_argument("--seconds", type=float, default=16.0)
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--summary", action="store_true")
    parser.add_argument("--docs", default=None, help="folder for tables and figures")
    options = parser.parse_args(arguments)
    if wrong := set(options.columns.split(",")) - set(COLUMNS):
        parser.error(f"--columns takes {', '.join(COLUMNS)}, not {', '.join(sorted(wrong))}")
    if options.sizes != "flight" and options.rate != Cell().rate:
        parser.error("sizes in the noise are known at 100 Hz: --sizes flight with another --rate")
    path = Path(options.out)
    if not options.summary:
        open_ended(path, parser)
    rows = read_rows(path)
    if not options.summary:
        done = {_key(r) for r in rows}
        work = []
        for cell in planned(options):
            left = [s for s in options.seeds if _key({**cell.to_dict(), "seed": s}) not in done]
            work += [(cell, left[i : i + CHUNK]) for i in range(0, len(left), CHUNK)]
        if options.jobs > 1:
            with concurrent.futures.ProcessPoolExecutor(options.jobs) as pool:
                for future in concurrent.futures.as_completed(
                    [pool.submit(_whole, *w) for w in work]
                ):
                    for row in future.result():
                        append_json_line(path, row)
                        _say(row)
        else:
            for cell, seeds in work:
                for row in run(cell, seeds):
                    append_json_line(path, row)
                    _say(row)
        rows = read_rows(path)
    print(summary(rows))
    if options.docs:
        write_docs(rows, Path(options.docs))


if __name__ == "__main__":
    main()
