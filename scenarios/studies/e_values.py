"""Calibration of E: how often the e-value of a name that is not there reaches 20, and how evidence
grows with flights.

    python -m scenarios.studies.e_values --run null --seeds 1 40 --out e_values
    python -m scenarios.studies.e_values --run power --seeds 1 4 --out e_values
    python -m scenarios.studies.e_values --run depth --seeds 1 4 --out e_values
    python -m scenarios.studies.e_values --out e_values --figure docs/images/e_values.svg

The structure is fixed and nothing is searched, so that a row costs a few fits and there can be
many. A seed draws vehicle, gusts and the errors of its file; one short flight teaches and one
judges. `null`: nothing is hidden, and the name of a row is held against the model without it, which
is then the truth: P(E >= 20) must be at most .05. It is stated for every name and for the largest
of a seed, which is that of names that were chosen by their e-value and may exceed .05. `power`:
`HIDDEN` is there at a part of its size, and as many flights teach as judge. `depth`: how far the
optimum of a fit lies below a later step of it, in units of what the full step promised there, where
a fit that was stopped would have been charged `BEYOND` of them: a fit without a name, and one of
every cause, where `SLOW` hides. Commands can be run in pieces: DIR/e_values.jsonl keeps a row per
seed, name and number of flights, and what is there is not repeated. Seeds below 1000 are for
development. Intervals are exact (Clopper and Pearson 1934).
"""

from __future__ import annotations

import argparse
import functools
import io
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from greybox.data import Dataset
from greybox.data.lead import without_lead_in
from greybox.discovery.cause import offer
from greybox.discovery.certificate import certificates, splits
from greybox.discovery.evidence import Fitted, Flights, problem_of
from greybox.discovery.name import LOG10
from greybox.discovery.options import DiscoverOptions
from greybox.discovery.rules import EFFORT
from greybox.discovery.search import Rival
from greybox.estimation.initialisation import noise_start
from greybox.estimation.record import sample_time
from greybox.estimation.solvers.levenberg_marquardt import BEYOND, PACE, LevenbergMarquardt
from greybox.estimation.start import vector
from greybox.files import append_json_line, write_atomic
from greybox.plants.quadrotor import Quadrotor
from greybox.symbolic import FloatArray
from scenarios.foreign.campaign import share
from scenarios.studies.discovery_cells import (
    FRAMES,
    MAKERS,
    effect_of,
    flights,
    gusts,
    nominal,
    scaled,
)
from scenarios.studies.rows import read_rows

NAMES = (
    "rotational_damping",
    "rotor_drag",
    "constant_force",
    "center_of_mass_offset",
    "thrust_curve",
    "gyro_scale",
)
"""One of every stage and of one to three parameters."""
HIDDEN, PART = "rotor_drag", 0.25
"""What hides in a log of `power`, and the share of the size at which it matters in flight."""
COUNTS = (1, 2, 4, 8)
"""Flights that teach, and as many that judge."""
CRAFT = ("x250", "nano")
AIR = {False: "still air", True: "gusts"}
FALSE = 20.0
SLOW = "motor_lag"
"""What hides in a log of `depth`: fits next to a lag that is missing take most steps."""
DEEP = 200
"""Iterations of a fit whose optimum is sought."""
Row = dict[str, Any]


def gusty(seed: int) -> bool:
    """Whether the flights of a seed are in gusts."""
    return seed // 2 % 2 == 1


def craft(seed: int, hidden: str | None) -> Quadrotor:
    """The plant of a seed, `HIDDEN` in it or nothing."""
    kind = CRAFT[seed % len(CRAFT)]
    effects = [] if hidden is None else [scaled(effect_of(hidden, FRAMES[kind]), PART)]
    calm = MAKERS[kind](effects)
    return MAKERS[kind](effects, process=gusts(calm)) if gusty(seed) else calm


def log_e(
    plant: Quadrotor, seed: int, train: Dataset, test: Dataset, names: Sequence[str]
) -> dict[str, float]:
    """Name -> log e-value against the model without it."""
    said = nominal(plant, "off", seed)
    causes = offer(said, train.channels, sample_time=sample_time(train))
    common = Flights(
        causes=causes, data=without_lead_in(train), options=DiscoverOptions().of_every_fit
    )
    judges = splits(common, without_lead_in(test))
    null = common.fit(causes.base)
    out = {}
    for name in names:
        at: Fitted = common.fit(causes.base | {name}, [null.known])
        rival = Rival(instead=(), fitted=null)
        out[name] = certificates(at, {name: [rival]}, judges, math.inf)[name].log_e
    return out


def rows_of(what: str, seed: int, seconds: float, done: set[tuple[Any, ...]]) -> Iterator[Row]:
    """What is not `done` yet of one seed."""
    hidden = HIDDEN if what == "power" else None
    names, counts = (NAMES, (1,)) if hidden is None else ((HIDDEN,), COUNTS)
    for count in counts:
        left = [n for n in names if (what, seed, count, n, seconds) not in done]
        if not left:
            continue
        plant = craft(seed, hidden)
        first = 1000 * seed
        train = flights(plant, range(first, first + count), seconds, "train")
        test = flights(plant, range(first + 500, first + 500 + count), seconds, "test")
        for name, value in log_e(plant, seed, train, test, left).items():
            yield {
                "what": what,
                "seed": seed,
                "flights": count,
                "name": name,
                "seconds": seconds,
                "log10_e": value / LOG10 if np.isfinite(value) else None,
            }


def depths_of(seed: int, seconds: float, done: set[tuple[Any, ...]]) -> Iterator[Row]:
    """Per structure that is not `done` yet: the depth of its optimum below every later step."""
    plant = craft(seed, SLOW)
    train = without_lead_in(flights(plant, [1000 * seed], seconds, "train"))
    causes = offer(nominal(plant, "off", seed), train.channels, sample_time=sample_time(train))
    options = DiscoverOptions().of_every_fit
    left = [n for n in ("", *causes.effects) if ("depth", seed, 1, n, seconds) not in done]
    null = (
        Flights(causes=causes, data=train, options=options).fit(causes.base) if any(left) else None
    )
    for name in left:
        problem = problem_of(causes, train, options, causes.base | ({name} if name else set()))
        start = vector(problem, null.known) if name and null is not None else noise_start(problem)
        costs, promises = np.full(DEEP + 1, np.nan), np.zeros(DEEP + 1)

        def kept(
            n: int,
            cost: float,
            promise: float,
            into: tuple[FloatArray, FloatArray] = (costs, promises),
        ) -> None:
            into[0][n], into[1][n] = cost, promise

        theta, status = LevenbergMarquardt(tolerance=1e-4, max_iterations=DEEP).solve(
            problem, start, kept
        )
        later = np.flatnonzero(promises >= EFFORT.exact)
        later = later[later > PACE]
        depth = (costs[later] - problem.evaluate(theta, 0).cost) / promises[later]
        yield {
            "what": "depth",
            "seed": seed,
            "flights": 1,
            "name": name,
            "seconds": seconds,
            "converged": status.converged,
            "depths": depth.tolist(),
        }


def depths(rows: Sequence[Row]) -> str:
    """Quantiles of the depths of optima, in promises of the full step."""
    mine = [r for r in rows if r["what"] == "depth" and r["converged"]]
    found = np.concatenate([np.zeros(0), *(r["depths"] for r in mine)])
    if not found.size:
        return "depth of optima: none measured"
    middle, most, nearly, deepest = np.quantile(found, [0.5, 0.95, 0.99, 1.0])
    return (
        f"depth of optima in promises, {found.size} later steps of {len(mine)} fits: half below "
        f"{middle:.2g}, 95 % below "
        f"{most:.2g}, 99 % below {nearly:.2g}, deepest {deepest:.2g}; charged {BEYOND:g}"
    )


def summary(rows: Sequence[Row]) -> str:
    """P(E >= 20) for every name, for all and for the largest of a seed; evidence by number of
    flights; depths."""
    null = [r for r in rows if r["what"] == "null"]
    bar = math.log10(FALSE)
    # An e-value that could not be worked out counts as nothing.
    big = [r for r in null if (r["log10_e"] or -math.inf) >= bar]
    out = [f"P(E >= {FALSE:g}) where nothing is missing"]
    for name in dict.fromkeys(r["name"] for r in null):
        mine = [r for r in null if r["name"] == name]
        out.append(f"  {name:24s} {share(sum(r in big for r in mine), len(mine))}")
    seeds = {r["seed"] for r in null}
    out.append(f"  {'all names':24s} {share(len(big), len(null))}")
    out.append(
        f"  {'the largest of a seed':24s} {share(len({r['seed'] for r in big}), len(seeds))}"
    )
    asked = [r for r in rows if r["what"] != "depth"]
    lost = sum(r["log10_e"] is None for r in asked)
    out.append(f"  no e-value (a fit did not end): {lost} of {len(asked)}")
    for gust, air in AIR.items():
        out.append(f"log10 E of {HIDDEN} at {PART:g} of its size, {air}")
        for count, values in grown(rows, gust).items():
            low, middle, high = np.percentile(values, [0, 50, 100])
            out.append(
                f"  {count} flights: {middle:.1f} ({low:.1f} to {high:.1f}, {len(values)} seeds)"
            )
    out.append(depths(rows))
    return "\n".join(out)


def said(row: Row) -> str:
    """One line about a row."""
    about = f"{row['what']} {row['seed']} {row['flights']} {row['name'] or 'no name'}"
    if row["what"] == "depth":
        return (
            f"{about}: {len(row['depths'])} later steps, deepest "
            f"{max(row['depths'], default=0.0):.2g} promises"
        )
    value = "none" if row["log10_e"] is None else f"{row['log10_e']:.2f}"
    return f"{about}: log10 E {value}"


def grown(rows: Sequence[Row], gust: bool) -> dict[int, list[float]]:
    """Number of flights -> log10 e-values of what hides, of the seeds in gusts or still air."""
    mine = [r for r in rows if r["what"] == "power" and gusty(r["seed"]) is gust]
    out: dict[int, list[float]] = {}
    for r in sorted(mine, key=lambda r: r["flights"]):
        if r["log10_e"] is not None:
            out.setdefault(r["flights"], []).append(r["log10_e"])
    return out


def drawn(rows: Sequence[Row]) -> str:
    """SVG: e-values where nothing is missing against their bound, and evidence against flights."""
    figure = Figure(figsize=(8.4, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    null = np.sort(
        [r["log10_e"] if r["log10_e"] is not None else -np.inf for r in rows if r["what"] == "null"]
    )
    if null.size:
        left.step(
            null[::-1],
            np.arange(1, null.size + 1) / null.size,
            where="post",
            color="tab:blue",
            label="measured",
        )
    bound = np.linspace(0.0, 2.0, 50)
    left.plot(bound, 10.0**-bound, color="0.2", linestyle=":", label="bound 1/E")
    left.set(yscale="log", xlim=(-6, 2.5), xlabel="log10 E", ylabel="share of E at least as large")
    left.set_title("nothing is missing", fontsize=9)
    left.legend(fontsize=8)
    for (gust, air), colour in zip(AIR.items(), ("tab:blue", "tab:orange"), strict=True):
        told = grown(rows, gust)
        if not told:
            continue
        for count, values in told.items():
            right.plot([count] * len(values), values, ".", color=colour, alpha=0.4)
        counts = np.array(list(told))
        middle = np.array([float(np.median(v)) for v in told.values()])
        right.plot(counts, middle, "o-", color=colour, label=f"median, {air}")
        right.plot(counts, middle[-1] * counts / counts[-1], ":", color=colour)
    right.axhline(math.log10(FALSE), color="tab:red", linewidth=0.8, label=f"E = {FALSE:g}")
    right.set_yscale("symlog", linthresh=1.0)
    right.set_xscale("log", base=2)
    right.set_xticks(COUNTS, [str(n) for n in COUNTS])
    right.set(xlabel="flights that teach, and that judge", ylabel="log10 E")
    right.set_title(f"{HIDDEN} at {PART:g} of its size", fontsize=9)
    right.legend(fontsize=8)
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()


def main(argv: Sequence[str] | None = None) -> None:
    """Run what is not there yet, print the summary, draw the figure where it is asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--run", nargs="+", choices=("null", "power", "depth"), default=[], help="none: sum up"
    )
    parser.add_argument("--seeds", type=int, nargs=2, default=(1, 2), metavar=("FIRST", "LAST"))
    parser.add_argument("--seconds", type=float, default=4.0, help="length of a flight")
    parser.add_argument("--out", type=Path, default=Path("e_values"), help="folder")
    parser.add_argument("--figure", type=Path, default=None, metavar="F.svg")
    options = parser.parse_args(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "e_values.jsonl"
    done = {(r["what"], r["seed"], r["flights"], r["name"], r["seconds"]) for r in read_rows(path)}
    for seed in range(options.seeds[0], options.seeds[1] + 1):
        for what in options.run:
            found = depths_of if what == "depth" else functools.partial(rows_of, what)
            for row in found(seed, options.seconds, done):
                append_json_line(path, row)
                print(said(row), flush=True)
    rows = read_rows(path)
    print(summary(rows))
    if options.figure is not None:
        write_atomic(options.figure, drawn(rows))


if __name__ == "__main__":
    main()
