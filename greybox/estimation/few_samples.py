"""Few samples: when there are too few for a fit, and when too few for its standard errors.

The Fisher covariance takes the noise levels for known; in a second of data a level that comes out
too small by chance makes the errors too small with it. With levels that are held the 95 % intervals
hold the truth in 93 to 97 % from 0.6 s on; with estimated ones in 74 % (0.6 s), 81 % (1 s), 93 % (2
s) and 97 % (4 s), see `scenarios.studies.short_flights`. Doubt about the levels by quadrature
brought 82 % at 1 s, restricted likelihood with Satterthwaite's degrees of freedom 88 %: neither
makes a 95 % interval, so it is said that the flights are too short.
"""

from __future__ import annotations

from greybox.data import Dataset
from greybox.errors import DataError
from greybox.estimation.covariance import FEWEST_BLOCKS
from greybox.estimation.problem import Problem

SHORTEST_FLIGHT = 0.6
"""Seconds without an interruption: the first tenth tells only its commands."""


def demand_long_enough(train: Dataset) -> None:
    """Raise `DataError` where no flight is long enough to search in."""
    longest = max((s.n * f.dt for f in train for s in f.segments), default=0.0)
    if longest < SHORTEST_FLIGHT:
        raise DataError(
            "no training flight is long enough to search in",
            expected=f"{SHORTEST_FLIGHT:g} s without an interruption",
            got=f"{longest:.2g} s at most",
            fix="flights of some ten seconds in which everything moves",
        )


def demand_samples(problem: Problem) -> None:
    """Raise `DataError` where there are fewer samples than unknowns (initial states left out: they
    are read off the data)."""
    samples = sum(int((r.mask != 0).any(axis=1).sum()) for r in problem.records)
    unknowns = sum(u.kind != "initial" for u in problem.unknowns)
    if samples < unknowns:
        raise DataError(
            f"{samples} samples are fewer than the {unknowns} unknowns",
            fix="pass a longer flight, or hold parameters (--fixed) and noise levels "
            "(--hold-noise)",
        )


def too_short_for_errors(blocks: int, seconds: float, levels: bool, coloured: bool) -> str:
    """What to know of standard errors that rest on so few stretches of `seconds`: `levels` were
    estimated from them, or the innovations are `coloured`."""
    why = ["noise levels are hardly known"] * levels + [
        "what colours the innovations is not allowed for"
    ] * coloured
    fix = "fly longer, or hold them (--hold-noise)" if levels and not coloured else "fly longer"
    return (
        f"standard errors are too small: the flights hold {blocks} stretch(es) of {seconds:.2g} s, "
        f"fewer than {FEWEST_BLOCKS}, so that {' and '.join(why)}; {fix}"
    )
