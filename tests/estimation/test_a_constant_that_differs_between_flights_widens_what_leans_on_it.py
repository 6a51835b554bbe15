"""A thrust scale that differs from flight to flight drifts within them, too: inertia, which leans on
it, is known no better than it is; where flights agree its error stays as it was."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.data import Dataset
from greybox.estimation import conclusion
from greybox.estimation.fit import fit
from greybox.estimation.result import Fit
from greybox.model.model import build_model
from tests.automatic.craft import IMU, flight, flown, plant, vehicle

INERTIA = ("inertia.xx", "inertia.yy")


def fitted(fade: float) -> Fit:
    """Two flights in a row in which thrust fades evenly by `fade` in all: what is logged as commands
    is more than the rotors gave."""
    parts = []
    for k, columns in enumerate(flown()):
        n = len(columns["t"])
        lost = fade * (0.5 * k + np.linspace(0.0, 0.5, n))
        faded = {f"u{i}": columns[f"u{i}"] / np.sqrt(1 - lost) for i in range(1, 5)}
        parts.append(flight({**columns, **faded}, f"run{k}", IMU).flights[0])
    data = Dataset(flights=tuple(parts))
    model = build_model(
        vehicle(),
        data.channels,
        ("motor_lag", "command_delay", "gyro_bias", "accelerometer_bias"),
        sample_time=parts[0].dt,
    )
    return fit(model, data, disturbance=("force", "torque"), per_flight=("thrust.c2",))


def relative(found: Fit, name: str) -> float:
    return found[name].std / found[name].value


@pytest.fixture(scope="module")
def faded() -> Fit:
    return fitted(0.16)


def test_inertia_is_known_no_better_than_the_thrust_it_leans_on(faded):
    thrust = relative(faded, "thrust.c2")
    assert thrust > 0.02
    for name in INERTIA:
        assert relative(faded, name) == pytest.approx(thrust, rel=0.3)


def test_without_the_scatter_it_looks_many_times_as_sure(faded, monkeypatch):
    monkeypatch.setattr(
        conclusion, "varying_spread", lambda problem, *_: np.zeros((problem.n, problem.n))
    )
    alone = fitted(0.16)
    for name in INERTIA:
        assert alone[name].value == faded[name].value
        assert relative(alone, name) < 0.5 * relative(faded, name)
    assert alone["thrust.c2"].std == pytest.approx(faded["thrust.c2"].std)


def test_the_truth_is_within_the_wider_errors(faded):
    true = dict(
        zip(("inertia.xx", "inertia.yy", "inertia.zz"), plant().airframe.inertia, strict=True)
    )
    for name in INERTIA:
        assert abs(faded[name].value - true[name]) < 3 * faded[name].std


def test_where_flights_agree_nothing_is_added(monkeypatch):
    same = fitted(0.0)
    monkeypatch.setattr(
        conclusion, "varying_spread", lambda problem, *_: np.zeros((problem.n, problem.n))
    )
    alone = fitted(0.0)
    for name in INERTIA:
        assert same[name].std == pytest.approx(alone[name].std, rel=0.15)
