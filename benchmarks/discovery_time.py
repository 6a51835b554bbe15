"""How long does the discovery take on two 32 s flights at 100 Hz, the whole catalogue, with and
without a filled cache?

    python -m benchmarks.discovery_time [--only clean,one,five] [--cold]

`clean` hides nothing, `one` a motor lag, `five` motor lag, battery sag, rotor drag, blade flapping
and rotational damping. Nominal inertia, thrust and torque are 15 % off. Every row runs in a process
of its own; `--cold` gives it an empty build cache (compilation included), otherwise a first run
fills the cache and the second one counts. Wall and CPU seconds of `discover` alone, compilers
included; the machine's load average is recorded, as wall time means little on a busy one.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from typing import Any

from benchmarks.kept_rows import keep

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

ROWS = {
    "clean": (),
    "one": ("motor_lag",),
    "five": ("motor_lag", "battery_sag", "rotor_drag", "blade_flapping", "rotational_damping"),
}


def measure(row: str) -> dict[str, Any]:
    """One search in this process."""
    from greybox.discovery.workflow import discover
    from scenarios.studies.discovery_cells import Cell, flown, nominal

    seed, plant, _, train, test = next(flown(Cell(hidden=ROWS[row], seconds=32.0), [4]))
    vehicle = nominal(plant, "off", seed)
    before, began = os.times(), time.perf_counter()
    found = discover(vehicle, train, test)
    wall, after = time.perf_counter() - began, os.times()
    return {
        "row": row,
        "hidden": list(ROWS[row]),
        "named": [e["name"] for e in found.effects()],
        "verdict": found.verdict,
        "wall_s": round(wall, 2),
        "cpu_s": round(sum(after[:4]) - sum(before[:4]), 2),
        "load": os.getloadavg()[0],
    }


def _child(row: str, cache: str) -> dict[str, Any]:
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.discovery_time", "--child", row],
        env={**os.environ, "GREYBOX_CACHE": cache},
        capture_output=True,
        text=True,
        check=True,
    )
    out: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return out


def main() -> None:
    """Run the rows and record them."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", default=",".join(ROWS))
    parser.add_argument("--cold", action="store_true")
    parser.add_argument("--child", default=None)
    options = parser.parse_args()
    if options.child:
        print(json.dumps(measure(options.child)))
        return
    rows = []
    for row in options.only.split(","):
        with tempfile.TemporaryDirectory() as cache:
            rows.append(_child(row, cache) | {"cache": "empty"})
            print(rows[-1], flush=True)
            if not options.cold:
                rows.append(_child(row, cache) | {"cache": "filled"})
                print(rows[-1], flush=True)
    keep("discovery_time", rows)


if __name__ == "__main__":
    main()
