"""What each fault does to a fit: the largest shift of an estimate, in standard errors of the fit to
the sound log.

python -m pytest -m slow tests/hardening/test_log_faults_in_the_estimates.py -s prints the column of
docs/hardening.md. Thrust, motor lag, drag and biases are fitted at 50 Hz; everything else stands as
the vehicle file says it, and the noise levels as the sound log has them. `greybox discover` refuses
what `check` blocks; `greybox fit` only says so.
"""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

import greybox as gb
from greybox.errors import GreyboxError
from greybox.estimation.fit import Fit, noise_of
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt
from greybox.examples import vehicle_path
from tests.hardening.log_faults import FAULTS, SET, flight
from tests.hardening.test_log_faults_are_found_or_survived import SURVIVED, WARNED

EFFECTS = ("motor_lag", "battery_sag", "rotor_drag", "accelerometer_bias", "gyro_bias")
FREE = (
    "thrust.c2",
    "motor_lag.tau",
    "rotor_drag.k_x",
    "rotor_drag.k_y",
    *(f"{sensor}_bias.b_{axis}" for sensor in ("accelerometer", "gyro") for axis in "xyz"),
)
HARMLESS = 0.5
"""Standard errors by which a fault that is called survived may move an estimate."""


def fitted(content: bytes, noise: Mapping[str, float] | None) -> Fit:
    """A fit of the flight in this file at 50 Hz; noise levels are estimated where none are
    given."""
    vehicle = gb.read_vehicle(vehicle_path(SET))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "flight.csv"
        path.write_bytes(content)
        data = gb.read_logs([path], vehicle, rate=50)
    model = gb.build_model(
        vehicle, data.channels, EFFECTS, sample_time=1 / 50, kinematic_noise=True
    )
    return gb.fit(
        model,
        data,
        free=FREE,
        values={"battery_sag.c_V": 1.0},
        noise=noise,
        estimate_noise=noise is None,
        initialisation="equation-error" if noise is None else "nominal",
        solver=LevenbergMarquardt(tolerance=1e-3, max_iterations=20),
    )


@functools.cache
def sound() -> tuple[Fit, Mapping[str, float]]:
    """The fit to the sound log, and the noise levels that it was held at."""
    noise = noise_of(fitted(flight().csv(), None).model)
    return fitted(flight().csv(), noise), noise


def shift(found: Fit) -> tuple[float, str]:
    """(largest shift in standard errors of the sound fit, of which parameter)."""
    worst = (0.0, "")
    for name, good in sound()[0].parameters.items():
        if good.std and np.isfinite(good.std) and name in found.parameters:
            worst = max(worst, (abs(found.parameters[name].value - good.value) / good.std, name))
    return worst


def outcome(name: str) -> str:
    """A cell of the table."""
    try:
        found = fitted(FAULTS[name][1](flight()), sound()[1])
    except GreyboxError as error:
        return f"refused: {type(error).__name__}"
    by, parameter = shift(found)
    return f"{by:.2g} ({parameter})" + ("" if found.converged else ", not converged")


@pytest.mark.slow
@pytest.mark.parametrize("name", [*SURVIVED, *WARNED])
def test_what_a_fault_does_to_the_estimates(name: str) -> None:
    got = outcome(name)
    print(f"\n{name}: {got}", flush=True)
    if name in SURVIVED:
        assert float(got.split()[0]) < HARMLESS
