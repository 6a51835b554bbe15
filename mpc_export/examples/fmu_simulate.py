"""Simulate the FMU with fmpy and compare with f. Needs this bundle, casadi, numpy, fmpy and a C
compiler.

python examples/fmu_simulate.py [--json]
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

import fmpy
import numpy as np

BUNDLE = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(BUNDLE / "python"))

from consumers.exported import load  # noqa: E402

SECONDS, STEPS = 0.2, 400


def main() -> None:
    """A fifth of a second with the reference commands, by fmpy's CVode and by Runge-Kutta steps of
    f."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="print numbers for a program")
    arguments = parser.parse_args()
    model = load(BUNDLE, ("f", "h"))
    own = model.states[: model.own_states]
    outputs = [f"y.{name}" for name in model.outputs]
    with tempfile.TemporaryDirectory() as folder:
        fmu = str(fmpy.extract(str(BUNDLE / "fmu" / f"{model.name}.fmu"), unzipdir=folder))
        if fmpy.platform_tuple not in fmpy.supported_platforms(
            fmu
        ) and fmpy.platform not in fmpy.supported_platforms(fmu):
            from fmpy.build import build_platform_binary

            build_platform_binary(fmu)
        found = fmpy.simulate_fmu(
            fmu,
            stop_time=SECONDS,
            output_interval=SECONDS,
            relative_tolerance=1e-9,
            output=[*own, *outputs],
        )
    names, last = found.dtype.names, found[-1]
    got = np.array([last[names.index(n)] for n in own])
    x, u, p, dt = (
        model.reference_state[: len(own)],
        model.reference_inputs,
        model.parameter_values,
        SECONDS / STEPS,
    )
    for _ in range(STEPS):
        k1 = model["f"](x, u, p).full().ravel()
        k2 = model["f"](x + dt / 2 * k1, u, p).full().ravel()
        k3 = model["f"](x + dt / 2 * k2, u, p).full().ravel()
        x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + model["f"](x + dt * k3, u, p).full().ravel())
    seen = model["h"](model.with_history(got, u), u, p).full().ravel()
    states = float(
        (
            np.abs(got - x)
            / np.where(model.state_scale[: len(own)] > 0, model.state_scale[: len(own)], 1)
        ).max()
    )
    outside = float(np.abs(np.array([last[names.index(n)] for n in outputs]) - seen).max())
    if arguments.json:
        print(json.dumps({"states": states, "outputs": outside}))
    else:
        print(
            f"after {SECONDS} s: states differ by {states:.1e} of their size, outputs by "
            f"{outside:.1e}"
        )


if __name__ == "__main__":
    main()
