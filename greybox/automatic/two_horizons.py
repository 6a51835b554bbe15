"""Two horizons: error bars of a fit to errors ahead that hold what one step ahead says.

Errors half a second ahead are least where the model foretells, not where its numbers are true: under
feedback the commands answer gusts, and what they answer is taken for what they do (Ljung 1999,
System Identification, sec. 13.4). The likelihood one step ahead knows the commands' past alone, and
has the truth where the model's form is right. Both were fitted to the same pieces when the recipe
was decided. Where the form is right they differ by chance, with at most the variance of the one that
knows less (Hausman 1978, Econometrica 46(6)). Where they differ by more, nobody knows which is
nearer, and the errors hold the rest of the difference.
"""

from __future__ import annotations

import numpy as np

from greybox.automatic.trials import Candidate
from greybox.automatic.widened import HELD, moved_away, no_measurement, widened
from greybox.estimation.result import Estimate, Fit
from greybox.model.layer import own_parameters

WHY = "the same flights, told by the likelihood one step ahead,"
"""What moves numbers that depend on how far ahead a fit looks."""


def with_one_step(found: Fit, candidate: Candidate | None) -> Fit:
    """A fit to errors ahead with errors that hold how much further than by chance the likelihood
    moves the `candidate` it began with; every other fit, and where one of the two did not end at a
    minimum, as it was."""
    if candidate is None or candidate.ahead is None or candidate.fit is not candidate.ahead:
        return found
    if found.settings["predictor"] != candidate.ahead.settings["predictor"]:
        return found
    if not (candidate.likelihood.converged and candidate.ahead.converged):
        return found
    far, near = candidate.ahead.parameters, candidate.likelihood.parameters
    shift: list[float] = []
    rows: dict[str, list[int]] = {}
    for name in sorted(own_parameters(found.model.dynamics) & {*found.parameters}):
        if name not in far or name not in near or not found.parameters[name].std > 0:
            continue
        flights = found.parameters[name].per_flight or {"": (0.0, 0.0)}
        moved = [_beyond_chance(_at(near[name], f), _at(far[name], f)) for f in flights]
        rows[name] = list(range(len(shift), len(shift) + len(moved)))
        shift += moved
    if not any(shift):
        return found
    moves = np.array(shift)
    line = no_measurement(moved_away(found, moves, rows), WHY, HELD)
    return widened(found, np.outer(moves, moves), rows, line)


def _at(estimate: Estimate, flight: str) -> tuple[float, float]:
    """(value, standard error) in a flight, those of all where it has none there."""
    return estimate.per_flight.get(flight, (estimate.value, estimate.std))


def _beyond_chance(near: tuple[float, float], far: tuple[float, float]) -> float:
    """How far `near` is from `far`, each (value, standard error), less what chance does: its square
    less the variance of `far`. At a bound, where there is no error, they differ by chance alone."""
    (one, _), (other, std) = near, far
    moved = one - other
    excess = moved**2 - std**2
    return float(np.copysign(np.sqrt(excess), moved)) if excess > 0 else 0.0
