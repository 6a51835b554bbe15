"""Allocation: whether rotors, where they stand and as they turn, hold a craft and turn it.

Thrust and the three moments are rows of a mixer: they must be independent, and some thrusts within
the range of commands must hold the craft level.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.optimize import linprog

from greybox.model.plausibility.craft import HOVER_RANGE, Craft
from greybox.model.plausibility.finding import Implausible
from greybox.symbolic import FloatArray


def allocation(c: Craft) -> Iterator[Implausible]:
    """Whether the rotors can make thrust and all three moments, and hover level."""
    arms = c.place - np.array([q.value for q in c.vehicle.center_of_mass])
    lever = c.lever or 0.0
    lost = [*_dependent(c, _mixer(c, arms, c.spin * lever / c.L), lever)]
    yield from lost
    if not lost:
        yield from _level_hover(c, arms)
        yield from _hubs(c, arms)
        yield from _discs(c)


def _mixer(c: Craft, arms: FloatArray, yaw: FloatArray) -> FloatArray:
    """(4, n): thrust, roll, pitch and yaw that every rotor makes with arms (n, 3) and `yaw` (n,),
    in units of it; signs do not matter to who asks."""
    return np.stack([np.ones(c.n), arms[:, 1] / c.L, arms[:, 0] / c.L, yaw])


def _dependent(c: Craft, rows: FloatArray, lever: float) -> Iterator[Implausible]:
    """Which of thrust and moments, the rows (4, n) of the mixer, are no independent ones."""
    names = ("thrust", "roll", "pitch", "yaw")
    rank = int(np.linalg.matrix_rank(rows, tol=1e-3 * max(abs(lever) / c.L, 1e-9)))
    if rank == 4:
        return
    lost = [
        n
        for k, n in enumerate(names)
        if np.linalg.matrix_rank(np.delete(rows, k, 0), tol=1e-6) == rank
    ]
    if c.n < 4:
        fix = "greybox models fixed rotors: four or more are needed"
    elif not lever:
        fix = "give the torque map: without it there is no yaw"
    else:
        fix = (
            f"check spins ({_pattern(c)}) and positions: neighbours turn opposite ways, "
            "opposite rotors alike"
        )
    yield Implausible(
        "blocking",
        "rotor",
        f"no independent {', '.join(lost)}",
        "thrust, roll, pitch and yaw of rank 4",
        f"rank {rank}",
        fix,
    )


def _level_hover(c: Craft, arms: FloatArray) -> Iterator[Implausible]:
    """Whether every rotor lifts in a level hover, with room to both sides: one at rest can only
    push one way, which controls nothing (Du, Quan, Yang and Cai 2015, J. Guidance, Control, and
    Dynamics 38(5))."""
    if not c.lift[-1] >= c.weight:
        return
    thrusts = _even_hover(c, arms, c.spin)
    if thrusts is not None:
        yield from _uneven(c, thrusts)
    elif _even_hover(c, arms, np.zeros(c.n)) is not None:
        one_turned = [i + 1 for i in range(c.n) if _hovers_evenly(c, arms, i)]
        yield Implausible(
            "blocking",
            "rotor.spin",
            "no level hover without yaw torque in which every rotor lifts",
            "thrusts above zero that carry the weight with no moment",
            f"spins {_pattern(c)}",
            f"turn the spin of rotor {' or '.join(map(str, one_turned))} round"
            if one_turned
            else "compare each spin with the craft: neighbours turn opposite ways",
        )
    else:
        yield Implausible(
            "blocking",
            "rotor.position",
            "the rotors cannot hover level",
            "thrust = weight with no moment within the command range",
            "no such commands",
            "check signs of the positions (x forward, y left) and the centre of mass",
        )


def _even_hover(c: Craft, arms: FloatArray, spin: FloatArray) -> FloatArray | None:
    """Thrusts (n,) of the rotors [N] in the level hover whose weakest rotor lifts most; None where
    there is none in which all lift."""
    # Shares of the mean thrust and, last, the least of them, which is maximised.
    low, high = float(c.lift.min()) / c.weight, float(c.lift.max()) / c.weight
    balance = _mixer(c, arms, spin)
    balance[0] /= c.n
    best = linprog(
        c=np.append(np.zeros(c.n), -1.0),
        A_ub=np.column_stack([-np.eye(c.n), np.ones(c.n)]),
        b_ub=np.zeros(c.n),
        A_eq=np.column_stack([balance, np.zeros(4)]),
        b_eq=[1.0, 0.0, 0.0, 0.0],
        bounds=[(low, high)] * c.n + [(None, None)],
    )
    # A share of a millionth is the rounding of the solver.
    if not (best.success and best.x[-1] > 1e-6):
        return None
    return np.asarray(best.x[:-1], dtype=np.float64) * c.weight / c.n


def _hovers_evenly(c: Craft, arms: FloatArray, rotor: int) -> bool:
    """Whether the craft hovers with that rotor (counted from 0) turned round and keeps its yaw."""
    spin = np.where(np.arange(c.n) == rotor, -c.spin, c.spin)
    rank = int(np.linalg.matrix_rank(_mixer(c, arms, spin)))
    return rank == 4 and _even_hover(c, arms, spin) is not None


def _uneven(c: Craft, thrusts: FloatArray) -> Iterator[Implausible]:
    """A rotor close to a limit in the level hover (thrusts (n,) [N]), where all on average are
    not."""
    shares = c.share_of(np.interp(thrusts * c.n, c.lift, c.u))
    low, high = HOVER_RANGE
    if c.hover is None or not low <= float(c.share_of(c.hover)) <= high:
        return
    if shares.min() < low or shares.max() > high:
        yield Implausible(
            "warning",
            "rotor",
            "a level hover needs very unequal thrusts",
            f"{100 * low:.0f} to {100 * high:.0f} % of the command range for every rotor",
            ", ".join(f"{100 * s:.0f} %" for s in shares),
            "check spins, positions and the centre of mass",
        )


def _pattern(c: Craft) -> str:
    return " ".join(f"{int(s):+d}" for s in c.spin)


def _hubs(c: Craft, arms: FloatArray) -> Iterator[Implausible]:
    """Levers for roll and pitch, and the length of the arms (n, 3) alike."""
    for axis, name in ((1, "roll"), (0, "pitch")):
        reach = float(np.abs(arms[:, axis]).max())
        if reach < 0.2 * c.L:
            yield Implausible(
                "warning",
                "rotor.position",
                f"hardly any lever for {name}",
                f"above {0.2 * c.L:.3g} m",
                f"{reach:.3g} m",
                "check x and y of the hubs",
            )
    reach_all = np.hypot(c.place[:, 0], c.place[:, 1])
    if reach_all.max() > 1.5 * max(reach_all.min(), 1e-9):
        yield Implausible(
            "warning",
            "rotor.position",
            "arms of different length",
            f"all near {np.median(reach_all):.3g} m",
            f"{reach_all.min():.3g} to {reach_all.max():.3g} m",
            "check each hub position",
        )


def _discs(c: Craft) -> Iterator[Implausible]:
    """Whether discs at about one height overlap."""
    radius = c.vehicle.actuator.rotor_radius
    if radius is None:
        return
    gaps = [
        float(np.linalg.norm(a - b))
        for i, a in enumerate(c.place)
        for b in c.place[:i]
        if abs(a[2] - b[2]) < 0.1 * c.L
    ]
    if gaps and 2 * radius > 1.05 * min(gaps):
        yield Implausible(
            "warning",
            "actuator.rotor_radius",
            "discs overlap",
            f"at most {min(gaps) / 2:.3g} m",
            f"{radius:g} m",
            "give the radius in metres, not the diameter",
        )
