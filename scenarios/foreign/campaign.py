"""Fit drawn craft with the plain command and hold the results to the truth: one row per seed.

    python -m scenarios.foreign.campaign --seeds 1 60 --out DIR [--simulator rotorpy] [-- options]
    python -m scenarios.foreign.campaign --out DIR --summary

Every seed is drawn into a folder of DIR and fitted by `greybox fit` with its vehicle file, three
training flights, two test flights and the options after `--`, and nothing else. DIR/rows.jsonl
keeps one row per seed, which a second run does not repeat. Greybox is reached as a user reaches
it, through its command and its files.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from scipy.stats import beta

from scenarios.foreign.draw import SIMULATORS, draw, truth_of, write

DEVIATIONS = 1.96
"""Half width of a 95 % interval in standard errors."""
HORIZONS = (0.1, 0.5)
"""Horizons [s] at which a model is compared with holding the last value."""
USABLE, NOT_USABLE = 0, 1
"""Exit codes of `greybox fit`."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """What came out for one seed.

    code: exit code of the fit; seconds: its CPU time; said: its first line; z: deviations from the
    truth in standard errors, by parameter that was estimated and whose truth is exact; off: the
    same relative to the truth; worse: groups and horizons at which holding the last value is
    better.
    """

    seed: int
    simulator: str
    mass: float
    gusts: bool
    sensors: str
    sigmas: bool
    code: int
    seconds: float
    said: str
    z: dict[str, float]
    off: dict[str, float]
    worse: list[str]

    @property
    def inside(self) -> int:
        """Number of parameters inside their 95 % intervals."""
        return sum(abs(z) <= DEVIATIONS for z in self.z.values())


def deviations(
    parameters: Mapping[str, Mapping[str, Any]], truth: Mapping[str, float]
) -> tuple[dict[str, float], dict[str, float]]:
    """Deviations in standard errors and relative to the truth, of what was estimated for all
    flights together (parameters: that table of a fit.json)."""
    z, off = {}, {}
    for name, found in parameters.items():
        value, error = found["value"], found["std"]
        if name in truth and error and value is not None and not found.get("per_flight"):
            z[name] = (value - truth[name]) / error
            if truth[name]:
                off[name] = value / truth[name] - 1.0
    return z, off


def worse_than_last_value(validation: Mapping[str, Any]) -> list[str]:
    """Groups of a validate.json whose error is above that of holding the last value."""
    found = []
    for row, rival in zip(validation["horizons"], validation["persistence"]["horizons"]):
        seconds = row["seconds"]
        if rival["seconds"] != seconds or not any(math.isclose(seconds, h) for h in HORIZONS):
            continue
        for group, errors in row["groups"].items():
            if errors["rmse"] > rival["groups"][group]["rmse"]:
                found.append(f"{group} {seconds:g} s")
    return found


def fit_plainly(
    vehicle: Path,
    train: Sequence[Path],
    test: Sequence[Path],
    folder: Path,
    options: Sequence[str],
    environment: Mapping[str, str] | None = None,
) -> subprocess.CompletedProcess[str]:
    """`greybox fit` in a process of its own: its files are in folder/fit, what it said in
    folder/fit.txt."""
    command = [sys.executable, "-m", "greybox", "fit", "--vehicle", str(vehicle)]
    command += ["--train", *map(str, train), "--test", *map(str, test)]
    command += ["--out", str(folder / "fit"), *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    (folder / "fit.txt").write_text(done.stdout + done.stderr, encoding="utf-8")
    return done


def seconds_of_children() -> float:
    """CPU time [s] of the processes that were run from this one and have ended."""
    spent = os.times()
    return spent.children_user + spent.children_system


def judge(
    seed: int, out: Path, simulator: str | None, hidden: Sequence[str], options: Sequence[str]
) -> Row:
    """Draw, fit and compare one seed."""
    drawn = draw(seed, simulator, hidden)
    folder = out / f"{seed}_{drawn.simulator}"
    if not (folder / "truth.json").exists():
        write(drawn, folder)
    fitted = folder / "fit"
    train, test = (sorted(folder.glob(f"{kind}*.csv")) for kind in ("train", "test"))
    before = seconds_of_children()
    done = fit_plainly(folder / "vehicle.toml", train, test, folder, options)
    seconds = seconds_of_children() - before
    z: dict[str, float] = {}
    off: dict[str, float] = {}
    worse: list[str] = []
    truth: Any = truth_of(drawn)
    if (fitted / "fit.json").exists():
        z, off = deviations(
            json.loads((fitted / "fit.json").read_text())["parameters"], truth["parameters"]
        )
    if (fitted / "validate.json").exists():
        worse = worse_than_last_value(json.loads((fitted / "validate.json").read_text()))
    said = (done.stdout.strip() or done.stderr.strip() or "nothing").splitlines()
    return Row(
        seed=seed,
        simulator=drawn.simulator,
        mass=float(drawn.craft.airframe.mass),
        gusts=drawn.gusts,
        sensors="ideal" if drawn.realism is None else "real",
        sigmas=drawn.knowledge.sigmas,
        code=done.returncode,
        seconds=seconds,
        said=said[0],
        z=z,
        off=off,
        worse=worse,
    )


def share(part: int, whole: int) -> str:
    """A share with its exact 95 % interval (Clopper and Pearson 1934)."""
    if whole == 0:
        return "0 of 0"
    low = float(beta.ppf(0.025, part, whole - part + 1)) if part else 0.0
    high = float(beta.ppf(0.975, part + 1, whole - part)) if part < whole else 1.0
    return f"{part} of {whole} ({100 * part / whole:.1f} %, {100 * low:.1f} to {100 * high:.1f})"


def line(row: Row) -> str:
    """One line of the table."""
    farthest = max(row.z, key=lambda name: abs(row.z[name]), default="")
    worst = f"{farthest} {row.z[farthest]:+.1f}" if farthest else ""
    return (
        f"{row.seed:5d} {row.simulator:12} {1000 * row.mass:5.0f} g "
        f"{'gusts' if row.gusts else 'still'} {row.sensors:5} "
        f"{'sigma' if row.sigmas else 'bare':5} "
        f"code {row.code} {row.seconds:5.0f} s  {row.inside}/{len(row.z)} inside  {worst:28} "
        f"{'worse: ' + ', '.join(row.worse) if row.worse else ''}"
    )


def summary(rows: Iterable[Row]) -> str:
    """Counts over all rows, and over each simulator, air and kind of sensor."""
    rows = list(rows)
    groups = {"all": rows}
    for word in SIMULATORS:
        groups[word] = [r for r in rows if r.simulator == word]
    groups |= {"gusts": [r for r in rows if r.gusts], "still": [r for r in rows if not r.gusts]}
    groups |= {word: [r for r in rows if r.sensors == word] for word in ("ideal", "real")}
    out = []
    for word, some in groups.items():
        if not some:
            continue
        usable = [r for r in some if r.code == USABLE]
        inside, judged = sum(r.inside for r in usable), sum(len(r.z) for r in usable)
        out.append(
            f"{word:12} usable {share(len(usable), len(some))}; "
            f"usable and worse than the last value {sum(bool(r.worse) for r in usable)}; "
            f"inside their intervals {share(inside, judged)}; "
            f"CPU {sorted(r.seconds for r in some)[len(some) // 2]:.0f} s (median)"
        )
    return "\n".join(out)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the campaign; exit code 0 when every fit ended with one of the codes of a verdict."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs=2, default=(1, 60), metavar=("FIRST", "LAST"))
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--simulator", choices=SIMULATORS)
    parser.add_argument("--hidden", nargs="*", default=[])
    parser.add_argument("--summary", action="store_true", help="only print what is there")
    given = list(sys.argv[1:] if argv is None else argv)
    cut = given.index("--") if "--" in given else len(given)
    arguments = parser.parse_args(given[:cut])
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / "rows.jsonl"
    kept = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    rows = {row.seed: row for row in (Row(**json.loads(text)) for text in kept)}
    if arguments.summary:
        print("\n".join([*map(line, rows.values()), summary(rows.values())]))
        return 0
    first, last = arguments.seeds
    began = time.monotonic()
    for seed in range(first, last + 1):
        if seed not in rows:
            row = judge(
                seed, arguments.out, arguments.simulator, arguments.hidden, given[cut + 1 :]
            )
            rows[seed] = row
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(asdict(row)) + "\n")
        print(line(rows[seed]), flush=True)
    chosen = [rows[seed] for seed in range(first, last + 1)]
    print(summary(chosen))
    print(f"{time.monotonic() - began:.0f} s")
    return 0 if all(row.code in (USABLE, NOT_USABLE) for row in chosen) else 1


if __name__ == "__main__":
    raise SystemExit(main())
