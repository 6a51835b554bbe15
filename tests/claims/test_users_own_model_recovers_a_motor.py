"""Claim: a user's own model (CasADi f and h with declared parameters) is fitted by the same calls
as a quadrotor.

The motor is simulated in NumPy, independently. Its parameters come back within their intervals, by
output error on a quiet motor and by the innovation form on one with torque noise; output error on
the noisy one is over-confident.
"""

from __future__ import annotations

import numpy as np
import pytest

from greybox import fit
from greybox.estimation.fit import Fit
from tests import motor


def normalised(result: Fit) -> np.ndarray:
    return np.array([(e.value - motor.TRUTH[n]) / e.std for n, e in result.parameters.items()])


@pytest.mark.parametrize(
    ("predictor", "torque_noise"), [("simulation", 0.0), ("innovation", 0.002), ("kalman", 0.002)]
)
def test_parameters_come_back_within_their_intervals(predictor: str, torque_noise: float) -> None:
    scores = []
    for seed in range(5):
        data = motor.record(torque_noise=torque_noise, seed=seed)
        result = fit(motor.model(), data, predictor=predictor, initialisation="equation-error")
        assert result.converged
        assert set(result.parameters) == set(motor.TRUTH)
        scores.append(normalised(result))
    table = np.array(scores)
    assert np.abs(table).max() < 4.5
    # Thirty normal scores: mean square within its 99.9 % band.
    assert 0.3 < np.mean(table**2) < 2.1


def test_output_error_mistakes_process_noise_for_precision() -> None:
    data = motor.record(torque_noise=0.002)
    result = fit(motor.model(), data, predictor="simulation", initialisation="equation-error")
    fisher = [abs(e.value - motor.TRUTH[n]) / e.std_fisher for n, e in result.parameters.items()]
    assert max(fisher) > 5


def test_the_fit_speaks_of_the_users_names_and_units() -> None:
    result = fit(
        motor.model(), motor.record(), predictor="simulation", initialisation="equation-error"
    )
    assert result["J"].unit == "kg m^2"
    assert "J " in result.summary()
