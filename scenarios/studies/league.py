"""League table: greybox and its peers name what is hidden in the same logs.

    python -m scenarios.foreign.naming --cells clean single pair --seeds 1 12 --out DIR
    python -m scenarios.studies.league --logs DIR [--out league.jsonl]

Peers get what a competent user would give them: discrepancy accelerations from the nominal model of
the vehicle file along the flights, a smoothed derivative, and a library whose terms are those of
the catalogue (`league_terms`). A name counts as in `scenarios.foreign.verdicts`.

    greybox    the plain command, from DIR/rows.jsonl
    SINDy      sequentially thresholded least squares (Brunton et al. 2016; pysindy), the threshold
               by the error on the test flight, the sparsest within one standard error
    E-SINDy    20 bootstraps of it (Fasel et al. 2022): effects in more than 60 % of them
    split F    forward selection on the first training flight, F tests on the second at 5 %
               over all that were chosen (the idea of LISDD)
    PySR       symbolic regression of the residual (Cranmer 2023), where it is installed: it says
               equations, not names, so that only its held-out share is told
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import f as f_distribution

from greybox.model.vehicle import read_vehicle
from scenarios.foreign.campaign import share
from scenarios.foreign.naming import read_rows
from scenarios.foreign.naming_cells import REAL
from scenarios.foreign.verdicts import Said, judge, judge_outside
from scenarios.studies.league_terms import CORE, Array, Regression, read_columns, regression

THRESHOLDS = (0.02, 0.05, 0.1, 0.2, 0.4)
"""Of a coefficient, in units of the discrepancy's standard deviation."""
RIDGE = 1e-3
MODELS = 20
INCLUDED = 0.6
LEVEL = 0.05
BLOCKS = 10


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """Weighted rows without what the core explains: y (N,), columns (N, P), effect of every column;
    for each training flight (`parts`), all of them (`train`) and the test flight."""

    parts: list[tuple[Array, Array]]
    train: tuple[Array, Array]
    test: tuple[Array, Array]
    owner: list[str]


def problem(folder: Path) -> Problem:
    """The logs of a folder as one regression."""
    vehicle = read_vehicle(folder / "vehicle.toml")
    train = [regression(vehicle, read_columns(p)) for p in sorted(folder.glob("train*.csv"))]
    test = [regression(vehicle, read_columns(p)) for p in sorted(folder.glob("test*.csv"))]
    names = [n for n in train[0].terms if n != CORE]
    owner = [n for n in names for _ in range(train[0].terms[n].shape[-1])]

    def stacked(r: Regression, weight: Array) -> tuple[Array, Array, Array]:
        columns = np.concatenate([r.terms[n] for n in names], -1) * weight[:, None]
        core = r.terms[CORE] * weight[:, None]
        return (
            (r.y * weight).reshape(-1),
            columns.reshape(-1, columns.shape[-1]),
            core.reshape(-1, core.shape[-1]),
        )

    one = np.ones(6)
    y, x, c = (np.concatenate(a) for a in zip(*(stacked(r, one) for r in train)))
    full = np.concatenate([x, c], -1)
    left = (y - full @ np.linalg.lstsq(full, y, rcond=None)[0]).reshape(-1, 6)
    weight = 1.0 / np.maximum(left.std(axis=0), 1e-6)
    sets = [[stacked(r, weight) for r in rs] for rs in (train, test)]
    y, x, c = (np.concatenate(a) for a in zip(*sets[0]))
    core = np.linalg.lstsq(c, np.concatenate([y[:, None], x], -1), rcond=None)[0]
    size = np.sqrt(np.mean((x - c @ core[:, 1:]) ** 2, axis=0))
    kept = size > 1e-9 * np.max(size)
    size = np.where(kept, size, 1.0)
    height = float(np.std(y - c @ core[:, 0]))

    def clean(part: Sequence[tuple[Array, Array, Array]]) -> tuple[Array, Array]:
        y, x, c = (np.concatenate(a) for a in zip(*part))
        return (y - c @ core[:, 0]) / height, ((x - c @ core[:, 1:]) / size)[:, kept]

    return Problem(
        parts=[clean([s]) for s in sets[0]],
        train=clean(sets[0]),
        test=clean(sets[1]),
        owner=[n for n, k in zip(owner, kept) if k],
    )


def _optimizer(threshold: float) -> Any:
    import pysindy

    return pysindy.STLSQ(threshold=threshold, alpha=RIDGE, max_iter=20)


def chosen_threshold(p: Problem) -> float:
    """The largest threshold whose error on the test flight is within one standard error."""
    errors = []
    for threshold in THRESHOLDS:
        found = _optimizer(threshold).fit(p.train[1], p.train[0][:, None]).coef_.ravel()
        left = (p.test[0] - p.test[1] @ found) ** 2
        errors.append([float(b.mean()) for b in np.array_split(left, BLOCKS)])
    table = np.array(errors)
    best = int(np.argmin(table.mean(1)))
    spread = (table - table[best]).std(axis=1, ddof=1) / np.sqrt(BLOCKS)
    good = table.mean(1) <= table[best].mean() + spread
    return max(t for t, ok in zip(THRESHOLDS, good) if ok)


def sindy(p: Problem, seed: int) -> set[str]:
    """Effects with a coefficient that survives."""
    found = _optimizer(chosen_threshold(p)).fit(p.train[1], p.train[0][:, None]).coef_.ravel()
    return {n for n, v in zip(p.owner, found) if v != 0.0}


def ensemble(p: Problem, seed: int) -> set[str]:
    """Effects with a coefficient in more than INCLUDED of the bootstraps."""
    import pysindy

    optimizer = pysindy.EnsembleOptimizer(
        opt=_optimizer(chosen_threshold(p)), bagging=True, n_models=MODELS
    )
    np.random.seed(seed)  # noqa: NPY002  pysindy draws from NumPy's global generator
    optimizer.fit(p.train[1], p.train[0][:, None])
    often = np.mean([np.ravel(c) != 0.0 for c in optimizer.coef_list], axis=0)
    return {n for n, v in zip(p.owner, often) if v > INCLUDED}


def _squares(y: Array, x: Array) -> float:
    if x.shape[1] == 0:
        return float(y @ y)
    left = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
    return float(left @ left)


def _tail(y: Array, x: Array, without: Array) -> float:
    """p of the F test of x against x without some columns."""
    more, n = x.shape[1] - without.shape[1], len(y)
    small, large = _squares(y, x), _squares(y, without)
    ratio = (large - small) / more / (small / (n - x.shape[1]))
    return float(f_distribution.sf(ratio, more, n - x.shape[1]))


def split_f(p: Problem, seed: int) -> set[str]:
    """Chosen on the first training flight, tested on the others."""
    first, rest = p.parts[0], p.parts[1:] or p.parts
    owner = np.array(p.owner)
    names, chosen = list(dict.fromkeys(p.owner)), list[str]()
    while len(chosen) < len(names):
        base = first[1][:, np.isin(owner, chosen)]
        tails = {
            n: _tail(first[0], first[1][:, np.isin(owner, [*chosen, n])], base)
            for n in names
            if n not in chosen
        }
        best = min(tails, key=lambda n: tails[n])
        if tails[best] > LEVEL / len(names):
            break
        chosen.append(best)
    y, x = (np.concatenate([r[i] for r in rest]) for i in (0, 1))
    whole = x[:, np.isin(owner, chosen)]
    return {
        n
        for n in chosen
        if _tail(y, whole, x[:, np.isin(owner, [c for c in chosen if c != n])])
        < LEVEL / len(chosen)
    }


def pysr_share(p: Problem, seed: int) -> float:
    """Share of the discrepancy on the test flight that PySR's equation explains."""
    from pysr import PySRRegressor

    model = PySRRegressor(
        niterations=40,
        binary_operators=["+", "*"],
        random_state=seed,
        deterministic=True,
        parallelism="serial",
        verbosity=0,
    )
    model.fit(p.train[1], p.train[0])
    left = p.test[0] - model.predict(p.test[1])
    return 1.0 - float(left @ left) / float(p.test[0] @ p.test[0])


PEERS: dict[str, Callable[[Problem, int], set[str]]] = {
    "SINDy": sindy,
    "E-SINDy": ensemble,
    "split F": split_f,
}


def said(names: set[str]) -> Said:
    """Names of a peer; one that stands for several is a set."""
    sets = [[frozenset([m]) for m in n.split("|")] for n in sorted(names) if "|" in n]
    return Said(
        verdict="named" if names else "nothing_missing",
        effects={n: {} for n in sorted(names) if "|" not in n},
        sets=sets,
    )


def compared(folder: Path) -> list[dict[str, Any]]:
    """One row per peer for the logs of a folder."""
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    true = REAL if truth["sensors"] == "real" else ()
    began = time.process_time()
    rows = []
    here = problem(folder)
    prepared = time.process_time() - began
    for peer, name in PEERS.items():
        began = time.process_time()
        found = said(name(here, truth["seed"]))
        if truth["cell"].startswith("outside"):
            verdict = judge_outside(found, truth["axes"], truth["family"], true)
        else:
            verdict = judge(found, truth["hidden"], true)
        took = prepared + time.process_time() - began
        named = [*found.effects, *("|".join(sorted(n for c in s for n in c)) for s in found.sets)]
        rows.append(
            {"peer": peer, "judged": verdict, "named": named, "seconds": round(took, 2)}
            | {k: truth[k] for k in ("cell", "seed", "hidden")}
        )
    if importlib.util.find_spec("pysr") is not None:
        explained = pysr_share(here, truth["seed"])
        print(f"{folder.name}: PySR explains {explained:.3f} of the held-out discrepancy")
    return rows


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Markdown, one line per peer."""
    out = [
        "| method | clean: a false name | hidden: all named, alone or in a set | "
        "hidden: a false name | CPU [s] |",
        "|---|---|---|---|---|",
    ]
    for peer in dict.fromkeys(r["peer"] for r in rows):
        own = [r for r in rows if r["peer"] == peer]
        clean = [r for r in own if r["cell"] == "clean"]
        more = [r for r in own if r["hidden"]]
        false = [sum(r["judged"] in ("wrong", "extra") for r in some) for some in (clean, more)]
        good = sum(r["judged"] in ("right", "set") for r in more)
        spent = sorted(r["seconds"] for r in own)[len(own) // 2]
        out.append(
            f"| {peer} | {share(false[0], len(clean))} | {share(good, len(more))} | "
            f"{share(false[1], len(more))} | {spent:.0f} |"
        )
    return "\n".join(out)


def main(argv: Sequence[str] | None = None) -> int:
    """Compare on all logs of a folder of the judge of names."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--logs", type=Path, required=True, help="folder of scenarios.foreign.naming"
    )
    parser.add_argument("--out", type=Path, help="keep the rows here")
    options = parser.parse_args(argv)
    if importlib.util.find_spec("pysindy") is None:
        parser.error("pysindy is not installed; it comes with: pip install greybox-sysid[judge]")
    rows = [
        {k: r[k] for k in ("cell", "seed", "hidden", "judged", "seconds")} | {"peer": "greybox"}
        for r in read_rows([options.logs / "rows.jsonl"])
    ]
    judged = {(r["cell"], r["seed"]) for r in rows}
    for folder in sorted((options.logs / "logs").iterdir()):
        truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
        if judged and (truth["cell"], truth["seed"]) not in judged:
            continue  # every line of the table is of the same logs
        found = compared(folder)
        rows += found
        told = (f"{r['peer']} {r['judged']}: {', '.join(r['named']) or '-'}" for r in found)
        print(f"{folder.name}: " + "; ".join(told), flush=True)
    if options.out:
        text = "".join(json.dumps(row) + "\n" for row in rows)
        options.out.write_text(text, encoding="utf-8")
    print(table(rows))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
