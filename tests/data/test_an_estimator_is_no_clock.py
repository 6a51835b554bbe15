"""A clock makes all axes late alike. Where they differ an estimator filters the attitude: that is
said, blocks nothing, and hides no clock that is late besides."""

from __future__ import annotations

import numpy as np
import pytest
from faults import vehicle

from greybox.data import RawLog
from greybox.data.checks import CheckReport, Finding, check
from greybox.validation.advice import Symptom, hints_of_checks

RATE = 100.0


def flown(roll: float, yaw: float, seed: int = 0) -> Finding:
    """What is said of a flight whose gyro is so many samples late against roll and heading."""
    (found,) = checked(roll, yaw, seed).of("alignment")
    return found


def checked(roll: float, yaw: float, seed: int = 0) -> CheckReport:
    """All that is said."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 20.0, 1.0 / RATE)

    def bank(at: np.ndarray) -> np.ndarray:
        return 0.3 * np.sin(0.4 * np.pi * at) + 0.1 * np.sin(5.9 * np.pi * at)

    def heading(at: np.ndarray) -> np.ndarray:
        return 0.4 * np.sin(0.5 * np.pi * at) + 0.1 * np.sin(4.7 * np.pi * at)

    half, course = 0.5 * bank(t + roll / RATE), 0.5 * heading(t + yaw / RATE)
    half, course = (a + 0.001 * rng.standard_normal(t.size) for a in (half, course))
    turn, change = ((f(t + 1e-4) - f(t - 1e-4)) / 2e-4 for f in (heading, bank))
    rates = {"p": change, "q": turn * np.sin(bank(t)), "r": turn * np.cos(bank(t))}
    channels = {f"u{i}": np.full(t.size, 0.6) for i in (1, 2, 3, 4)}
    channels |= {n: v + 0.01 * rng.standard_normal(t.size) for n, v in rates.items()}
    channels |= {"qw": np.cos(course) * np.cos(half), "qx": np.cos(course) * np.sin(half)}
    channels |= {"qy": np.sin(course) * np.sin(half), "qz": np.sin(course) * np.cos(half)}
    raw = RawLog(
        t=t,
        channels=channels,
        extra={},
        rows=np.arange(1, t.size + 1),
        flight="flown",
        source="flown.csv",
        sha256="0" * 64,
    )
    return check([raw], vehicle("nanobench"))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("late", [12.0, -9.0])
def test_axes_that_differ_are_an_estimators(late: float, seed: int) -> None:
    found = flown(late, 0.0, seed)
    assert found.severity == "warning"
    assert "an estimator" in found.message
    assert found.evidence["p_samples"] == pytest.approx(late, abs=1.5)
    assert found.evidence["r_samples"] == pytest.approx(0.0, abs=0.7)
    assert found.evidence["offset_samples"] == 0.0


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("late", [12.0, -9.0])
def test_what_all_axes_share_is_a_clocks(late: float, seed: int) -> None:
    found = flown(late, late, seed)
    assert found.severity == "blocking"
    assert "estimator" not in found.message
    assert found.evidence["offset_samples"] == pytest.approx(late, abs=0.5)


@pytest.mark.parametrize("seed", range(3))
def test_an_estimator_hides_no_clock(seed: int) -> None:
    found = flown(22.0, 10.0, seed)
    assert found.severity == "blocking"
    assert "estimator" in found.message
    assert "is a clock's" in found.message
    assert found.evidence["offset_samples"] == pytest.approx(10.0, abs=1.0)


def test_axes_that_differ_to_both_sides_share_nothing() -> None:
    found = flown(16.0, -7.0)
    assert found.severity == "warning"
    assert found.evidence["offset_samples"] == 0.0


def test_axes_that_differ_are_no_drift_of_clocks_and_turn_on_noise_between_attitude_and_gyro() -> (
    None
):
    report = checked(12.0, 0.0)
    assert report.drifts == () and report.wander == 0.0
    (apart,) = report.axes_apart
    assert apart == pytest.approx(12.0, abs=2.0) and report.loose
    clean = checked(0.0, 0.0)
    assert clean.axes_apart == () and not clean.loose


def test_a_bad_fit_is_told_of_an_estimator_and_not_of_clocks() -> None:
    (hint,) = hints_of_checks(checked(12.0, 0.0), effects=("motor_lag",))
    assert hint.symptom is Symptom.CLOCKS and hint.detail.startswith("an estimator's axes are 1")
    assert not hints_of_checks(checked(12.0, 0.0), effects=("motor_lag",), kinematic_noise=True)
