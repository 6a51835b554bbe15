"""DiscoverOptions: all choices of a search in one frozen record."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, TypedDict, Unpack

from greybox.discovery.rules import EFFORT, Effort
from greybox.estimation.options import FitOptions, chosen
from greybox.model.effect import Effect
from greybox.model.identified import IdentifiedModel
from greybox.model.known import NOTHING, Known, since
from greybox.takes import NATURAL, SHARE, taken_fields


class DiscoverChoices(TypedDict, total=False):
    """The keywords of `discover`: the fields of `DiscoverOptions`, which says what they mean."""

    own: Iterable[Effect]
    alpha: float
    max_effects: int
    adapt: float | None
    kinematic_noise: bool | None
    per_flight: Iterable[str]
    fixed: Iterable[str]
    hold_sensor_noise: bool
    attainable: bool
    trace: bool
    since: IdentifiedModel | None
    effort: Effort
    seed: int


@dataclass(frozen=True, kw_only=True)
class DiscoverOptions:
    """All choices of a search."""

    own: tuple[Effect, ...] = ()
    """Effects besides the catalogue."""
    alpha: float = 0.05
    """Family-wise level of a name: the probability of a false one on flights that miss nothing."""
    max_effects: int = 12
    """Causes besides those of the base after which the search stops."""
    adapt: float | None = None
    """Seconds of a test flight to fit its own values on (None: 5, at most a third; 0: none)."""
    kinematic_noise: bool | None = None
    """Noise between attitude and gyro (None: where their clocks drift apart)."""
    per_flight: tuple[str, ...] = ()
    """Parameters with one value per flight."""
    fixed: tuple[str, ...] = ()
    """Parameters that stay at the vehicle file's value."""
    hold_sensor_noise: bool = False
    """Whether the sensors' noise levels stay at those of the vehicle file."""
    attainable: bool = False
    """Whether a Gaussian process learns what the bare model misses, for comparison."""
    trace: bool = False
    """Whether what is certain but worth nothing stays in the model."""
    since: IdentifiedModel | None = None
    """A model from which on changes are sought: effects are known, its numbers the prior."""
    effort: Effort = EFFORT
    """How much is tried; decides nothing."""
    seed: int = 0
    """Seed of bootstraps and random halves."""

    def __post_init__(self) -> None:
        taken_fields(self, alpha=SHARE, max_effects=NATURAL)

    @classmethod
    def of(cls, options: DiscoverOptions | None, choices: DiscoverChoices) -> DiscoverOptions:
        """`options` (None: the defaults) with `choices` as its own. Raises `UnknownNameError`."""
        return chosen("option of a search", cls, options, choices)

    def but(self, **choices: Unpack[DiscoverChoices]) -> DiscoverOptions:
        """These options with other `choices`. Raises `UnknownNameError`."""
        return DiscoverOptions.of(self, choices)

    @property
    def known(self) -> Known:
        """What is known before new flights."""
        return NOTHING if self.since is None else since(self.since)

    @property
    def of_every_fit(self) -> FitOptions:
        """What every fit of the search has in common."""
        held: Literal["process"] | bool = "process" if self.hold_sensor_noise else True
        return FitOptions(estimate_noise=held)
