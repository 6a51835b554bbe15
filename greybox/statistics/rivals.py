"""Rivals: what else the data may want in a model, and what that does to the estimates it has.

At a minimum the cost is a parabola, in the unknowns that were fitted and in those of causes that
were left out. Each set of causes then has its evidence and a shift of every estimate (the bias of an
omitted variable), without a fit. An error bar that holds under any form is the average over forms,

    variance = sum_f w_f (variance under f + shift_f shift_f'),

with the posterior odds w_f (Hoeting, Madigan, Raftery and Volinsky 1999, Statistical Science
14(4)). A set that is less likely than without its last cause is no rival (Occam's window: Madigan
and Raftery 1994, JASA 89(428)): what the data do not ask for widens nothing. Scores that scatter
more than the information says, as those of coloured errors do, count for less (Rotnitzky and Jewell
1990, Biometrika 77(3)). A form is judged where it is possible: an estimate that it would move beyond
its bounds stops there.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

TOGETHER = 6
"""Causes of one set at most: the later ones rest on a parabola about the fit without any."""
DEAD = 1e-8
"""Information per prior below which nothing is felt but rounding."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Parabola:
    """The cost about a fit: `information` (n, n) with all priors and `gradient` (n,), by the
    unknowns that are `fitted` and by those of `causes`, which stand at nothing with priors of
    precision `prior` (n,). `low`, `high` (n,): how far each may step, 0 at a bound. `scatter` (n,
    n): sum of the outer products of block scores, None where errors are white."""

    information: FloatArray
    gradient: FloatArray
    prior: FloatArray
    fitted: Sequence[int]
    causes: Mapping[str, Sequence[int]]
    low: FloatArray
    high: FloatArray
    scatter: FloatArray | None = None

    @staticmethod
    def about(
        data: FloatArray,
        gradient: FloatArray,
        prior: FloatArray,
        loose: Iterable[int],
        causes: Mapping[str, Sequence[int]],
        *,
        low: FloatArray | None = None,
        high: FloatArray | None = None,
        scatter: FloatArray | None = None,
    ) -> Parabola:
        """The parabola where flights give the information `data` (n, n). Of the unknowns that are
        `loose` those are fitted that are no cause's and of which anything is told; without `low`
        and `high` nothing is bounded."""
        information, far = data + np.diag(prior), np.full(len(prior), np.inf)
        of_causes = {i for rows in causes.values() for i in rows}
        return Parabola(
            information=information,
            gradient=gradient,
            prior=prior,
            fitted=[i for i in loose if i not in of_causes and information[i, i] > 0],
            causes=causes,
            low=-far if low is None else low,
            high=far if high is None else high,
            scatter=scatter,
        )

    def felt(self) -> dict[str, list[int]]:
        """Of every cause the places that the data feel."""
        data = np.diag(self.information) - self.prior
        found = {
            n: [i for i in rows if data[i] > DEAD * self.prior[i]]
            for n, rows in self.causes.items()
        }
        return {n: rows for n, rows in found.items() if rows}


@dataclass(frozen=True, kw_only=True, eq=False)
class Form:
    """A set of causes: log of its odds against the fit without any, the `shift` (m,) of the fitted
    unknowns with them, what not knowing their size adds to the covariance (m, m), and by place of
    a cause how far it goes, with the standard error of that (`steps`). `kept_back`: what the cost
    falls less because unknowns stop at their bounds."""

    causes: tuple[str, ...]
    log_odds: float
    shift: FloatArray
    more: FloatArray
    steps: Mapping[int, tuple[float, float]] = field(default_factory=dict)
    kept_back: float = 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Averaged:
    """`spread` (m, m), to be added to the covariance of the fitted unknowns; `shift` (m,), how far
    the average of all forms is from the fit; the likeliest form, None where that is the fit."""

    spread: FloatArray
    shift: FloatArray
    best: Form | None


def room(
    at: FloatArray, lower: FloatArray, upper: FloatArray, bounded: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """(low, high) (n,) of a parabola about `at` (n,): how far each unknown may step to its bounds,
    without end where it is not `bounded`."""
    low, high = np.minimum(lower - at, 0.0), np.maximum(upper - at, 0.0)
    return np.where(bounded, low, -np.inf), np.where(bounded, high, np.inf)


def price_of(at: Parabola) -> float:
    """What each of k causes costs, log k, since so many were asked."""
    return float(np.log(max(len(at.felt()), 1)))


def averaged(at: Parabola, others: Sequence[Form] = ()) -> Averaged:
    """The average over the fit and its rivals, see the module. Forms are sought by steps, each
    from the likeliest of the last one; `others` are known already, from beyond the parabola."""
    felt, size = at.felt(), len(at.fitted)
    price = price_of(at)
    found: list[Form] = []
    best: Form | None = None
    while len(() if best is None else best.causes) < TOGETHER:
        names, odds = ((), 0.0) if best is None else (best.causes, best.log_odds)
        asked = [_form(at, felt, best, n, price) for n in felt if n not in names]
        likelier = [f for f in asked if f is not None and f.log_odds > odds]
        if not likelier:
            break
        found += likelier
        best = max(likelier, key=lambda f: f.log_odds)
    found += others
    spread, shift = np.zeros((size, size)), np.zeros(size)
    if not found:
        return Averaged(spread=spread, shift=shift, best=None)
    logs = np.array([0.0, *(f.log_odds for f in found)])
    weights = np.exp(logs - logs.max())
    for form, weight in zip(found, (weights / weights.sum())[1:], strict=True):
        spread += weight * (form.more + np.outer(form.shift, form.shift))
        shift += weight * form.shift
    return Averaged(spread=spread, shift=shift, best=max(found, key=lambda f: f.log_odds))


def likeliest(at: Parabola, prices: Mapping[str, float]) -> Form | None:
    """The likeliest form, by steps, of causes that cost `prices` each; None where that is the
    fit."""
    felt = at.felt()
    best: Form | None = None
    while True:
        names, odds = ((), 0.0) if best is None else (best.causes, best.log_odds)
        asked = [_form(at, felt, best, n, prices[n]) for n in felt if n not in names]
        likelier = [f for f in asked if f is not None and f.log_odds > odds]
        if not likelier:
            return best
        best = max(likelier, key=lambda f: f.log_odds)


def _form(
    at: Parabola, felt: Mapping[str, Sequence[int]], before: Form | None, name: str, price: float
) -> Form | None:
    """The form with one more cause than `before`; None where bounds hold all of it back."""
    there = () if before is None else before.causes
    of_others = [i for n in there for i in felt[n]]
    others, own = _inside(at, of_others, felt[name])
    if not own:
        return None
    gain, told = _gain(at, [*at.fitted, *others], own)
    stopped, kept_back = _stopped(at, [*others, *own])
    if stopped.keys() >= {*own}:
        return None
    rows = [i for i in (*others, *own) if i not in stopped]
    rest = [i for i in at.fitted if i not in stopped]
    gradient = at.gradient + at.information[:, [*stopped]] @ np.array([*stopped.values()])
    information, score, moved = _projected(replace(at, gradient=gradient), rest, rows)
    errors = _errors(at, rest, rows, information, moved)
    back = np.linalg.solve(information, score)
    along = -_inverse(at, rest) @ at.information[np.ix_(rest, [*stopped])]
    shift = np.array([stopped.get(i, 0.0) for i in at.fitted])
    place = [at.fitted.index(i) for i in rest]
    shift[place] = moved @ back + along @ np.array([*stopped.values()])
    more = np.zeros((shift.size, shift.size))
    more[np.ix_(place, place)] = moved @ np.linalg.solve(information, moved.T)
    odds, known = (0.0, 0.0) if before is None else (before.log_odds, before.kept_back)
    return Form(
        causes=(*there, name),
        log_odds=odds + gain - price - max(kept_back - known, 0.0) / told,
        shift=shift,
        more=more,
        steps={i: (-float(b), e) for i, b, e in zip(rows, back, errors, strict=True)},
        kept_back=kept_back,
    )


def _stopped(at: Parabola, rows: Sequence[int]) -> tuple[dict[int, float], float]:
    """(the unknowns that reach a bound where the causes at `rows` move what is fitted, with their
    steps; what the cost falls less because of that). Pulls that fitted unknowns have of their own
    are no cause's."""
    stopped: dict[int, float] = {}
    fall, fitted = 0.0, [*at.fitted]
    pull = _inverse(at, fitted) @ at.gradient[fitted]
    gradient = at.gradient - at.information[:, fitted] @ pull
    while True:
        free = [i for i in (*fitted, *rows) if i not in stopped]
        at_bound, steps = [*stopped], np.array([*stopped.values()])
        slope = gradient + at.information[:, at_bound] @ steps
        step = -_inverse(at, free) @ slope[free]
        own = gradient[at_bound] + 0.5 * at.information[np.ix_(at_bound, at_bound)] @ steps
        new = -0.5 * float(slope[free] @ step) - float(own @ steps)
        if not stopped:
            fall = new
        # Of those beyond, the one that reaches its bound first.
        share = {
            i: (at.low[i] if s < 0 else at.high[i]) / s
            for i, s in zip(free, step, strict=True)
            if not at.low[i] <= s <= at.high[i]
        }
        if not share:
            return stopped, max(fall - new, 0.0)
        first = min(share, key=lambda i: share[i])
        stopped[first] = float(at.low[first] if step[free.index(first)] < 0 else at.high[first])


def _inside(at: Parabola, others: Sequence[int], own: Sequence[int]) -> tuple[list[int], list[int]]:
    """Those of both that do not run through a bound together."""
    rows = [*others, *own]
    while rows:
        information, score, _ = _projected(at, at.fitted, rows)
        falls = np.linalg.solve(information, score) > 0
        free = np.where(falls, at.low[rows] < 0, at.high[rows] > 0)
        if free.all():
            break
        rows = [i for i, inside in zip(rows, free, strict=True) if inside]
    return [i for i in others if i in rows], [i for i in own if i in rows]


def _gain(at: Parabola, rest: Sequence[int], own: Sequence[int]) -> tuple[float, float]:
    """(log evidence that the unknowns at `own` bring, those at `rest` along; how many times less
    coloured scores count)."""
    information, score, moved = _projected(at, rest, own)
    prior, told = np.diag(at.prior[own]), 1.0
    if (scatter := _scatter(at, rest, own, moved)) is not None:
        told = max(float(np.trace(np.linalg.solve(information, scatter))) / len(own), 1.0)
        information, score = (information - prior) / told + prior, score / told
    _, size = np.linalg.slogdet(information)
    room = float(size - np.log(at.prior[own]).sum())
    return 0.5 * float(score @ np.linalg.solve(information, score)) - 0.5 * room, told


def _scatter(
    at: Parabola, rest: Sequence[int], own: Sequence[int], moved: FloatArray
) -> FloatArray | None:
    """Scatter (k, k) of the scores of the unknowns at `own`, those at `rest` projected out, with
    their priors; None where errors are white."""
    if at.scatter is None:
        return None
    through = np.zeros((len(at.prior), len(own)))
    through[own, range(len(own))] = 1.0
    through[rest] = -moved
    return np.asarray(through.T @ at.scatter @ through + np.diag(at.prior[own]))


def _errors(
    at: Parabola,
    rest: Sequence[int],
    own: Sequence[int],
    information: FloatArray,
    moved: FloatArray,
) -> list[float]:
    """Standard errors of the steps of the unknowns at `own`, never below those of white errors;
    infinite where rounding leaves no information."""
    inverse = np.linalg.inv(information)
    least, scatter = np.diag(inverse), _scatter(at, rest, own, moved)
    variance = least if scatter is None else np.diag(inverse @ scatter @ inverse)
    wider = np.maximum(variance, least)
    return [float(e) for e in np.sqrt(np.where(wider > 0, wider, np.inf))]


def _inverse(at: Parabola, among: Sequence[int]) -> FloatArray:
    """Inverse (k, k) of the information on the unknowns at `among`."""
    size = np.sqrt(np.maximum(np.diag(at.information)[[*among]], 1e-300))
    unit = at.information[np.ix_(among, among)] / np.outer(size, size)
    inverse: FloatArray = np.linalg.pinv(unit, rcond=1e-12, hermitian=True)
    return inverse / np.outer(size, size)


def _projected(
    at: Parabola, rest: Sequence[int], rows: Sequence[int]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(information (k, k) on the unknowns at `rows` with their priors, score (k,), move (m, k) of
    those at `rest` against one unit of each), those at `rest` projected out."""
    across = at.information[np.ix_(rest, rows)]
    moved = _inverse(at, rest) @ across
    information = at.information[np.ix_(rows, rows)] - across.T @ moved
    return information, at.gradient[rows] - moved.T @ at.gradient[rest], moved
