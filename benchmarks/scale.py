"""How do time and memory of a fit grow with the length of a log and with the number of flights?

    python -m benchmarks.scale [--minutes 1,4,15,60] [--flights 10,50,200] [--cap 1800]

`minutes`: one record at 1 kHz (a simulated flight of 20 s, repeated). `flights`: a fleet of 30 s
logs at 100 Hz. Each row is a process of its own: set-up and three evaluations of cost, gradient and
Hessian; a fit takes about a dozen. Wall and CPU seconds, largest resident memory, and both per
sample; the data themselves are in memory, too.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import numpy as np  # noqa: E402 (after the thread counts)

RESULTS = Path(__file__).resolve().parent / "results"
EVALUATIONS = 3


def flight(rate: float, seconds: float) -> dict[str, Any]:
    """One simulated flight."""
    from greybox.excitation.injection import rich_excitation
    from greybox.excitation.waypoints import RandomWaypoints
    from greybox.plants.flight_log import fly
    from greybox.plants.presets import controller_for
    from scenarios.studies.recovery import plant

    craft = plant()
    log = fly(
        craft,
        controller_for(craft),
        RandomWaypoints(),
        rich_excitation(),
        seconds,
        1 / rate,
        7,
        warm_up=1.0,
    )
    return {n: v for n, v in log.items() if not n.startswith("omega")}


def data(kind: str, size: int) -> Any:
    """`size` minutes at 1 kHz, or `size` flights of 30 s at 100 Hz."""
    from greybox.data import dataset_from_arrays

    if kind == "minutes":
        one = flight(1000.0, 20.0)
        n = len(one["t"]) * 3 * size
        return dataset_from_arrays(
            np.arange(n) * 1e-3, {k: np.tile(v, 3 * size) for k, v in one.items() if k != "t"}
        )
    one = flight(100.0, 30.0)
    rng = np.random.default_rng(0)
    out = None
    for k in range(size):
        columns = {n: v + 1e-4 * rng.standard_normal(v.shape) for n, v in one.items() if n != "t"}
        added = dataset_from_arrays(one["t"], columns, name=f"run{k:03d}")
        out = added if out is None else out + added
    return out


def measure(kind: str, size: int) -> dict[str, Any]:
    """One row, in this process."""
    from greybox.estimation.criteria.gaussian import Gaussian
    from greybox.estimation.predictors.innovation import Innovation
    from greybox.estimation.problem import make_problem
    from greybox.model.model import build_model
    from tests.simulated import vehicle

    flights = data(kind, size)
    model = build_model(vehicle(), flights.channels, ("motor_lag", "rotor_drag"))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    problem = make_problem(model, flights, predictor=Innovation(), criterion=Gaussian())
    theta = np.array([u.start for u in problem.unknowns])
    began, cpu = time.perf_counter(), time.process_time()
    for _ in range(EVALUATIONS):
        value = problem.evaluate(theta)
    samples = sum(r.n for r in problem.records)
    return {
        "kind": kind,
        "size": size,
        "samples": samples,
        "unknowns": problem.n,
        "valid": value.valid,
        "wall_s": (time.perf_counter() - began) / EVALUATIONS,
        "cpu_s": (time.process_time() - cpu) / EVALUATIONS,
        "data_mb": before / 1024,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "load": os.getloadavg()[0],
    }


def main() -> None:
    """Measure the rows, print them, write benchmarks/results/scale.json."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", default="1,4,15,60")
    parser.add_argument("--flights", default="10,50,200")
    parser.add_argument("--cap", type=float, default=1800.0, help="seconds that a row may take")
    parser.add_argument("--child", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        print(json.dumps(measure(options.child[0], int(options.child[1]))))
        return
    rows = []
    for kind in ("minutes", "flights"):
        for size in filter(None, getattr(options, kind).split(",")):
            command = [sys.executable, "-m", "benchmarks.scale", "--child", kind, size]
            try:
                done = subprocess.run(
                    command, capture_output=True, text=True, check=True, timeout=options.cap
                )
            except subprocess.TimeoutExpired:
                print(f"{kind} {size}: more than {options.cap:g} s")
                continue
            row = json.loads(done.stdout.splitlines()[-1])
            rows.append(row)
            print(
                f"{kind:8s}{row['size']:5d}{row['samples']:10d} samples {row['unknowns']:5d} "
                f"unknowns  evaluation {row['cpu_s']:7.2f} s CPU "
                f"({1e6 * row['cpu_s'] / row['samples']:.1f} us a sample), {row['wall_s']:.2f} s "
                f"wall, memory {row['peak_mb']:6.0f} MB, of which data {row['data_mb']:.0f}",
                flush=True,
            )
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "scale.json").write_text(
        json.dumps(
            {"python": platform.python_version(), "machine": platform.machine(), "rows": rows},
            indent=1,
        )
        + "\n"
    )


if __name__ == "__main__":
    main()
