"""How strongly the commands turn the craft is judged axis by axis, with its error: what moves little
beside what moves much was measured all the same, and what was not seen accuses nobody. A gain that
is far off is said of whom the rest of the data leaves: of the gyro, or of the vehicle file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from faults import vehicle

from greybox.data import RawLog
from greybox.data.airframe import Airframe
from greybox.data.checks import CheckReport, check
from greybox.data.checks.strength import promised_gain, strength_of
from greybox.data.checks.torque import Sums
from greybox.model.vehicle import Vehicle

RATE = 200.0
CRAFT = vehicle("nanobench")


def directions(craft: Airframe) -> np.ndarray:
    rows = [[r.position[1], -r.position[0], -r.spin] for r in craft.rotors]
    return np.array(rows).T / np.linalg.norm(np.array(rows), axis=0)[:, None]


def flown(
    *, level: float = 0.002, yaw: float = 0.1, gyro: float = 1.0, posed: bool = True
) -> RawLog:
    """Twenty seconds of a craft that turns as its vehicle file promises, rolls and pitches by
    `level` [u^2] and yaws by `yaw`. The log's gyro is `gyro` times the rate."""
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 20.0, 1.0 / RATE)
    tones = ((2.0, 3.1, 5.3), (2.3, 3.7, 4.9), (1.9, 3.3, 4.3))
    size = (level, level, yaw)
    strength = (*promised_gain(CRAFT), 30.0)
    push = np.array([sum(np.sin(2 * np.pi * f * t + f) for f in own) for own in tones])
    rate = [
        s * g * sum(-np.cos(2 * np.pi * f * t + f) / (2 * np.pi * f) for f in own)
        for own, s, g in zip(tones, size, strength, strict=True)
    ]
    squared = 0.36 + (directions(CRAFT).T @ (np.array(size)[:, None] * push)).T
    u = np.sqrt(squared)
    q = np.tile([1.0, 0.0, 0.0, 0.0], (t.size, 1))
    for k in range(1, t.size):
        w, x, y, z = q[k - 1]
        a, b, c = (0.5 * (r[k] + r[k - 1]) / 2 / RATE for r in rate)
        q[k] = [
            w - x * a - y * b - z * c,
            x + w * a + y * c - z * b,
            y + w * b + z * a - x * c,
            z + w * c + x * b - y * a,
        ]
        q[k] /= np.linalg.norm(q[k])
    channels = {f"u{i + 1}": u[:, i] for i in range(4)}
    noise = 1e-3 * rng.standard_normal((3, t.size))
    channels |= {n: gyro * (r + e) for n, r, e in zip("pqr", rate, noise, strict=True)}
    if posed:
        channels |= dict(zip(("qw", "qx", "qy", "qz"), q.T, strict=True))
    return RawLog(
        t=t,
        channels=channels,
        extra={},
        rows=np.arange(1, t.size + 1),
        flight="flown",
        source="flown.csv",
        sha256="0" * 64,
    )


def told(raw: RawLog, craft: Vehicle = CRAFT) -> CheckReport:
    return check([raw], craft)


@pytest.mark.parametrize("level", [0.02, 0.002, 0.0005])
@pytest.mark.parametrize("posed", [True, False])
def test_gentle_roll_and_pitch_beside_lively_yaw_are_no_fault(level: float, posed: bool) -> None:
    report = told(flown(level=level, posed=posed))
    assert report.ok
    assert not report.of("motors")


def test_small_commands_are_still_only_where_the_motion_does_not_show_them() -> None:
    (seen,) = told(flown(level=0.002, yaw=0.002)).of("excitation")
    assert not any(f"{axis} command" in seen.message for axis in ("roll", "pitch", "yaw"))
    (unseen,) = told(flown(level=0.0, yaw=0.1)).of("excitation")
    assert "roll command, pitch command" in unseen.message
    assert "yaw command" not in unseen.message


@pytest.mark.parametrize(("gyro", "words"), [(57.3, "is deg/s"), (1 / 57.3, "twice")])
@pytest.mark.parametrize("level", [0.02, 0.002])
def test_a_gyro_in_another_unit_is_found_at_any_size_of_the_motion(level, gyro, words) -> None:
    (found,) = told(flown(level=level, gyro=gyro, posed=False)).of("motors")
    assert found.severity == "blocking"
    assert found.where == "p, q, r"
    assert words in found.message


@pytest.mark.parametrize("posed", [True, False])
@pytest.mark.parametrize(("unit", "name"), [(100.0, "centimetres"), (1000.0, "millimetres")])
def test_arms_in_another_unit_are_the_files_and_not_the_gyros(posed, unit, name) -> None:
    rotors = [replace(r, position=tuple(unit * x for x in r.position)) for r in CRAFT.rotors]
    (found,) = told(flown(posed=posed), replace(CRAFT, rotors=tuple(rotors))).of("motors")
    assert found.severity == "blocking"
    assert "gyro is" not in found.message
    assert f"({name} instead of metres?)" in found.message


def test_an_inertia_in_another_unit_is_the_files() -> None:
    small = tuple(tuple(1e-3 * x for x in row) for row in CRAFT.inertia)
    (found,) = told(flown(), replace(CRAFT, inertia=small)).of("motors")
    assert "the inertia is about" in found.message
    assert "times too small" in found.message


@pytest.mark.parametrize("factor", [0.01, 100.0])
def test_thrust_that_is_far_off_is_not_the_gyros_where_the_attitude_agrees(factor: float) -> None:
    actuator = CRAFT.actuator
    thrust = tuple(replace(c, value=factor * c.value) for c in actuator.thrust)
    craft = replace(CRAFT, actuator=replace(actuator, thrust=thrust))
    found = told(flown(), craft).of("motors")
    assert all("gyro is" not in f.message for f in found)


def test_a_direction_without_information_has_no_gain_rather_than_none() -> None:
    promised = directions(CRAFT)
    rng = np.random.default_rng(1)
    push = rng.standard_normal((8, 200, 3)) * [0.0, 1e-4, 1.0]
    turn = push * [40.0, 40.0, 40.0] + rng.standard_normal(push.shape)
    u = push @ promised
    sums = Sums(
        xx=np.tile(np.einsum("bti,btj->bij", u, u), (3, 1, 1, 1)),
        xy=np.einsum("bti,bta->abi", u, turn),
    )
    found = strength_of(CRAFT, sums, promised)
    assert found is not None
    assert np.isnan(found.ratio[0]), "never moved"
    assert abs(found.ratio[1] * promised_gain(CRAFT)[1] - 40.0) < 4.0 * (
        found.error[1] * promised_gain(CRAFT)[1]
    )
    assert not found.told
    assert found.wrong([]) is None
