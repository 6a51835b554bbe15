"""Fuzz of the tube MPC in stretches that add up: one row per seed, kept in a file.

    python -m tests.mpc_export.tube.fuzz_rows plans --seeds 300 309     # 25 000 plans of the compiled solver a seed
    python -m tests.mpc_export.tube.fuzz_rows float --seeds 300 309     # the same in single precision
    python -m tests.mpc_export.tube.fuzz_rows samples --seeds 300 309   # 3000 samples of a pilot a seed
    python -m tests.mpc_export.tube.fuzz_rows                           # the sums, by version of the solver

A seed that has a row of today's version is left out, so that the same command goes on where it was
stopped. Exit code 1 where anything was outside its limits, not finite, raised or not back.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import mpc_export.tube
from greybox.files import write_atomic
from mpc_export.c_code import FAST_FLAGS
from scenarios.studies.rows import read_rows
from tests.mpc_export.tube.test_controller_flies_and_survives import pilot
from tests.mpc_export.tube.test_no_measurement_moves_a_command_out_of_its_limits import (
    in_float,
    program,
)
from tests.mpc_export.tube.wild import fuzzed

ROWS = Path("scenarios/results/tube_fuzz.jsonl")
STEPS = {"plans": 25_000, "float": 25_000, "samples": 3000}
FILES = {"plans": "*.c", "float": "*.c", "samples": "*.[cp]*"}
PROGRAMS = {"plans": program, "float": in_float}
BROKEN = ("outside", "not_finite", "changed", "raised", "lost")
"""What must be 0: steps beyond limits, not finite, refused but written to, that raised; stretches
that a pilot who knows the true state brings home and this one does not."""


def version(what: str) -> str:
    """Of the solver's C for plans, of the whole controller for samples."""
    files = sorted(Path(mpc_export.tube.__file__).parent.glob(FILES[what]))
    return hashlib.sha256(b"".join(f.read_bytes() for f in files)).hexdigest()[:12]


def plans(command: Sequence[str], steps: int, seed: int) -> dict[str, int]:
    """Counts of fuzz.c. Raises `CalledProcessError` where it does not end by itself."""
    done = subprocess.run(
        [*command, str(steps), str(seed)], capture_output=True, text=True, check=False
    )
    if done.returncode not in (0, 1):
        raise subprocess.CalledProcessError(done.returncode, command, done.stdout, done.stderr)
    *kinds, _, back = (line.split() for line in done.stdout.splitlines())
    names = ("steps", "solved", "cut", "refused", "outside", "not_finite", "changed")
    sums = {name: sum(int(row[1 + i]) for row in kinds) for i, name in enumerate(names)}
    return sums | {"back": int(back[1]), "rests": int(back[3])}


def samples(steps: int, seed: int) -> dict[str, int]:
    """Counts of a flight of a pilot."""
    tally = fuzzed(pilot(), steps, seed)
    whole = {k: getattr(tally, k) for k in ("outside", "back", "rests", "home", "lost")}
    return {"steps": tally.steps.total(), "raised": len(tally.raised)} | whole


def summed(rows: Sequence[Mapping[str, str | int]]) -> tuple[list[str], bool]:
    """(a line per kind and version, whether nothing was broken)."""
    lines, sound = [], True
    for what, of in sorted({(str(r["what"]), str(r["version"])) for r in rows}):
        total: Counter[str] = Counter()
        those = [r for r in rows if (r["what"], r["version"]) == (what, of)]
        for row in those:
            total.update({k: v for k, v in row.items() if isinstance(v, int) and k != "seed"})
        today = " (today's)" if of == version(what) else ""
        lines.append(
            f"{what}, version {of}{today}, {len(those)} seeds: "
            + ", ".join(f"{k} {v}" for k, v in total.items())
        )
        sound &= not any(total[k] for k in BROKEN) and total["back"] == total["rests"]
    return lines, sound


def main(argv: Sequence[str] | None = None) -> int:
    """Add rows, or sum them up."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", nargs="?", choices=sorted(STEPS))
    parser.add_argument("--seeds", nargs=2, type=int, metavar=("FIRST", "LAST"))
    parser.add_argument("--rows", type=Path, default=ROWS)
    arguments = parser.parse_args(argv)
    if (arguments.what is None) != (arguments.seeds is None):
        parser.error("say what is fuzzed and with which seeds, or neither")
    rows = read_rows(arguments.rows)
    if arguments.what:
        what, of = arguments.what, version(arguments.what)
        done = {r["seed"] for r in rows if (r["what"], r["version"]) == (what, of)}
        with tempfile.TemporaryDirectory() as folder:
            command = PROGRAMS[what](Path(folder), FAST_FLAGS) if what in PROGRAMS else []
            for seed in range(arguments.seeds[0], arguments.seeds[1] + 1):
                if seed not in done:
                    found = (
                        plans(command, STEPS[what], seed) if command else samples(STEPS[what], seed)
                    )
                    rows.append({"what": what, "version": of, "seed": seed} | found)
                    write_atomic(
                        arguments.rows, "".join(json.dumps(r) + "\n" for r in rows).encode()
                    )
                    print(json.dumps(rows[-1]), flush=True)
    lines, sound = summed(rows)
    print("\n".join(lines))
    return 0 if sound else 1


if __name__ == "__main__":
    raise SystemExit(main())
