"""What is a model of one craft worth for another one, of which there are 5 or 20 s of flight?

    python -m scenarios.studies.another_craft --out DIR [--pairs 1701-1702 ...] [--seconds 5 20]
    python -m scenarios.studies.another_craft --out DIR --arpl MODEL.json
    python -m scenarios.studies.another_craft --rows scenarios/results/another_craft.jsonl.gz

A pair are two drawn craft (`scenarios.foreign.draw`), source and target; --source and --target say
who flies them. By plain commands the target's first training flight, cut to so many seconds, is
fitted alone and with `--from` the source's model; its three training flights of 20 s are fitted,
too. In one row the source's model flies in the target's place, adapted to so many seconds of each
flight, half of it at most (`greybox validate --adapt`). All are judged on the target's two test
flights.

--arpl: MODEL.json, of NanoBench flights, is the source, the Crazyflie of the ARPL logs the target.
It has no pose: rates are judged, on log10; the seconds are those from 20 s on of log15.

Printed: mean absolute error 0.1, 0.5 and 1 s ahead over that of holding the last value, geometric
means over pairs; the share of errors inside the stated 95 % regions; CPU seconds. DIR/rows.jsonl
keeps one row per pair, which a second run does not repeat.
"""

from __future__ import annotations

import argparse
import gzip
import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from greybox.examples import flight_path, vehicle_path
from scenarios.foreign.campaign import fit_plainly, seconds_of_children
from scenarios.foreign.draw import SIMULATORS, draw, write
from scenarios.foreign.flights import DURATION
from scenarios.studies.rows import read_rows

AHEAD = (0.1, 0.5, 1.0)
GROUPS = ("position", "velocity", "rotation", "rate")
ARPL_BEGINS = 20.0
"""Seconds into log15 from which the craft flies."""


def cut(log: Path, first: float, seconds: float, out: Path) -> Path:
    """The rows of a CSV log between `first` and `first + seconds` after its begin."""
    text = gzip.decompress(log.read_bytes()).decode() if log.suffix == ".gz" else log.read_text()
    head, *rows = text.splitlines()
    times = np.array([float(r.split(",", 1)[0]) for r in rows])
    inside = (times >= times[0] + first) & (times < times[0] + first + seconds)
    out.write_text("\n".join([head, *(r for r, i in zip(rows, inside, strict=True) if i)]) + "\n")
    return out


def judged(file: Path, seconds: float) -> dict[str, Any]:
    """Errors, those of the last value and coverage by group and horizon, from a validate.json."""
    told = json.loads(file.read_text())
    last = {h["seconds"]: h["groups"] for h in told["persistence"]["horizons"]}
    errors = {
        f"{g} {h['seconds']:g}": {
            "mae": e["mae"],
            "last": last[h["seconds"]][g]["mae"],
            "coverage95": e.get("coverage95"),
        }
        for h in told["horizons"]
        for g, e in h["groups"].items()
        if h["seconds"] in AHEAD
    }
    return {"cpu": seconds, "errors": errors, "verdict": told["verdict"]["line"]}


def fitted(
    vehicle: Path, train: Sequence[Path], test: Sequence[Path], folder: Path, *options: str
) -> dict[str, Any]:
    """A plain fit and what judges it; without it what the command said."""
    folder.mkdir(parents=True, exist_ok=True)
    before = seconds_of_children()
    done = fit_plainly(vehicle, train, test, folder, options)
    file = folder / "fit" / "validate.json"
    if done.returncode not in (0, 1) or not file.exists():
        return {"error": done.stderr.strip().splitlines()[-1]}
    return judged(file, seconds_of_children() - before)


def as_it_is(source: Path, test: Sequence[Path], adapt: float, file: Path) -> dict[str, Any]:
    """The source's model on flights of the target."""
    words = ["validate", str(source), "--log", *map(str, test), "--adapt", f"{adapt:g}"]
    before = seconds_of_children()
    done = subprocess.run(
        [sys.executable, "-m", "greybox", *words, "--json", str(file)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )
    if done.returncode not in (0, 1):
        return {"error": done.stderr.strip().splitlines()[-1]}
    return judged(file, seconds_of_children() - before)


def transfer(
    source: Path,
    vehicle: Path,
    log: tuple[Path, float],
    test: Sequence[Path],
    lengths: Sequence[float],
    folder: Path,
) -> dict[str, Any]:
    """By method and seconds the result, from `log` (file, where its seconds begin)."""
    found = {}
    for seconds in lengths:
        short = cut(*log, seconds, folder / f"first_{seconds:g}.csv")
        place = folder / f"{seconds:g}"
        found[f"own seconds {seconds:g}"] = fitted(vehicle, [short], test, place / "alone")
        found[f"source and own seconds {seconds:g}"] = fitted(
            vehicle, [short], test, place / "from", "--from", str(source)
        )
    return found


def of_pair(
    first: int, second: int, simulators: Sequence[str], lengths: Sequence[float], folder: Path
) -> dict[str, Any]:
    """The row of a pair of drawn craft."""
    places = []
    for seed, simulator in zip((first, second), simulators, strict=True):
        places.append(folder / f"{seed}_{simulator}")
        if not (places[-1] / "truth.json").exists():
            write(draw(seed, simulator), places[-1])
    files = [[sorted(p.glob(f"{kind}*.csv")) for kind in ("train", "test")] for p in places]
    vehicles = [p / "vehicle.toml" for p in places]
    train, test = files[0]
    fitted(vehicles[0], train, test, places[0])
    source = places[0] / "fit" / "model.json"
    train, test = files[1]
    found = {
        f"source as it is {s:g}": as_it_is(source, test, s, folder / f"as_it_is_{s:g}.json")
        for s in lengths
        if s <= DURATION / 2
    }
    found |= transfer(source, vehicles[1], (train[0], 0.0), test, lengths, folder)
    found["all own flights"] = fitted(vehicles[1], train, test, places[1])
    masses = [float(draw(s, m).craft.airframe.mass) for s, m in zip((first, second), simulators)]
    return {
        "pair": f"{first}-{second}",
        "simulators": list(simulators),
        "mass": masses,
        "found": found,
    }


def of_arpl(source: Path, lengths: Sequence[float], folder: Path) -> dict[str, Any]:
    """The row of the ARPL craft."""
    folder.mkdir(parents=True, exist_ok=True)
    log15, log10 = (flight_path("arpl_crazyflie", f"log{k}") for k in (15, 10))
    vehicle = vehicle_path("arpl_crazyflie")
    found = transfer(source, vehicle, (log15, ARPL_BEGINS), [log10], lengths, folder)
    found["all own flights"] = fitted(vehicle, [log15], [log10], folder)
    return {"pair": "NanoBench-ARPL", "found": found}


def summary(rows: Sequence[Mapping[str, Any]]) -> str:
    """The table as text; drawn craft and ARPL apart."""
    lines = []
    for title in ("drawn craft", "NanoBench-ARPL"):
        own = [r for r in rows if (r["pair"] == title) == (title == "NanoBench-ARPL")]
        if not own:
            continue
        lines.append(f"{title}: {len(own)}; share of the last value's error, 95 % regions hold")
        heads = "".join(f"{f'{g} {h:g} s':>17}" for g in GROUPS for h in AHEAD)
        lines.append(f"{'':<28}{heads}{'CPU':>8}")
        for method in dict.fromkeys(m for r in own for m in r["found"]):
            here = [r["found"][method] for r in own if method in r["found"]]
            done = [f for f in here if "errors" in f]
            line = f"{method:<28}"
            for key in (f"{g} {h:g}" for g in GROUPS for h in AHEAD):
                some = [f["errors"][key] for f in done if key in f["errors"]]
                share = [e["mae"] / e["last"] for e in some]
                held = [e["coverage95"] for e in some if e["coverage95"] is not None]
                cell = f"{np.exp(np.mean(np.log(share))):.3f}" if share else "-"
                cell += f" {100 * np.mean(held):3.0f}%" if held else ""
                line += f"{cell:>17}"
            line += f"{np.median([f['cpu'] for f in done]):7.0f}s" if done else ""
            line += f"  {len(here) - len(done)} failed" if len(done) < len(here) else ""
            lines.append(line)
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Fly, fit, judge, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pairs", nargs="*", default=[], metavar="SEED-SEED")
    parser.add_argument("--source", choices=SIMULATORS, default="rotorpy")
    parser.add_argument("--target", choices=SIMULATORS, default="mujoco")
    parser.add_argument("--arpl", type=Path, metavar="MODEL.json")
    parser.add_argument("--seconds", type=float, nargs="+", default=[5.0, 20.0])
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for fits and rows.jsonl")
    parser.add_argument("--rows", type=Path, metavar="F", help="rows to sum up, nothing is run")
    options = parser.parse_args(arguments)
    if (options.out is None) == (options.rows is None):
        parser.error("--out DIR to run, or --rows F to sum up")
    path = options.rows or options.out / "rows.jsonl"
    rows = read_rows(path)
    there = {r["pair"] for r in rows}

    def keep(row: dict[str, Any]) -> None:
        rows.append(row)
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")

    if options.out is not None:
        simulators = (options.source, options.target)
        for pair in options.pairs:
            first, second = (int(s) for s in pair.split("-"))
            if pair not in there:
                keep(of_pair(first, second, simulators, options.seconds, options.out / pair))
        if options.arpl is not None and "NanoBench-ARPL" not in there:
            keep(of_arpl(options.arpl, options.seconds, options.out / "arpl"))
    print(summary(rows))


if __name__ == "__main__":
    main()
