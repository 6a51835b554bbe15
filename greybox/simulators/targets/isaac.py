"""Isaac Sim with Pegasus: the numbers of its thrust curve and drag as YAML, the body as USD text.

Pegasus has thrust rotor_constant Omega^2 at every rotor at once, yaw torque
rolling_moment_coefficient Omega^2 rot_dir on the body, and a linear drag of the body velocity
(Jacinto et al. 2024, ICUAS; logic/thrusters/quadratic_thrust_curve.py, logic/dynamics).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from greybox.simulators.command_text import command_text, say_commands
from greybox.simulators.craft import Craft
from greybox.simulators.laws import drag_of, fold_drag
from greybox.simulators.principal_axes import principal_axes
from greybox.simulators.sensor_text import coloured_parts
from greybox.simulators.words import Word, Wording, quadratic_maps
from greybox.simulators.yaml_text import yaml_list, yaml_number
from greybox.symbolic import FloatArray

_YAML = """# {name} for Pegasus (Isaac Sim), written by greybox twin.
# config = yaml.safe_load(file); QuadraticThrustCurve(config["thrust_curve"]);
# LinearDrag(config["drag"])
# Rotor speeds: SPEED_MAX * commands.Rotors().speeds(u, dt), which carries delay and lag.
mass: {mass}  # kg
thrust_curve:
  num_rotors: {count}
  rotor_constant: {constants}  # N/(rad/s)^2
  rolling_moment_coefficient: {moments}  # N m/(rad/s)^2
  rot_dir: {directions}  # sign of the torque on the body
  min_rotor_velocity: {low}  # rad/s
  max_rotor_velocity: {high}
drag: {drag}  # N s/m, body axes
imu:
  gyroscope:
    noise_density: {gyro}  # rad/s/sqrt(Hz)
    random_walk: {gyro_walk}  # rad/s after one second, over sqrt(s)
  accelerometer:
    noise_density: {accelerometer}  # m/s^2/sqrt(Hz)
    random_walk: {accelerometer_walk}
"""
_USD = """#usda 1.0
(
    defaultPrim = "{name}"
    metersPerUnit = 1
    upAxis = "Z"
)
def Xform "{name}" (prepend apiSchemas = ["PhysicsArticulationRootAPI"])
{{
    def Xform "body" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"])
    {{
        float physics:mass = {mass}
        point3f physics:centerOfMass = ({com})
        float3 physics:diagonalInertia = ({moments})
        quatf physics:principalAxes = ({axes})
        def Cylinder "hull"
        {{
            double radius = {arm}
            double height = {height}
        }}
{rotors}
    }}
}}
"""
_ROTOR = """        def Xform "rotor{i}"
        {{
            double3 xformOp:translate = ({place})
            uniform token[] xformOpOrder = ["xformOp:translate"]
        }}"""


class Isaac:
    """Pegasus on Isaac Sim."""

    name = "isaac"
    simulator = "Isaac Sim (Pegasus)"
    source = "PegasusSimulator, logic/thrusters/quadratic_thrust_curve.py, logic/dynamics"

    def words(self, craft: Craft) -> tuple[Word, ...]:
        """A thrust curve per rotor and linear drag."""
        w = Wording(craft, self.simulator)
        quadratic_maps(w, thrust="rotor_constant", torque="rolling_moment_coefficient")
        say_commands(w)
        w.said("motor_lag", "commands.Rotors").said("motor_lag_asymmetry", "commands.Rotors")
        w.said("rotor_asymmetry", "commands.Rotors scales each rotor's speed")
        for name in ("center_of_mass_offset", "products_of_inertia", "payload_mass"):
            w.said(name, "in the USD body")
        fold_drag(w, "drag", wind=False)
        return w.finish()

    def files(self, craft: Craft) -> Mapping[str, str]:
        """pegasus.yaml, NAME.usda and commands.py."""
        n, speed = craft.count, craft.speed_max
        moments, axes = principal_axes(craft.inertia)
        noise = [craft.noise(names) for names in (("p", "q", "r"), ("ax", "ay", "az"))]
        gyro, accelerometer = (
            0.0 if s is None else float(np.sqrt(np.mean(s**2) * craft.sample_time)) for s in noise
        )
        arm = float(np.abs(craft.hubs[:, :2]).max())
        yaml = _YAML.format(
            name=craft.name,
            mass=yaml_number(craft.mass),
            count=n,
            constants=yaml_list([float(craft.thrust[2]) / speed**2] * n),
            moments=yaml_list([float(craft.torque[2]) / speed**2] * n),
            directions=[int(-s) for s in craft.spins],
            low=yaml_list([0.0] * n),
            high=yaml_list([2.0 * speed] * n),
            drag=yaml_list(drag_of(craft)),
            gyro=yaml_number(gyro),
            accelerometer=yaml_number(accelerometer),
            **{
                f"{s}_walk": yaml_number(
                    float(coloured_parts(craft, s).get("drift", {}).get("sigma", 0))
                )
                for s in ("gyro", "accelerometer")
            },
        )
        usd = _USD.format(
            name=craft.name,
            mass=repr(craft.mass),
            com=_text(craft.center_of_mass),
            moments=_text(moments),
            axes=_text(axes),
            arm=repr(arm),
            height=repr(0.3 * arm),
            rotors="\n".join(
                _ROTOR.format(i=i, place=_text(hub)) for i, hub in enumerate(craft.hubs)
            ),
        )
        return {
            "pegasus.yaml": yaml,
            f"{craft.name}.usda": usd,
            "commands.py": command_text(craft),
        }


def _text(values: FloatArray) -> str:
    return ", ".join(repr(float(v)) for v in values)
