"""Subspace alone is biased under feedback where the closed-loop variants and PEM are not, if the
feedback matters.

One second-order plant with a coloured disturbance, static output feedback u = r - F y, white r of
standard deviation R, many records. All six settings of (F, R) that were tried are shown: without
feedback no method is biased; with mild feedback and much excitation the bias drowns in the scatter;
with strong feedback and weak excitation it stands out. Mean and standard error of the first three
samples of the impulse response per method; a method is biased where the mean error exceeds four
standard errors. Writes a figure with --figure.

    python -m scenarios.studies.linear_feedback_bias --runs 40 --figure
    docs/images/linear_feedback_bias.svg
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np

from greybox.linear.fit import Options, fit_linear
from greybox.linear.records import Record
from scenarios.plants.linear_systems import LinearTruth, simulate

TRUTH = LinearTruth(
    np.array([[0.9, 0.25], [-0.25, 0.85]]),
    np.array([[0.2], [1.0]]),
    np.array([[1.0, 0.3]]),
    np.array([[0.7], [0.4]]),
    np.array([[1.0]]),
)
SETTINGS = ((0.0, 1.0), (0.0, 0.3), (0.3, 1.0), (0.3, 0.3), (0.9, 1.0), (0.9, 0.3))
"""(feedback gain F, standard deviation R of the excitation): all that were tried."""
FEEDBACK, EXCITATION = SETTINGS[-1]
PAST = 12
METHODS = ("n4sid", "moesp", "cva", "ssarx", "pbsid")


def errors(
    runs: int,
    count: int,
    *,
    first: int = 0,
    feedback: float = FEEDBACK,
    excitation: float = EXCITATION,
) -> dict[str, np.ndarray]:
    """Error of the impulse response at lags 1-3 (runs, 3) per method; PEM starts from ssarx."""
    exact = [(TRUTH.c @ np.linalg.matrix_power(TRUTH.a, i) @ TRUTH.b).item() for i in range(3)]
    out: dict[str, list[np.ndarray]] = {m: [] for m in (*METHODS, "pem")}
    gain = np.array([[feedback]])
    for seed in range(first, first + runs):
        u, y = simulate(
            np.random.default_rng(seed), TRUTH, count, feedback=gain, excitation=excitation
        )
        record = Record(u=u, y=y)
        for name in out:
            methods = ("ssarx",) if name == "pem" else (name,)
            options = Options(methods=methods, polish=name == "pem", past=PAST)  # type: ignore[arg-type]
            m = fit_linear([record], 2, options=options).model.matrices
            found = [(m.c @ np.linalg.matrix_power(m.a, i) @ m.b).item() for i in range(3)]
            out[name].append(np.subtract(found, exact))
    return {k: np.array(v) for k, v in out.items()}


def scores(e: np.ndarray) -> np.ndarray:
    """Mean error in standard errors of the mean, per lag."""
    return np.asarray(e.mean(axis=0) / (e.std(axis=0, ddof=1) / np.sqrt(len(e))))


def main(argv: Sequence[str] | None = None) -> int:
    """Print mean error, its standard error and the verdict per method."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--count", type=int, default=3000)
    parser.add_argument("--figure", default=None)
    arguments = parser.parse_args(argv)
    tables = {}
    print(
        "mean error of the impulse response at lags 1, 2, 3, and the same in standard errors of "
        "the mean"
    )
    for feedback, excitation in SETTINGS:
        print(f"feedback {feedback:g}, excitation {excitation:g}")
        table = errors(arguments.runs, arguments.count, feedback=feedback, excitation=excitation)
        tables[feedback, excitation] = table
        for name, e in table.items():
            score = scores(e)
            verdict = "biased" if np.abs(score).max() > 4 else "no bias seen"
            means = "  ".join(f"{m:+.4f}" for m in e.mean(axis=0))
            print(
                f"  {name:7}  {means}   "
                + "  ".join(f"{s:+7.1f}" for s in score)
                + f"   {verdict}",
                flush=True,
            )
    if arguments.figure:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(9, 4.6))
        for place, ((feedback, excitation), table) in enumerate(tables.items()):
            axes = figure.add_subplot(2, 3, 1 + 3 * (place % 2) + place // 2)
            axes.boxplot(
                [e[:, 0] for e in table.values()], tick_labels=list(table), showfliers=False
            )
            axes.axhline(0.0, color="grey", linewidth=0.8)
            axes.set_title(f"feedback {feedback:g}, excitation {excitation:g}", fontsize=9)
            axes.tick_params(labelsize=7)
        figure.supylabel("error of the first impulse-response sample", fontsize=9)
        figure.tight_layout()
        figure.savefig(arguments.figure)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
