"""How many times slower are the peers, all in one table, and did any ratio fall since it was last
written down?

Runs the benchmarks that need no other environment, each in a process of its own and at its smallest
size, and takes from each the time of a peer over ours, both measured in the same run. Other work on
the machine then hardly counts; the width of its vector unit does, of which ours makes more use, so
that the kind of machine stands beside the table. About six minutes. `--compare` writes nothing and
ends with 1 where a ratio fell by more than 30 %; the table of another kind of machine is no
measure.

    python -m benchmarks.ratios [--only export_speed,innovation_fit] [--compare]
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

COMMITTED = Path(__file__).resolve().parent / "results" / "ratios.json"
FALL = 0.3
"""Share by which a ratio may be lower than the committed one: repeats of a run differ by about a
tenth."""

Ratios = dict[str, float]


def export_speed(found: Mapping[str, Any]) -> Ratios:
    """Exported C of a Gaussian process with 100 support points."""
    us = found["microseconds"]
    simd = {
        w: min(v for k, v in us.items() if k.startswith("simd") and k.endswith(w))
        for w in ("jac", "all")
    }
    return {
        "hand-written SIMD, mean and Jacobian": simd["jac"] / us["ours jac"],
        "hand-written SIMD, with variance": simd["all"] / us["ours all"],
        "CasADi's derivatives as C, with variance": us["casadi AD, plain C all"] / us["ours all"],
        "GPyTorch, mean and Jacobian": us["gpytorch jac"] / us["ours jac"],
    }


def gp_evaluation(found: Mapping[str, Any]) -> Ratios:
    """A Gaussian process inside a CasADi optimiser."""
    rows = [r for r in found["rows"] if r["vm_ad"] is not None and not r["shared_kernel"]]
    return {
        f"CasADi's derivatives in its VM, {r['points']} points, {r['quantities']}": r["vm_ad"]
        / r["vm"]
        for r in rows
    }


def gpytorch_export(found: Mapping[str, Any]) -> Ratios:
    """A model that was trained in GPyTorch, as C."""
    us = found["microseconds"]
    return {"GPyTorch with autograd": us["GPyTorch, autograd"] / us["from_gpytorch, C"]}


def innovation_fit(found: Mapping[str, Any]) -> Ratios:
    """A fit of 13 parameters in innovation form."""
    return {
        f"{r['who']}, solution": r["ratio_solve"]
        for r in found["rows"]
        if r["who"].startswith("scipy")
    }


BENCHMARKS: dict[str, tuple[Callable[[Mapping[str, Any]], Ratios], tuple[str, ...]]] = {
    "export_speed": (export_speed, ()),
    "gp_evaluation": (gp_evaluation, ()),
    "gpytorch_export": (gpytorch_export, ()),
    "innovation_fit": (innovation_fit, ("--only", "scipy", "--runs", "3")),
}
"""Benchmark -> (what to take from its file, its options)."""


def measured(name: str) -> Ratios:
    """Run one benchmark. Raises `subprocess.CalledProcessError` where it fails."""
    taken, options = BENCHMARKS[name]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.json"
        command = [sys.executable, "-m", f"benchmarks.{name}", *options, "--out", str(out)]
        subprocess.run(
            command,
            check=True,
            stdout=subprocess.DEVNULL,
            cwd=Path(__file__).resolve().parent.parent,
        )
        return {k: round(v, 3) for k, v in taken(json.loads(out.read_text())).items()}


WIDTHS = {"avx512f": "AVX-512", "avx2": "AVX2", "avx": "AVX", "sse2": "SSE2"} | {
    "sve": "SVE",
    "asimd": "NEON",
}
"""Flags of Linux for vector units, the widest of a family first."""


def processor() -> str:
    """The kind of machine: what Linux calls it, and its widest vector unit. One name may stand for
    machines with different units."""
    info = Path("/proc/cpuinfo")
    return kind_of(info.read_text() if info.exists() else "")


def kind_of(cpuinfo: str) -> str:
    """The same out of the text of /proc/cpuinfo; the bare architecture where it says nothing."""
    said: dict[str, str] = {}
    for line in cpuinfo.splitlines():
        key, _, value = line.partition(":")
        said.setdefault(key.strip(), value.strip())
    flags = (said.get("flags") or said.get("Features") or "").split()
    widest = next((name for flag, name in WIDTHS.items() if flag in flags), "")
    return ", ".join(filter(None, (said.get("model name") or platform.machine(), widest)))


def fallen(now: Mapping[str, Ratios], before: Mapping[str, Ratios]) -> list[str]:
    """A line for every ratio of `before` that is lower by more than `FALL` in the benchmarks of
    `now`, or gone."""
    return [
        f"{name}: {what}: {ratio:g} -> {now[name].get(what, 'gone')}"
        for name in now
        for what, ratio in before.get(name, {}).items()
        if now[name].get(what, 0.0) < (1 - FALL) * ratio
    ]


def main(argv: list[str] | None = None) -> int:
    """Print the table; write it, or compare with the one that was written. Returns 1 where a ratio
    fell."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", default=",".join(BENCHMARKS), metavar="a,b")
    parser.add_argument(
        "--compare",
        action="store_true",
        help="write nothing; 1 where a ratio fell by more than 30 %%",
    )
    arguments = parser.parse_args(argv)
    before: dict[str, Any] = (
        json.loads(COMMITTED.read_text()) if COMMITTED.exists() else {"ratios": {}}
    )
    kind = before.get("machine", {}).get("processor", processor())
    if arguments.compare and kind != processor():
        print(
            f"nothing to compare: the table is of another kind of machine ({kind})", file=sys.stderr
        )
        return 0
    now: dict[str, Ratios] = {}
    chosen = arguments.only.split(",")
    if unknown := [n for n in chosen if n not in BENCHMARKS]:
        parser.error(f"--only {','.join(unknown)}: expected some of {', '.join(BENCHMARKS)}")
    for name in chosen:
        now[name] = measured(name)
        for what, ratio in now[name].items():
            print(f"{name:16} {what:62} {ratio:9.2f} x", flush=True)
    lines = fallen(now, before["ratios"])
    for line in lines:
        print(f"fell by more than {FALL:.0%}: {line}", file=sys.stderr)
    if arguments.compare:
        return 1 if lines else 0
    text = {
        "date": datetime.date.today().isoformat(),
        "machine": {
            "processor": processor(),
            "cores": os.cpu_count(),
            "python": platform.python_version(),
        },
        "ratios": {**before["ratios"], **now},
    }
    COMMITTED.write_text(json.dumps(text, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
