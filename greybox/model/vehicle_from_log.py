"""A vehicle file from what a log knows: motor order, spins, arms where they are parameters, the
command in hover.

Facts of the firmware, body axes forward, left, up:
- PX4: CA_ROTORi_PX, PY, PZ and the sign of KM (docs.px4.io, parameter reference); without them the
geometry of the airframe
  SYS_AUTOSTART (docs.px4.io, airframe reference: quadrotor x 4001 to 4999, quadrotor + 5001).
- Betaflight, quad X: 1 rear right, 2 front right, 3 rear left, 4 front left; front right turns
counter-clockwise with props
  in, clockwise with yaw_motors_reversed (betaflight.com, guide "Reversed motor direction"). Logs do
  not hold that setting, so that it is taken from how the yaw rate answers the commands.
- Crazyflie: m1 front right counter-clockwise, m2 rear right, m3 rear left, m4 front left in turn
(bitcraze.io, the
  Crazyflie 2.x assembly and coordinate system pages).
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from greybox.data.inspection import inspect_log
from greybox.data.raw import FloatArray, RawLog
from greybox.data.readers.px4 import idle_of, motor_signal
from greybox.data.readers.recording import Recording
from greybox.errors import DataError
from greybox.files import Parsed
from greybox.frames import GRAVITY
from greybox.model.vehicle import Vehicle
from greybox.model.vehicle_template import vehicle_text, written

Place = tuple[tuple[float, float, float], int]

SLOPE = 0.5**0.5
QUAD_X: Mapping[str, tuple[Place, ...]] = {
    "px4": tuple(
        ((x, y, 0.0), s) for x, y, s in ((1, -1, 1), (-1, 1, 1), (1, 1, -1), (-1, -1, -1))
    ),
    "betaflight": tuple(
        ((x, y, 0.0), s) for x, y, s in ((-1, -1, -1), (1, -1, 1), (-1, 1, 1), (1, 1, -1))
    ),
}
"""Places (to be scaled by arm / sqrt 2) and spins of the motors in the firmware's order."""
QUAD_PLUS: tuple[Place, ...] = (
    ((0.0, -1.0, 0.0), 1),
    ((0.0, 1.0, 0.0), 1),
    ((1.0, 0.0, 0.0), -1),
    ((-1.0, 0.0, 0.0), -1),
)
"""PX4's quadrotor +: right, left, front, rear."""

DENSITY = 250.0
"""Mass over the cube of the arm [kg/m^3] of the templates' craft (277 Crazyflie, 385 racer, 256
quadrotor in X)."""
GUESS = 0.5
"""Relative sigma of a mass, and of what follows from it, that nobody weighed."""
ARM = 0.11
"""Arm [m] where neither log nor user knows it: a 5 inch racer."""
TURNING = 0.1
"""Correlation of yaw acceleration and yaw command from which the sense of the motors is taken as
seen."""
FEW = 100
"""Rows in flight below which commands and sensors are not asked."""
LEAST = 0.15
"""Mean command below which nothing flies: idle, or a craft that `greybox vehicle check` warns
of."""
SMOOTH = 0.01
"""Seconds over which yaw rate and commands are averaged before they are compared, against noise and
vibration."""
QUADROTOR = 2.0
"""MAV_TYPE of a quadrotor (MAVLink)."""


@dataclass(frozen=True, kw_only=True)
class FromLog:
    """Text of a vehicle file, what of it the log knew, and what a person must still measure."""

    text: str
    known: tuple[str, ...]
    to_measure: tuple[str, ...]


def vehicle_from_log(path: str | os.PathLike[str], changes: Parsed | None = None) -> FromLog:
    """A vehicle file for the craft that wrote this log; `changes` are those of `vehicle_text`
    (mass, arm, hover, ...).

    Raises `DataError` for a log whose layout cannot be known, `VehicleError` for changes that do
    not fit.
    """
    where, given = os.fspath(path), dict(changes or {})
    found = inspect_log(path)
    known: list[str] = []
    measure: list[str] = []
    hover = _hover(found.raw, found.recording, known)
    if hover is None and "hover" not in given:
        measure.append("hover: command that carries the weight, 0 to 1 (--set hover=0.45)")
    elif hover is not None:
        given.setdefault("hover", hover)
    if found.format.name == "crazyflie":
        known.append("layout: Crazyflie in X, m1 front right")
        if "mass" not in given:
            measure.append("mass: weigh it with battery and decks (--set mass=0.032)")
        text = vehicle_text("crazyflie", given)
        if "mass" not in given:
            text = written(
                text, "mass", {"value": 0.027, "sigma": 0.003}, "kg, GUESSED: no deck; weigh yours"
            )
        return FromLog(text=text, known=tuple(known), to_measure=tuple(measure))
    places, arm = _layout(found.format.name, found.recording, found.raw, known, where)
    if arm is None:
        arm = float(given.get("arm", ARM))
        places = tuple(((x * arm, y * arm, z), s) for (x, y, z), s in places)
    elif "arm" in given:
        places = tuple((_scaled(p, float(given["arm"]) / arm), s) for p, s in places)
        arm = float(given["arm"])
    else:
        known.append(f"arms: {arm:.3g} m as the firmware's parameters say; check with a ruler")
    if "arm" not in given and not found.recording.rotors:
        measure.append("arm: from the centre to a motor axis, in m (--set arm=0.11)")
    mass = float(given.get("mass", float(f"{DENSITY * arm**3:.2g}")))
    voltage = _voltage(found.raw)
    if voltage is not None:
        given.setdefault("battery.nominal_voltage", voltage)
    settings = {"name": "from a log", **given, "mass": mass, "arm": arm}
    text = vehicle_text("x", settings)
    text = _with_rotors(text, places)
    if len(places) != 4:
        text = _shared(text, 4 / len(places))
    if "mass" not in given:
        text = _guessed(text)
        measure.append("mass: weigh it ready to fly, in kg (--set mass=0.6)")
    Vehicle.from_dict(tomllib.loads(text), where=f"vehicle of {where}")
    return FromLog(text=text, known=tuple(known), to_measure=tuple(measure))


def _scaled(place: tuple[float, float, float], factor: float) -> tuple[float, float, float]:
    x, y, z = place
    return x * factor, y * factor, z * factor


def _layout(
    form: str, recording: Recording, raw: RawLog | None, known: list[str], where: str
) -> tuple[tuple[Place, ...], float | None]:
    """(places and spins, arm), or places for an arm of 1 m and None. Raises `DataError`."""
    if recording.rotors:
        known.append(
            f"motor order, places and spins of {len(recording.rotors)} rotors: CA_ROTOR parameters"
        )
        return recording.rotors, max(float(np.hypot(p[0], p[1])) for p, _ in recording.rotors)
    told = recording.parameters
    start = int(told.get("SYS_AUTOSTART", 0.0))
    if form == "ulog" and told.get("MAV_TYPE") == QUADROTOR:
        plus = 5000 <= start < 6000
        known.append(
            f"motor order: PX4 quadrotor {'+' if plus else 'x'} (SYS_AUTOSTART = {start}, MAV_TYPE "
            "= 2)"
        )
        return QUAD_PLUS if plus else _unit(QUAD_X["px4"]), None
    if form == "betaflight" and raw is not None and _motors(raw) == 4:
        places = _unit(QUAD_X["betaflight"])
        seen = _yaw_answer(raw, [s for _, s in places])
        if seen is None or abs(seen) < TURNING:
            known.append(
                "motor order: Betaflight quad X; spins: props in ASSUMED (yaw says too little), "
                "look at the craft"
            )
        else:
            known.append(
                f"motor order: Betaflight quad X; spins: props {'in' if seen > 0 else 'out'}, as "
                "yaw answers"
            )
            places = tuple((p, s if seen > 0 else -s) for p, s in places)
        return places, None
    raise DataError(
        "the log does not say where the motors are",
        where=where,
        expected="PX4 with CA_ROTOR parameters or MAV_TYPE 2, a Betaflight quad, a Crazyflie",
        fix="greybox vehicle new --template x, then order the rotors as the commands",
    )


def _unit(places: tuple[Place, ...]) -> tuple[Place, ...]:
    return tuple((_scaled(p, SLOPE), s) for p, s in places)


def _motors(raw: RawLog) -> int:
    return sum(1 for name in raw.channels if name[0] == "u" and name[1:].isdigit())


def _commands(raw: RawLog) -> FloatArray:
    return np.column_stack([raw.channels[f"u{i + 1}"] for i in range(_motors(raw))])


def _flying(raw: RawLog) -> np.ndarray | None:
    """Rows in which the motors run well above idle; None where there are hardly any."""
    if _motors(raw) == 0:
        return None
    mean = _commands(raw).mean(axis=1)
    if not np.isfinite(mean).any():
        return None
    rows = np.isfinite(mean) & (mean > max(LEAST, 0.5 * float(np.nanpercentile(mean, 90))))
    return rows if rows.sum() > FEW and float(np.nanstd(mean)) > 1e-3 else None


def _yaw_answer(raw: RawLog, spins: list[int]) -> float | None:
    """Correlation of the yaw acceleration with the yaw command of these spins (positive: they are
    the true ones)."""
    rows = _flying(raw)
    if rows is None or "r" not in raw.channels:
        return None
    squares = _commands(raw) ** 2
    wanted = -(
        squares @ np.array(spins, dtype=np.float64)
    )  # a rotor's drag turns the body against its spin
    width = max(1, round(SMOOTH / max(float(np.median(np.diff(raw.t))), 1e-4)))
    smooth = np.ones(width) / width
    rate = np.diff(np.convolve(np.nan_to_num(raw.channels["r"]), smooth, "same"))
    wanted = np.convolve(np.nan_to_num(wanted), smooth, "same")[1:]
    step = np.diff(raw.t)
    good = rows[1:] & (step > 0)
    if good.sum() < FEW:
        return None
    answer = rate[good] / step[good]
    return (
        float(np.corrcoef(answer, wanted[good])[0, 1])
        if answer.std() > 0 and wanted[good].std() > 0
        else None
    )


def _hover(raw: RawLog | None, recording: Recording, known: list[str]) -> float | None:
    """Command that carries the weight: from flight and accelerometer, else the firmware's own
    estimate."""
    rows = _flying(raw) if raw is not None else None
    if raw is not None and rows is not None and "az" in raw.channels:
        pull = raw.channels["az"]
        rows = rows & np.isfinite(pull) & (pull > 0.3 * GRAVITY)
        if rows.sum() > FEW and abs(float(np.median(pull[rows])) / GRAVITY - 1) < 0.7:
            square = float(
                np.median((_commands(raw)[rows] ** 2).mean(axis=1) * GRAVITY / pull[rows])
            )
            if 0 < square < 1:
                known.append(
                    f"hover command {square**0.5:.2f}: commands and accelerometer of the log"
                )
                return float(f"{square**0.5:.3g}")
    told = recording.parameters.get("MPC_THR_HOVER", 0.0)
    if 0 < told < 1:
        factor = recording.parameters.get("THR_MDL_FAC", 0.0)
        convert = motor_signal(factor if 0 < factor <= 1 else 0.0, idle_of(recording.parameters))
        signal = float(convert(np.array([told]))[0]) if convert else told
        known.append(
            f"hover command {signal:.2f}: MPC_THR_HOVER = {told:g}, THR_MDL_FAC = {factor:g}"
        )
        return float(f"{signal:.3g}")
    return None


def _voltage(raw: RawLog | None) -> float | None:
    if raw is None or "vbat" not in raw.channels:
        return None
    value = float(np.nanmedian(raw.channels["vbat"]))
    return float(f"{value:.3g}") if 2.5 < value < 60 else None


def _with_rotors(text: str, places: tuple[Place, ...]) -> str:
    """The file with other rotors."""
    begin, end = text.index("[[rotor]]"), text.index("[actuator]")
    blocks = []
    for i, ((x, y, z), spin) in enumerate(places):
        ahead = "front" if x > 1e-6 else "rear" if x < -1e-6 else ""
        side = "left" if y > 1e-6 else "right" if y < -1e-6 else ""
        numbers = ", ".join(f"{v:.6g}" if v else "0.0" for v in (x, y, z))
        blocks.append(
            f"[[rotor]]  # motor {i + 1}, {ahead} {side}".rstrip()
            + f"\nposition = [{numbers}]\nspin = {spin}\n"
        )
    return text[:begin] + "".join(blocks) + "\n" + text[end:]


def _shared(text: str, factor: float) -> str:
    """Thrust and torque maps for another number of rotors than four."""
    actuator = tomllib.loads(text)["actuator"]
    for key in ("thrust", "torque"):
        for name in (key, f"{key}_sigma"):
            values = [float(f"{v * factor:.6g}") for v in actuator[name]]
            text = written(text, f"actuator.{name}", values, "shared by the rotors")
    return text


def _guessed(text: str) -> str:
    """Mass and all that follows from it marked as guesses, with wide sigmas."""
    data = tomllib.loads(text)

    def wide(values: list[float]) -> list[float]:
        return [float(f"{GUESS * abs(v):.3g}") for v in values]

    mass = data["mass"]["value"]
    text = written(
        text,
        "mass",
        {"value": mass, "sigma": float(f"{GUESS * mass:.3g}")},
        "kg, GUESSED from the arms: weigh it",
    )
    moments = wide([data["inertia"][i][i] for i in range(3)])
    text = written(text, "inertia_sigma", moments, "GUESSED with the mass")
    for key in ("thrust", "torque"):
        text = written(
            text, f"actuator.{key}_sigma", wide(data["actuator"][key]), "GUESSED with the mass"
        )
    return text
