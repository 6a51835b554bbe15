"""The covariance of a fit is a matrix to NumPy, the one that errors go by; innovations are a list of
records; a number of every flight is profiled for one that is named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox import build_model, fit, profile
from greybox.errors import UnknownNameError
from greybox.estimation.result import Fit
from tests.simulated import flights, vehicle


@pytest.fixture(scope="module")
def found() -> Fit:
    data = flights(2, seconds=2.0)
    model = build_model(vehicle(), data.channels, ["motor_lag", "gyro_bias"], sample_time=0.01)
    free = ("motor_lag.tau", "thrust.c2", "gyro_bias.b_x")
    return fit(model, data, free=free, disturbance=("torque",))


def test_the_covariance_is_the_matrix_that_errors_go_by(found: Fit) -> None:
    matrix = np.asarray(found.covariance)
    assert matrix.shape == (found.theta.size, found.theta.size) and matrix.dtype == float
    at = [u.name for u in found.problem.unknowns].index("motor_lag.tau")
    assert np.sqrt(matrix[at, at]) == pytest.approx(found["motor_lag.tau"].std)
    for coloured in (False, True):
        errors = replace(found.covariance, coloured=coloured)
        assert np.array_equal(np.asarray(errors), found.covariance.chosen(coloured))
    assert np.asarray(found.covariance, dtype=np.float32).dtype == np.float32


def test_innovations_are_a_list_of_records(found: Fit) -> None:
    for records in found.innovations.values():
        assert isinstance(records, list)
        assert all(r.shape[1] == len(found.model.dynamics.innovations) for r in records)


def test_a_number_of_every_flight_wants_one_that_is_named(found: Fit) -> None:
    every = r"'gyro_bias.b_x'.*it has a value for every flight; name one of run0, run1"
    with pytest.raises(UnknownNameError, match=every):
        profile(found, "gyro_bias.b_x")
    for name in ("gyro_bias.b_x", "motor_lag.tau"):
        with pytest.raises(UnknownNameError, match=r"unknown flight 'run7'.*run0"):
            profile(found, name, flight="run7")
    grid = [found["gyro_bias.b_x"].value]
    assert profile(found, "gyro_bias.b_x", flight="run1", grid=grid).flight == "run1"
