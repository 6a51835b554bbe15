"""ValidateOptions: all choices of a validation in one frozen record."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TypedDict

from greybox.data.segment import START_SECONDS
from greybox.estimation.options import chosen
from greybox.takes import COUNT, NOT_NEGATIVE, Several, has, taken_fields
from greybox.validation.advice import Hint

HINTS = Several(
    words="a list of Hints",
    fits=has("symptom", "detail"),
    fix="[greybox.validation.advice.Hint(symptom=...)]",
)


class HorizonChoices(TypedDict, total=False):
    """Those of `ValidateChoices` that say how far ahead."""

    horizons: Sequence[float] | None
    horizon_samples: Sequence[int] | None


class ValidateChoices(HorizonChoices, total=False):
    """The keywords of `validate`: the fields of `ValidateOptions`, which says what they mean."""

    adapt: float | None
    measured_start: bool
    every: int | None
    skip: float
    judged_on: str | None
    hints: Iterable[Hint]
    use_compiler: bool


@dataclass(frozen=True, kw_only=True)
class ValidateOptions:
    """All choices of a validation."""

    horizons: tuple[float, ...] | None = None
    """Horizons that are listed [s]; None: `HORIZONS`, of a model that is no vehicle's `SAMPLES`."""
    horizon_samples: tuple[int, ...] | None = None
    """The same in numbers of samples, instead."""
    adapt: float | None = None
    """Seconds at the beginning of a flight that its per-flight parameters and its initial state are
    fitted on (0: not at all); None: on `adaptation` of those flights whose own values the model has
    and does not know."""
    measured_start: bool = False
    """Whether a row starts from the measured state, smoothed velocities included."""
    every: int | None = None
    """One of so many samples is an origin; None: one per `SPACING` seconds."""
    skip: float = START_SECONDS
    """Seconds after the start of a segment before its first origin."""
    judged_on: str | None = None
    """What the flights are to the model, in words; None: from the names of its training flights."""
    hints: tuple[Hint, ...] = ()
    """What else was seen, for the verdict."""
    use_compiler: bool = True
    """Whether the model runs as compiled C where there is a compiler; False: in CasADi's VM."""

    def __post_init__(self) -> None:
        taken_fields(self, every=COUNT, skip=NOT_NEGATIVE, hints=HINTS)

    @classmethod
    def of(cls, options: ValidateOptions | None, choices: ValidateChoices) -> ValidateOptions:
        """`options` (None: the defaults) with the `choices` in place of its own. Raises
        `UnknownNameError`."""
        return chosen("option of a validation", cls, options, choices)
