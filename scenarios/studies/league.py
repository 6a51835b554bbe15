"""League table: greybox and its peers name what is hidden in the same logs.

    python -m scenarios.studies.league --rows scenarios/results/naming_13*.jsonl.gz --out DIR
    python -m scenarios.studies.league --summary scenarios/results/league_1257.jsonl.gz

Rows of `scenarios.foreign.naming` say what greybox named; their logs are flown again by cell and
seed into DIR/logs, where they are not there, and given to the peers, a row each in
DIR/league.jsonl. What is there is not repeated; without --rows those of DIR/rows.jsonl.

Peers get what a competent user would give them: discrepancies from the nominal model of the vehicle
file along the flights, and a library whose terms are those of the catalogue (`league_terms`). The
file's numbers are fitted first, within the errors it states, and stay free beside every term; rows
are made white (gusts last). A name counts as in `scenarios.foreign.verdicts`.

    greybox    the plain command
    SINDy      sequentially thresholded least squares (Brunton et al. 2016; pysindy); threshold and
               ridge by the test flight, the fewest effects within one standard error
    E-SINDy    20 bootstraps of it (Fasel et al. 2022): effects in more than 60 % of them
    split F    forward selection on the first training flight, F tests on the second at 5 %
               over all that were chosen (the idea of LISDD)
    Operon     genetic programming (Burlacu et al. 2020; pyoperon) of an equation in the terms; the
               shortest of its Pareto front within one standard error on the test flight. It says an
               equation: the effects whose terms stand in it count as its names
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
import re
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from scipy.stats import f as f_distribution

from greybox.model.vehicle import read_vehicle
from scenarios.foreign.campaign import share
from scenarios.foreign.naming import read_rows, retired
from scenarios.foreign.naming_cells import REAL, case_of, described, write
from scenarios.foreign.naming_summary import FALSE, kind_of, shows
from scenarios.foreign.verdicts import Said, judge, judge_outside
from scenarios.studies.league_terms import Array, Regression, read_columns, regression

THRESHOLDS = (0.02, 0.03, 0.05, 0.07, 0.1, 0.14, 0.2, 0.3, 0.4)
"""Of a coefficient, in units of the discrepancy's standard deviation."""
RIDGES = (1e-3, 10.0, 100.0)
"""Of a sum of squares over all rows: columns that are alike share their coefficient."""
MODELS = 20
INCLUDED = 0.6
LEVEL = 0.05
BLOCKS = 10
LOOKS, LARGEST = 3, 0.7
"""How often the file's numbers are fitted, and the share by which they may be off."""
POPULATION, EVALUATIONS, LENGTH = 500, 50_000, 40


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """White rows without what the core explains: y (N,), columns (N, P), effect of every column;
    for each training flight (`parts`), all of them (`train`) and the test flight."""

    parts: list[tuple[Array, Array]]
    train: tuple[Array, Array]
    test: tuple[Array, Array]
    owner: list[str]


@dataclass(frozen=True, kw_only=True, eq=False)
class Whitening:
    """Of every channel: how much of a row the next one keeps (Cochrane and Orcutt 1949; gusts
    last), and the scale of what is left."""

    keep: Array
    scale: Array

    @classmethod
    def of(cls, train: Sequence[Regression]) -> tuple[Whitening, dict[str, float]]:
        """What the whole library leaves in the training flights; twice, as the weights change. Also
        what the file's numbers are off by."""
        channels = train[0].y.shape[1]
        found = cls(keep=np.zeros(channels), scale=np.ones(channels))
        for _ in range(2):
            y, x, c = _joined([found.rows(r, prior=k == 0) for k, r in enumerate(train)])
            fit = np.linalg.lstsq(np.concatenate([x, c], axis=1), y, rcond=None)[0]
            some, core = fit[: x.shape[1]], fit[x.shape[1] :]
            left = [r.y - stacked(r) @ some - r.core @ core for r in train]
            keep = sum((e[1:] * e[:-1]).sum(0) for e in left)
            keep = np.clip(keep / np.maximum(sum((e * e).sum(0) for e in left), 1e-30), 0.0, 0.98)
            white = np.concatenate([e[1:] - keep * e[:-1] for e in left])
            found = cls(keep=keep, scale=np.maximum(white.std(axis=0), 1e-9))
        off = {n: value + more for (n, (value, _)), more in zip(train[0].known.items(), core)}
        return found, off

    def rows(self, r: Regression, prior: bool) -> tuple[Array, Array, Array]:
        """White y (N,), columns (N, P), core (N, K); with the prior of the core as rows if asked
        for."""

        def white(a: Array) -> Array:
            k, s = (v.reshape(-1, *(1,) * (a.ndim - 2)) for v in (self.keep, self.scale))
            return np.asarray((a[1:] - k * a[:-1]) / s)

        x, c = (white(a) for a in (stacked(r), r.core))
        y, x, c = white(r.y).reshape(-1), x.reshape(-1, x.shape[-1]), c.reshape(-1, c.shape[-1])
        if prior:
            off, doubt = np.array(list(r.known.values())).T
            y = np.append(y, -off / doubt)
            x = np.concatenate([x, np.zeros((len(doubt), x.shape[1]))])
            c = np.concatenate([c, np.diag(1.0 / doubt)])
        return y, x, c


def stacked(r: Regression) -> Array:
    """All terms of a flight (n, channels, P)."""
    return np.concatenate(list(r.terms.values()), axis=-1)


def problem(folder: Path) -> Problem:
    """The logs of a folder as one regression, around what a first one makes of the file's numbers:
    what is late or turned is so of the craft, and no more of what the file says."""
    vehicle = read_vehicle(folder / "vehicle.toml")
    columns = [
        [read_columns(path) for path in sorted(folder.glob(f"{kind}*.csv"))]
        for kind in ("train", "test")
    ]
    off: dict[str, float] = {}
    for _ in range(LOOKS):
        train = [regression(vehicle, c, off) for c in columns[0]]
        whiten, found = Whitening.of(train)
        at, off = off, {n: float(np.clip(v, -LARGEST, LARGEST)) for n, v in found.items()}
    test = [regression(vehicle, c, at) for c in columns[1]]
    owner = [n for n, term in train[0].terms.items() for _ in range(term.shape[-1])]
    parts = [whiten.rows(r, prior=True) for r in train]
    whole = _joined([whiten.rows(r, prior=k == 0) for k, r in enumerate(train)])
    core = _explained(whole)
    size = np.sqrt(np.mean((whole[1] - whole[2] @ core[:, 1:]) ** 2, axis=0))
    kept = size > 1e-6 * np.sqrt(np.mean(whole[1] ** 2, axis=0))
    height = float(np.std(whole[0] - whole[2] @ core[:, 0]))

    def clean(part: tuple[Array, Array, Array], core: Array) -> tuple[Array, Array]:
        y, x, c = part
        columns = (x - c @ core[:, 1:])[:, kept] / size[kept]
        return (y - c @ core[:, 0]) / height, columns

    return Problem(
        parts=[clean(p, _explained(p)) for p in parts],
        train=clean(whole, core),
        test=clean(_joined([whiten.rows(r, prior=False) for r in test]), core),
        owner=[n for n, k in zip(owner, kept) if k],
    )


def _joined(parts: Sequence[tuple[Array, Array, Array]]) -> tuple[Array, Array, Array]:
    y, x, c = (np.concatenate(a) for a in zip(*parts))
    return y, x, c


def _explained(part: tuple[Array, Array, Array]) -> Array:
    """What of the core is in y and in every column (K, 1 + P)."""
    y, x, c = part
    both = np.concatenate([y[:, None], x], axis=1)
    return np.asarray(np.linalg.lstsq(c, both, rcond=None)[0])


def _optimizer(threshold: float, ridge: float) -> Any:
    import pysindy

    return pysindy.STLSQ(threshold=threshold, alpha=ridge, max_iter=20)


def _fitted(p: Problem, threshold: float, ridge: float) -> Array:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Sparsity parameter is too big")
        found = _optimizer(threshold, ridge).fit(p.train[1], p.train[0][:, None]).coef_
    return np.asarray(found).ravel()


def sparsest(left: Sequence[Array], sizes: Sequence[int]) -> int:
    """Which of these models, by what each leaves of the test flight: the smallest whose squares are
    within one standard error of the best, told from BLOCKS stretches."""
    table = np.array([[b @ b / len(b) for b in np.array_split(e, BLOCKS)] for e in left])
    best = table[int(np.argmin(table.mean(axis=1)))]
    spread = (table - best).std(axis=1, ddof=1) / np.sqrt(BLOCKS)
    good = np.flatnonzero(table.mean(axis=1) <= best.mean() + spread)
    return min(map(int, good), key=lambda k: (sizes[k], table[k].mean()))


def chosen(p: Problem) -> tuple[float, float, Array]:
    """Threshold, ridge and coefficients by the test flight."""
    grid = [(t, r) for t in THRESHOLDS for r in RIDGES]
    fits = [_fitted(p, *pair) for pair in grid]
    left = [p.test[0] - p.test[1] @ found for found in fits]
    which = sparsest(left, [len(_owners(p, found)) for found in fits])
    return *grid[which], fits[which]


def _owners(p: Problem, found: Array) -> set[str]:
    return {n for n, v in zip(p.owner, found) if v != 0.0}


def sindy(p: Problem, seed: int) -> set[str]:
    """Effects with a coefficient that survives."""
    return _owners(p, chosen(p)[2])


def ensemble(p: Problem, seed: int) -> set[str]:
    """Effects with a coefficient in more than INCLUDED of the bootstraps."""
    import pysindy

    threshold, ridge, _ = chosen(p)
    optimizer = pysindy.EnsembleOptimizer(
        opt=_optimizer(threshold, ridge), bagging=True, n_models=MODELS
    )
    np.random.seed(seed)  # noqa: NPY002  pysindy draws from NumPy's global generator
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Sparsity parameter is too big")
        optimizer.fit(p.train[1], p.train[0][:, None])
    often = np.mean([np.ravel(c) != 0.0 for c in optimizer.coef_list], axis=0)
    return {n for n, v in zip(p.owner, often) if v > INCLUDED}


def operon(p: Problem, seed: int) -> set[str]:
    """Effects whose terms stand in the equation that the test flight chooses."""
    from pyoperon.sklearn import SymbolicRegressor

    model = SymbolicRegressor(
        allowed_symbols="add,mul,constant,variable",
        objectives=["mse", "length"],
        optimizer_iterations=3,
        population_size=POPULATION,
        max_evaluations=EVALUATIONS,
        max_length=LENGTH,
        random_state=seed,
    )
    model.fit(p.train[1], p.train[0])
    columns = dict(zip(model.variables_.values(), p.owner))
    front = model.pareto_front_
    left = [p.test[0] - model.evaluate_model(m["tree"], p.test[1]) for m in front]
    which = sparsest([p.test[0], *left], [0, *(m["length"] for m in front)])
    return {columns[v] for v in front[which - 1]["variables"]} if which else set()


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


PEERS: dict[str, Callable[[Problem, int], set[str]]] = {
    "SINDy": sindy,
    "E-SINDy": ensemble,
    "split F": split_f,
    "Operon": operon,
}


NEEDS = {"SINDy": "pysindy", "E-SINDy": "pysindy", "Operon": "pyoperon"}
"""Packages, of the extra judge; without its own a peer is left out."""


def present() -> list[str]:
    """Peers whose package is installed."""
    return [p for p in PEERS if p not in NEEDS or importlib.util.find_spec(NEEDS[p])]


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
    for peer in present():
        began = time.process_time()
        found = said(PEERS[peer](here, truth["seed"]))
        if truth["cell"].startswith("outside"):
            verdict = judge_outside(found, truth["axes"], truth["family"], true)
        else:
            verdict = judge(found, truth["hidden"], true)
        took = prepared + time.process_time() - began
        rows.append(
            {"peer": peer, "judged": verdict, "named": _named(found.effects, found.sets)}
            | {"seconds": round(took, 2)}
        )
    return rows


def _named(effects: Iterable[str], sets: Iterable[Iterable[Iterable[str]]]) -> list[str]:
    """Names, and sets as one word each."""
    return [*effects, *("|".join(sorted("+".join(sorted(c)) for c in s)) for s in sets)]


def _same(one: object, other: object) -> bool:
    """Whether two drawn things are the same but for the last digit, in which processors differ."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(_same(v, other[k]) for k, v in one.items())
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(_same, one, other))
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=1e-12)
    return one == other


def flown(row: dict[str, Any], folder: Path) -> Path:
    """The folder of a judged row's log, flown again where it is not there. Raises ValueError where
    the row's cell and seed draw another log today."""
    case = case_of(row["asked"], row["seed"])
    drawn = json.loads(json.dumps(described(case)))
    if other := sorted(k for k, v in drawn.items() if k in row and not _same(row[k], v)):
        raise ValueError(f"{row['asked']} {row['seed']}: drawn otherwise today: {', '.join(other)}")
    if not (folder / "truth.json").exists():
        write(case, folder, seconds=row["length"])
    return folder


def league(row: dict[str, Any], folder: Path) -> list[dict[str, Any]]:
    """Rows of greybox, as it was judged, and of its peers."""
    same = {k: row.get(k) for k in ("asked", "seed", "hidden", "power")}
    sets = [[c.split("+") for c in some] for some in row.get("sets", ())]
    own = {"peer": "greybox", "judged": row["judged"], "named": _named(row.get("names", ()), sets)}
    own["seconds"] = row["seconds"]
    return [same | r for r in (own, *compared(flown(row, folder)))]


def _false(row: dict[str, Any]) -> bool:
    return row["judged"] in FALSE


def _good(row: dict[str, Any]) -> bool:
    return row["judged"] in ("right", "set")


LINES: tuple[tuple[str, tuple[str, ...], bool, Callable[[dict[str, Any]], bool]], ...] = (
    ("clean: a false name", ("clean",), False, _false),
    ("one effect: named", ("single",), True, _good),
    ("two to five: all named", ("pair", "five"), True, _good),
    ("wind: named", ("wind",), False, lambda r: "steady_wind" in r["named"]),
    ("IMU alone: named", ("imu",), True, _good),
    ("these four: a false name", ("single", "pair", "five", "wind", "imu"), False, _false),
    ("outside: a false name", ("outside",), False, _false),
)
"""What is counted: title, sets, whether only where the oracle sees what hides, what counts. Named
means alone or in a set, with nothing false beside it; a wind may have false names beside it."""


def short(part: int, whole: int) -> str:
    """A share with its exact 95 % interval, for narrow columns."""
    told = re.search(r", ([\d.]+) to ([\d.]+)\)", share(part, whole))
    return f"{part}/{whole}<br>{told[1]}-{told[2]} %" if told else "-"


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Markdown, one column per method: shares with exact 95 % intervals, CPU time."""
    peers = list(dict.fromkeys(r["peer"] for r in rows))
    out = [f"| | {' | '.join(peers)} |", "|---" * (1 + len(peers)) + "|"]
    for title, kinds, seen, counts in LINES:
        cells = []
        for peer in peers:
            own = [r for r in rows if r["peer"] == peer and kind_of(r) in kinds]
            own = [r for r in own if shows(r) or not seen]
            cells.append(short(sum(map(counts, own)), len(own)))
        out.append(f"| {title} | {' | '.join(cells)} |")
    spent = [median(r["seconds"] for r in rows if r["peer"] == peer) for peer in peers]
    return "\n".join([*out, f"| CPU [s], median | {' | '.join(f'{s:.1f}' for s in spent)} |"])


def main(argv: Sequence[str] | None = None) -> int:
    """Compare on the logs of judged rows, or print the table of rows that are kept."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows", type=Path, nargs="+", help="judged rows, DIR/rows.jsonl if none")
    parser.add_argument("--out", type=Path, default=Path("league"), help="folder")
    parser.add_argument("--summary", type=Path, nargs="+", help="only the table of these files")
    options = parser.parse_args(argv)
    spent = retired()
    if options.summary:
        kept = read_rows(options.summary)
        print(table([r for r in kept if (r["asked"], r["seed"]) not in spent]))
        return 0
    for package in dict.fromkeys(NEEDS[p] for p in PEERS if p not in present()):
        print(f"without {package}, which comes with: pip install greybox-sysid[judge]")
    path = options.out / "league.jsonl"
    rows = read_rows([path])
    done = {(r["asked"], r["seed"]) for r in rows} | spent
    for row in read_rows(options.rows or [options.out / "rows.jsonl"]):
        if (row["asked"], row["seed"]) in done:
            continue
        name = f"{row['asked'].replace(':', '_')}_{row['seed']}"
        found = league(row, options.out / "logs" / name)
        rows += found
        options.out.mkdir(parents=True, exist_ok=True)
        with path.open("a", encoding="utf-8") as stream:
            stream.write("".join(json.dumps(r) + "\n" for r in found))
        told = (f"{r['peer']} {r['judged']}: {', '.join(r['named']) or '-'}" for r in found)
        print(f"{name}: " + "; ".join(told), flush=True)
    print(table(rows))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
