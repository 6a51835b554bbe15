"""State blocks of the rigid body, and where they are when a flight begins."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from greybox.model.sensor import Start
from greybox.symbolic import FloatArray


@dataclass(frozen=True, kw_only=True)
class Block:
    """A state block of the rigid body: letters and unit of its components, and where a flight
    starts where no sensor says more: at `rest`, with the standard deviation `spread` per error
    component (always three)."""

    letters: str
    unit: str
    rest: tuple[float, ...]
    spread: float

    @property
    def size(self) -> int:
        """Number of components of the state; its error has three."""
        return len(self.letters)


BLOCKS: Mapping[str, Block] = {
    "position": Block(letters="xyz", unit="m", rest=(0.0, 0.0, 0.0), spread=10.0),
    "velocity": Block(letters="xyz", unit="m/s", rest=(0.0, 0.0, 0.0), spread=1.0),
    "attitude": Block(letters="wxyz", unit="-", rest=(1.0, 0.0, 0.0, 0.0), spread=0.3),
    "rate": Block(letters="xyz", unit="rad/s", rest=(0.0, 0.0, 0.0), spread=1.0),
}
"""State blocks by name, in the order of the state. What effects and sensors remember follows, and
rotor states where there is a lag."""


def start_of(name: str, said: Iterable[Start]) -> tuple[FloatArray, FloatArray]:
    """(value, standard deviations of its three error components) of a block at the start of a
    flight.

    Of what sensors say of it the surest counts, else the craft is level and at rest.
    """
    value, spread = np.array(BLOCKS[name].rest), np.full(3, BLOCKS[name].spread)
    for start in (s for s in said if s.block == name):
        new, near = np.asarray(start.value, dtype=float), np.asarray(start.spread, dtype=float)
        if value.shape == spread.shape:
            better = np.isfinite(new) & (near < spread)
            value[better], spread[better] = new[better], near[better]
        elif np.isfinite(new).all() and near.mean() < spread.mean():
            value, spread = new, near  # the components of a quaternion belong together
    return value, spread


def first_times(start: Mapping[str, FloatArray]) -> FloatArray:
    """Times of the first samples [s]."""
    return np.asarray(start.get("t", np.array([0.0])))


def usual_of(name: str) -> str:
    """Under which name the first samples hold the mean of a column over the whole segment."""
    return f"usual {name}"


def first_columns(start: Mapping[str, FloatArray], names: Sequence[str]) -> FloatArray:
    """First samples of named channels, (n, columns); one row of NaN where they are not all of one
    length."""
    columns = [np.asarray(start.get(n, np.array([np.nan]))) for n in names]
    return (
        np.column_stack(columns)
        if len({c.size for c in columns}) == 1
        else np.full((1, len(names)), np.nan)
    )
