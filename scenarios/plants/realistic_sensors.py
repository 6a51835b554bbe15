"""Realistic sensors: what a real log adds to white noise, each ingredient on its own switch, all of
it seeded.

Sizes are relative to the white noise of the plant's sensors, so that one set suits a nano drone and
a larger vehicle alike. The order is that of a flight: rotors shake the IMU, its filter smooths what
it feels, slow errors add, motion capture arrives late and unevenly, the logger rounds and loses
rows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from greybox.plants.noise import SensorNoise, axes
from greybox.plants.vectors import multiply, normalised, quaternion_of
from scenarios.plants.sensor_faults import (
    ACCELEROMETER,
    GYRO,
    POSE,
    Columns,
    Log,
    coloured_noise,
    drifting_bias,
    dropped_rows,
    low_passed,
    quantised,
    uneven,
    vibration,
)

COMMANDS = "u"
INGREDIENTS = (
    "colour",
    "vibration",
    "low_pass",
    "pose_delay",
    "jitter",
    "command_step",
    "lost",
    "drift",
)


@dataclass(frozen=True, kw_only=True)
class Realism:
    """Ingredients; zero leaves one out.

    colour: Gauss-Markov noise on every motion sensor, standard deviation relative to its white
    noise (correlation times `imu_time` for the IMU, `pose_time` for motion capture [s]). vibration:
    RMS over all rotors of a line at the speed of every rotor in the IMU, folded by the sampling,
    relative to the white noise. low_pass: cut-off of a first-order filter of the IMU [Hz].
    pose_delay: latency of motion capture [s]. jitter: further delay of every row of motion capture,
    uniform between zero and so many samples. command_step: resolution of the logged commands. lost:
    share of rows. drift: random walk of the gyro bias after one second, relative to its white
    noise.
    """

    colour: float = 0.0
    vibration: float = 0.0
    low_pass: float = 0.0
    pose_delay: float = 0.0
    jitter: float = 0.0
    command_step: float = 0.0
    lost: float = 0.0
    drift: float = 0.0
    imu_time: float = 0.05
    pose_time: float = 0.2

    def only(self, *ingredients: str) -> Realism:
        """The same sizes with only the named ingredients switched on."""
        unknown = sorted(set(ingredients) - set(INGREDIENTS))
        if unknown:
            raise ValueError(
                f"no such ingredient: {', '.join(unknown)}; there are {', '.join(INGREDIENTS)}"
            )
        return replace(self, **{n: 0.0 for n in INGREDIENTS if n not in ingredients})

    @property
    def switched_on(self) -> tuple[str, ...]:
        """Names of the ingredients that are not zero."""
        return tuple(
            f.name for f in fields(self) if f.name in INGREDIENTS and getattr(self, f.name)
        )


REALISTIC = Realism(
    colour=1.0,
    vibration=1.0,
    low_pass=30.0,
    pose_delay=0.015,
    jitter=1.0,
    command_step=1e-3,
    lost=0.01,
    drift=0.2,
)
"""All of it, in sizes that are usual for a hobby autopilot in a motion-capture room."""


def realistic(log: Columns, sensors: SensorNoise, realism: Realism, seed: int) -> Log:
    """The log as real sensors and a real logger would have kept it. Vibration needs the columns
    omega1, omega2, ...

    Every ingredient draws from a generator of its own: switching one off leaves the others as they
    were.
    """
    out: Log = {name: values.copy() for name, values in log.items()}
    draws = {name: np.random.default_rng([seed, 7, i]) for i, name in enumerate(INGREDIENTS)}
    levels: dict[str, float] = {}
    for names, level in (
        (GYRO, sensors.gyro),
        (ACCELEROMETER, sensors.accelerometer),
        (("x", "y", "z"), sensors.position),
        (("vx", "vy", "vz"), sensors.velocity),
        (("1", "2", "3"), sensors.attitude),
    ):
        levels |= {n: float(v) for n, v in zip(names, axes(level), strict=True)}
    imu = [n for n in (*GYRO, *ACCELEROMETER) if n in out]
    pose = [n for n in POSE if n in out]
    if realism.vibration:
        rotors = [n for n in out if n.startswith("omega")]
        if not rotors:
            raise ValueError(
                "vibration needs rotor speeds: keep the columns omega1, omega2, ... until here"
            )
        amplitude = realism.vibration * np.sqrt(2.0 / len(rotors))
        for name in imu:
            for rotor in rotors:
                out = vibration(out, [name], amplitude * levels[name], draws["vibration"], rotor)
    if realism.low_pass:
        out = low_passed(out, imu, realism.low_pass)
    if realism.colour:
        for name in (*imu, *(n for n in pose if n in levels)):
            correlation = realism.imu_time if name in imu else realism.pose_time
            out = coloured_noise(
                out, [name], realism.colour * levels[name], correlation, draws["colour"]
            )
        if "qw" in out:
            turn = [realism.colour * levels[a] for a in ("1", "2", "3")]
            out = _turned(out, turn, realism.pose_time, draws["colour"])
    if realism.drift:
        for name in GYRO:
            if name in out:
                out = drifting_bias(out, [name], realism.drift * levels[name], draws["drift"])
    if realism.pose_delay or realism.jitter:
        out = uneven(out, pose, realism.pose_delay, realism.jitter, draws["jitter"])
    if realism.command_step:
        commands = [n for n in out if n[:1] == COMMANDS and n[1:].isdigit()]
        out = quantised(out, commands, realism.command_step)
    if realism.lost:
        out = dropped_rows(out, realism.lost, draws["lost"])
    return out


def _turned(
    log: Mapping[str, NDArray[np.float64]],
    sigma: list[float],
    time: float,
    rng: np.random.Generator,
) -> Log:
    """The attitude turned by a small rotation with Gauss-Markov components in body axes."""
    out = {name: values.copy() for name, values in log.items()}
    empty = {"t": out["t"], **{a: np.zeros_like(out["qw"]) for a in "123"}}
    for axis, level in zip("123", sigma, strict=True):
        empty = coloured_noise(empty, [axis], level, time, rng)
    quaternion = (out["qw"], out["qx"], out["qy"], out["qz"])
    turned = normalised(multiply(quaternion, quaternion_of((empty["1"], empty["2"], empty["3"]))))
    return out | dict(zip(("qw", "qx", "qy", "qz"), turned, strict=True))
