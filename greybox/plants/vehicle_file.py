"""The vehicle file of a simulated plant: what a ruler and a data sheet would say, which need not be
what is true."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from greybox.plants.airframe import Airframe
from greybox.plants.quadrotor import Quadrotor
from greybox.plants.vectors import Number

_SENSORS = {
    "gyro": "gyro",
    "accelerometer": "accelerometer",
    "attitude": "attitude",
    "position": "position",
    "velocity": "velocity",
    "voltage": "voltage",
    "rotor_speed": "rotor_speed",
}


def write_vehicle(
    path: str | Path,
    plant: Quadrotor,
    *,
    sigma: Mapping[str, float] | None = None,
    errors: Mapping[str, float] | None = None,
    known: Iterable[str] = (),
    noise: bool = True,
    speed: bool = True,
    schema: str = "greybox.vehicle/1",
) -> Path:
    """Write a vehicle TOML of the file contract for this plant.

    errors: factors by which the nominal values are off (1.15 = the file says 15 % too much); sigma:
    their standard deviations relative to the nominal value. Keys of both: "mass", "inertia",
    "inertia.xx", "inertia.yy", "inertia.zz", "thrust", "thrust.c0" to "thrust.c2", "torque",
    "torque.c0" to "torque.c2"; a full name wins over its group. Without a sigma a value is bare:
    exact in schema /1, believed within the default of its quantity in "greybox.vehicle/2", where
    the file is what a stranger writes. known: names of effects that the file declares with their
    true parameters. noise: write the sensor noise; speed: write speed_max.
    """
    frame = plant.airframe
    used = _Nominal(errors or {}, sigma or {})
    mass, mass_sigma = used.pair("mass", frame.mass)
    moments = [
        used.pair(f"inertia.{axis}", v) for axis, v in zip(("xx", "yy", "zz"), frame.inertia)
    ]
    thrust = [used.pair(f"thrust.c{k}", v) for k, v in enumerate(frame.thrust)]
    torque = [used.pair(f"torque.c{k}", v) for k, v in enumerate(frame.torque)]
    used.refuse_unused()
    xy, xz, yz = (_number(v) for v in frame.products)
    lines = [
        f'schema = "{schema}"',
        f'name = "{frame.name}"',
        f"gravity = {frame.gravity!r}",
        f"mass = {{ value = {mass!r}, sigma = {mass_sigma!r} }}"
        if mass_sigma
        else f"mass = {mass!r}",
        f"inertia = [[{moments[0][0]!r}, {xy!r}, {xz!r}], [{xy!r}, {moments[1][0]!r}, {yz!r}], "
        f"[{xz!r}, {yz!r}, {moments[2][0]!r}]]",
        *_sigmas("inertia", moments, schema),
        f"center_of_mass = {_numbers(frame.center_of_mass)!r}",
        f"imu_position = {_numbers(frame.imu_position)!r}",
    ]
    lines += _drives(frame, speed)
    for name, pairs in (("thrust", thrust), ("torque", torque)):
        lines += [f"{name} = {[v for v, _ in pairs]!r}", *_sigmas(name, pairs, schema)]
    lines += _known_effects(plant, tuple(known))
    if frame.nominal_voltage is not None:
        lines += ["", "[battery]", f"nominal_voltage = {frame.nominal_voltage!r}"]
    if noise:
        levels = {key: _level(getattr(plant.sensors, field)) for key, field in _SENSORS.items()}
        lines += [
            "",
            "[noise]",
            *(f"{key} = {value!r}" for key, value in levels.items() if value > 0.0),
        ]
    path = Path(path)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def _drives(frame: Airframe, speed: bool) -> list[str]:
    """The lines of the rotors and of the actuator up to its maps."""
    lines: list[str] = []
    for rotor in frame.rotors:
        lines += [
            "",
            "[[rotor]]",
            f"position = {_numbers(rotor.position)!r}",
            f"spin = {rotor.spin}",
        ]
    lines += [
        "",
        "[actuator]",
        f"u_min = {frame.u_min!r}",
        f"u_max = {frame.u_max!r}",
        'hold = "previous"',
    ]
    if frame.rotor_radius is not None:
        lines.append(f"rotor_radius = {frame.rotor_radius!r}")
    if frame.speed_max is not None and speed:
        lines.append(f"speed_max = {frame.speed_max!r}")
    return lines


def _sigmas(name: str, pairs: Sequence[tuple[float, float]], schema: str) -> list[str]:
    """The line of a triple's sigmas; none where schema /2 is to believe its defaults."""
    sigmas = [s for _, s in pairs]
    return (
        [] if schema != "greybox.vehicle/1" and not any(sigmas) else [f"{name}_sigma = {sigmas!r}"]
    )


class _Nominal:
    """Nominal values and their sigmas from true values, factors and relative sigmas."""

    def __init__(self, errors: Mapping[str, float], sigma: Mapping[str, float]) -> None:
        self._errors, self._sigma = errors, sigma
        self._asked: set[str] = set()

    def pair(self, name: str, true: Number) -> tuple[float, float]:
        """Value and standard deviation to write."""
        self._asked |= {name, name.split(".")[0]}
        value = _number(true) * self._look(self._errors, name, 1.0)
        return value, abs(value) * self._look(self._sigma, name, 0.0)

    @staticmethod
    def _look(table: Mapping[str, float], name: str, default: float) -> float:
        return float(table.get(name, table.get(name.split(".")[0], default)))

    def refuse_unused(self) -> None:
        """Complain about keys that name no parameter."""
        unknown = sorted((set(self._errors) | set(self._sigma)) - self._asked)
        if unknown:
            raise ValueError(
                f"no such parameter: {', '.join(unknown)}; there are "
                f"{', '.join(sorted(self._asked))}"
            )


def _known_effects(plant: Quadrotor, known: tuple[str, ...]) -> list[str]:
    lines: list[str] = []
    present = {effect.name: effect for effect in plant.effects}
    for name in known:
        if name not in present:
            raise ValueError(
                f"the plant has no effect {name!r}; it has {', '.join(present) or 'none'}"
            )
        lines += ["", f"[effects.{name}]"]
        lines += [
            f"{key.split('.', 1)[1]} = {_number(v)!r}"
            for key, v in present[name].parameters().items()
        ]
    return lines


def _number(value: Number) -> float:
    array = np.asarray(value, dtype=float)
    if array.size != 1:
        raise ValueError("a vehicle file holds one vehicle; this plant has a batch of values")
    return float(array.reshape(()))


def _numbers(values: Iterable[Number]) -> list[float]:
    return [_number(v) for v in values]


def _level(value: npt.ArrayLike) -> float:
    """One sigma for a sensor: the root mean square over its axes."""
    return float(np.sqrt(np.mean(np.square(np.asarray(value, dtype=float)))))
