"""Is the truth recovered? Order and interval coverage on random linear systems, open and closed
loop, coloured noise.

For orders 1-8, one or two inputs and outputs, 20 dB, N = 3000: the order is chosen by BIC among 1
.. n + 4; a run counts for the order where the oracle likelihood ratio of n over n - 1 (both fitted
also from the truth) exceeds 40. At the true order the 95 % intervals of poles (real and imaginary
part) and of the frequency response (ln |G| and phase at five frequencies) and of the steady gain
are compared with the truth.

    python -m scenarios.studies.linear_recovery --repeats 4 --out recovery.json
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from greybox.linear.fit import fit_linear
from greybox.linear.order import choose_order
from greybox.linear.parametrisation import Free
from greybox.linear.pem import minimise
from greybox.linear.records import Record, prepare
from greybox.linear.search import Options
from greybox.model.matrices import Matrices, truncated
from scenarios.plants.linear_systems import (
    LinearTruth,
    random_system,
    simulate,
    stabilising_feedback,
)

Z95 = 1.959963984540054
FREQUENCIES = np.array([0.01, 0.05, 0.12, 0.25, 0.4])
"""Cycles per sample."""


def one_run(
    seed: int, n: int, size: int, closed: bool, *, count: int = 3000, order: bool = True
) -> dict[str, Any]:
    """One system, one record: chosen order, oracle likelihood ratio, and the coverage hits at the
    true order."""
    rng = np.random.default_rng([seed, n, size, int(closed)])
    truth = random_system(rng, n, size, size)
    feedback = stabilising_feedback(rng, truth) if closed else None
    u, y = simulate(rng, truth, count, feedback=feedback)
    record = Record(u=u, y=y)
    started = time.perf_counter()
    fit = fit_linear([record], n, options=Options(exact_order=True))
    row: dict[str, Any] = {
        "seed": seed,
        "n": n,
        "size": size,
        "closed": closed,
        "converged": fit.converged,
        "seconds_fit": time.perf_counter() - started,
    }
    row |= coverage(fit.uncertainty, truth)
    if order:
        scaled, scaling = prepare([record])
        options = Options()
        started = time.perf_counter()
        choice = choose_order(scaled, n + 4, options)
        row["seconds_order"] = time.perf_counter() - started
        row["chosen"] = choice.order
        values = {k: f.solution.evaluation.criterion for k, f in choice.found.items()}
        matrices = Matrices(truth.a, truth.b, truth.c, np.zeros((size, size)), truth.k)
        start = matrices.scaled(scaling.input_scale, scaling.output_scale)
        at = minimise(Free(system=start, feedthrough=False), scaled)
        oracle = min(at.evaluation.criterion, values.get(n, np.inf))
        row["worse_than_oracle"] = values.get(n, np.inf) - oracle
        if n > 1:
            cut = truncated(at.system, n - 1)
            cut = cut._replace(d=np.zeros_like(cut.d))
            below = minimise(Free(system=cut, feedthrough=False), scaled).evaluation.criterion
            row["ratio"] = min(below, values.get(n - 1, np.inf)) - oracle
        else:
            # order 0: nothing but white noise around a mean
            y1 = scaled[0].y - scaled[0].y.mean(axis=0)
            zero = count * (
                np.linalg.slogdet(y1.T @ y1 / count)[1] + size * (1 + np.log(2 * np.pi))
            )
            row["ratio"] = float(zero) - oracle
        row["ratio_above"] = oracle - values.get(n + 1, np.nan)
    return row


def coverage(known: Any, truth: LinearTruth) -> dict[str, list[bool]]:
    """Hits of the 95 % intervals, by kind of quantity; all poles are paired with the true ones at
    the least total distance.

    `poles` are all of them, `sure_poles` those that the fit calls well determined.
    """
    poles, hits, sure_hits = known.poles(), [], []
    exact = np.linalg.eigvals(truth.a)
    pairs = linear_sum_assignment(np.abs(poles.value[:, None] - exact[None]))
    sure = known.well_determined()
    for i, j in zip(*pairs):
        value, cov, error = poles.value[i], poles.covariance[i], poles.value[i] - exact[j]
        if value.imag < 0:
            continue
        here = [bool(abs(error.real) <= Z95 * np.sqrt(cov[0, 0]))]
        if value.imag > 0:
            here.append(bool(abs(error.imag) <= Z95 * np.sqrt(cov[1, 1])))
        hits += here
        sure_hits += here if sure[i] else []
    n = len(truth.a)
    bode = known.bode(FREQUENCIES, 1.0)
    response = np.array(
        [
            truth.c @ np.linalg.solve(np.exp(2j * np.pi * f) * np.eye(n) - truth.a, truth.b)
            for f in FREQUENCIES
        ]
    )
    gain = np.abs(np.log(bode["magnitude"] / np.abs(response))) <= Z95 * bode["log_magnitude_std"]
    turn = np.angle(np.exp(1j * (bode["phase"] - np.angle(response))))
    phase = np.abs(turn) <= Z95 * bode["phase_std"]
    steady, cov0 = known.response(np.zeros(1), 1.0)
    at_zero = truth.c @ np.linalg.solve(np.eye(n) - truth.a, truth.b)
    dc = np.abs(steady[0].real - at_zero) <= Z95 * np.sqrt(cov0[0, :, :, 0, 0])
    return {
        "poles": hits,
        "sure_poles": sure_hits,
        "ln_gain": [bool(v) for v in gain.ravel()],
        "phase": [bool(v) for v in phase.ravel()],
        "steady_gain": [bool(v) for v in dc.ravel()],
    }


def summary(rows: Sequence[dict[str, Any]]) -> str:
    """The figures in words; the standard error of a coverage treats runs, not intervals, as
    independent."""
    lines = []
    pooled: list[float] = []
    everything: list[bool] = []
    for kind in ("poles", "ln_gain", "phase", "steady_gain"):
        hits = [h for r in rows for h in r[kind]]
        lines.append(f"coverage {kind}: {100 * np.mean(hits):.2f} % of {len(hits)} intervals")
        everything += hits
    sure = [h for r in rows for h in r["sure_poles"]]
    lines.append(
        f"coverage of well determined poles: {100 * np.mean(sure):.2f} % of {len(sure)} intervals"
    )
    for r in rows:
        own = [h for kind in ("poles", "ln_gain", "phase", "steady_gain") for h in r[kind]]
        pooled.append(float(np.mean(own)))
    error = 100 * np.std(pooled, ddof=1) / np.sqrt(len(pooled)) if len(pooled) > 1 else float("nan")
    lines.append(
        f"coverage pooled: {100 * np.mean(everything):.2f} % of {len(everything)} intervals in "
        f"{len(rows)} runs (run-to-run standard error {error:.2f} %)"
    )
    judged = [r for r in rows if r.get("ratio", -np.inf) > 40]
    if judged:
        right = [r["chosen"] == r["n"] for r in judged]
        under = sum(r["chosen"] < r["n"] for r in judged)
        over = sum(r["chosen"] > r["n"] for r in judged)
        lines.append(
            f"order right: {100 * np.mean(right):.1f} % of {len(judged)} runs with oracle ratio > "
            f"40 ({under} too low, {over} too high); "
            f"{len([r for r in rows if 'ratio' in r]) - len(judged)} runs below 40"
        )
        lines.append(
            "order search above the oracle by > 1 at the true order: "
            f"{sum(r['worse_than_oracle'] > 1 for r in judged)}"
        )
    lines.append(f"converged: {sum(r['converged'] for r in rows)} of {len(rows)}")
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study and print its summary; with --out write every run as JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=4, help="runs per order, size and loop")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--orders", default="1,2,3,4,5,6,7,8")
    parser.add_argument("--no-order", action="store_true", help="coverage only")
    parser.add_argument("--out", default=None)
    arguments = parser.parse_args(argv)
    rows = []
    for seed in range(arguments.first, arguments.first + arguments.repeats):
        for n in (int(v) for v in arguments.orders.split(",")):
            for size in (1, 2):
                for closed in (False, True):
                    rows.append(one_run(seed, n, size, closed, order=not arguments.no_order))
        print(f"after seed {seed}:\n{summary(rows)}", flush=True)
        if arguments.out:
            with open(arguments.out, "w", encoding="utf-8") as stream:
                json.dump(rows, stream, default=float)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
