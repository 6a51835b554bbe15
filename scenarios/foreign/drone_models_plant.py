"""drone-models flies the craft: its first-principles model, in the shape fitted to four Crazyflies.

What differs there: quaternions are (x, y, z, w), rotor speeds are revolutions per minute, arms and
spins are rows of a mixing matrix, moments of gusts are given in the world, drag is linear in
velocity (wind comes as a force), and rotors follow their commands by a law of the second degree
whose numbers for rising and falling speeds differ. The attitude is integrated from the body rates
here, as drone-models asks for: the quaternion row of its symbolic model takes (x, y, z, w) for (w,
x, y, z) in 0.1.0.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence

import casadi as ca
import numpy as np

# before drone_models, which would switch SciPy's array interface on for everybody
import scipy  # noqa: F401

from greybox.plants.effects.base import PlantEffect
from greybox.plants.noise import SensorNoise
from greybox.plants.vectors import (
    Quaternion,
    Vector,
    add,
    apply,
    inverse_symmetric,
    multiply,
    quaternion_of,
    rotation,
    subtract,
)
from scenarios.foreign.craft import Craft
from scenarios.foreign.loads import Load
from scenarios.foreign.plant import ForeignPlant, MissingSimulator, Motion

_switch = os.environ.get("SCIPY_ARRAY_API")
try:
    os.environ["SCIPY_ARRAY_API"] = "1"
    from drone_models.core import load_params
    from drone_models.first_principles import symbolic_dynamics
except ImportError as missing:
    raise MissingSimulator("drone-models") from missing
finally:
    if _switch is None:
        del os.environ["SCIPY_ARRAY_API"]
    else:
        os.environ["SCIPY_ARRAY_API"] = _switch

PER_MINUTE = 60.0 / (2.0 * math.pi)
"""Revolutions per minute in one rad/s."""
FITTED = ("cf2x_L250", "cf2x_P250", "cf2x_T350", "cf21B_500")
"""Craft whose numbers come with drone-models."""
STEP_PER_LAG = 0.2
"""Longest Runge-Kutta step as a share of the rotors' time constant; its error, 0.2^5 / 120, is 3e-6
of a change."""


class DroneModelsPlant(ForeignPlant):
    """A craft in drone-models. fitted: whose rotor dynamics, scaled to the craft's lag; None: a
    first-order lag."""

    simulator = "drone_models"

    def __init__(
        self,
        craft: Craft,
        *,
        sensors: SensorNoise | None = None,
        sample_time: float = 0.01,
        effects: Sequence[PlantEffect] = (),
        fitted: str | None = None,
    ) -> None:
        frame = craft.airframe
        self._scale = craft.speed_max * PER_MINUTE
        hover = float(frame.hover_speed) * self._scale
        self.fitted = fitted
        self._linear_drag = (
            craft.air.rotor_drag * float(frame.hover_speed) * craft.speed_max * len(frame.rotors)
        )
        """Drag [N s/m] that rotor drag would have at hover."""
        arms = [subtract(rotor.position, frame.center_of_mass) for rotor in frame.rotors]
        strength = ca.DM(1.0 + np.array(craft.uneven))
        matrix = np.array(frame.inertia_matrix, dtype=float).reshape(3, 3)
        inverse = inverse_symmetric(*frame.inertia, *frame.products)
        rate, state, command, _ = symbolic_dynamics(
            model_rotor_vel=True,
            model_dist_f=True,
            model_dist_t=True,
            mass=frame.mass,
            L=1.0,
            prop_inertia=0.0,
            gravity_vec=np.array([0.0, 0.0, -frame.gravity]),
            J=matrix,
            J_inv=np.array(inverse).reshape(3, 3),
            rpm2thrust=[strength * c / self._scale**k for k, c in enumerate(frame.thrust)],
            rpm2torque=[strength * c / self._scale**k for k, c in enumerate(frame.torque)],
            mixing_matrix=np.array(
                [[a[1] for a in arms], [-a[0] for a in arms], [-r.spin for r in frame.rotors]]
            ),
            rotor_dyn_coef=rotor_response(craft.lag, hover, fitted),
            drag_matrix=-self._linear_drag * np.eye(3),
        )
        free = ca.vertcat(
            rate[:3], _attitude_rate(state[3:7], state[10:13]), rate[7:], ca.DM.zeros(6)
        )
        self._rate = ca.Function("rate", [state, command], [free])
        self._step = _runge_kutta(self._rate)
        super().__init__(craft, sensors=sensors, sample_time=sample_time, effects=effects)

    def _start(
        self, position: Vector, velocity: Vector, attitude: Quaternion, rates: Vector, nu: float
    ) -> None:
        w, x, y, z = attitude
        speeds = [nu * self._scale] * len(self.airframe.rotors)
        self._state = np.array([*position, x, y, z, w, *velocity, *rates, *speeds, *[0.0] * 6])

    def _disturb(self, wind: Vector, twist: Vector, load: Load, duration: float = 0.0) -> None:
        """Write the force of wind and load, and the moment of gusts and load, into the state, both
        in the world. The load turns with the body: its direction is that half of `duration` on."""
        x, y, z, w = self._state[3:7].tolist()
        p, q, r = (0.5 * duration * float(v) for v in self._state[10:13])
        ahead = rotation(multiply((w, x, y, z), quaternion_of((p, q, r))))
        self._state[17:20] = self._linear_drag * np.array(wind) + apply(ahead, load.force)
        twisted = apply(rotation((w, x, y, z)), twist)
        self._state[20:23] = add(twisted, apply(ahead, load.moment))

    def _hold(
        self, target: tuple[float, ...], wind: Vector, twist: Vector, load: Load, duration: float
    ) -> None:
        self._disturb(wind, twist, load, duration)
        count = math.ceil(duration / (STEP_PER_LAG * self.craft.lag) - 1e-9)
        aim = self._scale * np.array(target)
        for _ in range(count):
            self._state = np.array(self._step(self._state, aim, duration / count)).ravel()
            self._state[3:7] /= np.linalg.norm(self._state[3:7])

    def _look(self, wind: Vector, twist: Vector, load: Load) -> Motion:
        self._disturb(wind, twist, load)
        state = self._state.tolist()
        rate = np.array(self._rate(self._state, self._state[13:17])).ravel().tolist()
        x, y, z, w = state[3:7]
        return Motion(
            position=(state[0], state[1], state[2]),
            velocity=(state[7], state[8], state[9]),
            acceleration=(rate[7], rate[8], rate[9]),
            attitude=(w, x, y, z),
            rates=(state[10], state[11], state[12]),
            turning=(rate[10], rate[11], rate[12]),
            nu=tuple(v / self._scale for v in state[13:17]),
        )

    @property
    def near(self) -> dict[str, float]:
        """Rotor drag and inflow at hover speed, and the lag where rotors follow the fitted law."""
        drag = self.craft.air.rotor_drag
        names = ("rotor_drag.k_x", "rotor_drag.k_y", "axial_inflow.k_z")
        found = dict.fromkeys(names, drag) if drag else {}
        return found if self.fitted is None else found | {"motor_lag.tau": self.craft.lag}


def rotor_response(lag: float, hover: float, fitted: str | None) -> list[float]:
    """drone-models' four numbers of how rotors rise and fall: linear and quadratic, each twice.

    A fitted shape keeps its parts and its ratio of rising to falling, scaled so that the mean of
    the two time constants at hover speed [rpm] is `lag` [s]. Raises ValueError for a name that
    drone-models does not know.
    """
    if fitted is None:
        return [1.0 / lag, 0.0, 1.0 / lag, 0.0]
    if fitted not in FITTED:
        raise ValueError(f"no fitted craft {fitted!r}; there are {', '.join(FITTED)}")
    numbers = load_params("first_principles", fitted)
    own = np.array(numbers["rotor_dyn_coef"], dtype=float)
    t0, t1, t2 = (float(c) for c in numbers["rpm2thrust"])
    need = float(numbers["mass"]) * 9.81 / 4.0 - t0
    own_hover = (math.sqrt(t1 * t1 + 4.0 * t2 * need) - t1) / (2.0 * t2)
    # near hover the quadratic law is a first-order one with the rate a + 2 b n
    own[[1, 3]] *= own_hover / hover
    rise, fall = own[0] + 2.0 * own[1] * hover, own[2] + 2.0 * own[3] * hover
    return [float(v) for v in own * 0.5 * (1.0 / rise + 1.0 / fall) / lag]


def _attitude_rate(quaternion: ca.MX, rates: ca.MX) -> ca.MX:
    """Time derivative of a quaternion (x, y, z, w) at these body rates."""
    axis, real = quaternion[:3], quaternion[3]
    return 0.5 * ca.vertcat(real * rates + ca.cross(axis, rates), -ca.dot(axis, rates))


def _runge_kutta(rate: ca.Function) -> ca.Function:
    """One classical Runge-Kutta step (state, command, length) of the simulator's own derivative."""
    state, command = ca.MX.sym("state", rate.size1_in(0)), ca.MX.sym("command", rate.size1_in(1))
    h = ca.MX.sym("h")
    k1 = rate(state, command)
    k2 = rate(state + 0.5 * h * k1, command)
    k3 = rate(state + 0.5 * h * k2, command)
    k4 = rate(state + h * k3, command)
    return ca.Function("step", [state, command, h], [state + h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)])
