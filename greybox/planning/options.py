"""PlanOptions: all choices of a plan in one frozen record."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TypedDict, Unpack

from greybox.errors import GreyboxError
from greybox.estimation.options import chosen
from greybox.model.effect import Effect
from greybox.planning.limits import Limits
from greybox.takes import COUNT, EFFECTS, POSITIVE, Kind, has, taken_fields

LIMITS = Kind(
    words="Limits",
    fits=has("box", "floor", "command"),
    fix="greybox.planning.limits.Limits(box=...)",
)

LONGEST = 3600.0
"""Seconds [s] of all flights beyond which a plan is refused: no battery lasts so long, and
milliseconds that were given for seconds are caught."""


def demand_lengths(
    of: str, seconds: float, piece: float, *, shortest: tuple[float, str], longest: float
) -> None:
    """That a `piece` [s] lasts the `shortest` time at least ([s], and in words), and that all
    `seconds` of what it is a part `of` hold one and are no more than the `longest` [s]. Raises
    `GreyboxError`."""
    least, said = shortest
    if least <= piece <= seconds <= longest:
        return
    wrong = "--piece is longer than --seconds"
    if seconds > longest:
        wrong = f"too long {of}"
    elif not seconds >= least:
        wrong = f"too short {of}"
    elif not piece >= least:
        wrong = "too short a --piece"
    usual = min(max(5.0, 2 * least), longest / 24)
    raise GreyboxError(
        wrong,
        expected=f"{said} <= --piece <= --seconds <= {longest:g} s",
        got=f"--piece {piece:g} and --seconds {seconds:g}",
        fix=f"--seconds {12 * usual:g} --piece {usual:g}",
    )


def whole_pieces(seconds: float, piece: float) -> int:
    """How many manoeuvres of `piece` [s] fit into `seconds`."""
    return int(seconds / piece + 1e-9)


def left_over(seconds: float, piece: float) -> tuple[str, ...]:
    """What whole manoeuvres leave of the time that was asked for, in words; empty for nothing."""
    count = whole_pieces(seconds, piece)
    if seconds - count * piece < 1e-6 * seconds:
        return ()
    return (
        f"{seconds:g} s were asked for, of which whole manoeuvres of {piece:g} s take "
        f"{count * piece:g} s: --seconds {(count + 1) * piece:g}, or another --piece",
    )


class PlanChoices(TypedDict, total=False):
    """The keywords of `plan`: the fields of `PlanOptions`, which says what they mean."""

    effects: Iterable[str | Effect]
    seconds: float
    piece: float
    flights: int
    limits: Limits | None
    free: Iterable[str] | None
    values: Mapping[str, float] | None
    noise: Mapping[str, float] | None
    sensors: Iterable[str] | None
    sample_time: float | None
    setpoints_only: bool
    seed: int


@dataclass(frozen=True, kw_only=True)
class PlanOptions:
    """All choices of a plan."""

    effects: tuple[str | Effect, ...] = ()
    """Effects whose parameters are wanted; none: all that are free."""
    seconds: float = 60.0
    """Length of all flights together [s]."""
    piece: float = 5.0
    """Length of one manoeuvre [s]."""
    flights: int = 1
    """Number of flights that the manoeuvres are split over."""
    limits: Limits | None = None
    """What may not be left; None: a box of 4 x 4 x 2.5 m, 3 m/s, 35 degrees, the command range less
    2 %."""
    free: tuple[str, ...] | None = None
    """Exactly these parameters are estimated; None: as in a fit."""
    values: Mapping[str, float] = field(default_factory=dict)
    """Parameter values that are taken for true, in SI units."""
    noise: Mapping[str, float] = field(default_factory=dict)
    """Noise levels by name, in SI units, as in a fit."""
    sensors: tuple[str, ...] | None = None
    """Sensors of the craft; None: those of the model, or position, attitude, gyro and
    accelerometer."""
    sample_time: float | None = None
    """Sample time [s]; None: that of the model."""
    setpoints_only: bool = False
    """Leave out manoeuvres that need injected signals."""
    seed: int = 0
    """Seed of random manoeuvres."""

    def __post_init__(self) -> None:
        taken_fields(self, effects=EFFECTS, limits=LIMITS, sample_time=POSITIVE, flights=COUNT)

    @classmethod
    def of(cls, options: PlanOptions | None, choices: PlanChoices) -> PlanOptions:
        """`options` (None: the defaults) with the `choices` in place of its own. Raises
        `UnknownNameError`."""
        return chosen("option of a plan", cls, options, choices)

    def but(self, **choices: Unpack[PlanChoices]) -> PlanOptions:
        """These options with other `choices`. Raises `UnknownNameError`."""
        return PlanOptions.of(self, choices)
