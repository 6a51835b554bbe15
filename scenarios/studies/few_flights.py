"""How many flights does a model need, and does it carry over to trajectories of another type?

    python -m scenarios.studies.few_flights --out DIR [--sets one three nine] [--methods TCN]
    python -m scenarios.studies.few_flights --rows scenarios/results/few_flights.jsonl.gz [--figure F.svg]

One, three and nine of the NanoBench training flights are fitted by plain commands: `greybox fit`,
then `greybox compare --adapt 5 --budget 2` with its model and the networks of --methods. All are
judged on the same five flights, one of each type of trajectory. One flight is of one type, so that
four of the five are of types that the model has not seen. A row of DIR/rows.jsonl is one method on
one set; what is there already is not run again. The second form sums up rows.

Printed: mean absolute error 0.1, 0.5 and 1 s ahead, its least and largest value over the sets of
one size, the share of errors inside the stated 95 % regions, and CPU seconds of the whole process.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from greybox.examples import NANOBENCH_TEST, NANOBENCH_TRAIN, flight_path, vehicle_path
from scenarios.foreign.campaign import seconds_of_children
from scenarios.studies.rows import read_rows

SETS: Mapping[str, tuple[tuple[str, ...], ...]] = {
    "one": (
        ("B3_figure8_medium_rep2",),
        ("B2_circle_medium_rep1",),
        ("B8_star_slow_rep2",),
    ),
    "three": (
        ("B2_circle_medium_rep1", "B3_figure8_medium_rep2", "B8_star_slow_rep2"),
        ("B5_helix_fast_mell_rep1", "B7_oval_medium_rep2", "B8_star_fast_rep2"),
    ),
    "nine": (NANOBENCH_TRAIN,),
}
"""How many flights -> sets of them."""
ADAPT, BUDGET, AHEAD = 5.0, 2, (0.1, 0.5, 1.0)
GROUPS = {"position": "m", "velocity": "m/s", "rotation": "rad", "rate": "rad/s"}
FIT = "nonlinear PEM"
"""The method of `greybox compare` that is the fitted model."""


def command(*arguments: str) -> float:
    """CPU seconds of a greybox command. Raises `SystemExit` with what it said where it fails."""
    before = seconds_of_children()
    done = subprocess.run(
        [sys.executable, "-m", "greybox", *arguments],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )
    if done.returncode not in (0, 1):
        raise SystemExit(f"greybox {arguments[0]} ended with {done.returncode}: {done.stderr}")
    return seconds_of_children() - before


def judged(name: str, train: Sequence[str], methods: Sequence[str], folder: Path) -> list[Any]:
    """Rows of the methods on one set; the fit is made where it is not there."""
    paths = [str(flight_path("nanobench", n)) for n in (*train, *NANOBENCH_TEST)]
    own, seen = paths[: len(train)], paths[len(train) :]
    flights = ["--vehicle", str(vehicle_path("nanobench")), "--train", *own, "--test", *seen]
    model, spent = folder / "fit" / "model.json", folder / "seconds.json"
    if not spent.exists():
        seconds = command("fit", *flights, "--out", str(model.parent))
        spent.write_text(json.dumps(seconds))
    rows = []
    for method in methods:
        place = folder / method.replace(" ", "_")
        wanted = [
            *flights,
            *("--adapt", f"{ADAPT:g}", "--budget", str(BUDGET), "--methods", method),
            *("--horizons", ",".join(f"{h:g}" for h in AHEAD), "--out", str(place)),
            *("--fitted", str(model)),
        ]
        seconds = command("compare", *wanted)
        found = json.loads((place / "compare.json").read_text())["methods"][0]
        if found["status"] != "done":
            raise SystemExit(f"{method}: {found['error']}")
        errors = {
            flight: {
                f"{g} {h['seconds']:g}": {k: h["groups"][g].get(k) for k in ("mae", "coverage95")}
                for h in told["horizons"]
                for g in GROUPS
                if g in h["groups"]
            }
            for flight, told in found["multi_step"]["per_flight"].items()
        }
        if method == FIT or method.startswith("physics"):
            seconds += float(json.loads(spent.read_text()))
        rows.append(
            {"size": name, "train": train, "method": method, "cpu": seconds, "errors": errors}
        )
    return rows


def kind(flight: str) -> str:
    """Type of trajectory of a flight."""
    return flight.split("_")[0]


def cells(
    rows: Sequence[Mapping[str, Any]], key: str, value: str, seen: bool | None = None
) -> list[float]:
    """Per row the mean over its judged flights; `seen`: only of types that were trained on, or only
    of others."""
    out = []
    for row in rows:
        types = {kind(f) for f in row["train"]}
        own = [
            e[key][value]
            for flight, e in row["errors"].items()
            if (seen is None or (kind(flight) in types) == seen) and e[key][value] is not None
        ]
        if own:
            out.append(float(np.mean(own)))
    return out


def summary(rows: Sequence[Mapping[str, Any]]) -> str:
    """The tables as text."""
    lines = []
    for g, unit in GROUPS.items():
        heads = "".join(f"{f'{h:g} s':>24}" for h in AHEAD)
        lines.append(f"{g} [{unit}]{'':<{28 - len(g) - len(unit)}}{heads}")
        for size, method in dict.fromkeys((r["size"], r["method"]) for r in rows):
            own = [r for r in rows if (r["size"], r["method"]) == (size, method)]
            for label, seen in (("", None), (", same type", True), (", other types", False)):
                if seen is not None and size == "nine":
                    continue
                line = ""
                for h in AHEAD:
                    e = cells(own, f"{g} {h:g}", "mae", seen)
                    c = cells(own, f"{g} {h:g}", "coverage95", seen)
                    if not e:
                        continue
                    span = f" ({min(e):.3g}-{max(e):.3g})" if len(e) > 1 else ""
                    inside = f" {100 * np.mean(c):3.0f}%" if c else ""
                    line += f"{f'{np.mean(e):.4f}{span}{inside}':>24}"
                if line:
                    lines.append(f"  {f'{size}, {method}{label}':<32}{line}")
    lines.append("CPU seconds, the fit included")
    for size, method in dict.fromkeys((r["size"], r["method"]) for r in rows):
        spent = [r["cpu"] for r in rows if (r["size"], r["method"]) == (size, method)]
        lines.append(f"  {f'{size}, {method}':<32}{np.mean(spent):8.0f}")
    return "\n".join(lines)


def draw(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Errors half a second ahead against the number of flights; one dot a set."""
    import matplotlib
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 2.8), layout="constrained")
    axes = figure.subplots(1, len(GROUPS))
    sizes = {name: len(sets[0]) for name, sets in SETS.items()}
    for axis, (g, unit) in zip(axes, GROUPS.items(), strict=True):
        for i, method in enumerate(dict.fromkeys(r["method"] for r in rows)):
            own = [r for r in rows if r["method"] == method]
            for r in own:
                axis.plot(
                    sizes[r["size"]], cells([r], f"{g} 0.5", "mae")[0], "o", ms=3, color=f"C{i}"
                )
            there = [s for s in sizes if any(r["size"] == s for r in own)]
            means = [
                np.mean(cells([r for r in own if r["size"] == s], f"{g} 0.5", "mae")) for s in there
            ]
            axis.plot([sizes[s] for s in there], means, color=f"C{i}", label=method)
        axis.set(xscale="log", xlabel="flights", title=f"{g}, 0.5 s [{unit}]", ylim=(0, None))
        axis.set_xticks(list(sizes.values()), [str(v) for v in sizes.values()])
        axis.minorticks_off()
    axes[-1].legend(fontsize=7)
    path.parent.mkdir(parents=True, exist_ok=True)
    with matplotlib.rc_context({"svg.hashsalt": "few flights"}):
        figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)


def main(arguments: Sequence[str] | None = None) -> None:
    """Fit, compare, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sets", nargs="+", choices=list(SETS), default=list(SETS))
    parser.add_argument("--methods", nargs="+", default=[FIT, "TCN"])
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for models and rows.jsonl")
    parser.add_argument("--rows", type=Path, metavar="F", help="rows to sum up, nothing is run")
    parser.add_argument("--figure", type=Path, metavar="F.svg")
    options = parser.parse_args(arguments)
    if (options.out is None) == (options.rows is None):
        parser.error("--out DIR to run, or --rows F to sum up")
    path = options.rows or options.out / "rows.jsonl"
    rows = read_rows(path)
    for name in () if options.rows else options.sets:
        for number, train in enumerate(SETS[name]):
            there = {r["method"] for r in rows if tuple(r["train"]) == train}
            missing = [m for m in options.methods if m not in there]
            folder = options.out / f"{name}_{number + 1}"
            folder.mkdir(parents=True, exist_ok=True)
            for method in missing:
                rows += judged(name, train, [method], folder)
                with path.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(rows[-1]) + "\n")
                print(f"{folder.name} {method}: {rows[-1]['cpu']:.0f} s of CPU", flush=True)
    print(summary(rows))
    if options.figure:
        draw(rows, options.figure)


if __name__ == "__main__":
    main()
