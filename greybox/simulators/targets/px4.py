"""PX4: parameters of its simulation in hardware (SIH), and of the controller for the real craft.

SIH's quadrotor has thrust SIH_T_MAX times a command that follows with SIH_T_TAU, arms SIH_L_ROLL
and SIH_L_PITCH, yaw torque SIH_Q_MAX times the command, one linear drag SIH_KDV against the
airspeed and one damping SIH_KDW (PX4, src/modules/simulation/simulator_sih/sih.cpp). Axes are FRD
there.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from greybox.simulators.change import Change
from greybox.simulators.craft import SHORTEST_LAG, Craft
from greybox.simulators.laws import drag_at_hover, drag_of, fold_drag
from greybox.simulators.layout import order_in
from greybox.simulators.words import THRUST_MAP, TORQUE_MAP, Status, Word, Wording, symmetric_arms

PLACES = ((1, -1, 1), (-1, 1, 1), (1, 1, -1), (-1, -1, -1))
"""Motors 1 to 4 of PX4's quadrotor x: front right and rear left counter-clockwise, front left and
rear right clockwise."""
FLOAT, INTEGER = 9, 6
"""Types of a parameter in a file of QGroundControl."""


class PX4:
    """PX4's SIH, and the craft's own parameters."""

    name = "px4"
    simulator = "PX4 SIH"
    source = "PX4, src/modules/simulation/simulator_sih/sih.cpp"

    def words(self, craft: Craft) -> tuple[Word, ...]:
        """Thrust linear in the command, symmetric arms, one drag, one damping."""
        order_in(craft, PLACES, self.simulator)
        w = Wording(craft, self.simulator)
        slope, offset, torque = about_hover(craft)
        how = "SIH_T_MAX: thrust is linear in the command, which PX4 asks for as a thrust; tangent"
        tangent = {"thrust.c0": offset, "thrust.c1": slope, "thrust.c2": 0.0}
        if craft.thrust[0] or craft.thrust[2]:
            row = Word(
                effect=THRUST_MAP, status=Status.FOLDED, how=how, change=Change(values=tangent)
            )
        else:
            row = Word(effect=THRUST_MAP, status=Status.SAID, how="SIH_T_MAX")
        w.add(row)
        ratio = {f"torque.c{k}": v for k, v in enumerate(torque)}
        same = np.allclose([ratio[f"torque.c{k}"] for k in range(3)], craft.torque)
        w.add(
            Word(effect=TORQUE_MAP, status=Status.SAID, how="SIH_Q_MAX")
            if same
            else Word(
                effect=TORQUE_MAP,
                status=Status.FOLDED,
                how="SIH_Q_MAX: in proportion to thrust, as at hover",
                change=Change(values=ratio),
            )
        )
        w.said("motor_lag", "SIH_T_TAU (of the thrust)").folded_lag_mean()
        w.said("products_of_inertia", "SIH_IXY, SIH_IXZ, SIH_IYZ").said("payload_mass", "SIH_MASS")
        damping = craft.vector("rotational_damping.d_", "pqr")
        mean = float(damping.mean())
        w.folded(
            "rotational_damping",
            "one SIH_KDW for all axes, the mean",
            Change(values={f"rotational_damping.d_{a}": mean for a in "pqr"}),
        )
        level = float(drag_at_hover(craft)[:2].mean())
        fold_drag(w, "one SIH_KDV for all axes", np.full(3, level), wind=True)
        if "steady_wind" in craft.effects:
            up = craft.get("steady_wind.w_z")
            if up == 0.0:
                w.said("steady_wind", "SIH_WIND_N, SIH_WIND_E")
            else:
                w.folded(
                    "steady_wind",
                    "SIH_WIND_N, SIH_WIND_E: no vertical wind",
                    Change(values={"steady_wind.w_z": 0.0}),
                )
        symmetric_arms(w, "SIH_L_ROLL, SIH_L_PITCH")
        return w.finish()

    def files(self, craft: Craft) -> Mapping[str, str]:
        """sih.params and vehicle.params."""
        return {"sih.params": _sih(craft), "vehicle.params": _vehicle(craft)}


def about_hover(craft: Craft) -> tuple[float, float, tuple[float, float, float]]:
    """(slope, offset) of the thrust's tangent at hover [N], and torque c0, c1, c2 in proportion to
    it."""
    _, c1, c2 = craft.thrust
    nu = craft.hover_nu
    slope = float(c1 + 2.0 * c2 * nu)
    hover = craft.mass * craft.gravity / craft.count
    offset = hover - slope * nu
    q0, q1, q2 = craft.torque
    ratio = float(q0 + nu * (q1 + nu * q2)) / hover
    return slope, offset, (ratio * offset, ratio * slope, 0.0)


def full_thrust(craft: Craft) -> float:
    """Thrust of one rotor at nu = 1 by the craft's own map [N]."""
    return float(sum(craft.source.values[f"thrust.c{k}"] for k in range(3)))


def _rows(title: str, rows: list[tuple[str, float | int, str]]) -> str:
    lines = [f"# {title}", "# Vehicle-Id Component-Id Name Value Type"]
    for name, value, note in rows:
        kind = INTEGER if isinstance(value, int) else FLOAT
        lines.append(f"1\t1\t{name}\t{value!r}\t{kind}" + (f"\t# {note}" if note else ""))
    return "\n".join(lines) + "\n"


def _sih(craft: Craft) -> str:
    j, arms = craft.inertia, np.abs(craft.hubs - craft.hubs.mean(axis=0))
    full = full_thrust(craft)
    hover = craft.mass * craft.gravity / craft.count
    q = float(sum(c * craft.hover_nu**k for k, c in enumerate(craft.torque)))
    wind = craft.vector("steady_wind.w_")
    rows: list[tuple[str, float | int, str]] = [
        ("SIH_VEHICLE_TYPE", 0, ""),
        ("SIH_MASS", craft.mass, ""),
        ("SIH_IXX", float(j[0, 0]), ""),
        ("SIH_IYY", float(j[1, 1]), ""),
        ("SIH_IZZ", float(j[2, 2]), ""),
        ("SIH_IXY", float(-j[0, 1]), ""),  # y and z point the other way in FRD
        ("SIH_IXZ", float(-j[0, 2]), ""),
        ("SIH_IYZ", float(j[1, 2]), ""),
        ("SIH_L_ROLL", float(arms[:, 1].mean()), ""),
        ("SIH_L_PITCH", float(arms[:, 0].mean()), ""),
        ("SIH_T_MAX", full, ""),
        ("SIH_Q_MAX", full * q / hover, ""),
        ("SIH_T_TAU", max(craft.get("motor_lag.tau"), SHORTEST_LAG), ""),
        ("SIH_KDV", float(drag_of(craft).mean()), ""),
        ("SIH_KDW", float(craft.vector("rotational_damping.d_", "pqr").mean()), ""),
        # SIH adds the wind to the velocity: it is where the air comes from. North is our y.
        ("SIH_WIND_N", float(-wind[1]), ""),
        ("SIH_WIND_E", float(-wind[0]), ""),
        ("THR_MDL_FAC", 0.0, ""),
        ("MPC_THR_HOVER", hover / full, ""),
    ]
    return _rows(f"SIH of {craft.name}, written by greybox twin", rows)


def _vehicle(craft: Craft) -> str:
    """Control allocation and thrust model of the craft itself."""
    v = {k: float(craft.source.values[f"thrust.c{k}"]) for k in (1, 2)}
    full = full_thrust(craft)
    f = v[2] / (v[1] + v[2]) if v[1] + v[2] else 0.0
    torque = float(sum(craft.source.values[f"torque.c{k}"] for k in range(3)))
    rows: list[tuple[str, float | int, str]] = [("CA_AIRFRAME", 0, ""), ("CA_ROTOR_COUNT", 4, "")]
    for i, k in enumerate(order_in(craft, PLACES, "PX4")):
        x, y, z = (float(v) for v in craft.arms[k])
        rows += [
            (f"CA_ROTOR{i}_PX", x, ""),
            (f"CA_ROTOR{i}_PY", -y, ""),
            (f"CA_ROTOR{i}_PZ", -z, ""),
            (f"CA_ROTOR{i}_CT", full, ""),
            (f"CA_ROTOR{i}_KM", float(craft.spins[k]) * torque / full, ""),
        ]
    rows += [
        ("THR_MDL_FAC", min(max(f, 0.0), 1.0), ""),
        ("MPC_THR_HOVER", craft.mass * craft.gravity / craft.count / full, ""),
    ]
    return _rows(f"Allocation and thrust model of {craft.name}, written by greybox twin", rows)
