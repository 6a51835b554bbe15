"""What each automatic decision of `greybox fit` is worth: each alone is overruled, the rest is
decided as always.

    python -m scenarios.studies.ablation --out DIR [--seeds 1350 1355] [--only effects ...]
    python -m scenarios.studies.ablation --out DIR --table

Craft are drawn as in `scenarios.foreign.campaign`, and three NanoBench flights are fitted and two
of other types judged. DIR has one folder per decision; what is there is not fitted again. The table
gives the median ratio of the errors 0.5 s ahead to those of the automatic fit (1: the decision is
worth nothing here) and its largest over craft and groups.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from greybox.examples import NANOBENCH_TEST, NANOBENCH_TRAIN, flight_path, vehicle_path
from greybox.files import write_json
from scenarios.foreign.campaign import DEVIATIONS, USABLE, fit_plainly, judge

AUTOMATIC = "automatic"
OVERRULED: dict[str, tuple[str, ...]] = {
    AUTOMATIC: (),
    "disturbance states": ("--disturbance", "none"),
    "effects": ("--effects", "none"),
    "noise of the IMU": ("--noise-parts", "none"),
    "noise on the attitude": ("--no-kinematic-noise",),
    "criterion": ("--predictor", "innovation"),
    "errors of what is held": ("--considered", "none"),
    "all of them": ("--manual",),
}
HORIZON = 0.5
"""Where errors are compared [s]."""
TRAIN, TEST = NANOBENCH_TRAIN[3:6], NANOBENCH_TEST[1:3]


def run(name: str, out: Path, seeds: Sequence[int]) -> None:
    """All fits with one decision overruled; rows.json keeps what the campaign says of each
    craft."""
    folder = out / name.replace(" ", "_")
    if (folder / "rows.json").exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    rows = [asdict(judge(seed, folder, None, (), OVERRULED[name])) for seed in seeds]
    real = folder / "nanobench"
    real.mkdir(exist_ok=True)
    train, test = (
        [flight_path("nanobench", flight) for flight in flights] for flights in (TRAIN, TEST)
    )
    fit_plainly(vehicle_path("nanobench"), train, test, real, OVERRULED[name])
    write_json(folder / "rows.json", {"rows": rows})


def errors(folder: Path) -> dict[tuple[str, str], float]:
    """(flight set, group) -> RMSE at HORIZON of every fit below a folder."""
    found: dict[tuple[str, str], float] = {}
    for path in sorted(folder.glob("*/fit/validate.json")):
        table: Any = json.loads(path.read_text(encoding="utf-8"))
        (row,) = (r for r in table["horizons"] if abs(r["seconds"] - HORIZON) < 1e-6)
        found |= {
            (path.parts[-3], group): float(value["rmse"]) for group, value in row["groups"].items()
        }
    return found


def table(out: Path) -> str:
    """One line for each decision."""
    lines = [
        f"{'overruled':24} {'usable':>7} {'inside':>9} {'CPU':>6} {'median':>7} {'largest':>8}  "
        "where; NanoBench"
    ]
    plain = errors(out / AUTOMATIC)
    for name in OVERRULED:
        folder = out / name.replace(" ", "_")
        if not (folder / "rows.json").exists():
            continue
        rows = json.loads((folder / "rows.json").read_text(encoding="utf-8"))["rows"]
        z = [abs(v) for row in rows for v in row["z"].values()]
        ratio = {key: value / plain[key] for key, value in errors(folder).items() if key in plain}
        craft = {key: value for key, value in ratio.items() if key[0] != "nanobench"}
        worst = max(craft, key=lambda key: craft[key])
        real = ", ".join(
            f"{key[1]} {value:.2f}" for key, value in ratio.items() if key[0] == "nanobench"
        )
        lines.append(
            f"{name:24} {sum(r['code'] == USABLE for r in rows):2d} of {len(rows):2d} "
            f"{sum(v <= DEVIATIONS for v in z):3d} of {len(z):3d} "
            f"{np.median([r['seconds'] for r in rows]):4.0f} s "
            f"{np.median(list(craft.values())):7.2f} {craft[worst]:8.2f}  {worst[0]} {worst[1]}; "
            f"{real or 'no model'}"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Fit what is not there yet, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument(
        "--seeds", type=int, nargs=2, default=(1350, 1355), metavar=("FIRST", "LAST")
    )
    parser.add_argument("--only", nargs="+", choices=tuple(OVERRULED), default=tuple(OVERRULED))
    parser.add_argument("--table", action="store_true", help="print what is there")
    options = parser.parse_args(arguments)
    if not options.table:
        for name in options.only:
            run(name, options.out, range(options.seeds[0], options.seeds[1] + 1))
            print(f"{name}: done", flush=True)
    print(table(options.out))


if __name__ == "__main__":
    main()
