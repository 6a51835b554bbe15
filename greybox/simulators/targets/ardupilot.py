"""ArduPilot: the JSON of a frame for its SITL, and the parameters of the motors.

SITL's frame has thrust c1 u + c2 u^2 (hoverThrOut, propExpo) times the square of the battery's
share of maxVoltage, at once; a yaw torque of thrust times u; drag of the rotors in proportion to
the square root of their thrust, equal along all axes (mdrag_coef); one drag |v| v of the body
against the airspeed (refSpd, refAngle), axis by axis; one damping of the angular acceleration
(refRotRate); and no gyroscopic moment of the turning body. Axes are FRD, motors stand about the
centre of mass (ArduPilot, libraries/SITL/SIM_Frame.cpp, SIM_Motor.cpp).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping

import casadi as ca
import numpy as np

from greybox.errors import ModelError
from greybox.frames import GRAVITY
from greybox.model.effect import Effect
from greybox.model.effects import effect_by_name
from greybox.model.flow import Flow
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.simulators.change import Change
from greybox.simulators.craft import Craft
from greybox.simulators.laws import drag_into_rotors, no_gyroscopic_moment
from greybox.simulators.layout import Place, order_in
from greybox.simulators.words import (
    THRUST_MAP,
    TORQUE_MAP,
    Status,
    Word,
    Wording,
    fixed_gravity,
)
from greybox.symbolic import Expr

DENSITY, ALTITUDE, TEMPERATURE = 1.225, 0.0, 15.0
"""Air of the reference test [kg/m^3, m, deg C]: thrust is as written at sea level."""
OUTFLOW = 100.0
"""Air velocity behind the rotors at hover [m/s] that the reference power says: so fast that
climbing costs no thrust (a ten thousandth per (m/s)^2), which would come on top of mdrag_coef."""
REFERENCE_SPEED = 10.0
YAW_SCALE = 0.05
DAMPING = math.radians(400.0)
"""SITL: yaw torque over diagonal_size, and damping times refRotRate."""
X: tuple[Place, ...] = ((1, -1, 1), (-1, 1, 1), (1, 1, -1), (-1, -1, -1))
PLUS: tuple[Place, ...] = ((0, -1, 1), (0, 1, 1), (1, 0, -1), (-1, 0, -1))
FRAMES: Mapping[str, tuple[Place, ...]] = {"x": X, "+": PLUS}
"""Frames by the name that `--model` takes; motors 1 to 4."""


class AxisDrag(Effect):
    """F_j = -c v_a,j |v_a,j| through the centre of mass."""

    name = "axis_drag"
    stage = "wrench"
    summary = "drag of SITL, axis by axis"
    formula = "F_j = -c v_a,j |v_a,j|"

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """c [N s^2/m^2]."""
        return (
            Parameter(
                name="c", unit="N s^2/m^2", nominal=0.0, null=0.0, meaning="drag coefficient"
            ),
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """Force through the centre of mass."""
        air = flow.velocity - flow.wind
        return {"force": -p["c"] * air * ca.fabs(air)}


def frame_of(craft: Craft) -> tuple[str, tuple[int, ...]]:
    """(frame, which of the craft's rotors each motor is). Raises `ModelError` for other layouts."""
    first: ModelError | None = None
    for name, places in FRAMES.items():
        try:
            return name, order_in(craft, places, "ArduPilot SITL", arms=False)
        except ModelError as error:
            first = first or error
    assert first is not None
    raise first


class ArduPilot:
    """ArduPilot's SITL."""

    name = "ardupilot"
    simulator = "ArduPilot SITL"
    source = "ArduPilot, libraries/SITL/SIM_Frame.cpp and SIM_Motor.cpp"

    def words(self, craft: Craft) -> tuple[Word, ...]:
        """Thrust of second degree in the command, one drag, no lag."""
        frame_of(craft)
        w = Wording(craft, self.simulator)
        self._maps(w)
        fixed_gravity(w, GRAVITY)
        w.folded(
            "battery_sag",
            "thrust goes with (SIM_BATT_VOLTAGE / maxVoltage)^2",
            Change(values={"battery_sag.c_V": 1.0}),
        )
        w.folded(
            "thrust_curve",
            "propExpo: see the thrust map",
            Change(without=("thrust_curve",)),
        )
        w.said("center_of_mass_offset", "motorN_position").said("payload_mass", "mass")
        drag_into_rotors(w)
        craft = w.craft
        drag = _hub_drag(craft)
        there = [n for n in ("rotor_drag", "axial_inflow") if n in craft.effects]
        values = {f"rotor_drag.k_{a}": drag for a in "xy"} | {"axial_inflow.k_z": drag}
        missing = tuple(
            effect_by_name(n)
            for n in ("rotor_drag", "axial_inflow")
            if n not in {e.name for e in craft.physics.effects}
        )
        for i, name in enumerate(there):
            how = "one mdrag_coef for all axes, the mean of x and y"
            change = Change(values=values, instead=missing) if i == 0 else Change()
            w.folded(name, how, change)
        mean = float(craft.vector("parasitic_drag.c_").mean())
        w.folded(
            "parasitic_drag",
            "refSpd, refAngle: one coefficient, |v| v of each axis by itself",
            Change(
                without=("parasitic_drag",),
                instead=(AxisDrag(),),
                values={"axis_drag.c": mean},
            ),
        )
        rate = _damping(craft)
        w.folded(
            "rotational_damping",
            "refRotRate: one angular acceleration per rad/s for all axes",
            Change(
                values={
                    f"rotational_damping.d_{a}": rate * float(craft.inertia[i, i])
                    for i, a in enumerate("pqr")
                }
            ),
        )
        wind = "SIM_WIND_SPD, SIM_WIND_DIR, SIM_WIND_DIR_Z, with SIM_WIND_T 1 at any height"
        w.said("steady_wind", f"{wind}; SITL has no wind in its first 5 s")
        w.lost("motor_lag", "motors follow at once; slew_max is a limit of their rate")
        w.lost("products_of_inertia", "moment_inertia has three numbers")
        no_gyroscopic_moment(w, "SITL divides torque by moment of inertia")
        return w.finish()

    def _maps(self, w: Wording) -> None:
        craft = w.craft
        c1, c2 = thrust_of_command(craft)
        how = "hoverThrOut, propExpo, at sea level; SITL scales thrust with the air density at "
        how += "the craft's altitude, home's included"
        values = {"thrust.c0": 0.0, "thrust.c1": c1, "thrust.c2": c2}
        if craft.thrust[0] or "thrust_curve" in craft.effects:
            how += "; value and slope at hover"
            change = Change(values=values)
            w.add(Word(effect=THRUST_MAP, status=Status.FOLDED, how=how, change=change))
        else:
            w.add(Word(effect=THRUST_MAP, status=Status.SAID, how=how))
        q0, q1, q2 = torque_of_command(craft)
        how = "motorN_yaw: thrust times the command; equal at hover"
        change = Change(values={"torque.c0": q0, "torque.c1": q1, "torque.c2": q2})
        w.add(Word(effect=TORQUE_MAP, status=Status.FOLDED, how=how, change=change))

    def files(self, craft: Craft) -> Mapping[str, str]:
        """frame.json (`sim_vehicle.py --model x:frame.json`) and motors.parm."""
        name, order = frame_of(craft)
        return {"frame.json": _frame(craft, order), "motors.parm": _motors(craft, name)}


def thrust_of_command(craft: Craft) -> tuple[float, float]:
    """c1, c2 [N] of the thrust c1 u + c2 u^2 of one rotor that has the craft's value and slope at
    the command of hover."""
    f = craft.get("thrust_curve.f")
    if craft.thrust[0] == 0.0 and f == 0.0:
        return float(craft.thrust[1]), float(craft.thrust[2])
    u, nu = craft.hover_command, craft.hover_nu
    weight = craft.mass * craft.gravity / craft.count
    slope = float(craft.thrust[1] + 2.0 * craft.thrust[2] * nu) * (1.0 - f + 2.0 * f * u)
    return 2.0 * weight / u - slope, (slope - weight / u) / u


def torque_of_command(craft: Craft) -> tuple[float, float, float]:
    """Torque c0, c1, c2 [N m] of SITL's k u (c1 u + c2 u^2), equal to the craft's at hover: the
    expansion to second degree about the command of hover."""
    c1, c2 = thrust_of_command(craft)
    u, nu = craft.hover_command, craft.hover_nu
    q0, q1, q2 = craft.torque
    k = float(q0 + nu * (q1 + nu * q2)) / (u * (c1 * u + c2 * u * u))
    # u^3 about u0: 3 u0 u^2 - 3 u0^2 u + u0^3
    return k * c2 * u**3, -3.0 * k * c2 * u * u, k * (c1 + 3.0 * c2 * u)


def _hub_drag(craft: Craft) -> float:
    """One coefficient of rotor drag, in the units of the vehicle's own rotor speeds."""
    x, y = craft.get("rotor_drag.k_x"), craft.get("rotor_drag.k_y")
    return 0.5 * (x + y) if "rotor_drag" in craft.effects else craft.get("axial_inflow.k_z")


def _damping(craft: Craft) -> float:
    """Mean of the angular deceleration per rate [1/s]."""
    d = craft.vector("rotational_damping.d_", "pqr")
    return float((d / np.diag(craft.inertia)).mean())


def _frame(craft: Craft, order: tuple[int, ...]) -> str:
    n, weight = craft.count, craft.mass * GRAVITY
    c1, c2 = float(craft.thrust[1]), float(craft.thrust[2])
    full, u = c1 + c2, craft.hover_command
    size = 2.0 * float(np.linalg.norm(craft.arms[:, :2], axis=1).mean())
    torque = float(sum(c * u**k for k, c in enumerate(craft.torque)))
    yaw = torque / (YAW_SCALE * size * u * weight / n)
    # drag of one rotor per airspeed over the square root of its thrust
    hub = craft.per_speed("rotor_drag.k_x") * craft.speed_max * u / math.sqrt(weight / n)
    area = n * math.pi * (craft.rotor_radius or 0.25 * size) ** 2
    momentum = hub / math.sqrt(DENSITY * area / n)
    angle, speed = _reference_test(craft, momentum, area)
    power = 0.5 * weight * OUTFLOW
    volt = craft.nominal_voltage or 12.6
    turning = _damping(craft)
    frame: dict[str, object] = {
        "mass": craft.mass,
        "diagonal_size": size,
        "refSpd": speed,
        "refAngle": angle,
        "refVoltage": volt,
        "refCurrent": power / volt,
        "refAlt": ALTITUDE,
        "refTempC": TEMPERATURE,
        "refBatRes": 0.0,
        "maxVoltage": volt,
        "battCapacityAh": 0,
        "propExpo": c2 / full,
        "refRotRate": DAMPING / turning if turning > 0 else 0,
        "hoverThrOut": weight / n / full,
        "pwmMin": 1000,
        "pwmMax": 2000,
        "spin_min": 0,
        "spin_max": 1,
        "slew_max": 0,
        "disc_area": area,
        "mdrag_coef": momentum,
        "moment_inertia": [float(v) for v in np.diag(craft.inertia)],
        "num_motors": n,
    }
    for i, k in enumerate(order, 1):
        x, y, z = (float(v) for v in craft.arms[k])
        frame[f"motor{i}_position"] = [x, -y, -z]
        frame[f"motor{i}_yaw"] = yaw * float(craft.spins[k])
    return json.dumps(frame, indent=1) + "\n"


def _reference_test(craft: Craft, momentum: float, area: float) -> tuple[float, float]:
    """(refAngle [deg], refSpd [m/s]): the tilt at which the weight balances all drag at that speed,
    from which SITL takes the drag of the body."""
    weight, v = craft.mass * GRAVITY, REFERENCE_SPEED
    body = craft.get("axis_drag.c") * v * v

    def rest(a: float) -> float:
        rotors = momentum * v * math.cos(a) ** 1.5 * math.sqrt(weight * DENSITY * area)
        return weight * math.tan(a) - rotors - body

    low, high = 0.0, 0.5 * math.pi - 1e-9
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if rest(middle) < 0.0 else (low, middle)
    return math.degrees(high), v


def _motors(craft: Craft, frame: str) -> str:
    c1, c2 = float(craft.thrust[1]), float(craft.thrust[2])
    rows = {
        "FRAME_CLASS": 1,
        "FRAME_TYPE": {"+": 0, "x": 1}[frame],
        "MOT_THST_EXPO": c2 / (c1 + c2),
        "MOT_THST_HOVER": craft.mass * GRAVITY / craft.count / (c1 + c2),
        "MOT_SPIN_MIN": 0.0,
        "MOT_SPIN_MAX": 1.0,
        "MOT_PWM_MIN": 1000,
        "MOT_PWM_MAX": 2000,
    }
    wind = craft.vector("steady_wind.w_")
    if wind.any():  # it blows from there; north is our y
        rows["SIM_WIND_T"] = 1  # without it wind grows with the root of the height up to 60 m
        rows["SIM_WIND_SPD"] = float(np.linalg.norm(wind))
        rows["SIM_WIND_DIR"] = math.degrees(math.atan2(-wind[0], -wind[1])) % 360.0
        rows["SIM_WIND_DIR_Z"] = math.degrees(math.atan2(wind[2], math.hypot(wind[0], wind[1])))
    head = f"# Motors of {craft.name}, written by greybox twin; frame {frame}"
    return "\n".join([head, *(f"{k},{v!r}" for k, v in rows.items())]) + "\n"
