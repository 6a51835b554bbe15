"""Float builds run on an emulated Cortex-M4F: right, without double arithmetic, within a small
part's memory and time."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from benchmarks import cortex
from benchmarks.variational import derivative, rk4
from greybox.errors import ModelError
from greybox.model.parameter import nominal_values
from greybox.residual.hybrid import HybridModel
from mpc_export.bundle import write_bundle
from mpc_export.c_code import CSource, write_c
from mpc_export.c_kernels import GPKernel
from mpc_export.functions import model_functions
from tests.mpc_export import cases
from tests.mpc_export.test_c_code_gp import posterior
from tests.residual.hybrid_cases import craft, push

_missing = cortex.missing_tool()
pytestmark = pytest.mark.skipif(_missing is not None, reason=f"{_missing} is not installed")


def assert_close(
    run: cortex.CortexRun, function: Any, arguments: list[Any], tolerance: float
) -> None:
    """Every result to `tolerance` of its largest value, given arguments as they are after rounding
    to float."""
    rounded = [np.asarray(a, dtype=np.float32).astype(float) for a in arguments]
    for got, want in zip(run.results[function.name()], function.call(rounded)):
        expected = np.asarray(ca.densify(want)).ravel(order="F")
        assert np.abs(got - expected).max() <= tolerance * np.abs(expected).max()


def test_fifty_points_fit_a_small_part(tmp_path: Path) -> None:
    """Mean, Jacobian and variance of six outputs of ten inputs: 128 KiB of flash, 24 KiB of RAM,
    150 000 instructions."""
    gp = posterior(("se",) * 6, points=50, inputs=10)
    kernel = GPKernel(name="gp", posterior=gp, which=("mean", "variance", "mean_jacobian"))
    source = write_c([kernel.function()], tmp_path, prefix="m", kernels=[kernel], real="float")
    assert cortex.double_helpers(source, tmp_path) == []
    z = gp.input_mean + 0.8 * gp.support[3] * gp.input_scale
    run = cortex.run_on_cortex(source, {"gp": [z]}, tmp_path)
    assert_close(run, kernel.function(), [z], 1e-4)
    assert 40_000 < run.flash < 64 * 1024  # six factors alone are 35 KB
    assert 0 < run.stack < run.ram < 8 * 1024
    assert 20_000 < run.instructions["gp"] < 70_000


def test_a_hybrid_step_runs_with_its_jacobians(tmp_path: Path) -> None:
    model = HybridModel(inner=craft(), posterior=push(craft(), points=12))
    kernel = GPKernel(
        name="gp_mean_jac", posterior=model.posterior, which=("mean", "mean_jacobian")
    )
    step = rk4(derivative(model, learned=kernel.function()), 0.02)
    source = write_c([step], tmp_path, prefix="m", kernels=[kernel], real="float")
    assert cortex.double_helpers(source, tmp_path) == []
    chosen = nominal_values(model.parameters)
    x = model.reference({}) + 0.1 * np.random.default_rng(0).standard_normal(len(model.states))
    u = np.array([3.7 if n == "vbat" else 0.6 for n in model.inputs.names])
    arguments = [x, u, np.array([chosen[p.name] for p in model.parameters])]
    run = cortex.run_on_cortex(source, {"rk4": arguments}, tmp_path)
    assert_close(run, step, arguments, 1e-4)
    assert run.ram < 24 * 1024


@pytest.mark.slow
def test_a_sample_of_the_pilot_takes_a_tenth_of_a_millisecond(tmp_path: Path) -> None:
    """At one instruction per cycle of 168 MHz; the stabilizer of a Crazyflie calls every
    millisecond."""
    functions = model_functions(cases.disturbed(), with_=("pilot",))
    step = functions["pilot_step"]
    source = write_c([step], tmp_path, prefix="m", real="float")
    assert cortex.double_helpers(source, tmp_path) == []
    x, u = functions.pilot.x, functions.pilot.u
    y = functions["h"](x, u, []).full().ravel() + 0.01
    given = [
        x,
        u,
        np.zeros(0),
        y,
        np.ones(len(functions.innovations)),
        np.array([0.3, 0.0, 1.0, 0.5]),
    ]
    run = cortex.run_on_cortex(source, {"pilot_step": given}, tmp_path)
    assert 5_000 < run.instructions["pilot_step"] < 16_800
    assert run.ram < 8 * 1024
    assert_close(run, step, given, 1e-4)


@pytest.mark.slow
def test_the_whole_flight_layer_keeps_eight_kilobytes(tmp_path: Path) -> None:
    made = write_bundle(
        cases.disturbed(),
        tmp_path / "b",
        name="craft",
        targets=("crazyflie-app",),
        real="float",
        use_cache=False,
    )
    unit, out = tmp_path / "size.c", tmp_path / "size.o"
    unit.write_text(
        '#include "craft_flight.h"\nchar memory[sizeof(craft_flight)];\n', encoding="utf-8"
    )
    compiler = ["arm-none-eabi-gcc", *cortex.CPU_FLAGS, f"-I{made.folder / 'c'}", "-c"]
    subprocess.run([*compiler, unit, "-o", out], check=True)
    said = subprocess.run(["arm-none-eabi-nm", "-S", out], check=True, capture_output=True).stdout
    assert 7_000 < int(said.split()[1], 16) < 8_000


def small(folder: Path, real: Any = "float") -> tuple[CSource, Any]:
    x = ca.SX.sym("x", 3)
    f = ca.Function("f", [x], [ca.sin(x) / x, ca.atan2(x[0], x[1]) ** 3])
    return write_c([f, ca.Function("g", [x], [2 * x])], folder, prefix="m", real=real), f


def test_instructions_are_counted_one_by_one(tmp_path: Path) -> None:
    """The harness runs a loop of 2001 instructions itself; more work is more instructions; several
    functions, one image."""
    source, f = small(tmp_path)
    x = np.array([0.3, -0.2, 1.1])
    run = cortex.run_on_cortex(source, {"f": [x], "g": [x]}, tmp_path)
    assert 2001 <= run.loop <= 2006
    assert 5 < run.instructions["g"] < 100 < run.instructions["f"]
    assert_close(run, f, [x], 1e-5)
    np.testing.assert_array_equal(run.results["g"][0], 2 * x.astype(np.float32).astype(float))


def test_double_arithmetic_would_be_found(tmp_path: Path) -> None:
    source, _ = small(tmp_path)
    text = source.source.read_text()
    assert "sinf(" in text
    source.source.write_text(text.replace("sinf(", "sin("))
    assert "__aeabi_f2d" in cortex.double_helpers(source, tmp_path)


def test_what_cannot_run_is_refused(tmp_path: Path) -> None:
    source, _ = small(tmp_path)
    with pytest.raises(ModelError, match="no function"):
        cortex.run_on_cortex(source, {"h": []}, tmp_path)
    with pytest.raises(ModelError, match="sizes"):
        cortex.run_on_cortex(source, {"f": [np.zeros(2)]}, tmp_path)
    with pytest.raises(ModelError, match="float"):
        cortex.run_on_cortex(small(tmp_path, "double")[0], {"f": [np.zeros(3)]}, tmp_path)
