"""Judges: each looks at one side of a craft and yields what is wrong with it.

Limits are wide on purpose. Size and mass follow m ~ L^3 and J ~ m L^2 (Kushleyev, Mellinger, Powers
and Kumar 2013, Autonomous Robots 35(4), sec. 2); thrust is judged by T / (rho A (Omega R)^2),
torque over thrust by the rotor radius (Leishman 2006, Principles of Helicopter Aerodynamics, ch.
2). L is the longest arm.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from greybox.data.airframe import LENGTH_UNITS, MOMENTS
from greybox.frames import GRAVITY
from greybox.model.body import may_be_stated
from greybox.model.effects import effect_by_name
from greybox.model.plausibility.craft import HOVER_RANGE, Craft
from greybox.model.plausibility.finding import Implausible, Severity
from greybox.model.sensors import SENSORS
from greybox.model.vehicle import Vehicle

HUGE = 1e9
DENSITY = (20.0, 1500.0)
"""Usual mass over the cube of the arm [kg/m^3]."""
MASS_UNITS = {1e-3: "grams instead of kilograms"}
INERTIA_UNITS = {
    1e-9: "g mm^2",
    1e-7: "g cm^2",
    1e-6: "kg mm^2",
    1e-4: "kg cm^2",
    1e-3: "g m^2",
}
FORCE_UNITS = {
    1e-3 * GRAVITY: "gram-force instead of newton",
    GRAVITY: "kilogram-force instead of newton",
}


def _slip(value: float, low: float, high: float, units: dict[float, str]) -> str | None:
    """The unit that would explain a value outside of low..high."""
    return next((name for factor, name in units.items() if low <= value * factor <= high), None)


def extremes(vehicle: Vehicle) -> Iterator[Implausible]:
    """Numbers that nothing on a small craft has in any unit; with them there is nothing to
    calculate."""

    def numbers(place: str, value: object) -> Iterator[tuple[str, float]]:
        if isinstance(value, dict):
            for k, v in value.items():
                yield from numbers(f"{place}.{k}" if place else k, v)
        elif isinstance(value, list):
            for i, v in enumerate(value):
                yield from numbers(f"{place}[{i}]", v)
        elif isinstance(value, float | int):
            yield place, float(value)

    given = vehicle.to_dict()
    given.pop("columns")
    for place, value in numbers("", given):
        if abs(value) > HUGE:
            yield Implausible(
                "blocking",
                place,
                "far too large in any unit",
                f"below {HUGE:g}",
                f"{value:g}",
                "check the exponent",
            )
    for place, value in (("mass", vehicle.mass.value), ("gravity", vehicle.gravity)):
        if value < 1 / HUGE:
            yield Implausible(
                "blocking",
                place,
                "far too small in any unit",
                f"above {1 / HUGE:g}",
                f"{value:g}",
                "check the exponent",
            )


def size(c: Craft) -> Iterator[Implausible]:
    """Mass against arm length."""
    if not 0.01 <= c.L <= 3:
        # Of the units that make arms of it, the one whose arms carry this mass as craft do.
        usual = math.sqrt(DENSITY[0] * DENSITY[1])
        units = {f: n for f, n in LENGTH_UNITS.items() if 0.02 <= c.L * f <= 1.5}
        nearest = sorted(units, key=lambda f: abs(math.log(c.m / (c.L * f) ** 3 / usual)))
        slip = units[nearest[0]] if nearest else None
        yield Implausible(
            "blocking",
            "rotor.position",
            "arms of no small multirotor",
            "an arm of 0.01 to 3 m",
            f"{c.L:g} m",
            f"looks like {slip}: give metres" if slip else "give hub positions in metres",
        )
        return
    density = c.m / c.L**3
    if not 5 <= density <= 6000:
        slip = _slip(density, 10, 3000, MASS_UNITS)
        yield Implausible(
            "blocking",
            "mass",
            "no craft of this size has this mass",
            f"{5 * c.L**3:.2g} to {6000 * c.L**3:.2g} kg for arms of {c.L:.3g} m",
            f"{c.m:g} kg",
            f"looks like {slip}: give kg" if slip else "check kg and metres",
        )
    elif not DENSITY[0] <= density <= DENSITY[1]:
        yield Implausible(
            "warning",
            "mass",
            "unusual mass for its size",
            f"{DENSITY[0] * c.L**3:.2g} to {DENSITY[1] * c.L**3:.2g} kg for arms of {c.L:.3g} m",
            f"{c.m:g} kg",
            "weigh the craft ready to fly; measure from the centre to a motor axis",
        )
    if not 9.7 <= c.vehicle.gravity <= 9.9:
        yield Implausible(
            "warning",
            "gravity",
            "not the Earth's",
            "9.76 to 9.84 m/s^2",
            f"{c.vehicle.gravity:g} m/s^2",
            "leave the key out",
        )


def inertia(c: Craft) -> Iterator[Implausible]:
    """Moments against m L^2, shape and triangle inequality."""
    j = np.array(c.vehicle.inertia)
    for i, axis in enumerate(("xx", "yy", "zz")):
        a = j[i, i] / (c.m * c.L**2)
        slip = _slip(a, 0.08, 1.0, INERTIA_UNITS)
        if not MOMENTS[0] <= a <= MOMENTS[1]:
            yield Implausible(
                "blocking",
                f"inertia.{axis}",
                "no body of this mass and size has this moment",
                f"{0.05 * c.m * c.L**2:.2g} to {c.m * c.L**2:.2g} kg m^2",
                f"{j[i, i]:g}",
                f"looks like {slip}: give kg m^2"
                if slip
                else "check the unit and exponent; check mass and arms",
            )
        elif not 0.05 <= a <= 1.2:
            yield Implausible(
                "warning",
                f"inertia.{axis}",
                "unusual moment for mass and arm",
                f"{0.05 * c.m * c.L**2:.2g} to {c.m * c.L**2:.2g} kg m^2",
                f"{j[i, i]:g}",
                "check the exponent; small craft have 0.2 to 0.5 m L^2",
            )
    principal = np.linalg.eigvalsh(j)
    if principal[2] > principal[0] + principal[1]:
        within = may_be_stated(j, c.vehicle.stated_inertia_sigma)
        yield Implausible(
            "warning" if within else "blocking",
            "inertia",
            "breaks the triangle inequality: no body has it",
            f"the largest principal moment at most {principal[0] + principal[1]:.3g}",
            f"{principal[2]:.3g} kg m^2",
            "measure again; a flat body has Jzz = Jxx + Jyy at most",
        )
    elif j[2, 2] < max(j[0, 0], j[1, 1]):
        yield Implausible(
            "warning",
            "inertia.zz",
            "below a horizontal moment: a multirotor is flat",
            f"above {max(j[0, 0], j[1, 1]):.3g} kg m^2",
            f"{j[2, 2]:.3g}",
            "check the order xx, yy, zz",
        )


def thrust(c: Craft) -> Iterator[Implausible]:
    """Thrust to weight, the shape of the thrust map and the hover command."""
    yield from _thrust_to_weight(c)
    yield from _thrust_map(c)
    yield from _thrust_of_speed(c)
    yield from _hover_command(c)


def _thrust_to_weight(c: Craft) -> Iterator[Implausible]:
    ratio = float(c.lift[-1]) / c.weight
    if ratio < 1 or ratio > 40:
        top = c.vehicle.actuator.speed_max or 0.0
        rpm = 60.0 / math.tau * top
        per_speed = {
            top**2: "newton per (rad/s)^2, to be multiplied by speed_max^2",
            rpm**2: "newton per rpm^2, to be multiplied by the square of the rpm at u_max",
        }
        slip = _slip(ratio, 1.3, 12, FORCE_UNITS | per_speed)
        fix = (
            f"looks like {slip}: give the thrust of one rotor in N"
            if slip
            else "give the thrust of one rotor in N, the mass in kg"
        )
        yield Implausible(
            "blocking",
            "actuator.thrust",
            "cannot take off" if ratio < 1 else "too strong for any motor",
            "a thrust-to-weight ratio of 1.3 to 12",
            f"{ratio:.3g}",
            fix,
        )
    elif ratio < 1.3 or ratio > 12:
        yield Implausible(
            "warning",
            "actuator.thrust",
            "unusual thrust",
            "a thrust-to-weight ratio of 1.3 to 12",
            f"{ratio:.3g}",
            "give the thrust of one rotor at u_max in N",
        )


def _thrust_of_speed(c: Craft) -> Iterator[Implausible]:
    act = c.vehicle.actuator
    if act.speed_max and act.thrust[1].value and not act.thrust[2].value:
        yield Implausible(
            "warning",
            "actuator.thrust",
            "in proportion to the command, which speed_max takes for rotor speed",
            "thrust that grows with the square of rotor speed",
            "c2 = 0",
            "log the square root of a command that is a share of thrust, or leave speed_max out",
        )


def _thrust_map(c: Craft) -> Iterator[Implausible]:
    rise = np.diff(c.rotor)
    if (rise < 0).any():
        at = float(c.u[int(np.argmin(rise))])
        severity: Severity = "blocking" if c.hover is not None and at > 0.5 * c.hover else "warning"
        yield Implausible(
            severity,
            "actuator.thrust",
            "the thrust map falls",
            f"rising from u_min to u_max ({c.u[0]:g} to {c.u[-1]:g})",
            f"falling near {at:.2g}",
            "check the order c0, c1, c2 and the signs",
        )
    if c.rotor.min() < -0.05 * abs(c.rotor[-1]):
        yield Implausible(
            "warning",
            "actuator.thrust",
            "negative thrust inside the command range",
            "0 N or more",
            f"{c.rotor.min():.3g} N",
            "raise u_min or c0",
        )


def _hover_command(c: Craft) -> Iterator[Implausible]:
    if c.hover is None and float(c.lift[-1]) / c.weight >= 1:
        yield Implausible(
            "blocking",
            "actuator",
            "flies up at u_min: it cannot hover",
            f"less than {c.weight:.3g} N at u_min",
            f"{c.lift[0]:.3g} N",
            "check c0 and u_min",
        )
    if c.hover is not None:
        share = float(c.share_of(c.hover))
        if not HOVER_RANGE[0] <= share <= HOVER_RANGE[1]:
            yield Implausible(
                "warning",
                "actuator",
                "hovers close to a limit of the command",
                "15 to 85 % of the command range",
                f"{100 * share:.0f} % (u = {c.hover:.3g})",
                "check the thrust map; fly with margins",
            )


def rotors(c: Craft) -> Iterator[Implausible]:
    """Torque over thrust, tip speed and thrust coefficient."""
    radius, speed = c.vehicle.actuator.rotor_radius, c.vehicle.actuator.speed_max
    if c.lever is not None and c.lever != 0.0:
        low, high = (0.05 * radius, 0.6 * radius) if radius else (0.02 * c.L, 0.35 * c.L)
        if c.lever < 0:
            yield Implausible(
                "blocking",
                "actuator.torque",
                "negative: the sign belongs to spin",
                "a positive torque",
                f"{c.lever:.3g} m per N",
                "write magnitudes and set spin to 1 or -1",
            )
        elif not low <= c.lever <= high:
            yield Implausible(
                "warning",
                "actuator.torque",
                "unusual torque over thrust",
                f"{low:.2g} to {high:.2g} m",
                f"{c.lever:.3g} m",
                "give N m per rotor; about a quarter of the rotor radius times the thrust",
            )
    if radius is not None and c.tip is not None and speed is not None:
        if not 15 <= c.tip <= 250:
            slip = _slip(
                c.tip,
                25,
                220,
                {
                    2 * math.pi / 60: "rpm instead of rad/s",
                    2 * math.pi: "revolutions per second",
                    1e-3: "millimetres in rotor_radius",
                },
            )
            yield Implausible(
                "blocking" if c.tip > 340 else "warning",
                "actuator.speed_max",
                "unusual blade tip speed",
                "15 to 250 m/s",
                f"{c.tip:.3g} m/s",
                f"looks like {slip}" if slip else "give rad/s at full command and the radius in m",
            )
        elif c.coefficient is not None and not 0.002 <= c.coefficient <= 0.06:
            yield Implausible(
                "warning",
                "actuator.thrust",
                "thrust does not fit rotor radius and speed",
                "T / (rho A (Omega R)^2) of 0.002 to 0.06",
                f"{c.coefficient:.2g}",
                "check speed_max (rad/s at u_max), rotor_radius and thrust",
            )
    elif speed is not None and speed > 8000:
        yield Implausible(
            "warning",
            "actuator.speed_max",
            "faster than small rotors turn",
            "300 to 5000 rad/s",
            f"{speed:g}",
            "rad/s = rpm / 9.55",
        )


def points(c: Craft) -> Iterator[Implausible]:
    """Centre of mass and IMU position."""
    for key, place, reach in (
        ("center_of_mass", [q.value for q in c.vehicle.center_of_mass], 0.3),
        ("imu_position", c.vehicle.imu_position, 1.5),
    ):
        away = float(np.linalg.norm(place))
        if away > reach * c.L:
            slip = _slip(away, 0.0, reach * c.L, LENGTH_UNITS)
            yield Implausible(
                "blocking" if away > 5 * c.L else "warning",
                key,
                "far from the body origin",
                f"within {reach * c.L:.3g} m",
                f"{away:.3g} m",
                f"looks like {slip}"
                if slip and away > 5 * c.L
                else "measure from the point that the rotor positions start from",
            )


def _bad_effects(vehicle: Vehicle) -> Iterator[Implausible]:
    """Effects with parameters that they cannot have."""
    for name, given in vehicle.effects.items():
        declared = {d.name: d for d in effect_by_name(name).parameters(vehicle)}
        for short, q in given.items():
            d = declared.get(short)
            if d is None or d.lower <= q.value <= d.upper:
                continue
            slow = d.unit == "s" and d.lower <= 1e-3 * q.value <= d.upper
            yield Implausible(
                "blocking",
                f"effects.{name}.{short}",
                "outside of what it may be",
                f"{d.lower:g} to {d.upper:g} {d.unit}",
                f"{q.value:g}",
                "looks like milliseconds: give seconds" if slow else "check sign and unit",
            )


def lags(c: Craft) -> Iterator[Implausible]:
    """The effects' findings; a time constant that no motor of this size has."""
    bad = list(_bad_effects(c.vehicle))
    yield from bad
    tau = c.vehicle.effects.get("motor_lag", {}).get("tau")
    if tau is not None and not bad and not 0.005 <= tau.value <= 0.2:
        yield Implausible(
            "warning",
            "effects.motor_lag.tau",
            "unusual motor time constant",
            "0.01 to 0.15 s",
            f"{tau.value:g} s",
            "give the time to 63 % of a step, in seconds",
        )


def sigmas(c: Craft) -> Iterator[Implausible]:
    """Whether the numbers say how sure they are."""
    quantities = c.vehicle.quantities
    free = [n for n, q in quantities.items() if not q.exact]
    if not free:
        yield Implausible(
            "warning",
            "sigma",
            "every number is exact: a fit will move none of them",
            "a sigma where a number was not measured well",
            "none",
            "write { value = ..., sigma = ... }, inertia_sigma, thrust_sigma, torque_sigma",
        )
        return
    silent = [g for g in ("inertia", "thrust", "torque") if not any(n.startswith(g) for n in free)]
    if silent:
        yield Implausible(
            "info",
            "sigma",
            f"{', '.join(silent)} held exactly",
            "a sigma unless measured to a per cent",
            "none",
            f"add {silent[0]}_sigma",
        )
    for n in free:
        q = quantities[n]
        if n.startswith(("mass", "inertia")) and q.sigma > 0.5 * abs(q.value):
            yield Implausible(
                "warning",
                n,
                "a sigma of more than half the value",
                f"below {0.5 * abs(q.value):.3g}",
                f"{q.sigma:.3g}",
                "measure it, or give sigma in the value's unit",
            )


def noise(c: Craft) -> Iterator[Implausible]:
    """Sensor noise of another unit."""
    limits = {s.name: (s.noisiest, s.noisiest_hint) for s in SENSORS} | {
        "voltage": (1.0, "V, not mV")
    }
    for key, level in c.vehicle.noise.items():
        top, unit = limits.get(key, (math.inf, ""))
        if level > top:
            yield Implausible(
                "warning",
                f"noise.{key}",
                "more noise than such a sensor has",
                f"below {top:g}",
                f"{level:g}",
                f"give {unit}",
            )
    if not c.vehicle.noise:
        yield Implausible(
            "info",
            "noise",
            "no sensor noise stated: fits start from typical values",
            "one sigma per sensor",
            "none",
            "add [noise]",
        )
    voltage = c.vehicle.nominal_voltage
    if voltage is not None and not 2.5 <= voltage <= 60:
        yield Implausible(
            "warning",
            "battery.nominal_voltage",
            "no pack of a small craft",
            "3 to 60 V",
            f"{voltage:g} V",
            "give volts, not millivolts",
        )
