"""Do standard errors of linear fits say how much estimates scatter? Fisher and robust ones, with
and without model error.

Three cases of one second-order plant, many records: an output error model under a disturbance of
pole 0.95, an innovation model of order 2 where the disturbance has two more states, and the right
model. Printed per quantity (real part of a pole; real response at 0, 0.05 and 0.2 cycles per
sample): scatter over the median standard error (1 is honest), and how many 95 % intervals hold the
median estimate, which is what a wrong model estimates.

    python -m scenarios.studies.linear_errors --runs 120
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np
from scipy.signal import lfilter

from greybox.linear.fit import LinearFit, Options, Settings, fit_linear
from greybox.linear.records import Record
from greybox.linear.uncertainty import Uncertainty
from greybox.symbolic import FloatArray

NUMERATOR, DENOMINATOR = (0.0, 0.5, 0.3), (1.0, -1.2, 0.5)
FREQUENCIES = np.array([0.0, 0.05, 0.2])
CASES = {
    "output error, disturbance of pole 0.95": (
        (1.0, -0.95),
        0.5,
        Options(noise_model=False, settings=Settings(stable=True)),
    ),
    "order 2, disturbance of two more states": ((1.0, -1.8, 0.9), 0.1, Options()),
    "the right model": (DENOMINATOR, 1.0, Options()),
}
"""Name: poles' polynomial and size of the disturbance, and what is fitted."""


def one_fit(seed: int, case: str, count: int) -> LinearFit:
    """A fit of order 2 to one record of the case."""
    polynomial, size, options = CASES[case]
    rng = np.random.default_rng(seed)
    u = lfilter([1.0], [1.0, -0.8], rng.standard_normal((count, 1)), axis=0)
    v = size * lfilter([1.0], polynomial, rng.standard_normal(count + 500))[500:]
    return fit_linear(
        [Record(u=u, y=lfilter(NUMERATOR, DENOMINATOR, u[:, 0]) + v)], 2, options=options
    )


def quantities(known: Uncertainty) -> tuple[FloatArray, FloatArray]:
    """Values and standard errors (4,)."""
    poles, (gain, cov) = known.poles(), known.response(FREQUENCIES, 1.0)
    value = np.array([poles.value[-1].real, *gain[:, 0, 0].real])
    return value, np.sqrt([poles.covariance[-1, 0, 0], *cov[:, 0, 0, 0, 0]])


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=120)
    parser.add_argument("--count", type=int, default=3000)
    arguments = parser.parse_args(argv)
    for case in CASES:
        fits = [one_fit(seed, case, arguments.count) for seed in range(arguments.runs)]
        chosen = sum(f.errors == "robust" for f in fits)
        print(f"{case}: robust errors chosen in {chosen} of {len(fits)} records")
        value = np.array([quantities(f.fisher)[0] for f in fits])
        for what, known in (
            ("Fisher", [f.fisher for f in fits]),
            ("chosen", [f.uncertainty for f in fits]),
        ):
            error = np.array([quantities(k)[1] for k in known])
            ratio = value.std(axis=0, ddof=1) / np.median(error, axis=0)
            hits = np.mean(np.abs(value - np.median(value, axis=0)) < 1.96 * error, axis=0)
            cells = "  ".join(f"{r:.2f} ({100 * h:.0f} %)" for r, h in zip(ratio, hits))
            print(f"  {what}: {cells}", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
