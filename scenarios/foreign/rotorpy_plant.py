"""RotorPy flies the craft: its Multirotor with rotor drag, inflow, body drag and rotor lag (Folk,
Paulos, Kumar 2023).

What differs there: quaternions are (x, y, z, w), positions are relative to the centre of mass, a
rotor's direction is the sign of its torque on the body, gravity is 9.81 m/s^2, thrust and torque
are squares of the rotor speed, and air acts only by wind and drag (gusts do not swirl). Loads from
outside join the forces of its rotors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import OdeSolver

from greybox.plants.effects.base import PlantEffect
from greybox.plants.noise import SensorNoise
from greybox.plants.vectors import Quaternion, Vector, subtract
from scenarios.foreign.craft import Craft
from scenarios.foreign.loads import Load
from scenarios.foreign.plant import ForeignPlant, MissingSimulator, Motion

try:
    from rotorpy.vehicles.multirotor import Multirotor
except ImportError as missing:
    raise MissingSimulator("rotorpy") from missing

GRAVITY = 9.81
"""RotorPy's gravity [m/s^2], fixed in its Multirotor."""
STEP_PER_LAG = 0.35
"""Longest Runge-Kutta step as a share of the rotors' time constant: its error, 0.35^5 / 120, is
4e-5 of a change."""


class FixedRungeKutta(OdeSolver):
    """The classical fourth-order Runge-Kutta method with steps of one length, as a method of
    SciPy's solve_ivp."""

    t: float
    y: NDArray[np.float64]

    def __init__(
        self,
        fun: Any,
        t0: float,
        y0: Any,
        t_bound: float,
        vectorized: bool = False,
        longest: float = 0.01,
        **_: Any,
    ) -> None:
        super().__init__(fun, t0, y0, t_bound, vectorized)
        self._length = (t_bound - t0) / math.ceil((t_bound - t0) / longest - 1e-9)

    def _step_impl(self) -> tuple[bool, str | None]:
        h, t, y, f = self._length, self.t, self.y, self.fun
        k1 = f(t, y)
        k2 = f(t + 0.5 * h, y + 0.5 * h * k1)
        k3 = f(t + 0.5 * h, y + 0.5 * h * k2)
        k4 = f(t + h, y + h * k3)
        self.y = y + h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
        end = t + h
        self.t = self.t_bound if abs(end - self.t_bound) < 1e-9 else end
        return True, None


class LoadedMultirotor(Multirotor):
    """RotorPy's vehicle with a load on its body."""

    load = Load()

    def compute_body_wrench(self, *seen: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Force and moment of RotorPy, and the load."""
        force, moment = super().compute_body_wrench(*seen)
        return force + np.array(self.load.force), moment + np.array(self.load.moment)


class RotorPyPlant(ForeignPlant):
    """A craft in RotorPy. Raises ValueError for thrust or torque maps that are not squares, or
    another gravity."""

    simulator = "rotorpy"

    def __init__(
        self,
        craft: Craft,
        *,
        sensors: SensorNoise | None = None,
        sample_time: float = 0.01,
        effects: Sequence[PlantEffect] = (),
    ) -> None:
        frame, air = craft.airframe, craft.air
        if any((*frame.thrust[:2], *frame.torque[:2])):
            raise ValueError(
                "RotorPy's rotors have thrust and torque c2 nu^2: c0 and c1 must be zero"
            )
        if frame.gravity != GRAVITY:
            raise ValueError(f"RotorPy's gravity is {GRAVITY} m/s^2, the craft's {frame.gravity!r}")
        arms = [subtract(rotor.position, frame.center_of_mass) for rotor in frame.rotors]
        speed = craft.speed_max
        self._strength = np.sqrt(1.0 + np.array(craft.uneven))
        """Factor on a rotor's speed that scales its thrust and its torque as `uneven` says."""
        xx, yy, zz = frame.inertia
        xy, xz, yz = frame.products
        drag = air.parasitic
        self._vehicle = LoadedMultirotor(
            {
                "mass": frame.mass,
                **{"Ixx": xx, "Iyy": yy, "Izz": zz, "Ixy": xy, "Ixz": xz, "Iyz": yz},
                **{"c_Dx": drag[0], "c_Dy": drag[1], "c_Dz": drag[2]},
                "num_rotors": len(arms),
                "rotor_pos": {f"r{i}": np.array(arm) for i, arm in enumerate(arms, 1)},
                "rotor_directions": np.array([-rotor.spin for rotor in frame.rotors]),
                "rotor_speed_min": 0.0,
                "rotor_speed_max": 2.0 * speed,
                "k_eta": frame.thrust[2] / speed**2,
                "k_m": frame.torque[2] / speed**2,
                **{"k_d": air.rotor_drag, "k_z": air.inflow},
                **{"k_h": air.lift, "k_flap": -air.flapping},
                "tau_m": craft.lag,
                "motor_noise_std": 0.0,
            },
            aero=True,
            integrator_kwargs={"method": FixedRungeKutta, "longest": STEP_PER_LAG * craft.lag},
        )
        super().__init__(craft, sensors=sensors, sample_time=sample_time, effects=effects)

    def _start(
        self, position: Vector, velocity: Vector, attitude: Quaternion, rates: Vector, nu: float
    ) -> None:
        w, x, y, z = attitude
        self._state: dict[str, NDArray[np.float64]] = {
            "x": np.array(position),
            "v": np.array(velocity),
            "q": np.array([x, y, z, w]),
            "w": np.array(rates),
            "wind": np.zeros(3),
            "rotor_speeds": self._speeds(np.full(4, nu)),
        }

    def _speeds(self, nu: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(self.craft.speed_max * nu * self._strength)

    def _hold(
        self, target: tuple[float, ...], wind: Vector, twist: Vector, load: Load, duration: float
    ) -> None:
        self._state["wind"] = np.array(wind)
        self._vehicle.load = load
        command = {"cmd_motor_speeds": self._speeds(np.array(target))}
        self._state = self._vehicle.step(self._state, command, duration)

    def _carry_over(self, before: ForeignPlant) -> None:
        if not isinstance(before, RotorPyPlant):
            raise ValueError(f"a craft in {before.simulator} cannot go on in RotorPy")
        # rotors keep their speed, which stands here times their strength
        speeds = before._state["rotor_speeds"] * self._strength / before._strength
        self._state = {n: v.copy() for n, v in before._state.items()} | {"rotor_speeds": speeds}

    def _look(self, wind: Vector, twist: Vector, load: Load) -> Motion:
        state = self._state | {"wind": np.array(wind)}
        self._vehicle.load = load
        rate = self._vehicle.statedot(
            state, {"cmd_motor_speeds": state["rotor_speeds"]}, self.sample_time
        )
        x, y, z, w = state["q"].tolist()
        return Motion(
            position=_vector(state["x"]),
            velocity=_vector(state["v"]),
            acceleration=_vector(rate["vdot"]),
            attitude=(w, x, y, z),
            rates=_vector(state["w"]),
            turning=_vector(rate["wdot"]),
            nu=tuple((state["rotor_speeds"] / self._strength / self.craft.speed_max).tolist()),
        )

    @property
    def exact(self) -> dict[str, float]:
        """RotorPy's own forms are those of the catalogue (its flapping moment with the opposite
        sign)."""
        air = self.craft.air
        named = {
            "rotor_drag.k_x": air.rotor_drag,
            "rotor_drag.k_y": air.rotor_drag,
            "axial_inflow.k_z": air.inflow,
            "translational_lift.k_h": air.lift,
            "blade_flapping.k_flap": air.flapping,
        }
        named |= dict(
            zip(("parasitic_drag.c_x", "parasitic_drag.c_y", "parasitic_drag.c_z"), air.parasitic)
        )
        named |= dict(zip(("steady_wind.w_x", "steady_wind.w_y", "steady_wind.w_z"), air.wind))
        return {name: value for name, value in named.items() if value}


def _vector(values: NDArray[np.float64]) -> Vector:
    x, y, z = values.tolist()
    return (x, y, z)
