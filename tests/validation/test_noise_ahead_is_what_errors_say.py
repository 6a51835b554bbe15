"""How much noise a prediction collects: told by errors ahead, not by what parameters were unsure
of; where errors say nothing it stays what the filter has."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np

from greybox.validation.calibration import calibrate_horizons
from tests.residual.hybrid_cases import pendulum_model, swings

HORIZONS = (5, 20, 50)


def test_an_unsure_parameter_takes_no_noise_away() -> None:
    """Its error is not in the errors of the flights that it was fitted to."""
    data, sure = swings(3, 1, hidden=0.35, period=4.0), pendulum_model()
    unsure = replace(sure, covariance_names=("k",), covariance=np.array([[4.0]]))
    one, other = (calibrate_horizons(m, data, horizons=HORIZONS) for m in (sure, unsure))
    assert one.factors == other.factors
    assert one.model.horizon_noise is not None


def test_what_errors_do_not_tell_stays_with_the_filter() -> None:
    """Where the sensors' noise is stated too large it covers every error alone: no reason to
    predict with a tenth of the pushes."""
    data, model = swings(3, 1, hidden=0.0, period=4.0, seconds=6.0), pendulum_model((3e-3, 3e-3))
    loud = replace(model, sensor_noise=3.0 * model.sensor_noise)
    factors = calibrate_horizons(loud, data, horizons=HORIZONS).factors
    assert all(0.8 < f < 1.25 for f in factors.values()), factors


def test_a_long_horizon_takes_no_more_memory() -> None:
    """At 1 kHz half a second is 500 samples, of which five count."""
    data, model = swings(3, 1, hidden=0.0, period=4.0, seconds=40.0), pendulum_model((3e-3, 3e-3))
    calibrate_horizons(model, data, horizons=(5,), spacing=0.02)  # whatever is made once

    def peak(horizon: int) -> int:
        tracemalloc.start()
        calibrate_horizons(model, data, horizons=(horizon,), spacing=0.02)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return most

    assert peak(200) < 1.5 * peak(5)
