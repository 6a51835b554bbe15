"""Every error measure has the value that one computes by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from greybox.errors import DataError
from greybox.validation import metrics

Y = np.array([1.0, 2.0, 3.0, 4.0])
P = np.array([1.0, 2.0, 3.0, 6.0])
SERIES = arrays(np.float64, st.integers(3, 40), elements=st.floats(-100, 100, width=32))


def test_hand_computed() -> None:
    # errors 0, 0, 0, -2; sum of squares 4; spread of Y about 2.5: 5; variance of e about -0.5: (3 *
    # 0.25 + 2.25) = 3
    assert metrics.mse(Y, P) == pytest.approx(1.0)
    assert metrics.rmse(Y, P) == pytest.approx(1.0)
    assert metrics.mae(Y, P) == pytest.approx(0.5)
    assert metrics.r_squared(Y, P) == pytest.approx(1 - 4 / 5)
    assert metrics.fit_percentage(Y, P) == pytest.approx(100 * (1 - np.sqrt(4 / 5)))
    assert metrics.vaf(Y, P) == pytest.approx(100 * (1 - 3 / 5))


def test_mae_of_a_vector_is_the_mean_of_its_norm() -> None:
    y = np.zeros((2, 3))
    p = np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 1.0]])
    assert metrics.mae(y, p) == pytest.approx(3.0)
    assert metrics.mse(y, p) == pytest.approx(26 / 6)


def test_missing_samples_are_left_out_and_counted() -> None:
    y = np.array([1.0, np.nan, 2.0, 3.0, 4.0])
    p = np.array([1.0, 55.0, 2.0, 3.0, 6.0])
    result = metrics.channel_metrics(y, p, unit="m")
    assert (result.n, result.missing, result.unit) == (4, 1, "m")
    assert result.mse == pytest.approx(metrics.mse(Y, P))
    masked = metrics.channel_metrics(y, p, mask=np.array([True, True, True, True, False]))
    assert (masked.n, masked.missing, masked.mse) == (3, 2, 0.0)


def test_a_prediction_that_failed_is_not_a_missing_sample() -> None:
    with pytest.raises(DataError, match="NaN in 1 samples that were measured"):
        metrics.mse(Y, np.array([1.0, np.nan, 3.0, 4.0]))
    with pytest.raises(DataError, match="infinite"):
        metrics.mse(Y, np.array([1.0, np.inf, 3.0, 4.0]))


@pytest.mark.parametrize("call", [metrics.r_squared, metrics.fit_percentage, metrics.vaf])
def test_a_constant_channel_has_no_r_squared(call) -> None:
    with pytest.raises(DataError, match="constant"):
        call(np.full(5, 3.3), np.zeros(5))
    assert metrics.channel_metrics(np.full(5, 3.3), np.zeros(5)).r2 is None


def test_shapes_and_masks_are_checked() -> None:
    with pytest.raises(DataError, match="differ in shape"):
        metrics.mse(Y, P[:3])
    with pytest.raises(DataError, match="mask"):
        metrics.mse(Y, P, mask=np.ones(3, dtype=bool))
    with pytest.raises(DataError, match="mask"):
        metrics.mse(Y, P, mask=np.array([0, 1, 2, 3]))
    with pytest.raises(DataError, match="no sample"):
        metrics.mse(np.full(3, np.nan), np.zeros(3))


@given(SERIES, st.floats(0.01, 100), st.floats(-50, 50))
def test_fit_measures_do_not_depend_on_units(y: np.ndarray, scale: float, offset: float) -> None:
    if np.ptp(y) < 1e-2:
        return
    p = y + np.cos(np.arange(len(y)))
    a, b = (
        metrics.channel_metrics(y, p),
        metrics.channel_metrics(scale * y + offset, scale * p + offset),
    )
    assert b.rmse == pytest.approx(scale * a.rmse, rel=1e-6, abs=1e-9)
    assert b.r2 == pytest.approx(a.r2, rel=1e-5, abs=1e-7)
    assert a.fit == pytest.approx(100 * (1 - np.sqrt(1 - a.r2)), rel=1e-9)
    assert a.vaf >= 100 * a.r2 - 1e-6 * (1 + abs(a.r2))


def test_limits() -> None:
    rng = np.random.default_rng(1)
    y = rng.standard_normal((50, 3))
    perfect = metrics.channel_metrics(y, y)
    assert (perfect.r2, perfect.fit, perfect.vaf, perfect.bias) == (1.0, 100.0, 100.0, 0.0)
    mean = metrics.channel_metrics(y, np.broadcast_to(y.mean(axis=0), y.shape))
    assert mean.r2 == pytest.approx(0.0, abs=1e-12)
    offset = metrics.channel_metrics(y, y + 7.0)
    assert offset.vaf == pytest.approx(100.0)
    assert offset.r2 < 0
