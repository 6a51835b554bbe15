"""What does plain `greybox fit` cost on flights that come along, from a cold start and with a filled
cache?

    python -m benchmarks.fit_time [--only crazyflie,nanobench,nine]

CPU seconds of a process of its own, of which its compilers; wall time means little on a busy
machine. Every row runs with an empty build cache, then with the one that this filled. Python's own
cache of its modules is warm.
"""

from __future__ import annotations

import argparse
import compileall
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

import greybox
from benchmarks.kept_rows import keep

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

CRAZYFLIE = ("arpl_crazyflie", ("log10", "log15"), ("log16",))
NANOBENCH = (
    "nanobench",
    ("B2_circle_medium_rep1", "B8_star_fast_rep2"),
    ("B7_oval_fast_rep1",),
)
NINE = (
    "nanobench",
    (
        "B2_circle_fast_rep1",
        "B2_circle_medium_rep1",
        "B2_circle_slow_rep1",
        "B3_figure8_fast_rep1",
        "B3_figure8_medium_rep2",
        "B3_figure8_slow_rep1",
        "B5_helix_fast_mell_rep1",
        "B5_helix_medium_rep2",
        "B8_star_fast_rep2",
    ),
    ("B7_oval_fast_rep1",),
)
ROWS = {"crazyflie": CRAZYFLIE, "nanobench": NANOBENCH, "nine": NINE}
"""Set of flights, those that are fitted, those that judge."""
CHILD = """
import json, os, sys
from greybox.cli import main
code = main(sys.argv[1:])
t = os.times()
print(json.dumps({"code": code, "cpu_s": t[0] + t[1] + t[2] + t[3], "compilers_s": t[2] + t[3]}))
"""


def measure(row: str, folder: Path) -> dict[str, object]:
    """One fit in a process of its own, with the build cache in `folder`."""
    name, train, test = ROWS[row]
    flights = folder / name
    greybox = [sys.executable, "-m", "greybox"]
    if not flights.exists():
        subprocess.run([*greybox, "examples", name, "--out", flights], check=True, text=True)
    environment: Mapping[str, str] = {**os.environ, "GREYBOX_CACHE": str(folder / "cache")}
    arguments = ["--vehicle", flights / "vehicle.toml"]
    for option, chosen in (("--train", train), ("--test", test)):
        arguments += [option, *(flights / f"{n}.csv.gz" for n in chosen)]
    done = subprocess.run(
        [sys.executable, "-c", CHILD, "fit", *map(str, arguments), "--out", str(folder / "fit")],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    found = json.loads(done.stdout.splitlines()[-1])
    return {"row": row, **{k: round(v, 2) for k, v in found.items()}}


def main() -> None:
    """Run the rows and record them."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", default=",".join(ROWS))
    rows = []
    chosen = parser.parse_args().only.split(",")
    compileall.compile_dir(Path(greybox.__file__).parent, quiet=1)
    for row in chosen:
        with tempfile.TemporaryDirectory() as folder:
            for cache in ("empty", "filled"):
                rows.append(measure(row, Path(folder)) | {"cache": cache})
                print(rows[-1], flush=True)
    keep("fit_time", rows)


if __name__ == "__main__":
    main()
