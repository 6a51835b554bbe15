"""Pieces of flights that are left out: how a model is judged where there are no test flights.

Whoever has test flights should use them: neighbouring pieces of one flight share battery, trim and
air. Pieces are long stretches with the seconds between them dropped, so that no error ahead reaches
into what was fitted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from greybox.data import Dataset, Flight, Segment
from greybox.errors import DataError
from greybox.model.identified import IdentifiedModel
from greybox.validation.result import Validation
from greybox.validation.usefulness import LEFT_OUT
from greybox.validation.validate import validate

GUARD = 1.0
"""Seconds dropped at every cut: the longest horizon that is judged."""
SHORTEST = 2.0
"""Seconds below which a stretch is dropped: the filter starts and one look-ahead must fit in."""

Spans = Callable[[Flight], list[tuple[float, float]]]
"""Log times [s] from and to, of the stretches of a flight that are left out, in order."""


@dataclass(frozen=True, kw_only=True)
class Split:
    """Flights to fit and pieces that were left out of them; flights keep their names in both."""

    fitted: Dataset
    left_out: Dataset


def leave_out(data: Dataset, *, share: float = 1 / 3) -> Split:
    """The last `share` of the time of every flight is left out.

    Raises `DataError` for a share outside (0, 1), and where nothing long enough remains on either
    side.
    """
    if not 0.0 < share < 1.0:
        raise DataError(
            "share of the flights to leave out", expected="between 0 and 1", got=f"{share:g}"
        )
    return _split(data, lambda flight: [_span(flight, 1.0 - share, 1.0)])


def folds(data: Dataset, *, count: int = 3) -> tuple[Split, ...]:
    """`count` splits: in the k-th, the k-th of `count` equal times of every flight is left out.

    Together the left-out pieces cover the flights, apart from the seconds at the cuts. Raises
    `DataError` for fewer than two, and for flights that are too short.
    """
    if count < 2:
        raise DataError("folds of the flights", expected="two or more", got=str(count))

    def of(k: int) -> Split:
        return _split(data, lambda flight: [_span(flight, k / count, (k + 1) / count)])

    return tuple(of(k) for k in range(count))


def alternating(data: Dataset, *, seconds: float = 5.0) -> Split:
    """Every second stretch of `seconds` [s] of every flight is left out: both halves see the whole
    flight.

    Raises `DataError` for stretches below `SHORTEST` and two cuts, and for flights that are too
    short.
    """
    if not seconds >= SHORTEST + 2 * GUARD:
        raise DataError(
            "alternating pieces",
            expected=f"at least {SHORTEST + 2 * GUARD:g} s each",
            got=f"{seconds:g} s",
        )

    def spans(flight: Flight) -> list[tuple[float, float]]:
        start, stop = _span(flight, 0.0, 1.0)
        pieces = int((stop - start) / seconds)
        return [(start + k * seconds, start + (k + 1) * seconds) for k in range(1, pieces + 1, 2)]

    return _split(data, spans)


def judge_pieces(
    model: IdentifiedModel, split: Split, *, adapt: float | None = None, use_compiler: bool = True
) -> Validation:
    """`validate` on the left-out pieces of a split whose `fitted` side `model` was fitted to.

    The words of the verdict say so. Raises what `validate` raises.
    """
    return validate(
        model, split.left_out, adapt=adapt, judged_on=LEFT_OUT, use_compiler=use_compiler
    )


def _span(flight: Flight, first: float, last: float) -> tuple[float, float]:
    """Log times [s] at two shares of the time span; the end includes the last sample."""
    start, stop = float(flight.segments[0].t[0]), float(flight.segments[-1].t[-1]) + flight.dt
    return start + first * (stop - start), start + last * (stop - start)


def _split(data: Dataset, spans: Spans) -> Split:
    fitted: list[Flight] = []
    left: list[Flight] = []
    for flight in data:
        out = spans(flight)
        begin, end = _span(flight, 0.0, 1.0)
        edges = [begin, *(t for span in out for t in span), end]
        inside = list(zip(edges[::2], edges[1::2], strict=True))
        for target, stretches in ((fitted, inside), (left, out)):
            part = _part(flight, stretches, begin, end)
            if part is not None:
                target.append(part)
    if not fitted or not left:
        raise DataError(
            "the flights are too short to leave a piece out",
            expected=f"stretches of {SHORTEST:g} s",
            fix="--test",
        )
    return Split(fitted=Dataset(flights=tuple(fitted)), left_out=Dataset(flights=tuple(left)))


def _part(
    flight: Flight, stretches: list[tuple[float, float]], begin: float, end: float
) -> Flight | None:
    """The stretches of a flight, shortened by half the guard at every cut; None where none is long
    enough."""
    kept: list[Segment] = []
    for a, b in stretches:
        first = a if a <= begin + 1e-9 else a + 0.5 * GUARD
        last = b if b >= end - 1e-9 else b - 0.5 * GUARD
        for segment in flight.segments:
            inside = (segment.t >= first - 1e-9) & (segment.t < last - 1e-9)
            if inside.sum() * segment.dt >= SHORTEST - 1e-9:
                kept.append(segment.between(first - 1e-9, last - 1e-9))
    return replace(flight, segments=tuple(kept)) if kept else None
