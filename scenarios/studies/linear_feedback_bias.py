"""Subspace alone is biased under feedback where the closed-loop variants and PEM are not.

One second-order plant with a coloured disturbance under strong output feedback and weak excitation, many records: mean and
standard error of the pole error and of the steady gain error per method. A method is biased where the mean error exceeds
four standard errors. Writes a figure with --figure.

    python -m scenarios.studies.linear_feedback_bias --runs 40 --figure feedback_bias.svg
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np

from greybox.estimation.linear.fit import Options, fit_linear
from greybox.estimation.linear.records import Record
from scenarios.plants.linear_systems import LinearTruth, simulate

TRUTH = LinearTruth(
    np.array([[0.9, 0.25], [-0.25, 0.85]]),
    np.array([[0.2], [1.0]]),
    np.array([[1.0, 0.3]]),
    np.array([[0.7], [0.4]]),
    np.array([[1.0]]),
)
FEEDBACK = np.array([[0.9]])
EXCITATION = 0.3
PAST = 12
METHODS = ("n4sid", "moesp", "cva", "ssarx", "pbsid")


def errors(runs: int, count: int, *, first: int = 0) -> dict[str, np.ndarray]:
    """Error of the impulse response at lags 1-3 (runs, 3) per method; PEM starts from ssarx."""
    exact = [(TRUTH.c @ np.linalg.matrix_power(TRUTH.a, i) @ TRUTH.b).item() for i in range(3)]
    out: dict[str, list[np.ndarray]] = {m: [] for m in (*METHODS, "pem")}
    for seed in range(first, first + runs):
        u, y = simulate(np.random.default_rng(seed), TRUTH, count, feedback=FEEDBACK, excitation=EXCITATION)
        record = Record(u=u, y=y)
        for name in out:
            methods = ("ssarx",) if name == "pem" else (name,)
            options = Options(methods=methods, polish=name == "pem", past=PAST)  # type: ignore[arg-type]
            m = fit_linear([record], 2, options=options).model.matrices
            found = [(m.c @ np.linalg.matrix_power(m.a, i) @ m.b).item() for i in range(3)]
            out[name].append(np.subtract(found, exact))
    return {k: np.array(v) for k, v in out.items()}


def main(argv: Sequence[str] | None = None) -> int:
    """Print mean error, its standard error and the verdict per method."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--count", type=int, default=3000)
    parser.add_argument("--figure", default=None)
    arguments = parser.parse_args(argv)
    table = errors(arguments.runs, arguments.count)
    print("method   mean error of impulse response at lags 1, 2, 3, in standard errors of the mean")
    for name, e in table.items():
        score = e.mean(axis=0) / (e.std(axis=0, ddof=1) / np.sqrt(len(e)))
        verdict = "biased" if np.abs(score).max() > 4 else "no bias seen"
        means = "  ".join(f"{m:+.4f}" for m in e.mean(axis=0))
        print(f"{name:7}  {means}   " + "  ".join(f"{s:+7.1f}" for s in score) + f"   {verdict}")
    if arguments.figure:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(6, 3))
        axes = figure.add_subplot()
        axes.boxplot([e[:, 0] for e in table.values()], tick_labels=list(table))
        axes.axhline(0.0, color="grey", linewidth=0.8)
        axes.set_ylabel("error of the first impulse-response sample")
        figure.tight_layout()
        figure.savefig(arguments.figure)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
