"""gym-pybullet-drones: the URDF with the properties that its environments read.

(Panerati et al. 2021, Learning to fly, IROS; envs/BaseAviary.py: `_physics`, `_drag`,
`_groundEffect`.) Thrust and torque are squares of the rotor speed in revolutions per minute at the
links prop0 to prop3, the yaw torque has the signs -, +, -, +, drag acts on the centre of mass in
proportion to the sum of the rotor speeds with one coefficient for the horizontal axes of the WORLD,
and the ground effect is the first term of Cheeseman and Bennett's law.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import casadi as ca
import numpy as np

from greybox.errors import ModelError
from greybox.model.effect import Effect
from greybox.model.flow import Flow
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.simulators.change import Change
from greybox.simulators.command_text import command_text, say_commands
from greybox.simulators.craft import Craft
from greybox.simulators.laws import drag_into_rotors
from greybox.simulators.layout import ANY_LAYOUT
from greybox.simulators.words import Word, Wording, fixed_gravity, quadratic_maps
from greybox.symbolic import Expr, FloatArray

PER_MINUTE = 60.0 / (2.0 * math.pi)
GRAVITY = 9.8
"""Of BaseAviary [m/s^2]."""

_XML = """<?xml version="1.0" ?>
<robot name="{name}">
  <!-- Written by greybox twin for gym-pybullet-drones. {order}
       rpm = commands.RPM_MAX * speeds, speeds of commands.Rotors, which carries the lag. -->
  <properties arm="{arm}" kf="{kf}" km="{km}" thrust2weight="{ratio}"
    max_speed_kmh="{fastest}" gnd_eff_coeff="{ground}"
    prop_radius="{radius}" drag_coeff_xy="{drag_xy}" drag_coeff_z="{drag_z}"
    dw_coeff_1="0" dw_coeff_2="1" dw_coeff_3="1" />
  <link name="base_link">
    <inertial>
      <origin rpy="0 0 0" xyz="{com}"/>
      <mass value="{mass}"/>
      <inertia ixx="{xx}" ixy="{xy}" ixz="{xz}" iyy="{yy}" iyz="{yz}" izz="{zz}"/>
    </inertial>
    <visual>
      <origin rpy="0 0 0" xyz="0 0 0"/>
      <geometry><cylinder radius="{body}" length="{height}"/></geometry>
    </visual>
    <collision>
      <origin rpy="0 0 0" xyz="0 0 0"/>
      <geometry><cylinder radius="{body}" length="{height}"/></geometry>
    </collision>
  </link>
{links}
</robot>
"""
_LINK = """  <link name="{name}_link">
    <inertial>
      <origin rpy="0 0 0" xyz="{place}"/>
      <mass value="0"/>
      <inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/>
    </inertial>
  </link>
  <joint name="{name}_joint" type="fixed">
    <parent link="base_link"/>
    <child link="{name}_link"/>
  </joint>"""


class WorldDrag(Effect):
    """F = -sum_i(Omega_i) diag(k_xy, k_xy, k_z) v, in world axes, through the centre of mass."""

    name = "world_rotor_drag"
    stage = "wrench"
    summary = "drag of gym-pybullet-drones"
    formula = "F = -sum_i(Omega_i) diag(k_xy, k_xy, k_z) v, world axes"

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """k_xy, k_z [kg/rad], in the vehicle's own rotor speeds."""
        return tuple(
            Parameter(name=n, unit="kg/rad", nominal=0.0, null=0.0, meaning="drag")
            for n in ("k_xy", "k_z")
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """Force through the centre of mass, body axes."""
        gain: Expr = ca.vertcat(p["k_xy"], p["k_xy"], p["k_z"])
        total: Expr = ca.sum1(flow.rotor_speed)
        force = -total * gain * flow.velocity_world
        return {"force": flow.rotation.T @ force}


class PyBullet:
    """gym-pybullet-drones."""

    name = "pybullet"
    simulator = "gym-pybullet-drones"
    source = "Panerati et al. 2021, IROS; gym_pybullet_drones/envs/BaseAviary.py"

    def words(self, craft: Craft) -> tuple[Word, ...]:
        """Squares of the speed, drag in the world, ground effect to first order."""
        order(craft)
        w = Wording(craft, self.simulator)
        quadratic_maps(w, thrust="kf", torque="km")
        fixed_gravity(w, GRAVITY)
        say_commands(w)
        w.said("motor_lag", "commands.Rotors").said("motor_lag_asymmetry", "commands.Rotors")
        for name in ("center_of_mass_offset", "products_of_inertia", "payload_mass"):
            w.said(name, "in the inertial origin, inertia and mass")
        w.said("rotor_asymmetry", "commands.Rotors scales each rotor's speed")
        _drag(w)
        w.lost("ground_effect", _ground(craft))
        return w.finish()

    def files(self, craft: Craft) -> Mapping[str, str]:
        """NAME.urdf and commands.py."""
        scale, j = craft.speed_max * PER_MINUTE, craft.inertia
        chosen = order(craft)
        places = [craft.hubs[i] for i in chosen] + [craft.center_of_mass]
        names = [*(f"prop{i}" for i in range(4)), "center_of_mass"]
        full = float(craft.thrust[2]) * craft.count / (craft.mass * craft.gravity)
        own = craft.physics.vehicle.omega_scale / craft.speed_max
        arm = float(np.hypot(*craft.hubs[0, :2]))
        text = _XML.format(
            name=craft.name,
            order="prop0 to prop3 are rotors " + ", ".join(str(i + 1) for i in chosen) + ".",
            arm=repr(arm),
            kf=repr(float(craft.thrust[2]) / scale**2),
            km=repr(float(craft.torque[2]) / scale**2),
            ratio=repr(full),
            fastest=repr(3.6 * max(1.0, _fastest(craft))),
            ground="0",
            radius=repr(craft.rotor_radius or 0.25 * arm),
            drag_xy=repr(craft.get("world_rotor_drag.k_xy") * own),
            drag_z=repr(craft.get("world_rotor_drag.k_z") * own),
            com=_text(craft.center_of_mass),
            mass=repr(craft.mass),
            **{k: repr(float(j[a, b])) for k, (a, b) in _MOMENTS.items()},
            body=repr(arm),
            height=repr(0.3 * arm),
            links="\n".join(
                _LINK.format(name=n, place=_text(p)) for n, p in zip(names, places, strict=True)
            ),
        )
        return {f"{craft.name}.urdf": text, "commands.py": command_text(craft)}


_MOMENTS = {"xx": (0, 0), "yy": (1, 1), "zz": (2, 2), "xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}


def order(craft: Craft) -> tuple[int, ...]:
    """Rotors (from 0) at prop0 to prop3, whose torques on the body have the signs -, +, -, +.

    Any hubs will do, as thrust acts at the links. Raises `ModelError` for another number of rotors
    or of spins.
    """
    left = [i for i in range(craft.count) if craft.spins[i] > 0]
    right = [i for i in range(craft.count) if craft.spins[i] < 0]
    if len(left) != 2 or len(right) != 2:
        raise ModelError(
            "gym-pybullet-drones has four rotors, two of each spin",
            got=f"{len(left)} counter-clockwise and {len(right)} clockwise",
            fix=ANY_LAYOUT,
        )
    return left[0], right[0], left[1], right[1]


def _drag(wording: Wording) -> None:
    drag_into_rotors(wording)
    craft = wording.craft
    there = tuple(n for n in ("rotor_drag", "axial_inflow") if n in craft.effects)
    values = {
        "world_rotor_drag.k_xy": 0.5 * (craft.get("rotor_drag.k_x") + craft.get("rotor_drag.k_y")),
        "world_rotor_drag.k_z": craft.get("axial_inflow.k_z"),
    }
    whole = Change(without=there, instead=(WorldDrag(),), values=values)
    how = "drag_coeff_xy, drag_coeff_z: on the body, in world axes, without wind"
    for i, name in enumerate(there):
        same = f"{how}; in the row of {there[0]}"
        wording.folded(name, how if i == 0 else same, whole if i == 0 else Change())


def _ground(craft: Craft) -> str:
    k = craft.get("ground_effect.k")
    return f"off as written; gnd_eff_coeff = {k:.3g} is its first term in R/4z"


def _fastest(craft: Craft) -> float:
    boxes = [craft.domain.get(f"v{a}", (0.0, 0.0)) for a in "xyz"]
    return math.sqrt(sum(max(a * a, b * b) for a, b in boxes))


def _text(values: FloatArray) -> str:
    return " ".join(repr(float(v)) for v in values)
