"""Horizons are times: how far ahead a prediction is judged, in seconds and in samples of a model.

A horizon in samples means another time at every rate; seconds mean the same everywhere. Samples
remain for comparisons with tables that count them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from greybox.errors import DataError

HORIZONS = (0.01, 0.1, 0.5, 1.0)
"""Seconds ahead that are listed unless others are asked for: one sample at 100 Hz, the time in
which rotors answer, the look-ahead of a position controller, and twice that."""
SAMPLES = (1, 10, 50, 100)
"""Samples ahead that are listed of a model that is not a vehicle's: its time scale is its own."""
LONGEST = 10.0
"""Seconds [s] beyond which a horizon is refused: nobody predicts a multirotor open loop so far, and
a number of samples given where seconds are expected is caught."""


@dataclass(frozen=True, kw_only=True)
class Horizons:
    """Numbers of samples `steps` (increasing, each once), and what had to be changed to get them
    (`notes`)."""

    steps: tuple[int, ...]
    notes: tuple[str, ...] = ()


def horizons_of(
    seconds: Sequence[float] = HORIZONS,
    *,
    samples: Sequence[int] | None = None,
    sample_time: float,
    longest: float = LONGEST,
) -> Horizons:
    """Horizons in samples of `sample_time` [s] from `seconds`, or `samples` themselves where they
    are given.

    A time is rounded to the nearest sample; one below a sample becomes one sample, which is noted
    where it was asked for (tables show the time of each column). Raises `DataError` for no horizon,
    a horizon that is not positive, beyond `longest` seconds, or a number of samples that is not
    whole.
    """
    if samples is not None:
        if not samples or any(int(h) != h or h < 1 for h in samples):
            raise DataError(
                "horizons in samples must be whole numbers above zero",
                expected="1, 10, 50",
                got=str(list(samples)),
            )
        return Horizons(steps=tuple(sorted({int(h) for h in samples})))
    if not seconds or not all(0 < s <= longest for s in seconds):
        raise DataError(
            "horizons must be times ahead",
            expected=f"seconds above 0, at most {longest:g}",
            got=str([float(s) for s in seconds]),
            fix="0.1, 0.5, 1; numbers of samples are given as such (horizon_samples, "
            "--horizons-samples)",
        )
    short = sorted({float(s) for s in seconds if s < sample_time * (1 - 1e-9)})
    notes = (
        [
            f"horizon {', '.join(f'{s:g}' for s in short)} s is below one sample: "
            f"one sample, {sample_time:.4g} s, is judged instead"
        ]
        if short and tuple(seconds) != HORIZONS
        else []
    )
    steps = tuple(sorted({max(1, round(s / sample_time)) for s in seconds}))
    return Horizons(steps=steps, notes=tuple(notes))


def parse_seconds(
    text: str, option: str = "--horizons", longest: float = LONGEST
) -> tuple[float, ...]:
    """Times [s] from "0.1,0.5,1". Raises `DataError`."""
    try:
        values = tuple(float(part) for part in text.split(",") if part.strip())
    except ValueError:
        values = ()
    if not values or not all(0 < v <= longest for v in values):
        raise DataError(
            option,
            expected=f"horizons in seconds up to {longest:g}, such as 0.1,0.5,1",
            got=repr(text),
            fix="numbers of samples are given to --horizons-samples",
        )
    return values


def parse_samples(text: str, option: str = "--horizons-samples") -> tuple[int, ...]:
    """Whole numbers from "1,10,50". Raises `DataError`."""
    try:
        values = tuple(int(part) for part in text.split(",") if part.strip())
    except ValueError:
        values = ()
    if not values or min(values) < 1:
        raise DataError(
            option,
            expected="horizons as whole numbers of samples, such as 1,10,50",
            got=repr(text),
        )
    return values
