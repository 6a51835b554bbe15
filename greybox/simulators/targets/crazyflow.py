"""crazyflow and drone-models: the parameters of their first-principles dynamics as TOML.

Both take rotor speeds in revolutions per minute, a 3 x n matrix of arms and spins, polynomials of
thrust and torque, one linear drag, and rates of the rotors' rise and fall. Their fitted form with
thrust lag and drag (so_rpy_rotor_drag) describes a craft together with its attitude controller,
which the model does not hold: it is written for a controller that is as quick as rotors of this lag
and delay allow at a damping ratio of 1/sqrt(2).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from greybox.simulators.command_text import command_text, say_commands
from greybox.simulators.craft import SHORTEST_LAG, Craft
from greybox.simulators.laws import drag_of, fold_drag
from greybox.simulators.words import THRUST_MAP, TORQUE_MAP, Status, Word, Wording, fixed_gravity
from greybox.symbolic import FloatArray

PER_MINUTE = 60.0 / (2.0 * math.pi)


@dataclass(frozen=True, kw_only=True)
class FirstPrinciples:
    """One of the two packages. `per_motor`: a curve per motor is written as (n, 3), else as (3, n).

    `gyroscopic`: whether its rotor momentum turns the body as physics does (drone-models 0.1 has
    the other sign in roll, so that the term does work).
    """

    name: str
    simulator: str
    source: str
    per_motor: bool
    gyroscopic: bool
    gravity: float | None

    def words(self, craft: Craft) -> tuple[Word, ...]:
        """Everything but what depends on the air at a hub."""
        w = Wording(craft, self.simulator)
        for name, key in ((THRUST_MAP, "rpm2thrust"), (TORQUE_MAP, "rpm2torque")):
            w.add(Word(effect=name, status=Status.SAID, how=key))
        if self.gravity is not None:
            fixed_gravity(w, self.gravity)
        say_commands(w)
        for name in ("motor_lag", "motor_lag_asymmetry", "motor_lag_speed"):
            w.said(name, "rotor_dyn_coef")
        w.said("rotor_asymmetry", "a curve per motor")
        for name in ("center_of_mass_offset", "products_of_inertia", "payload_mass"):
            w.said(name, "in mixing_matrix, J and mass")
        if self.gyroscopic:
            w.said("rotor_gyroscopic", "prop_inertia")
        else:
            w.lost("rotor_gyroscopic", "its term has the wrong sign in roll: prop_inertia = 0")
        if "steady_wind" in craft.effects:
            w.lost("steady_wind", "no wind; give its force as dist_f")
        fold_drag(w, "drag_matrix", wind=False)
        return w.finish()

    def files(self, craft: Craft) -> Mapping[str, str]:
        """params.toml, so_rpy_rotor_drag.toml and commands.py."""
        scale = craft.speed_max * PER_MINUTE
        arms, n = craft.arms, craft.count
        length = float(np.abs(arms[:, :2]).max())
        mixing = np.vstack([arms[:, 1] / length, -arms[:, 0] / length, -craft.spins])
        rates = np.array(craft.rates(SHORTEST_LAG)) / [1.0, scale, 1.0, scale]
        low, high = craft.command_range
        lines = [
            f"# First-principles parameters for {self.simulator}, written by greybox twin.",
            "#   parameters = tomllib.load(file)[NAME]; J_inv = numpy.linalg.inv(J)",
            "#   rpm = commands.RPM_MAX * commands.normalised_speed(u)",
            f"[{craft.name}]",
            f"mass = {craft.mass!r}  # kg",
            f"L = {length!r}  # m; arms are mixing_matrix times L",
            f"J = {craft.inertia.tolist()}  # kg m^2, about the centre of mass",
            f"gravity_vec = [0.0, 0.0, {-craft.gravity!r}]  # m/s^2",
            f"mixing_matrix = {mixing.tolist()}",
            f"rpm2thrust = {self._curves(craft.thrust, craft, scale)}  # N, powers of rpm",
            f"rpm2torque = {self._curves(craft.torque, craft, scale)}  # N m, powers of rpm",
            f"rotor_dyn_coef = {rates.tolist()}  # 1/s, 1/(rpm s)",
            f"prop_inertia = {craft.per_speed('rotor_gyroscopic.J_r')!r}  # kg m^2",
            f"drag_matrix = {np.diag(-drag_of(craft)).tolist()}  # N s/m",
            f"thrust_min = {_thrust(craft, low)!r}  # N, of one rotor",
            f"thrust_max = {_thrust(craft, high)!r}",
        ]
        if n != 4:
            lines.insert(3, f"# {n} rotors: the package's own controllers expect four")
        return {
            "params.toml": "\n".join(lines) + "\n",
            "so_rpy_rotor_drag.toml": self._fitted(craft),
            "commands.py": command_text(craft),
        }

    def _fitted(self, craft: Craft) -> str:
        """Attitude as a second-order answer to angles, thrust as a first-order one."""
        lag = max(craft.get("motor_lag.tau"), SHORTEST_LAG)
        damping = 0.5 / (lag + craft.get("command_delay.d") + 0.5 * craft.sample_time)
        stiffness = 0.5 * damping**2
        low, high = craft.command_range
        lines = [
            f"# Fitted form so_rpy_rotor_drag for {self.simulator}, written by greybox twin.",
            "# rpy_coef, rpy_rates_coef and cmd_rpy_coef are no measurement: the attitude "
            "controller",
            "# is not in the model. Put in those of yours (identify them from its flights).",
            f"[{craft.name}]",
            f"mass = {craft.mass!r}  # kg",
            f"J = {craft.inertia.tolist()}  # kg m^2",
            f"gravity_vec = [0.0, 0.0, {-craft.gravity!r}]  # m/s^2",
            f"thrust_min = {_thrust(craft, low)!r}  # N, of one rotor",
            f"thrust_max = {_thrust(craft, high)!r}",
            "acc_coef = 0.0",
            "cmd_f_coef = 1.0",
            f"thrust_dyn_coef = {1.0 / lag!r}  # 1/s"
            if self.per_motor
            else f"thrust_time_coef = {lag!r}  # s",
            f"rpy_coef = {[-stiffness] * 3}  # 1/s^2",
            f"rpy_rates_coef = {[-damping] * 3}  # 1/s",
            f"cmd_rpy_coef = {[stiffness] * 3}  # 1/s^2",
            f"drag_matrix = {np.diag(-drag_of(craft)).tolist()}  # N s/m",
        ]
        return "\n".join(lines) + "\n"

    def _curves(self, c: FloatArray, craft: Craft, scale: float) -> str:
        powers = [float(v) / scale**k for k, v in enumerate(c)]
        if np.all(craft.strength == 1.0):
            return repr(powers)
        curves = np.outer(craft.strength, powers)
        return repr((curves if self.per_motor else curves.T).tolist())


def _thrust(craft: Craft, nu: float) -> float:
    c0, c1, c2 = craft.thrust
    return max(0.0, float(c0 + nu * (c1 + nu * c2)))


CRAZYFLOW = FirstPrinciples(
    name="crazyflow",
    simulator="crazyflow",
    source="crazyflow 0.4, dynamics/first_principles/dynamics.py",
    per_motor=True,
    gyroscopic=True,
    gravity=None,
)
DRONE_MODELS = FirstPrinciples(
    name="drone-models",
    simulator="drone-models",
    source="drone-models 0.1, first_principles/model.py",
    per_motor=False,
    gyroscopic=False,
    gravity=None,
)
