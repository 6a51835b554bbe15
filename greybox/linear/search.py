"""From records to the best model of one order, or of every order up to a largest: starts, polish,
warm starts.

The criterion has local minima. Every order is started from subspace models, from the smaller model
with states added that predict its innovations, and from the next larger model with its least
balanced states cut; the best is polished. The likelihood never falls when the order grows: where
all that ends above the smaller model, the start is that model itself with a state that nobody
reads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from greybox.errors import DataError, FitError, GreyboxError
from greybox.linear.parametrisation import Free
from greybox.linear.pem import (
    FORGET,
    Nuisance,
    Settings,
    Solution,
    Status,
    evaluate,
    minimise,
    start_nuisances,
)
from greybox.linear.records import Record
from greybox.linear.subspace import Method, Subspace, subspace
from greybox.model.matrices import Matrices, from_predictor, spectral_radius, truncated
from greybox.symbolic import FloatArray

RACE = 20
"""Steps after which the better of two starts is known."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """What is fitted and how it is started. `methods` are tried in turn and the best start is
    polished.

    `past` is the subspace horizon (None: AIC of a VARX). `polish` False stops at the subspace
    start. `exact_order` keeps states that the data do not carry (see `find`).
    """

    noise_model: bool = True
    feedthrough: bool = False
    methods: tuple[Method, ...] = ("pbsid", "ssarx")
    past: int | None = None
    polish: bool = True
    exact_order: bool = False
    settings: Settings = field(default_factory=Settings)


@dataclass(frozen=True, kw_only=True)
class Found:
    """A solution, the name of the start it came from, and the singular values of the first subspace
    method."""

    solution: Solution
    start: str
    singular_values: FloatArray


def decompose(records: Sequence[Record], largest: int, options: Options) -> list[Subspace]:
    """One subspace decomposition per method, wide enough for order `largest`; raises the first
    error if all fail."""
    out: list[Subspace] = []
    problem: GreyboxError | None = None
    for method in options.methods:
        try:
            out.append(
                subspace(
                    records,
                    method,
                    past=options.past,
                    order=largest,
                    feedthrough=options.feedthrough,
                    noise_model=options.noise_model,
                    varx=next((s.varx for s in out if s.varx is not None), None),
                )
            )
        except DataError as error:
            problem = problem or error
    if not out:
        raise problem or FitError("no subspace method was named", fix="methods=('ssarx',)")
    return out


def find(
    records: Sequence[Record],
    order: int,
    options: Options,
    *,
    bank: Sequence[Subspace] | None = None,
) -> Found:
    """The model of at most `order` states. Raises `DataError` or `FitError` where the data cannot
    carry it.

    An order that is too high costs nothing: of the subspace starts of `order` states and fewer the
    one of most evidence is polished, where every state pays `price_of_a_state`. Superfluous states
    cancel; the likelihood is then no bump, and its maximum fits the noise. (Orders that are
    compared, in `sweep`, are all polished.)
    """
    bank = bank or decompose(records, order, options)
    if all(order > s.largest_order for s in bank):
        raise FitError(
            f"order {order} is above what the data carry",
            expected=f"at most {max(s.largest_order for s in bank)}",
            fix="lower the order",
        )
    starts = _ranked(records, _subspace_starts(bank, order, options), options)
    if starts and not options.exact_order:
        starts = _of_most_evidence(starts, records, bank, options)
    return _polished(starts[:1], records, options, bank[0].singular_values)


def _of_most_evidence(
    starts: list[_Start], records: Sequence[Record], bank: Sequence[Subspace], options: Options
) -> list[_Start]:
    """The ranked starts of as many states as `starts` have, or of fewer if their evidence is
    greater."""
    order, m, p = starts[0].system.sizes
    price = price_of_a_state(m + (2 if options.noise_model else 1) * p, max(map(len, records)))
    # Fewer states foretell the next sample worse by this already before their recursion is closed.
    loss = np.min(
        [v - v[-1] for v in (s.misfits(order) for s in bank if s.largest_order >= order)], axis=0
    )
    best, total = starts, starts[0].criterion + price * order
    for states in range(order - 1, 0, -1):
        if starts[0].criterion + loss[states] + price > total:
            break
        fewer = _ranked(records, _subspace_starts(bank, states, options), options)
        if fewer and fewer[0].criterion + price * states < total:
            best, total = fewer, fewer[0].criterion + price * states
    return best


def price_of_a_state(parameters: int, samples: int) -> float:
    """Gain in -2 log likelihood at which one more state of so many `parameters` is as likely as
    not, on `samples` rows.

    Half of what a pair of states pays, by its marginal likelihood. Its strengths, s = 2 (parameters
    - 1) of them under a Gaussian prior whose width is the most likely one (empirical Bayes; MacKay
    1992, Neural Computation 4(3)), cost s (1 + log(G/s)) of a gain G. Its pole is as likely
    anywhere as the data tell poles apart (Jeffreys): information G/(1 - |pole|^2)^2 over the half
    disc of poles that the record forgets, of area pi r^2/(1 - r^2)/2 in that metric with r = 1 -
    FORGET/samples, costs 2 log(G area/(2 pi)) (Laplace). For 3000 rows a state pays 14 with one
    input and one output, 28 with four and three, where Akaike asks 6 and 20 and Schwarz 24 and 80.
    """
    strengths = 2 * max(parameters - 1, 1)
    r = max(1.0 - FORGET / samples, 0.5)
    area = np.pi * r**2 / (1.0 - r**2) / 2.0

    def ahead(gain: float) -> float:
        return float(
            gain
            - strengths * (1.0 + np.log(gain / strengths))
            - 2.0 * np.log(gain * area / (2.0 * np.pi))
        )

    pair = brentq(ahead, strengths, 100.0 * strengths) if ahead(strengths) < 0 else strengths
    return float(pair) / 2.0


def sweep(
    records: Sequence[Record],
    largest: int,
    options: Options,
    *,
    patience: int | None = None,
    penalty: float = 0.0,
) -> dict[int, Found]:
    """The best model of every order 1 .. largest, each started from its neighbours as well as from
    subspace models.

    Two starts of each are polished by 20 steps, and the better of them to 0.3 of -2 log likelihood,
    enough to compare orders: call `refine` on the chosen. With `patience` the sweep stops once -2
    log likelihood + penalty * parameters has not improved for that many orders.
    """
    bank = decompose(records, largest, options)
    tolerance = max(0.3, options.settings.tolerance)
    options = replace(options, settings=replace(options.settings, tolerance=tolerance))
    values = bank[0].singular_values
    found: dict[int, Found] = {}
    best_score, best_order = np.inf, 0
    for order in range(1, largest + 1):
        starts = _subspace_starts(bank, order, options)
        for back in (1, 2):
            if order - back in found:
                grown = _grown(found[order - back].solution, records, back, options)
                if grown is not None:
                    starts.append((f"order {order - back} + {back}", grown))
        if not starts:
            break
        here = _raced(_ranked(records, starts, options)[:2], records, options, values)
        found[order] = _nested(here, found.get(order - 1), records, options)
        here = found[order]
        score = here.solution.evaluation.criterion + penalty * _dimension(here.solution)
        if score < best_score - 1e-6:
            best_score, best_order = score, order
        if patience is not None and order - best_order >= patience:
            break
    for order in sorted(found)[-2::-1]:
        start = _cut(found[order + 1].solution, order, options)
        if start is None:
            continue
        rival = _raced(
            _ranked(records, [(f"order {order + 1} cut", start)], options), records, options, values
        )
        if rival.solution.evaluation.criterion < found[order].solution.evaluation.criterion - 1e-3:
            found[order] = rival
    for order in sorted(found)[1:]:
        found[order] = _nested(found[order], found[order - 1], records, options)
    return found


def _cut(above: Solution, order: int, options: Options) -> Matrices | None:
    """The next larger model without its least balanced states; None where that is no start."""
    try:
        start = truncated(above.system, order)
    except (GreyboxError, np.linalg.LinAlgError):
        return None
    if not options.noise_model:
        start = start._replace(k=np.zeros_like(start.k))
    if not options.feedthrough:
        start = start._replace(d=np.zeros_like(start.d))
    return start if _usable(start, options) else None


def _raced(
    starts: Sequence[_Start], records: Sequence[Record], options: Options, values: FloatArray
) -> Found:
    """The start that leads after a few steps, polished to the end. Raises as `_polished`."""
    few = min(RACE, options.settings.max_iterations)
    short = replace(options, settings=replace(options.settings, max_iterations=few))
    first = _polished(starts, records, short, values)
    if first.solution.status is not Status.MAX_ITERATIONS:
        return first
    return refine(first, records, options)


def _nested(
    here: Found, smaller: Found | None, records: Sequence[Record], options: Options
) -> Found:
    """`here`, or a model that starts as the `smaller` one of the order below, where that is more
    likely.

    The added state is the last sample, all channels alike, and is not read: its first step decides
    what it is worth.
    """
    if smaller is None:
        return here
    least = smaller.solution
    if here.solution.evaluation.criterion <= least.evaluation.criterion or not options.polish:
        return here
    n, m, p = least.system.sizes
    f = np.zeros((n + 1, n + 1))
    f[:n, :n] = least.system.predictor
    g = np.vstack([least.system.predictor_input, np.ones((1, m + p))])
    if not options.noise_model:
        g[n, m:] = 0.0
    system = from_predictor(f, g, np.hstack([least.system.c, np.zeros((p, 1))]), least.system.d)
    point = Free(system=system, noise_model=options.noise_model, feedthrough=options.feedthrough)
    nuisances = [replace(v, x0=np.append(v.x0, 0.0)) for v in least.nuisances]
    solution = minimise(point, records, options.settings, nuisances=nuisances)
    return replace(here, solution=solution, start=f"order {n} + 1 unread")


def refine(found: Found, records: Sequence[Record], options: Options) -> Found:
    """The same solution polished to the tolerance of `options`."""
    s = found.solution
    settings = options.settings if options.polish else replace(options.settings, max_iterations=0)
    return replace(found, solution=minimise(s.point, records, settings, nuisances=s.nuisances))


def _dimension(solution: Solution) -> int:
    return solution.tangent.shape[1]


def _subspace_starts(
    bank: Sequence[Subspace], order: int, options: Options
) -> list[tuple[str, Matrices]]:
    out: list[tuple[str, Matrices]] = []
    for s in bank:
        if order > s.largest_order:
            continue
        try:
            system = s.realise(order, stable=options.settings.stable)
        except (GreyboxError, np.linalg.LinAlgError, ValueError):
            continue
        if _usable(system, options):
            out.append((s.method, system))
    return out


def _usable(system: Matrices, options: Options) -> bool:
    if not all(np.isfinite(v).all() for v in system):
        return False
    limit = options.settings.radius
    if spectral_radius(system.predictor) >= limit:
        return False
    return not options.settings.stable or spectral_radius(system.a) < limit


class _Start(NamedTuple):
    """A start and its -2 log likelihood."""

    criterion: float
    name: str
    system: Matrices
    nuisances: tuple[Nuisance, ...]


def _ranked(
    records: Sequence[Record], starts: Sequence[tuple[str, Matrices]], options: Options
) -> list[_Start]:
    """The starts of finite criterion, most likely first."""
    scored = []
    p = records[0].y.shape[1]
    for label, system in starts:
        nuisances = start_nuisances(system, records, options.settings)
        scored.append(
            _Start(
                evaluate(system, nuisances, records, np.eye(p)).criterion, label, system, nuisances
            )
        )
    return sorted((s for s in scored if np.isfinite(s.criterion)), key=lambda s: s.criterion)


def _polished(
    starts: Sequence[_Start], records: Sequence[Record], options: Options, values: FloatArray
) -> Found:
    """The best of the starts, each polished; raises `FitError` where none is one."""
    if not starts:
        raise FitError(
            "every start predicts an output without error or diverges",
            fix="lower the order, or drop outputs that are combinations of others",
        )
    settings = options.settings if options.polish else replace(options.settings, max_iterations=0)
    best: Solution | None = None
    failed: FitError | None = None
    name = ""
    for start in starts:
        point = Free(
            system=start.system, noise_model=options.noise_model, feedthrough=options.feedthrough
        )
        try:
            solution = minimise(point, records, settings, nuisances=start.nuisances)
        except FitError as error:
            failed = failed or error
            continue
        if best is None or solution.evaluation.criterion < best.evaluation.criterion:
            best, name = solution, start.name
    if best is None:
        assert failed is not None
        raise failed
    return Found(solution=best, start=name, singular_values=values)


def _grown(
    solution: Solution, records: Sequence[Record], more: int, options: Options
) -> Matrices | None:
    """The model with `more` states added that predict its innovations from u and e; None where
    there are none.

    The added predictor runs on the innovations of the first, so that the cascade is again a
    predictor of that order sum. Adding states that are never read reproduces the smaller model,
    hence the likelihood cannot fall.
    """
    system = solution.system
    inner = [
        Record(u=r.u, y=q.e, name=r.name) for r, q in zip(records, solution.evaluation.predictions)
    ]
    try:
        more_model = subspace(
            inner,
            "ssarx",
            past=max(8, 2 * more + 2),
            order=more,
            feedthrough=False,
            noise_model=True,
        ).realise(more)
    except (GreyboxError, np.linalg.LinAlgError, ValueError):
        return None
    m = system.b.shape[1]
    f1, g1 = system.predictor, system.predictor_input
    f2, g2 = more_model.predictor, more_model.predictor_input
    b2, k2 = g2[:, :m], g2[:, m:]
    if not options.noise_model:
        a = np.block(
            [
                [system.a, np.zeros((system.order, more))],
                [np.zeros((more, system.order)), more_model.a],
            ]
        )
        b = np.vstack([system.b, more_model.b])
        c = np.hstack([system.c, more_model.c])
        grown = Matrices(a, b, c, system.d, np.zeros((len(a), len(c))))
        return grown if _usable(grown, options) else None
    f = np.block([[f1, np.zeros((len(f1), more))], [-k2 @ system.c, f2]])
    g = np.vstack([g1, np.hstack([b2 - k2 @ system.d, k2])])
    grown = from_predictor(f, g, np.hstack([system.c, more_model.c]), system.d)
    return grown if _usable(grown, options) else None
