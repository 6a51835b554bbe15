"""The paper's experiment, honestly: PEM, LSTM, GP and hybrids on a record per seed, beside the
paper's table and the floor.

    python -m scenarios.studies.paper_experiment --seeds 10 --out DIR

Every method predicts y(t) from measurements and commands up to t-1 (see paper_data). Results go to
DIR, one JSON file and one file of predictions per seed; a second call computes only what is
missing. Also run: the paper's literal form, whose inputs contain the answer (`LEAKS`), and the same
experiment without any noise, to see what error is reached there.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from greybox.files import read_json, write_json
from scenarios.studies.paper_data import SHORT, TEST, TRAIN, paper_data
from scenarios.studies.paper_figures import draw
from scenarios.studies.paper_methods import LEAKS, METHODS, Bench, Outcome, training_claim
from scenarios.studies.paper_scores import FLOOR, floor, qualities, scores, table, verdict

SCHEMA = "greybox.paper_experiment/1"


def run_seed(
    seed: int,
    folder: Path,
    methods: Mapping[str, Callable[[Bench], Outcome]],
    *,
    noise: bool = True,
    train: tuple[float, float] = TRAIN,
    budget: int = 4,
    again: Sequence[str] = (),
    claim: bool = False,
    say: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Results of one seed: what the folder already has, plus what is missing (or named in `again`),
    written back."""
    stem = f"seed{seed}" if noise else f"quiet{seed}"
    stem = stem if train == TRAIN else f"short{seed}"
    path, arrays = folder / f"{stem}.json", folder / f"{stem}.npz"
    result: dict[str, Any] = {
        "schema": SCHEMA,
        "seed": seed,
        "noise": noise,
        "budget": budget,
        "methods": {},
    }
    kept: dict[str, np.ndarray] = {}
    if path.exists():
        result = read_json(path, schema=SCHEMA)
        if arrays.exists():
            with np.load(arrays, allow_pickle=False) as file:
                kept = {name: file[name] for name in file.files}
    if claim and "claim" not in result:
        with threadpool_limits(limits=1):
            result["claim"] = training_claim(Bench(data=paper_data(seed, noise=noise), train=train))
        write_json(path, result)
    missing = [name for name in methods if name not in result["methods"] or name in again]
    if not missing:
        return result
    data = paper_data(seed, noise=noise)
    bench = Bench(data=data, budget=budget, train=train)
    result["methods"][FLOOR] = floor(data)
    for name in missing:
        with threadpool_limits(limits=1):
            outcome = methods[name](bench)
        found = scores(data, outcome)
        result["methods"][name] = found
        rows = data.rows(TEST)
        kept |= {f"{name}|mean": outcome.mean[rows], f"{name}|variance": outcome.variance[rows]}
        np.savez_compressed(arrays, **kept)  # type: ignore[arg-type]
        write_json(path, result)
        say(
            f"{stem}: {name:24s} to measurement {found['mse']:.3e}, to truth "
            f"{found['mse_truth']:.3e}"
        )
    return result


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what is missing, print the tables, draw the figures of the first seed."""
    parser = _parser()
    options = parser.parse_args(arguments)
    folder = Path(options.out)
    folder.mkdir(parents=True, exist_ok=True)
    known = {**METHODS, **LEAKS}
    chosen = [n.strip() for n in options.methods.split(",")] if options.methods else list(known)
    again = [n.strip() for n in options.again.split(",") if n.strip()]
    unknown = sorted((set(chosen) | set(again)) - set(known))
    if unknown:
        parser.error(f"no method {', '.join(unknown)}; there are {', '.join(known)}")
    picked = {n: known[n] for n in chosen}

    def say(text: str) -> None:
        print(text, flush=True)

    seeds = range(options.first, options.first + options.seeds)
    results = [
        run_seed(
            s, folder, picked, budget=options.budget, again=again, claim=options.claim, say=say
        )
        for s in seeds
    ]
    # A leak of y needs no second run without noise, and the floor there is zero.
    honest = {n: f for n, f in picked.items() if n in METHODS}
    quiet = [
        run_seed(s, folder, honest, noise=False, budget=options.budget, again=again, say=say)
        for s in list(seeds)[: options.quiet_seeds]
    ]
    short = [
        run_seed(s, folder, honest, train=SHORT, budget=options.budget, again=again, say=say)
        for s in list(seeds)[: options.short_seeds]
    ]
    _say_methods(results, short)
    print("\nNot methods: they see measurements of the instant that they predict\n")
    print(table(results, list(LEAKS)))
    print(f"\nWithout sensor and process noise, {len(quiet)} seed(s)\n")
    print(table(quiet, list(METHODS)))
    written = draw(folder, paper_data(options.first), _shown(folder, options.first))
    print(f"\nfigures: {', '.join(os.fspath(p) for p in written)}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--quiet-seeds", type=int, default=1, help="seeds of the run without noise")
    parser.add_argument(
        "--short-seeds",
        type=int,
        default=1,
        help="seeds of the run on a quarter of the training data",
    )
    parser.add_argument("--budget", type=int, default=4, help="candidates per method with choices")
    parser.add_argument(
        "--claim", action="store_true", help="time a GP on the outputs against one on the residual"
    )
    parser.add_argument("--methods", help="only these, separated by commas")
    parser.add_argument("--again", default="", help="compute these anew")
    parser.add_argument("--out", default="paper_experiment", metavar="DIR")
    return parser


def _say_methods(results: Sequence[Mapping[str, Any]], short: Sequence[Mapping[str, Any]]) -> None:
    """Scores, verdict, qualities and times of the methods."""
    hybrids = [n for n in METHODS if n.startswith("hybrid")]
    others = [n for n in METHODS if n not in hybrids]
    print(
        f"\nTest part, one step ahead, {len(results)} seeds; std: in units of the training "
        "variance\n"
    )
    print(table(results, list(METHODS)))
    print(f"\n{verdict(results, hybrids, others)}")
    print(
        f"\nQualities, {len(results)} seeds; data need: {len(short)} seed(s) trained on "
        f"{SHORT[0]:g} to {SHORT[1]:g} s\n"
    )
    print(qualities(results, short, list(METHODS)))
    for row in (r["claim"] for r in results if "claim" in r):
        print(
            f"\nThe same GP on the outputs {row['output']:.1f} s, on the residual "
            f"{row['residual']:.1f} s of CPU"
        )


def _shown(folder: Path, seed: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Method -> (mean, variance) of the test part, as kept for a seed."""
    with np.load(folder / f"seed{seed}.npz", allow_pickle=False) as file:
        return {
            n: (file[f"{n}|mean"], file[f"{n}|variance"])
            for n in METHODS
            if f"{n}|mean" in file.files
        }


if __name__ == "__main__":
    main()
