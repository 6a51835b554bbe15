"""RotorPy: the dictionary of a Multirotor (Folk, Paulos and Kumar 2023, arXiv:2306.04485)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from greybox.simulators.change import Change
from greybox.simulators.command_text import command_text, say_commands
from greybox.simulators.craft import SHORTEST_LAG, Craft
from greybox.simulators.laws import drag_into_rotors
from greybox.simulators.words import Word, Wording, fixed_gravity, quadratic_maps
from greybox.symbolic import FloatArray

GRAVITY = 9.81
"""Fixed in RotorPy's Multirotor [m/s^2]."""

_TEXT = '''"""{title} for RotorPy: written by greybox twin.

    from rotorpy.vehicles.multirotor import Multirotor
    from vehicle import initial_state, motor_speeds, quad_params
    craft = Multirotor(quad_params, initial_state(), control_abstraction="cmd_motor_speeds")
    state = craft.step(state, {{"cmd_motor_speeds": motor_speeds(u)}}, dt)

with_rest(Multirotor) in place of Multirotor also has what rest.py holds.
"""

import numpy as np

from commands import HOVER, SPEED_MAX, normalised_speed

quad_params = {{
    "mass": {mass!r},  # kg
    "Ixx": {xx!r}, "Iyy": {yy!r}, "Izz": {zz!r},  # kg m^2, about the centre of mass
    "Ixy": {xy!r}, "Ixz": {xz!r}, "Iyz": {yz!r},
    "num_rotors": {count},
    "rotor_pos": {{{places}}},  # m from the centre of mass
    "rotor_directions": np.array({directions}),  # sign of the torque on the body
    "rI": np.array({imu}),  # m, IMU
    "c_Dx": {c_x!r}, "c_Dy": {c_y!r}, "c_Dz": {c_z!r},  # N/(m/s)^2
    "k_eta": {k_eta!r},  # N/(rad/s)^2
    "k_m": {k_m!r},  # N m/(rad/s)^2
    "k_d": {k_d!r},  # kg/rad, rotor drag
    "k_z": {k_z!r},  # kg/rad, inflow
    "k_h": {k_h!r},  # N/(m/s)^2, translational lift
    "k_flap": {k_flap!r},  # kg m/rad, of opposite sign to greybox's blade_flapping
    "tau_m": {tau!r},  # s
    "rotor_speed_min": 0.0, "rotor_speed_max": {top!r},  # rad/s
    "motor_noise_std": 0.0,
}}
WIND = np.array({wind})  # m/s, world: state["wind"]
STRENGTH = np.array({strength})  # thrust and torque of each rotor against their mean


def motor_speeds(u, voltage=None):
    """Commanded speeds [rad/s] for commands u (n,) and a battery voltage [V]."""
    return SPEED_MAX * np.sqrt(STRENGTH) * normalised_speed(u, voltage)


def initial_state():
    """Level and at rest, rotors at hover speed."""
    speeds = SPEED_MAX * HOVER * np.sqrt(STRENGTH)
    zero = np.zeros(3)
    return {{"x": zero, "v": zero, "q": np.array([0, 0, 0, 1.0]), "w": zero, "wind": WIND,
            "rotor_speeds": speeds}}


def with_rest(Multirotor):
    """The class with the forces and moments of rest.py, which RotorPy has no terms for."""
    from rest import in_world, rest

    class Twin(Multirotor):
        def _s_dot_fn(self, t, s, cmd_rotor_speeds):
            out = super()._s_dot_fn(t, s, cmd_rotor_speeds)
            q = s[[9, 6, 7, 8]] / np.linalg.norm(s[6:10])
            nu = s[16:] / (SPEED_MAX * np.sqrt(STRENGTH))
            nu_rate = out[16:] / (SPEED_MAX * np.sqrt(STRENGTH))
            force, moment = rest(q, s[3:6], s[:3], s[10:13], nu, nu_rate)
            out[3:6] += in_world(q, force, moment)[0] / self.mass
            out[10:13] += self.inv_inertia @ moment
            return out

    return Twin
'''


class RotorPy:
    """RotorPy 3."""

    name = "rotorpy"
    simulator = "RotorPy"
    source = "Folk, Paulos and Kumar 2023, arXiv:2306.04485; rotorpy 3.0 vehicles/multirotor.py"

    def words(self, craft: Craft) -> tuple[Word, ...]:
        """Nearly all of the catalogue's aerodynamics; one drag coefficient for x and y."""
        w = Wording(craft, self.simulator)
        drag_into_rotors(w)
        quadratic_maps(w, thrust="k_eta", torque="k_m")
        fixed_gravity(w, GRAVITY)
        say_commands(w)
        w.said("motor_lag", "tau_m")
        w.folded_lag_mean()
        w.said("rotor_asymmetry", "motor_speeds() scales each rotor's speed")
        w.said("axial_inflow", "k_z").said("translational_lift", "k_h")
        w.said("parasitic_drag", "c_Dx, c_Dy, c_Dz").said("steady_wind", "WIND")
        w.said("blade_flapping", "k_flap, of opposite sign")
        for name in ("center_of_mass_offset", "products_of_inertia", "payload_mass"):
            w.said(name, "in rotor_pos, inertia and mass")
        one_drag(w, "k_d")
        return w.finish()

    def files(self, craft: Craft) -> Mapping[str, str]:
        """vehicle.py and commands.py."""
        speed, j = craft.speed_max, craft.inertia
        places = ", ".join(f'"r{i}": np.array({_list(arm)})' for i, arm in enumerate(craft.arms, 1))
        imu = np.array(craft.physics.vehicle.imu_position) - craft.center_of_mass
        c_x, c_y, c_z = craft.vector("parasitic_drag.c_").tolist()
        text = _TEXT.format(
            title=craft.name,
            mass=craft.mass,
            **{k: float(j[a, b]) for k, (a, b) in _MOMENTS.items()},
            count=craft.count,
            places=places,
            directions=_list(-craft.spins),
            imu=_list(imu),
            c_x=c_x,
            c_y=c_y,
            c_z=c_z,
            k_eta=float(craft.thrust[2]) / speed**2,
            k_m=float(craft.torque[2]) / speed**2,
            k_d=craft.per_speed("rotor_drag.k_x"),
            k_z=craft.per_speed("axial_inflow.k_z"),
            k_h=craft.get("translational_lift.k_h"),
            k_flap=-craft.per_speed("blade_flapping.k_flap"),
            tau=max(craft.get("motor_lag.tau"), SHORTEST_LAG),
            top=speed * float(np.sqrt(craft.strength.max())),
            wind=_list(craft.vector("steady_wind.w_")),
            strength=_list(craft.strength),
        )
        return {"vehicle.py": text, "commands.py": command_text(craft)}


_MOMENTS = {"xx": (0, 0), "yy": (1, 1), "zz": (2, 2), "xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}


def one_drag(wording: Wording, key: str) -> None:
    """The row of rotor drag where a simulator has one coefficient for x and y."""
    x, y = (wording.craft.get(f"rotor_drag.k_{a}") for a in "xy")
    if x == y:
        wording.said("rotor_drag", key)
        return
    mean = 0.5 * (x + y)
    wording.folded(
        "rotor_drag",
        f"one {key} for x and y, the mean of both",
        Change(values={"rotor_drag.k_x": mean, "rotor_drag.k_y": mean}),
    )


def _list(values: FloatArray) -> str:
    return repr([float(v) for v in values])
