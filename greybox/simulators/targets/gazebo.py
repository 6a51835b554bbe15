"""Gazebo: an SDF model with the multicopter motor plugin, for gz-sim and for Gazebo classic.

Both plugins go back to RotorS (Furrer, Burri, Achtelik and Siegwart 2016, in Koubaa ed., Robot
Operating System) and have the same law: thrust motorConstant Omega^2 along the joint, yaw moment
-turningDirection momentConstant thrust, drag -|Omega| rotorDragCoefficient v_perp at the rotor,
with v_perp its airspeed across the joint, and a moment -|Omega| rollingMomentCoefficient v_perp,
which lies ALONG the airspeed (gz-sim, systems/multicopter_motor_model/MulticopterMotorModel.cc).
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from greybox.simulators.craft import Craft
from greybox.simulators.laws import drag_into_rotors
from greybox.simulators.sensor_text import coloured_parts
from greybox.simulators.targets.rotorpy import one_drag
from greybox.simulators.words import Word, Wording, quadratic_maps
from greybox.symbolic import FloatArray

ROTOR_SHARE = 0.002
"""Mass of a rotor link as a share of the craft's; the base link has so much less."""
SLOWDOWN = 10.0
"""rotorVelocitySlowdownSim: joints turn this much slower than rotors."""
SHORTEST_LAG = 1e-4
"""Rotors without a lag get this one [s]."""

_SDF = """<?xml version="1.0" ?>
<sdf version="{version}">
  <!-- Written by greybox twin. The world needs <gravity>0 0 {gravity}</gravity>{wind}.
       Motor commands are rotor speeds [rad/s]. -->
  <model name="{name}">
    <link name="base_link">
      <inertial>
        <pose>{com} 0 0 0</pose>
        <mass>{mass}</mass>
        <inertia>
          <ixx>{xx}</ixx><ixy>{xy}</ixy><ixz>{xz}</ixz>
          <iyy>{yy}</iyy><iyz>{yz}</iyz><izz>{zz}</izz>
        </inertia>
      </inertial>
      <collision name="base_collision">
        <geometry><cylinder><radius>{arm}</radius><length>{height}</length></cylinder></geometry>
      </collision>
      <visual name="base_visual">
        <geometry><cylinder><radius>{arm}</radius><length>{height}</length></cylinder></geometry>
      </visual>
      <sensor name="imu_sensor" type="imu">
        <pose>{imu} 0 0 0</pose>
        <always_on>1</always_on>
        <update_rate>{rate}</update_rate>
        <imu>
          <angular_velocity>{gyro}</angular_velocity>
          <linear_acceleration>{accelerometer}</linear_acceleration>
        </imu>
      </sensor>
    </link>
{rotors}
{plugins}
  </model>
</sdf>
"""
_ROTOR = """    <link name="rotor_{i}">
      <pose>{place} 0 0 0</pose>
      <inertial>
        <mass>{mass}</mass>
        <inertia>
          <ixx>{small}</ixx><ixy>0</ixy><ixz>0</ixz><iyy>{small}</iyy><iyz>0</iyz><izz>{spin}</izz>
        </inertia>
      </inertial>
      <visual name="rotor_{i}_visual">
        <geometry><cylinder><radius>{radius}</radius><length>0.002</length></cylinder></geometry>
      </visual>
    </link>
    <joint name="rotor_{i}_joint" type="revolute">
      <parent>base_link</parent>
      <child>rotor_{i}</child>
      <axis>
        <xyz>0 0 1</xyz>
        <limit><lower>-1e16</lower><upper>1e16</upper></limit>
      </axis>
    </joint>"""
_PLUGIN = """    <plugin filename="{library}" name="{plugin}">
      <robotNamespace>{robot}</robotNamespace>
      <jointName>rotor_{i}_joint</jointName>
      <linkName>rotor_{i}</linkName>
      <turningDirection>{turning}</turningDirection>
      <timeConstantUp>{up}</timeConstantUp>
      <timeConstantDown>{down}</timeConstantDown>
      <maxRotVelocity>{top}</maxRotVelocity>
      <motorConstant>{motor}</motorConstant>
      <momentConstant>{moment}</momentConstant>
      <commandSubTopic>command/motor_speed</commandSubTopic>
      <{number}>{i}</{number}>
      <rotorDragCoefficient>{drag}</rotorDragCoefficient>
      <rollingMomentCoefficient>0</rollingMomentCoefficient>
      <rotorVelocitySlowdownSim>{slowdown}</rotorVelocitySlowdownSim>
      <motorType>velocity</motorType>
    </plugin>"""


class Gazebo:
    """gz-sim and Gazebo classic."""

    name = "gazebo"
    simulator = "Gazebo"
    source = "gz-sim, src/systems/multicopter_motor_model/MulticopterMotorModel.cc"

    def words(self, craft: Craft) -> tuple[Word, ...]:
        """What the motor plugin knows."""
        w = Wording(craft, self.simulator)
        drag_into_rotors(w)
        quadratic_maps(w, thrust="motorConstant", torque="momentConstant")
        w.said("motor_lag", "timeConstantUp, timeConstantDown")
        w.said("motor_lag_asymmetry", "timeConstantUp, timeConstantDown")
        w.said("rotor_asymmetry", "motorConstant of each rotor")
        for name in ("center_of_mass_offset", "products_of_inertia", "payload_mass"):
            w.said(name, "in inertial")
        one_drag(w, "rotorDragCoefficient")
        w.said("rotor_gyroscopic", "izz of the rotor links, times the slowdown")
        w.said("steady_wind", "<wind> of the world")
        w.lost("blade_flapping", "the plugin's rolling moment lies along the airspeed, not across")
        for name in ("gyro_bias", "accelerometer_bias"):
            w.said(name, "mean of the IMU's noise")
        for name in ("command_delay", "command_saturation", "thrust_curve", "battery_sag"):
            w.lost(name, "the command is a rotor speed; put it before the motors")
        return w.finish()

    def files(self, craft: Craft) -> Mapping[str, str]:
        """model.sdf (gz-sim) and model_classic.sdf."""
        return {
            "model.sdf": _sdf(craft, "1.9", _GZ),
            "model_classic.sdf": _sdf(craft, "1.6", _CLASSIC),
        }


_GZ = {
    "library": "gz-sim-multicopter-motor-model-system",
    "plugin": "gz::sim::systems::MulticopterMotorModel",
    "number": "motorNumber",
}
_CLASSIC = {"library": "libgazebo_motor_model.so", "plugin": "", "number": "motorNumber"}


def base_inertia(craft: Craft) -> tuple[float, FloatArray, FloatArray]:
    """(mass, centre of mass from the body origin, inertia about it) of the base link: the craft
    without its rotor links."""
    share = ROTOR_SHARE * craft.mass
    mass = craft.mass - craft.count * share
    com = (craft.mass * craft.center_of_mass - share * craft.hubs.sum(axis=0)) / mass
    j = craft.inertia - sum((share * _steiner(arm) for arm in craft.arms), np.zeros((3, 3)))
    j = j - mass * _steiner(com - craft.center_of_mass)
    small, spin = rotor_inertia(craft)
    return mass, com, j - craft.count * np.diag([small, small, spin])


def rotor_inertia(craft: Craft) -> tuple[float, float]:
    """(about a diameter, about the axis) of a rotor link [kg m^2]."""
    spin = SLOWDOWN * craft.per_speed("rotor_gyroscopic.J_r")
    spin = max(spin, 1e-4 * float(craft.inertia[2, 2]))
    return 0.5 * spin, spin


def _steiner(arm: FloatArray) -> FloatArray:
    return np.asarray(float(arm @ arm) * np.eye(3) - np.outer(arm, arm))


def _sdf(craft: Craft, version: str, kind: Mapping[str, str]) -> str:
    mass, com, j = base_inertia(craft)
    small, spin = rotor_inertia(craft)
    up, down = (max(v, SHORTEST_LAG) for v in craft.lags)
    arm = float(np.abs(craft.hubs[:, :2]).max())
    drag = craft.per_speed("rotor_drag.k_x")
    wind = craft.vector("steady_wind.w_")
    rotors, plugins = [], []
    for i in range(craft.count):
        rotors.append(
            _ROTOR.format(
                i=i,
                place=_text(craft.hubs[i]),
                mass=repr(ROTOR_SHARE * craft.mass),
                small=repr(small),
                spin=repr(spin),
                radius=repr(craft.rotor_radius or 0.4 * arm),
            )
        )
        motor = float(craft.thrust[2] * craft.strength[i]) / craft.speed_max**2
        plugins.append(
            _PLUGIN.format(
                **(dict(kind) | {"plugin": kind["plugin"] or f"rotor_{i}_motor"}),
                i=i,
                robot=craft.name,
                turning="ccw" if craft.spins[i] > 0 else "cw",
                up=repr(up),
                down=repr(down),
                top=repr(craft.speed_max),
                motor=repr(motor),
                moment=repr(float(craft.torque[2] / craft.thrust[2])),
                drag=repr(drag),
                slowdown=repr(SLOWDOWN),
            )
        )
    return _SDF.format(
        version=version,
        gravity=repr(-craft.gravity),
        wind=f" and <wind><linear_velocity>{_text(wind)}</linear_velocity></wind>"
        if np.any(wind)
        else "",
        name=craft.name,
        com=_text(com),
        mass=repr(mass),
        xx=repr(float(j[0, 0])),
        xy=repr(float(j[0, 1])),
        xz=repr(float(j[0, 2])),
        yy=repr(float(j[1, 1])),
        yz=repr(float(j[1, 2])),
        zz=repr(float(j[2, 2])),
        arm=repr(arm),
        height=repr(0.3 * arm),
        imu=_text(craft.physics.vehicle.imu_position),
        rate=repr(1.0 / craft.sample_time),
        gyro=_noise(craft, ("p", "q", "r"), "gyro"),
        accelerometer=_noise(craft, ("ax", "ay", "az"), "accelerometer"),
        rotors="\n".join(rotors),
        plugins="\n".join(plugins),
    )


def _noise(craft: Craft, names: tuple[str, ...], sensor: str) -> str:
    """White noise about the bias, and as dynamic bias the Gauss-Markov noise of the model.

    The bias is the noise's mean: of bias_mean gz-sensors takes the negative in every other run
    (src/GaussianNoiseModel.cc). Its dynamic_bias_stddev s is a density: the bias keeps
    exp(-dt/T) of itself and gains noise of variance s^2 T/2 (1 - exp(-2 dt/T)) a step, so that it
    settles at s sqrt(T/2).
    """
    sigma = craft.noise(names)
    if sigma is None:
        return ""
    mean = np.array([craft.source.values.get(f"{sensor}_bias.b_{a}", 0.0) for a in "xyz"])
    walk = coloured_parts(craft, sensor).get("coloured")
    further = ""
    if walk is not None:
        level = walk["sigma"] * math.sqrt(2.0 / walk["T"])
        further = (
            f"<dynamic_bias_stddev>{level!r}</dynamic_bias_stddev>"
            f"<dynamic_bias_correlation_time>{walk['T']!r}</dynamic_bias_correlation_time>"
        )
    axes = [
        f'<{a}><noise type="gaussian"><mean>{float(m)!r}</mean><stddev>{float(s)!r}</stddev>'
        f"<bias_mean>0</bias_mean>{further}</noise></{a}>"
        for a, s, m in zip("xyz", sigma, mean, strict=True)
    ]
    return "".join(axes)


def _text(values: FloatArray | tuple[float, ...]) -> str:
    return " ".join(repr(float(v)) for v in values)
