"""PyBullet flies the craft: Bullet's rigid body under forces and moments at its centre of mass.

What differs there: position, attitude and velocities are those of the principal axes of inertia,
angular velocity in the world. Bullet steps velocities before positions (semi-implicit Euler): half
a step without forces before half a step with twice the forces is the leapfrog method, of second
order. Its gyroscopic moment stays of first order. Rotors and drag are ours: drag is that of
gym-pybullet-drones (Panerati et al. 2021, IROS; BaseAviary `_drag`), proportional to airspeed and
to the sum of the rotor speeds, in WORLD axes, at the centre of mass.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from greybox.plants.effects.base import PlantEffect
from greybox.plants.noise import SensorNoise
from greybox.plants.vectors import Quaternion, Vector, multiply
from scenarios.foreign.craft import Craft, thrust_and_torque
from scenarios.foreign.loads import Load
from scenarios.foreign.plant import ForeignPlant, MissingSimulator, Motion

try:
    import pybullet
except ImportError as missing:
    raise MissingSimulator("pybullet") from missing

SUBSTEP = 0.00025
"""Longest step [s]."""


class PyBulletPlant(ForeignPlant):
    """A craft in PyBullet, in a world of its own."""

    simulator = "pybullet"

    def __init__(
        self,
        craft: Craft,
        *,
        sensors: SensorNoise | None = None,
        sample_time: float = 0.01,
        effects: Sequence[PlantEffect] = (),
    ) -> None:
        frame = craft.airframe
        self._inertia = np.array(frame.inertia_matrix).reshape(3, 3)
        moments, axes = np.linalg.eigh(self._inertia)
        axes[:, 2] *= np.sign(np.linalg.det(axes))
        x, y, z, w = Rotation.from_matrix(axes).as_quat().tolist()
        self._axes, self._given, self._taken = axes, (w, x, y, z), (w, -x, -y, -z)
        self._nu = np.zeros(len(frame.rotors))
        self._strength = 1.0 + np.array(craft.uneven)
        self._arms = np.array([r.position for r in frame.rotors]) - np.array(frame.center_of_mass)
        self._spins = np.array([r.spin for r in frame.rotors])
        self._world = pybullet.connect(pybullet.DIRECT)
        self._body = self._call(pybullet.createMultiBody, frame.mass)
        undamped = {"linearDamping": 0.0, "angularDamping": 0.0, "maxJointVelocity": 1e4}
        self._call(
            pybullet.changeDynamics,
            self._body,
            -1,
            localInertiaDiagonal=moments.tolist(),
            **undamped,
        )
        super().__init__(craft, sensors=sensors, sample_time=sample_time, effects=effects)

    def _call(self, function: Callable[..., Any], *values: Any, **named: Any) -> Any:
        return function(*values, **named, physicsClientId=self._world)

    def _start(
        self, position: Vector, velocity: Vector, attitude: Quaternion, rates: Vector, nu: float
    ) -> None:
        w, x, y, z = multiply(attitude, self._given)
        spin = _turn(np.array(attitude)) @ np.array(rates)
        self._call(pybullet.resetBasePositionAndOrientation, self._body, position, (x, y, z, w))
        self._call(pybullet.resetBaseVelocity, self._body, velocity, spin.tolist())
        self._nu, self._attitude = np.full(len(self.airframe.rotors), nu), attitude

    def _state(self) -> tuple[NDArray[np.float64], ...]:
        """Position, velocity (world), turn from body to world, rates (body)."""
        position, (x, y, z, w) = self._call(pybullet.getBasePositionAndOrientation, self._body)
        velocity, spin = self._call(pybullet.getBaseVelocity, self._body)
        turn = _turn(np.array([w, x, y, z])) @ self._axes.T
        attitude = multiply((w, x, y, z), self._taken)
        # of the two signs of a quaternion the one that goes on from the step before: Bullet changes
        # it
        sign = 1.0 if np.dot(attitude, self._attitude) >= 0.0 else -1.0
        self._attitude = (
            sign * attitude[0],
            sign * attitude[1],
            sign * attitude[2],
            sign * attitude[3],
        )
        return np.array(position), np.array(velocity), turn, turn.T @ np.array(spin)

    def _wrench(
        self,
        nu: NDArray[np.float64],
        velocity: NDArray[np.float64],
        turn: NDArray[np.float64],
        wind: Vector,
        twist: Vector,
        load: Load,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Force, world, and moment, body, at these rotor speeds and this motion."""
        frame, air = self.airframe, self.craft.air
        thrust, torque = thrust_and_torque(frame, self._strength, nu)
        moment = np.array(
            [self._arms[:, 1] @ thrust, -self._arms[:, 0] @ thrust, -self._spins @ torque]
        )
        drag = (
            self.craft.speed_max * nu.sum() * np.array([air.rotor_drag, air.rotor_drag, air.inflow])
        )
        force = turn @ (np.array([0.0, 0.0, thrust.sum()]) + np.array(load.force)) - drag * (
            velocity - np.array(wind)
        )
        force[2] -= frame.mass * frame.gravity
        return force, moment + np.array(twist) + np.array(load.moment)

    def _hold(
        self, target: tuple[float, ...], wind: Vector, twist: Vector, load: Load, duration: float
    ) -> None:
        count = math.ceil(duration / SUBSTEP - 1e-9)
        length = duration / count
        self._call(pybullet.setTimeStep, 0.5 * length)
        aim, half = np.array(target), math.exp(-0.5 * length / self.craft.lag)
        for _ in range(count):
            self._call(pybullet.stepSimulation)
            middle = aim + half * (self._nu - aim)
            self._nu = aim + half * (middle - aim)
            position, velocity, turn, _ = self._state()
            force, moment = self._wrench(middle, velocity, turn, wind, twist, load)
            for act, what in (
                (pybullet.applyExternalForce, (2.0 * force, position)),
                (pybullet.applyExternalTorque, (2.0 * turn @ moment,)),
            ):
                self._call(act, self._body, -1, *(v.tolist() for v in what), pybullet.WORLD_FRAME)
            self._call(pybullet.stepSimulation)

    def _look(self, wind: Vector, twist: Vector, load: Load) -> Motion:
        position, velocity, turn, rates = self._state()
        force, moment = self._wrench(self._nu, velocity, turn, wind, twist, load)
        turning = np.linalg.solve(self._inertia, moment - np.cross(rates, self._inertia @ rates))
        return Motion(
            position=_vector(position),
            velocity=_vector(velocity),
            acceleration=_vector(force / self.airframe.mass),
            attitude=self._attitude,
            rates=_vector(rates),
            turning=_vector(turning),
            nu=tuple(self._nu.tolist()),
        )

    @property
    def exact(self) -> dict[str, float]:
        """The wind."""
        return dict(
            zip(("steady_wind.w_x", "steady_wind.w_y", "steady_wind.w_z"), self.craft.air.wind)
        )

    @property
    def near(self) -> dict[str, float]:
        """Drag of the rotors: in world axes here, in those of the discs in the catalogue."""
        air = self.craft.air
        named = {
            "rotor_drag.k_x": air.rotor_drag,
            "rotor_drag.k_y": air.rotor_drag,
            "axial_inflow.k_z": air.inflow,
        }
        return {name: value for name, value in named.items() if value}


def _turn(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrix of a quaternion (w, x, y, z)."""
    w, x, y, z = (q / np.linalg.norm(q)).tolist()
    return np.array(pybullet.getMatrixFromQuaternion((x, y, z, w))).reshape(3, 3)


def _vector(values: NDArray[np.float64]) -> Vector:
    x, y, z = values.tolist()
    return (x, y, z)
