"""The map over speed, height and so on: quarters of equally many rows, and no map where there are too few rows for four."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.discovery.regimes import QUARTERS, regimes
from greybox.residual.discrepancy import Discrepancy
from greybox.symbolic import Layout, Signal


def seen(n: int) -> Discrepancy:
    """A torque error that grows with the roll rate."""
    rate = np.linspace(0.1, 2.0, n)
    return Discrepancy(
        inputs=Layout([Signal(name=n, unit="rad/s") for n in "pqr"]), outputs=Layout([Signal(name="torque.x", unit="N m")]),
        z=np.stack([rate, 0 * rate, 0 * rate], axis=1),
        y=(rate**2 * np.where(np.arange(n) % 2, 1, -1))[:, None], flights=("a",) * n,
    )  # fmt: skip


def test_the_error_is_largest_where_the_rate_is():
    rate = next(r for r in regimes(seen(80), ["p", "q", "r"]) if r.signal == "rate")
    assert rate.ratio.shape == (1, QUARTERS)
    assert (np.diff(rate.ratio[0]) > 0).all()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("rows", [1, 2, 3, 4, 5])
def test_few_rows_give_whole_quarters_or_no_map(rows: int):
    for regime in regimes(seen(rows), ["p", "q", "r"]):
        assert np.isfinite(regime.ratio).all()
