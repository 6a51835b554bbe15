"""The vehicle file of somebody who weighed the craft roughly, guessed its inertia and read the
rotors off a data sheet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from greybox.plants.airframe import Airframe
from greybox.plants.noise import SensorNoise

MASS_ERROR, INERTIA_ERROR, THRUST_ERROR, TORQUE_ERROR = 0.03, 0.3, 0.2, 0.2
"""Standard deviations of the nominal numbers relative to the truth; what a file with sigmas says of
itself."""
LARGEST_DEVIATION = 2.0
"""Deviations beyond so many sigmas are drawn again: nobody writes down a negative inertia."""
BODY_MARGIN = 0.98
"""A guessed inertia keeps Jzz below this share of Jxx + Jyy: nobody writes down an impossible body.
"""


@dataclass(frozen=True, kw_only=True)
class Knowledge:
    """Factors of the nominal numbers (mass; inertia of three axes; thrust; torque), and what the
    file says at all.

    sigmas: whether numbers have their standard deviations or stand bare (a bare number is believed
    within a default). The mass always says how sure it is: a bare one claims a kitchen scale, three
    times better than what is drawn here. noise: whether the file has the sensors' white noise.
    """

    mass: float
    inertia: tuple[float, float, float]
    thrust: float
    torque: float
    sigmas: bool
    noise: bool

    @classmethod
    def of(cls, frame: Airframe, random: np.random.Generator) -> Knowledge:
        """Drawn for this airframe."""
        mass, thrust, torque = (
            1.0 + e * _normal(random) for e in (MASS_ERROR, THRUST_ERROR, TORQUE_ERROR)
        )
        sigmas, noise = bool(random.random() < 0.5), bool(random.random() < 0.5)
        while True:
            xx, yy, zz = (1.0 + INERTIA_ERROR * _normal(random) for _ in range(3))
            a, b, c = (f * j for f, j in zip((xx, yy, zz), frame.inertia))
            if c < BODY_MARGIN * (a + b) and abs(a - b) < BODY_MARGIN * c:
                break
        return cls(
            mass=mass,
            inertia=(xx, yy, zz),
            thrust=thrust,
            torque=torque,
            sigmas=sigmas,
            noise=noise,
        )


def _normal(random: np.random.Generator) -> float:
    while True:
        value = float(random.standard_normal())
        if abs(value) <= LARGEST_DEVIATION:
            return value


def nominal_values(frame: Airframe, known: Knowledge) -> dict[str, float]:
    """What the file says, by canonical name."""
    values = {"mass": known.mass * float(frame.mass)}
    for axis, factor, true in zip(("xx", "yy", "zz"), known.inertia, frame.inertia):
        values[f"inertia.{axis}"] = factor * float(true)
    for name, factor, curve in (
        ("thrust", known.thrust, frame.thrust),
        ("torque", known.torque, frame.torque),
    ):
        values |= {f"{name}.c{k}": factor * float(c) for k, c in enumerate(curve)}
    return values


def vehicle_text(frame: Airframe, known: Knowledge, sensors: SensorNoise) -> str:
    """The file. The centre of mass is taken for the body origin; lag and drag are not mentioned."""
    said = nominal_values(frame, known)
    moments = [said[f"inertia.{axis}"] for axis in ("xx", "yy", "zz")]
    rows = [[moments[0], 0.0, 0.0], [0.0, moments[1], 0.0], [0.0, 0.0, moments[2]]]
    mass, doubt = _number(said["mass"]), _number(MASS_ERROR * said["mass"])
    lines = [
        'schema = "greybox.vehicle/2"',
        f'name = "{frame.name}"',
        f"gravity = {frame.gravity!r}",
        f"mass = {{ value = {mass}, sigma = {doubt} }}",
        f"inertia = [{', '.join(_row(row) for row in rows)}]",
    ]
    if known.sigmas:
        lines.append(f"inertia_sigma = {_row([INERTIA_ERROR * j for j in moments])}")
    for rotor in frame.rotors:
        lines += ["", "[[rotor]]", f"position = {_row(rotor.position)}", f"spin = {rotor.spin}"]
    lines += [
        "",
        "[actuator]",
        f"u_min = {frame.u_min!r}",
        f"u_max = {frame.u_max!r}",
        'hold = "previous"',
    ]
    lines += [
        f"rotor_radius = {_number(frame.rotor_radius or 0.0)}",
        f"speed_max = {_number(frame.speed_max or 0.0)}",
    ]
    for name, error in (("thrust", THRUST_ERROR), ("torque", TORQUE_ERROR)):
        curve = [said[f"{name}.c{k}"] for k in range(3)]
        lines.append(f"{name} = {_row(curve)}")
        if known.sigmas:
            lines.append(f"{name}_sigma = {_row([error * abs(c) for c in curve])}")
    if frame.nominal_voltage is not None:
        lines += ["", "[battery]", f"nominal_voltage = {_number(frame.nominal_voltage)}"]
    if known.noise:
        levels = ("gyro", "accelerometer", "attitude", "position", "velocity")
        lines += [
            "",
            "[noise]",
            *(f"{name} = {_number(float(vars(sensors)[name]))}" for name in levels),
        ]
    return "\n".join(lines) + "\n"


def _number(value: float) -> str:
    """Six digits, as somebody would write them; always a TOML float."""
    text = f"{value:.6g}"
    return text if any(c in text for c in ".en") else f"{text}.0"


def _row(values: list[float] | tuple[float, ...]) -> str:
    return f"[{', '.join(_number(float(v)) for v in values)}]"
