"""CompareOptions: all choices of a comparison in one frozen record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypedDict

from greybox.estimation.options import chosen
from greybox.takes import COUNT, taken_fields


class CompareChoices(TypedDict, total=False):
    """The keywords of `compare`: the fields of `CompareOptions`, which says what they mean."""

    adapt: float | None
    budget: int
    points: int
    seed: int
    horizons: Sequence[int]


@dataclass(frozen=True, kw_only=True)
class CompareOptions:
    """All choices of a comparison."""

    adapt: float | None = None
    """Seconds at the start of a test flight on which what belongs to a flight is fitted (None: 5, at
    most a third; 0: not)."""
    budget: int = 4
    """Candidates of every method that is tuned."""
    points: int = 50
    """Support points of every Gaussian process."""
    seed: int = 0
    """Seed of all that is drawn."""
    horizons: tuple[int, ...] = (1, 10, 50, 100)
    """Samples ahead that are listed."""

    def __post_init__(self) -> None:
        taken_fields(self, budget=COUNT, points=COUNT)

    @classmethod
    def of(cls, options: CompareOptions | None, choices: CompareChoices) -> CompareOptions:
        """`options` (None: the defaults) with the `choices` in place of its own. Raises
        `UnknownNameError`."""
        return chosen("option of a comparison", cls, options, choices)
