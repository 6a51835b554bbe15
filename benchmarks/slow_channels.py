"""What does a channel that comes at a tenth of the rate cost the default predictor?

Closed-loop flights of a nano quadrotor at 100 Hz, once with every position and once with positions
at 10 Hz, each flight with another phase. CPU time of one evaluation of the cost with gradient and
Hessian, and of a whole fit, starts and noise levels estimated; one BLAS thread. The extended Kalman
filter, which is exact in both, shows what is lost: nothing.

    python -m benchmarks.slow_channels [--flights 4] [--seconds 20] [--runs 5] [--kalman]
"""

from __future__ import annotations

import argparse
import os
import time

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import numpy as np  # noqa: E402 (after the thread counts)

EFFECTS = ("motor_lag", "command_delay", "rotor_drag", "rotational_damping")
SLOW = 10


def main(argv: list[str] | None = None) -> None:
    """Print one row per rate."""
    from greybox import build_model, fit
    from greybox.data import Dataset, dataset_from_arrays
    from greybox.estimation.criteria.gaussian import Gaussian
    from greybox.estimation.predictors.innovation import Innovation
    from greybox.estimation.predictors.kalman import Kalman
    from greybox.estimation.problem import make_problem
    from tests.simulated import flights, vehicle

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--flights", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument(
        "--kalman", action="store_true", help="likelihood of the extended Kalman filter beside it"
    )
    arguments = parser.parse_args(argv)

    def log(slow: bool) -> Dataset:
        whole: Dataset | None = None
        for i, flight in enumerate(flights(arguments.flights, arguments.seconds)):
            segment = flight.segments[0]
            one = {
                n: np.array(v) for n, v in segment.channels.items() if n not in ("vx", "vy", "vz")
            }
            for n in "xyz" if slow else "":
                one[n][(np.arange(segment.n) - 3 * i) % SLOW != 0] = np.nan
            single = dataset_from_arrays(segment.t, one, name=flight.name)
            whole = single if whole is None else whole + single
        assert whole is not None
        return whole

    print(
        f"{'positions at':14s} {'evaluation CPU s':>18s} {'fit CPU s':>12s} {'iterations':>12s} "
        f"{'log lik./sample':>18s}"
    )
    for slow in (False, True):
        data = log(slow)
        model = build_model(vehicle(), data.channels, EFFECTS)
        problem = make_problem(model, data, predictor=Innovation(), criterion=Gaussian())
        problem.evaluate(problem.start)
        best = []
        for _ in range(arguments.runs):
            begin = time.process_time()
            problem.evaluate(problem.start)
            best.append(time.process_time() - begin)
        begin = time.process_time()
        found = fit(model, data)
        cpu = time.process_time() - begin
        rate = "10 Hz" if slow else "100 Hz"
        row = f"{rate:14s} {min(best):18.4f} {cpu:12.2f} {found.status.iterations:12d}"
        print(row + f" {found.loglik / found.n_samples:18.4f}")
        if arguments.kalman:
            exact = make_problem(
                model,
                data,
                predictor=Kalman(),
                criterion=Gaussian(),
                estimate_noise=False,
                values={n: e.value for n, e in found.parameters.items()},
                noise={n: level for n, (level, _, _) in found.noise.items()},
            )
            score = -exact.evaluate(exact.start, 0).likelihood / found.n_samples
            print(f"{'  Kalman filter':58s} {score:18.4f}")


if __name__ == "__main__":
    main()
