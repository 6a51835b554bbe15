"""FlightGoggles: the parameter file of its multicopter, for rosparam.

Thrust and torque are coefficients times the square of each rotor's speed, one arm for roll and
pitch, one lag, three moments of inertia and no gyroscopic moment. Drag is an acceleration,
drag_coefficient |v| v in the world, without wind (Guerra et al. 2019, IROS, arXiv:1905.11377;
flightgoggles_uav_dynamics_node.cpp: Uav_Dynamics, Uav_Imu). What flies it there are rates and
thrust; filter and PID of its inner loop are no part of a craft and stay as they ship.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from greybox.errors import ModelError
from greybox.model.effects.parasitic_drag import ParasiticDrag
from greybox.simulators.change import Change
from greybox.simulators.craft import SHORTEST_LAG, Craft
from greybox.simulators.laws import (
    DRAGS,
    drag_at_hover,
    no_gyroscopic_moment,
    typical_speed,
)
from greybox.simulators.layout import ANY_LAYOUT, SYMMETRY, order_in
from greybox.simulators.targets.rotorpy import GRAVITY
from greybox.simulators.words import Word, Wording, fixed_gravity, quadratic_maps, symmetric_arms
from greybox.simulators.yaml_text import yaml_number
from greybox.symbolic import FloatArray

PLACES = ((1, 1, 1), (-1, 1, -1), (-1, -1, 1), (1, -1, -1))
"""Rotors of FlightGoggles: sign of x and y, spin; all spins the other way round are a negative
torque_coefficient."""
_YAML = """# {name} for FlightGoggles, written by greybox twin: rosparam load FILE /uav
# Its rotors 0 to 3 are {order}. Commands are rates and thrust, which its own inner loop makes
# speeds of.
flightgoggles_uav_dynamics:
  init_pose: [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
  ignore_collisions: false
  vehicle_mass: {mass}  # kg
  vehicle_inertia_xx: {xx}  # kg m^2
  vehicle_inertia_yy: {yy}
  vehicle_inertia_zz: {zz}
  max_prop_speed: {high}  # rad/s
  moment_arm: {arm}  # m
  motor_time_constant: {lag}  # s
  thrust_coefficient: {thrust}  # N/(rad/s)^2
  torque_coefficient: {torque}  # N m/(rad/s)^2
  drag_coefficient: {drag}  # 1/m
  angular_process_noise: 0.0
  linear_process_noise: 0.0
  reset_timeout: 0.1
  min_arming_thrust: {arming}  # N
flightgoggles_imu:
  accelerometer_variance: {accelerometer}  # m^2/s^4, every step
  gyroscope_variance: {gyro}  # rad^2/s^2
"""


class FlightGoggles:
    """FlightGoggles' own multicopter."""

    name = "flightgoggles"
    simulator = "FlightGoggles"
    source = "Guerra et al. 2019, IROS; flightgoggles_uav_dynamics_node.cpp"

    def words(self, craft: Craft) -> tuple[Word, ...]:
        """Squares of the speed, one lag, drag that is quadratic. Raises `ModelError` for rotors that
        stand otherwise."""
        _order(craft)
        roll, pitch = (float(a) for a in np.abs(_arms(craft)).mean(axis=0)[::-1])
        if abs(roll - pitch) > SYMMETRY * max(roll, pitch):
            raise ModelError(
                "FlightGoggles has one arm for roll and pitch",
                got=f"{roll:.4g} and {pitch:.4g} m",
                fix=ANY_LAYOUT,
            )
        w = Wording(craft, self.simulator)
        quadratic_maps(w, thrust="thrust_coefficient", torque="torque_coefficient")
        fixed_gravity(w, GRAVITY)
        w.said("motor_lag", "motor_time_constant").folded_lag_mean()
        w.said("payload_mass", "vehicle_mass")
        w.said("command_saturation", "max_prop_speed")
        w.lost("products_of_inertia", "vehicle_inertia has three numbers")
        w.lost("thrust_curve", "its inner loop asks for speeds")
        symmetric_arms(w, "moment_arm")
        no_gyroscopic_moment(w, "torque is divided by moment of inertia")
        _drag(w)
        return w.finish()

    def files(self, craft: Craft) -> Mapping[str, str]:
        """drone.yaml."""
        noise = [craft.noise(names) for names in (("p", "q", "r"), ("ax", "ay", "az"))]
        gyro, accelerometer = (0.0 if s is None else float(np.mean(s**2)) for s in noise)
        (chosen, way), j = _order(craft), np.diag(craft.inertia)
        text = _YAML.format(
            name=craft.name,
            order=", ".join(str(i + 1) for i in chosen),
            mass=yaml_number(craft.mass),
            **{k: yaml_number(float(v)) for k, v in zip(("xx", "yy", "zz"), j, strict=True)},
            high=yaml_number(craft.speed_max * craft.command_range[1]),
            arm=yaml_number(float(np.abs(_arms(craft)).mean())),
            lag=yaml_number(max(craft.get("motor_lag.tau"), SHORTEST_LAG)),
            thrust=yaml_number(float(craft.thrust[2]) / craft.speed_max**2),
            torque=yaml_number(way * float(craft.torque[2]) / craft.speed_max**2),
            drag=yaml_number(craft.get("parasitic_drag.c_x") / craft.mass),
            arming=yaml_number(1.01 * craft.mass * GRAVITY),
            gyro=yaml_number(gyro),
            accelerometer=yaml_number(accelerometer),
        )
        return {"drone.yaml": text}


def _order(craft: Craft) -> tuple[tuple[int, ...], int]:
    """Which of the craft's rotors stands at each place, and the sign of the torque coefficient."""
    at_front = [s for h, s in zip(_arms(craft), craft.spins, strict=True) if h[0] > 0 and h[1] > 0]
    way = -1 if at_front and at_front[0] < 0 else 1
    places = tuple((x, y, way * s) for x, y, s in PLACES)
    return order_in(craft, places, FlightGoggles.simulator), way


def _arms(craft: Craft) -> FloatArray:
    """From the centre of the hubs (n, 2) [m]."""
    hubs = craft.hubs[:, :2]
    return np.asarray(hubs - hubs.mean(axis=0))


def _drag(wording: Wording) -> None:
    """All drags in one, equal to their mean at the typical speed of the training flights."""
    craft = wording.craft
    there = tuple(n for n in DRAGS if n in craft.effects)
    if not there:
        return
    speed = typical_speed(craft)
    level = float(drag_at_hover(craft)[:2].mean()) / speed if speed else 0.0
    whole = Change(
        without=there,
        instead=(ParasiticDrag(),),
        values={f"parasitic_drag.c_{a}": level for a in "xyz"},
    )
    how = f"drag_coefficient |v| v, equal at {speed:.2g} m/s"
    wording.folded(there[0], how, whole)
    for name in there[1:]:
        wording.folded(name, f"{how}, in the row of {there[0]}", Change())
