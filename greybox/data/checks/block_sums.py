"""Sums over blocks of time: their total, all blocks but one, and those of several flights together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Self

import numpy as np

from greybox.symbolic import FloatArray

BLOCKS = 8
"""Blocks of time into which a flight is cut, and which are left out one by one."""


class BlockSums:
    """A dataclass of arrays alone, each with its blocks along `block_axis`."""

    block_axis: ClassVar[int]

    @property
    def total(self) -> Self:
        """Over all blocks, as one block."""
        return self._with({k: v.sum(self.block_axis, keepdims=True) for k, v in vars(self).items()})

    @property
    def left_out(self) -> Self:
        """Over all blocks but one, for each block."""
        total = vars(self.total)
        return self._with({k: total[k] - v for k, v in vars(self).items()})

    @classmethod
    def joined(cls, flights: Sequence[Self]) -> Self:
        """The blocks of several flights together."""
        first, axis = flights[0], cls.block_axis
        return first._with(
            {k: np.concatenate([vars(f)[k] for f in flights], axis=axis) for k in vars(first)}
        )

    def _with(self, arrays: dict[str, FloatArray]) -> Self:
        return type(self)(**arrays)
