"""Layout: whether rotors stand as a simulator with a fixed frame has them, and in which order."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from greybox.errors import ModelError
from greybox.simulators.craft import Craft
from greybox.symbolic import FloatArray

SYMMETRY = 0.02
"""Largest difference of arms, as a share of the longest one, that still counts as symmetric."""
ANY_LAYOUT = "choose a target that takes any layout: rotorpy, mujoco, crazyflow, gazebo"
"""What is to be done where rotors stand as a simulator does not have them."""
Place = tuple[int, int, int]
"""Sign of x and of y of a hub, and spin."""


def order_in(
    craft: Craft, places: Sequence[Place], simulator: str, *, arms: bool = True
) -> tuple[int, ...]:
    """Which of the craft's rotors (from 0) stands at each of the simulator's `places`; `arms`:
    whether these have to be symmetric.

    Raises `ModelError` for another number of rotors, another pattern of spins, or arms that are not
    symmetric about the centre of the hubs.
    """
    if craft.count != len(places):
        raise ModelError(
            f"{simulator} has {len(places)} rotors, {craft.title} {craft.count}",
            fix=ANY_LAYOUT,
        )
    hubs = craft.hubs[:, :2] - craft.hubs[:, :2].mean(axis=0)
    tolerance = SYMMETRY * float(np.abs(hubs).max())
    signs = np.where(np.abs(hubs) <= tolerance, 0, np.sign(hubs)).astype(int)
    rotors: list[Place] = [
        (int(x), int(y), int(s)) for (x, y), s in zip(signs, craft.spins, strict=True)
    ]
    for order in itertools.permutations(range(craft.count)):
        if [rotors[i] for i in order] == list(places):
            if arms:
                _check_arms(hubs, tolerance, simulator)
            return order
    raise ModelError(
        f"{simulator} cannot express the rotors of {craft.title}",
        expected=f"hubs and spins as {', '.join(_words(p) for p in places)}",
        got=", ".join(_words(r) for r in rotors),
        fix=ANY_LAYOUT,
    )


def _check_arms(hubs: FloatArray, tolerance: float, simulator: str) -> None:
    for axis, name in enumerate("xy"):
        arms = np.abs(hubs[:, axis])
        arms = arms[arms > tolerance]
        if len(arms) and arms.max() - arms.min() > tolerance:
            raise ModelError(
                f"{simulator} has one arm along {name}",
                got=f"{arms.min():.4g} to {arms.max():.4g} m",
                fix=ANY_LAYOUT,
            )


def _words(place: Place) -> str:
    x, y, spin = place
    where = {1: "front", -1: "rear", 0: ""}[x], {1: "left", -1: "right", 0: ""}[y]
    return f"{' '.join(w for w in where if w) or 'centre'} {'ccw' if spin > 0 else 'cw'}"
