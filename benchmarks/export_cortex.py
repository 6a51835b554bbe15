"""What does exported float C cost on a Cortex-M4F: flash, RAM, executed instructions (emulated;
never cycles)?

    python -m benchmarks.export_cortex

Six outputs of ten inputs, M = 50 and 100 support points: mean, Jacobian and variance, and the same
with the variance's Jacobian; and one RK4 step of a hybrid (17 states, M = 50) with its Jacobians,
which evaluates the process four times.
"""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from benchmarks.cortex import FLAGS, double_helpers, missing_tool, run_on_cortex
from benchmarks.gp_evaluation import INPUTS, OUTPUTS, posterior
from benchmarks.variational import derivative, rk4
from greybox.model.example import example_vehicle
from greybox.model.model import build_model
from greybox.model.parameter import nominal_values
from greybox.residual.features import feature_layout
from greybox.residual.hybrid import HybridModel
from greybox.symbolic import Layout
from mpc_export.c_code import write_c
from mpc_export.c_kernels import GPKernel

RESULTS = Path(__file__).resolve().parent / "results"
COLUMNS = ["p", "q", "r", "ax", "ay", "az", "qw", "qx", "qy", "qz", "x", "y", "z", "vx", "vy", "vz"]
MOMENTS = ("mean", "variance", "mean_jacobian")


def measured(label: str, function: Any, kernel: GPKernel, arguments: list[Any]) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source = write_c([function], folder, prefix="model", real="float", kernels=[kernel])
        found = run_on_cortex(source, {function.name(): arguments}, folder)
        helpers = double_helpers(source, folder)
    rounded = [np.asarray(a, dtype=np.float32).astype(float) for a in arguments]
    errors = []
    for got, want in zip(found.results[function.name()], function.call(rounded)):
        expected = np.asarray(ca.densify(want)).ravel(order="F")
        errors.append(float(np.abs(got - expected).max() / np.abs(expected).max()))
    row = {
        "what": label,
        "flash_bytes": found.flash,
        "ram_bytes": found.ram,
        "stack_bytes": found.stack,
        "instructions": found.instructions[function.name()],
        "double_helpers": helpers,
        "largest_relative_error": max(errors),
    }
    print(row, flush=True)
    return row


def main() -> None:
    missing = missing_tool()
    if missing:
        raise SystemExit(
            f"{missing} is needed (Debian: gcc-arm-none-eabi libnewlib-arm-none-eabi "
            "qemu-system-arm)"
        )
    z, rows = np.random.default_rng(1).standard_normal(INPUTS), []
    for points in (50, 100):
        gp = posterior(points, share=False)
        for label, which in (
            ("mean, Jacobian, variance", MOMENTS),
            ("and the variance's Jacobian", (*MOMENTS, "variance_jacobian")),
        ):
            kernel = GPKernel(name="gp", posterior=gp, which=which)
            rows.append(measured(f"M = {points}: {label}", kernel.function(), kernel, [z]))
    physics = build_model(
        example_vehicle(), COLUMNS, ["motor_lag", "rotor_drag", "rotational_damping"]
    )
    names = [*(f"body_velocity.{a}" for a in "xyz"), "p", "q", "r", "nu1", "nu2", "nu3", "nu4"]
    outputs = Layout([physics.noises.signals[i] for i in range(OUTPUTS)])
    learned = replace(
        posterior(50, share=False), inputs=feature_layout(physics, names), outputs=outputs
    )
    kernel = GPKernel(name="gp_mean_jac", posterior=learned, which=("mean", "mean_jacobian"))
    step = rk4(
        derivative(HybridModel(inner=physics, posterior=learned), learned=kernel.function()), 0.01
    )
    values = nominal_values(physics.parameters)
    x = np.asarray(physics.reference({})) + 0.1 * np.random.default_rng(2).standard_normal(
        len(physics.states)
    )
    arguments = [
        x,
        np.full(len(physics.inputs), 0.6),
        np.array([values[p.name] for p in physics.parameters]),
    ]
    rows.append(measured("M = 50: RK4 step of a hybrid with A and B", step, kernel, arguments))
    text = {
        "question": __doc__.splitlines()[0],
        "flags": " ".join(FLAGS),
        "emulator": "qemu mps2-an386",
        "rows": rows,
    }
    (RESULTS / "export_cortex.json").write_text(json.dumps(text, indent=1) + "\n")


if __name__ == "__main__":
    main()
