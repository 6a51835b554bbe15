"""What does a cluster gain? The fits of one step of discover on a real local dask.distributed
cluster, against one process.

    python -m benchmarks.cluster [--workers 1,2] [--repeats 5] [--seconds 32]

Eight rivals of a hidden motor lag are fitted to two flights: in this process (whose likelihood uses
all cores), and on clusters whose workers stand for machines of one core each: bound to a core of
their own, and warm (their models are built). Printed are medians over repeats, the seconds that the
tasks take to be sent and answered, and what the cost model

    t(w) = ceil(fits / w) * t_fit + fits * t_send

expects of more workers, t_fit being the mean fit on a worker of the first cluster.
"""

from __future__ import annotations

import argparse
import math
import os
import pickle
import statistics
import time
import warnings
from collections.abc import Callable, Sequence
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

from greybox.discovery.cause import offer  # noqa: E402 (after the thread counts)
from greybox.discovery.evidence import Flights, Task, solved  # noqa: E402

RIVALS = (
    ("motor_lag",),
    ("command_delay",),
    ("motor_lag", "command_delay"),
    ("sensor_delay",),
    ("pose_delay",),
    ("rotor_drag",),
    ("parasitic_drag",),
    ("rotational_damping",),
)


def step(seconds: float) -> tuple[Flights, list[Task]]:
    """The rivals of one step."""
    from greybox.plants.effects import MotorLag
    from greybox.plants.presets import x250
    from scenarios.studies.discovery_cells import flights, vehicle_of

    data = flights(x250([MotorLag(tau=0.04)]), (1, 2), seconds, "train")
    there = Flights(causes=offer(vehicle_of(x250()), data.channels, sample_time=0.01), data=data)
    start = there.fit(()).known
    return there, [
        Task(structure=frozenset(r), starts=(start,), tolerance=1e-3, iterations=60) for r in RIVALS
    ]


def solve(task: Task, content: Any) -> Any:
    """One fit."""
    return solved(*content, task)


def nothing(_task: Any, _data: Any) -> int:
    """A task without work."""
    return 0


def bind(cores: dict[str, int], dask_worker: Any) -> None:
    """Keep a worker, its threads too, on one core."""
    core = cores[dask_worker.address]
    for thread in os.listdir("/proc/self/task"):
        os.sched_setaffinity(int(thread), {core})


def median(run: Callable[[], Any], repeats: int) -> float:
    """Seconds, the first run (which warms) left out."""
    run()
    took = []
    for _ in range(repeats):
        began = time.perf_counter()
        run()
        took.append(time.perf_counter() - began)
    return statistics.median(took)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="The fits of a step on a local dask cluster.")
    parser.add_argument("--workers", default="1,2")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=32.0)
    options = parser.parse_args(arguments)
    from distributed import Client, LocalCluster

    warnings.simplefilter("ignore")
    there, tasks = step(options.seconds)
    content = there.causes, there.data, there.options
    alone = median(lambda: [solve(t, content) for t in tasks], options.repeats)
    print(
        f"{len(tasks)} fits, {pickle.dumps((tasks[0], content)).__sizeof__() / 1e6:.1f} MB each to "
        "send"
    )
    print(f"one process, likelihood on all cores: {alone:.2f} s")
    per_fit = send = first = 0.0
    for workers in (int(w) for w in options.workers.split(",")):
        with (
            LocalCluster(
                n_workers=workers, threads_per_worker=1, dashboard_address=None, processes=True
            ) as cluster,
            Client(cluster) as client,
        ):
            pool = client.get_executor(pure=False)
            usable = sorted(os.sched_getaffinity(0))
            names = sorted(client.scheduler_info(n_workers=-1)["workers"])
            client.run(bind, {name: usable[i % len(usable)] for i, name in enumerate(names)})

            def spread(work: Callable[..., Any], pool: Any = pool) -> list[Any]:
                return [f.result() for f in [pool.submit(work, t, content) for t in tasks]]

            took = median(lambda: spread(solve), options.repeats)
            empty = median(lambda: spread(nothing), options.repeats)
        if not per_fit:
            per_fit, send = workers * took / len(tasks), empty / len(tasks)
            first = took
        expected = math.ceil(len(tasks) / workers) * (per_fit - send) + len(tasks) * send
        print(
            f"{workers} worker(s): {took:.2f} s, {first / took:.2f} times as fast as the first "
            f"cluster, {alone / took:.2f} times as one process, sending {empty:.3f} s; the cost "
            f"model expects {expected:.2f} s",
            flush=True,
        )
    for workers in (4, 8):
        expected = math.ceil(len(tasks) / workers) * (per_fit - send) + len(tasks) * send
        print(f"{workers} workers of this speed, by the cost model: {expected:.2f} s")


if __name__ == "__main__":
    main()
