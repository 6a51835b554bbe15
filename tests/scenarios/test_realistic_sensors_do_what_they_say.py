"""Every ingredient of the realistic sensors has its stated size and shape, and can be switched on
alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.plants.noise import SensorNoise
from scenarios.plants.realistic_sensors import INGREDIENTS, REALISTIC, realistic

LEVELS = SensorNoise(gyro=0.01, accelerometer=0.1, attitude=0.003, position=0.003, velocity=0.02)
N, DT = 20000, 0.01


@pytest.fixture(scope="module")
def still():
    """A vehicle that hangs still: whatever moves is sensor."""
    log = {
        n: np.zeros(N) for n in ("p", "q", "r", "ax", "ay", "az", "x", "y", "z", "vx", "vy", "vz")
    }
    log |= {
        "t": DT * np.arange(N),
        "qw": np.ones(N),
        "qx": np.zeros(N),
        "qy": np.zeros(N),
        "qz": np.zeros(N),
    }
    log |= {f"u{i}": np.full(N, 0.54321) for i in range(1, 5)}
    return log | {
        f"omega{i}": np.full(N, 2 * np.pi * f)
        for i, f in enumerate((187.0, 191.0, 205.0, 212.0), 1)
    }


@pytest.fixture(scope="module")
def moving(still):
    """Slow sines in every channel, the attitude a steady turn."""
    t = still["t"]
    wave = np.sin(2.0 * t)
    log = still | {
        n: wave.copy() for n in ("p", "q", "r", "ax", "ay", "az", "x", "y", "z", "vx", "vy", "vz")
    }
    return log | {"qw": np.cos(0.5 * t), "qz": np.sin(0.5 * t)}


def only(log, *names, seed=3, **sizes):
    return realistic(log, LEVELS, replace(REALISTIC.only(*names), **sizes), seed)


def test_nothing_switched_on_changes_nothing(moving):
    out = only(moving)
    assert REALISTIC.only().switched_on == ()
    assert all(np.array_equal(out[k], moving[k]) for k in moving)


@pytest.mark.parametrize("name", INGREDIENTS)
def test_one_ingredient_repeats_with_its_seed_and_leaves_the_input_alone(moving, name):
    before = {k: v.copy() for k, v in moving.items()}
    first, second = only(moving, name), only(moving, name)
    assert all(np.array_equal(first[k], second[k]) for k in first)
    assert all(np.array_equal(moving[k], before[k]) for k in moving)
    assert any(
        first[k].size != moving[k].size or not np.array_equal(first[k], moving[k]) for k in moving
    )


@pytest.mark.parametrize(
    ("column", "level", "time"),
    [("q", 0.01, 0.05), ("az", 0.1, 0.05), ("y", 0.003, 0.2), ("vx", 0.02, 0.2)],
)
def test_colour_has_its_level_and_correlation_time(still, column, level, time):
    noise = only(still, "colour")[column]
    lag = round(time / DT)
    assert np.std(noise) == pytest.approx(level, rel=0.1)
    assert np.mean(noise[lag:] * noise[:-lag]) / np.var(noise) == pytest.approx(
        np.exp(-1.0), abs=0.08
    )


def test_coloured_attitude_is_a_small_rotation(still):
    out = only(still, "colour")
    assert sum(out[n] ** 2 for n in ("qw", "qx", "qy", "qz")) == pytest.approx(1.0, abs=1e-12)
    assert np.std(2 * out["qy"]) == pytest.approx(0.003, rel=0.15)


def test_vibration_is_a_line_per_rotor_where_sampling_folds_it(still):
    ax = only(still, "vibration")["ax"]
    power = np.abs(np.fft.rfft(ax)) ** 2
    frequency = np.fft.rfftfreq(N, DT)
    strongest = sorted(frequency[np.argsort(power)[-4:]])
    assert strongest == pytest.approx([5.0, 9.0, 12.0, 13.0], abs=0.02)
    assert np.std(ax) == pytest.approx(0.1, rel=0.02)


def test_low_pass_delays_slow_and_damps_fast_signals_of_the_imu_alone(moving):
    out = only(moving, "low_pass", low_pass=8.0)
    late = np.sin(2.0 * (moving["t"] - 1 / (2 * np.pi * 8.0)))
    assert out["p"][100:] == pytest.approx(late[100:], abs=1e-3)
    assert np.array_equal(out["x"], moving["x"])
    noise = moving | {"p": np.random.default_rng(0).standard_normal(N)}
    assert np.std(only(noise, "low_pass", low_pass=8.0)["p"]) < 0.5


def test_delay_moves_the_pose_and_not_the_imu(moving):
    out = only(moving, "pose_delay")
    assert out["x"][10:] == pytest.approx(np.sin(2.0 * (moving["t"][10:] - 0.015)), abs=1e-4)
    assert 2 * np.arctan2(out["qz"], out["qw"])[10:300] == pytest.approx(
        moving["t"][10:300] - 0.015, abs=1e-6
    )
    assert np.array_equal(out["p"], moving["p"])


def test_jitter_is_up_to_one_sample_and_the_same_for_the_whole_stream(moving):
    out = only(moving, "jitter")
    turn = np.unwrap(np.arctan2(out["qz"], out["qw"])) * 2
    late = (moving["t"] - turn)[10:]
    assert late.min() >= -1e-9
    assert late.max() <= DT + 1e-9
    assert np.mean(late) == pytest.approx(0.5 * DT, rel=0.05)
    assert out["x"][10:] == pytest.approx(np.sin(2 * (moving["t"][10:] - late)), abs=1e-4)


def test_commands_are_rounded_and_one_row_in_a_hundred_is_lost(still):
    assert np.unique(only(still, "command_step")["u3"]) == pytest.approx([0.543])
    lost = 1 - only(still, "lost")["t"].size / N
    assert 0.007 < lost < 0.013


def test_gyro_bias_drifts_as_a_random_walk(still):
    log = {k: np.stack([v] * 60, axis=1)[:1601] if k != "t" else v[:1601] for k, v in still.items()}
    walk = only(log, "drift")["r"]
    assert np.array_equal(walk[0], np.zeros(60))
    assert np.std(walk[1600]) == pytest.approx(0.2 * 0.01 * 4.0, rel=0.3)
    assert np.std(walk[400]) == pytest.approx(0.2 * 0.01 * 2.0, rel=0.3)


def test_vibration_without_rotor_speeds_is_refused(still):
    with pytest.raises(ValueError, match="omega1"):
        only({k: v for k, v in still.items() if not k.startswith("omega")}, "vibration")
