"""Nearly constant rates tell no delay between gyro and attitude: nothing is stated of their clocks.
Where the rates tell it, how far the clocks wander is found."""

from __future__ import annotations

import re
import sys

import numpy as np
import pytest
from faults import vehicle
from scipy.spatial.transform import Rotation

from greybox.data import RawLog
from greybox.data.checks import CheckReport, check

Posed = slice | np.ndarray
RATE = 100.0
ATTITUDE_NOISE, GYRO_NOISE = 0.002, 0.015


def flown(
    *,
    wobble: float,
    wander: float = 0.0,
    late: float = 0.0,
    seed: int = 0,
    posed: Posed = slice(None),
) -> CheckReport:
    """Twenty seconds of banking to and fro once in five seconds, and by `wobble` [rad] thrice a
    second; the gyro's clock is up to `wander` samples late and early, and `late` samples
    throughout. Only the rows `posed` have an attitude."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 20.0, 1.0 / RATE)

    def bank(at: np.ndarray) -> np.ndarray:
        return 0.3 * np.sin(0.4 * np.pi * at) + wobble * np.sin(6.0 * np.pi * at)

    felt = t - (late + wander * np.sin(0.2 * np.pi * t)) / RATE
    p = (bank(felt + 1e-4) - bank(felt - 1e-4)) / 2e-4 + GYRO_NOISE * rng.standard_normal(t.size)
    half = 0.5 * (bank(t) + ATTITUDE_NOISE * rng.standard_normal(t.size))
    still = {n: GYRO_NOISE * rng.standard_normal(t.size) for n in "qr"}
    channels = {f"u{i}": np.full(t.size, 0.6) for i in (1, 2, 3, 4)}
    channels |= {"qw": np.cos(half), "qx": np.sin(half), "qy": 0 * t, "qz": 0 * t, "p": p, **still}
    for name in ("qw", "qx", "qy", "qz"):
        whole, channels[name] = channels[name], np.full(t.size, np.nan)
        channels[name][posed] = whole[posed]
    return check([logged(t, channels)], vehicle("nanobench"))


def logged(t: np.ndarray, channels: dict[str, np.ndarray]) -> RawLog:
    return RawLog(
        t=t,
        channels=channels,
        extra={},
        rows=np.arange(1, t.size + 1),
        flight="flown",
        source="flown.csv",
        sha256="0" * 64,
    )


@pytest.mark.parametrize(
    "seed", [0, 1, 2, *(pytest.param(s, marks=pytest.mark.slow) for s in range(3, 8))]
)
def test_clocks_of_a_smooth_circle_do_not_wander(seed: int) -> None:
    report = flown(wobble=0.0, seed=seed)
    assert report.wander == 0.0
    assert not report.of("alignment")
    assert any("change too little" in u.reason for u in report.not_judged)


@pytest.mark.parametrize("every", [1, 3, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "noise", [(0.002, 0.015), pytest.param((0.001, 0.005), marks=pytest.mark.slow)]
)
def test_a_slow_pose_of_a_gentle_flight_makes_no_clock_wander(
    noise: tuple[float, float], every: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Lines between its samples have noise of their own, and a delay at which the correlation
    happens to be higher is no other one."""
    monkeypatch.setattr(sys.modules[__name__], "ATTITUDE_NOISE", noise[0])
    monkeypatch.setattr(sys.modules[__name__], "GYRO_NOISE", noise[1])
    for wobble in (0.0, 0.01):
        for seed in range(3):
            report = flown(wobble=wobble, seed=seed, posed=slice(None, None, every))
            assert report.wander == 0.0
            assert report.ok


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(s, marks=pytest.mark.slow) for s in range(1, 4))]
)
def test_clocks_that_wander_are_found_by_as_much_where_the_rates_tell_it(seed: int) -> None:
    report = flown(wobble=0.1, wander=4.0, seed=seed)
    assert report.wander == pytest.approx(7.0, abs=1.5)
    assert flown(wobble=0.1, seed=seed).wander == 0.0


@pytest.mark.parametrize("late", [0.0, 6.0])
@pytest.mark.parametrize("posed", ["second", "third", "two of five"])
def test_a_pose_that_is_slower_than_the_rows_tells_the_delay_as_well(posed: str, late: float):
    rows = np.arange(2000)
    kept = {"second": rows[::2], "third": rows[::3], "two of five": rows[np.isin(rows % 5, (0, 2))]}
    (found,) = flown(wobble=0.1, late=late, posed=kept[posed]).of("alignment")
    assert found.evidence["offset_samples"] == pytest.approx(late, abs=0.5)
    assert found.severity == ("blocking" if late else "info")


def test_a_delay_is_said_in_time_and_in_rows_of_the_log(monkeypatch: pytest.MonkeyPatch) -> None:
    """The checks look at 250 Hz; nobody who reads them has rows of that."""
    monkeypatch.setattr(sys.modules[__name__], "RATE", 500.0)
    (found,) = flown(wobble=0.1, late=20.0).of("alignment")
    said = re.search(r"the gyro is ([\d.]+) ms \(([\d.]+) rows\) late", found.message)
    assert said is not None, found.message
    assert float(said[1]) == pytest.approx(40.0, abs=2.0)
    assert float(said[2]) == pytest.approx(20.0, abs=1.0)
    assert "samples" not in found.message


@pytest.mark.parametrize("turned", [0.0, 5.0, 20.0])
def test_a_gyro_that_is_mounted_askew_is_no_clock_that_wanders(turned: float) -> None:
    """About a level circle the angle is early one way round and late the other."""
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 20.0, 0.5 / RATE)
    way = np.where(t < 10.0, 1.0, -1.0)
    rate = np.column_stack([np.cos(2 * np.pi * t), way * np.sin(2 * np.pi * t), 0.0 * t])
    attitude = Rotation.identity()
    poses = []
    for w in rate:
        poses.append(attitude.as_quat(scalar_first=True))
        attitude = attitude * Rotation.from_rotvec(w * 0.5 / RATE)
    gyro = Rotation.from_euler("z", turned, degrees=True).apply(rate)
    gyro += GYRO_NOISE * rng.standard_normal(gyro.shape)
    channels = {f"u{i}": np.full(t.size, 0.6) for i in (1, 2, 3, 4)}
    channels |= dict(zip(("qw", "qx", "qy", "qz"), np.array(poses).T, strict=True))
    channels |= dict(zip("pqr", gyro.T, strict=True))
    report = check([logged(t, channels)], vehicle("nanobench"))
    assert report.wander < 0.5
    assert not [f for f in report.of("alignment") if f.severity != "info"]
