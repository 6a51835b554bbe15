"""MuJoCo flies the craft: a free body under forces and moments at one site per rotor, in MuJoCo's
own fluid and wind.

What differs there: the linear velocity of a free joint is that of the body origin, in the world;
inertia is given about the centre of mass; actuators are forces, so that this file turns rotor
speeds into thrust and drag torque. Drag is that of MuJoCo's inertia box: quadratic per axis, with
moments that damp the rates.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from greybox.plants.effects.base import PlantEffect
from greybox.plants.noise import SensorNoise
from greybox.plants.vectors import Quaternion, Vector, add, apply, cross, rotation, subtract
from scenarios.foreign.craft import Craft, thrust_and_torque
from scenarios.foreign.loads import Load
from scenarios.foreign.plant import ForeignPlant, MissingSimulator, Motion

try:
    import mujoco
except ImportError as missing:
    raise MissingSimulator("mujoco") from missing

SUBSTEP = 0.002
"""Longest Runge-Kutta step [s]; rotor forces are constant in it, at their mean (Simpson)."""
AIR_DENSITY = 1.2
"""kg/m^3, at sea level."""


class MuJoCoPlant(ForeignPlant):
    """A craft in MuJoCo. `craft.air.parasitic` switches the fluid on; its size follows from the
    inertia box."""

    simulator = "mujoco"

    def __init__(
        self,
        craft: Craft,
        *,
        sensors: SensorNoise | None = None,
        sample_time: float = 0.01,
        effects: Sequence[PlantEffect] = (),
    ) -> None:
        self._model = mujoco.MjModel.from_xml_string(body_description(craft))
        self._data = mujoco.MjData(self._model)
        self._nu = np.zeros(len(craft.airframe.rotors))
        self._strength = 1.0 + np.array(craft.uneven)
        super().__init__(craft, sensors=sensors, sample_time=sample_time, effects=effects)

    def _start(
        self, position: Vector, velocity: Vector, attitude: Quaternion, rates: Vector, nu: float
    ) -> None:
        turn, origin = rotation(attitude), subtract((0.0, 0.0, 0.0), self.airframe.center_of_mass)
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:3] = add(position, apply(turn, origin))
        self._data.qpos[3:7] = attitude
        self._data.qvel[:3] = add(velocity, apply(turn, cross(rates, origin)))
        self._data.qvel[3:6] = rates
        self._nu = np.full(len(self.airframe.rotors), nu)

    def _rotors(self, nu: NDArray[np.float64]) -> NDArray[np.float64]:
        """Thrust of every rotor [N], then its drag torque [N m], at these speeds."""
        return np.concatenate(thrust_and_torque(self.airframe, self._strength, nu))

    def _apply(self, rotors: NDArray[np.float64], wind: Vector, twist: Vector, load: Load) -> None:
        """Forces and torques of the rotors, wind, the moment of the gusts, and the load."""
        self._data.ctrl[:] = rotors
        self._model.opt.wind[:] = wind
        w, x, y, z = self._data.qpos[3:7].tolist()
        turn = rotation((w, x, y, z))
        self._data.xfrc_applied[1, :3] = apply(turn, load.force)
        self._data.xfrc_applied[1, 3:6] = apply(turn, add(twist, load.moment))

    def _hold(
        self, target: tuple[float, ...], wind: Vector, twist: Vector, load: Load, duration: float
    ) -> None:
        count = math.ceil(duration / SUBSTEP - 1e-9)
        length = duration / count
        self._model.opt.timestep = length
        aim, half = np.array(target), math.exp(-0.5 * length / self.craft.lag)
        for _ in range(count):
            begin, middle = self._nu, aim + half * (self._nu - aim)
            self._nu = aim + half * (middle - aim)
            mean = self._rotors(begin) + 4.0 * self._rotors(middle) + self._rotors(self._nu)
            self._apply(mean / 6.0, wind, twist, load)
            mujoco.mj_step(self._model, self._data)

    def _carry_over(self, before: ForeignPlant) -> None:
        if not isinstance(before, MuJoCoPlant):
            raise ValueError(f"a craft in {before.simulator} cannot go on in MuJoCo")
        self._data.qpos[:], self._data.qvel[:] = before._data.qpos, before._data.qvel
        self._nu = before._nu.copy()

    def _look(self, wind: Vector, twist: Vector, load: Load) -> Motion:
        data = self._data
        self._apply(self._rotors(self._nu), wind, twist, load)
        mujoco.mj_forward(self._model, data)
        w, x, y, z = data.qpos[3:7].tolist()
        turn = rotation((w, x, y, z))
        arm, rates = self.airframe.center_of_mass, _vector(data.qvel[3:6])
        turning = _vector(data.qacc[3:6])
        spun = add(cross(turning, arm), cross(rates, cross(rates, arm)))
        return Motion(
            position=add(_vector(data.qpos[:3]), apply(turn, arm)),
            velocity=add(_vector(data.qvel[:3]), apply(turn, cross(rates, arm))),
            acceleration=add(_vector(data.qacc[:3]), apply(turn, spun)),
            attitude=(w, x, y, z),
            rates=rates,
            turning=turning,
            nu=tuple(self._nu.tolist()),
        )

    def own_sensors(self) -> tuple[Vector, Vector]:
        """What MuJoCo's own accelerometer and gyro read at the IMU [m/s^2, rad/s]."""
        self._now()
        ax, ay, az, p, q, r = self._data.sensordata.tolist()
        return (ax, ay, az), (p, q, r)

    @property
    def near(self) -> dict[str, float]:
        """Body drag c_j = 0.5 rho A_j of the inertia box; MuJoCo has |v_j| v_j where the catalogue
        has |v| v_j."""
        if not any(self.craft.air.parasitic):
            return {}
        bx, by, bz = inertia_box(self.craft)
        sides = {"x": by * bz, "y": bx * bz, "z": bx * by}
        return {
            f"parasitic_drag.c_{axis}": 0.5 * AIR_DENSITY * side for axis, side in sides.items()
        }


def inertia_box(craft: Craft) -> Vector:
    """Sides [m] of the box of even density with the mass and inertia of the craft: MuJoCo's fluid
    acts on it."""
    xx, yy, zz = craft.airframe.inertia
    scale = 6.0 / craft.airframe.mass
    return (
        math.sqrt(scale * (yy + zz - xx)),
        math.sqrt(scale * (xx + zz - yy)),
        math.sqrt(scale * (xx + yy - zz)),
    )


def body_description(craft: Craft) -> str:
    """The craft in MuJoCo's own language (MJCF)."""
    frame = craft.airframe
    density = AIR_DENSITY if any(craft.air.parasitic) else 0.0
    rotors = list(enumerate(frame.rotors, 1))
    sites = "".join(f'<site name="rotor{i}" pos="{_text(r.position)}"/>' for i, r in rotors)
    thrust = "".join(f'<general site="rotor{i}" gear="0 0 1 0 0 0"/>' for i, _ in rotors)
    torque = "".join(f'<general site="rotor{i}" gear="0 0 0 0 0 {-r.spin}"/>' for i, r in rotors)
    return f"""
<mujoco>
  <compiler angle="radian"/>
  <option integrator="RK4" timestep="{SUBSTEP}" density="{density}"
    gravity="0 0 {-frame.gravity!r}"/>
  <worldbody>
    <body name="craft">
      <freejoint/>
      <inertial pos="{_text(frame.center_of_mass)}" mass="{frame.mass!r}"
        fullinertia="{_text((*frame.inertia, *frame.products))}"/>
      {sites}<site name="imu" pos="{_text(frame.imu_position)}"/>
    </body>
  </worldbody>
  <actuator>{thrust}{torque}</actuator>
  <sensor><accelerometer site="imu"/><gyro site="imu"/></sensor>
</mujoco>"""


def _text(values: tuple[float, ...]) -> str:
    return " ".join(repr(float(v)) for v in values)


def _vector(values: NDArray[np.float64]) -> Vector:
    x, y, z = values.tolist()
    return (x, y, z)
