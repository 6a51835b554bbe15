"""Evidence: how likely flights are under a structure, its parameters integrated over their priors.

Laplace's approximation at the maximum a posteriori (Kass and Raftery 1995, JASA 90(430), sec. 4.1),
exact for a linear Gaussian model. Parameters of a cause have the prior that it declares, core
parameters that of the vehicle file, the start of every flight that of its first readings. A
parameter that ended at its bound is integrated along one side, and a prior that a bound cuts holds
its mass on the side that is allowed.
"""

from __future__ import annotations

import concurrent.futures
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy.special
from threadpoolctl import threadpool_limits

from greybox.cores import cores
from greybox.data import Dataset
from greybox.discovery.cause import Causes
from greybox.discovery.rules import EFFORT, Effort
from greybox.estimation.engine import engine_for
from greybox.estimation.fit import Fit, fit
from greybox.estimation.initialisation import noise_start
from greybox.estimation.options import FitOptions
from greybox.estimation.problem import Problem, Value, few_samples, make_problem
from greybox.estimation.solver import Objective, Progress
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt
from greybox.estimation.status import Code, Status
from greybox.symbolic import BoolArray, FloatArray

Key = tuple[str, str | None]
"""An unknown and, where it is one flight's own, the flight (or record)."""
Structure = frozenset[str]
WEAK = 1e-8
"""Precision, per squared scale, of an unknown without prior that nothing tells: a flat prior."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Fitted:
    """A structure at its maximum a posteriori on some flights. `log_evidence` is that of the
    flights, `theta` (n,) all unknowns of `problem`, `value` its cost, gradient and Hessian there."""

    structure: Structure
    problem: Problem
    theta: FloatArray
    value: Value
    status: Status
    log_evidence: float
    exact: bool = True

    @property
    def comparable(self) -> bool:
        """Whether the evidence can be held against others: the optimum, or a kink (a delay of whole
        samples) where no step lowers the cost."""
        return self.status.converged or self.status.code is Code.NO_PROGRESS

    @property
    def known(self) -> dict[Key, float]:
        """All unknowns by name and flight."""
        pairs = zip(self.problem.unknowns, self.theta, strict=True)
        return {(u.name, u.flight): float(t) for u, t in pairs}

    @property
    def held(self) -> BoolArray:
        """Which unknowns ended at a bound."""
        return at_bound(self.problem, self.theta, self.value)


def at_bound(problem: Problem, theta: FloatArray, value: Value) -> BoolArray:
    """Which unknowns (n,) a bound holds back."""
    assert value.gradient is not None
    low, high = theta <= problem.lower, theta >= problem.upper
    return np.asarray((low & (value.gradient > 0)) | (high & (value.gradient < 0)))


def log_evidence(problem: Problem, theta: FloatArray, value: Value) -> float:
    """Log of the integral of likelihood times prior about `theta` (n,), see the module."""
    assert value.gradient is not None and value.hessian is not None
    scale = problem.scale
    gradient = value.gradient * scale
    h = value.hessian * np.outer(scale, scale) + WEAK * np.eye(problem.n)
    held = at_bound(problem, theta, value)
    free = ~held
    sign, logdet = np.linalg.slogdet(h[np.ix_(free, free)])
    if sign <= 0:
        return -np.inf
    total = -value.cost + float(np.log(scale).sum())
    total += 0.5 * float(free.sum()) * np.log(2 * np.pi) - 0.5 * float(logdet)
    for i in np.flatnonzero(held):  # integral of exp(-g t - h t^2 / 2) over t > 0
        g, c = abs(gradient[i]), h[i, i]
        ratio = scipy.special.erfcx(g / np.sqrt(2 * c))
        total += float(np.log(np.sqrt(np.pi / (2 * c)) * ratio))
    spread = np.zeros(problem.n)
    spread[free] = np.sqrt(np.diag(np.linalg.inv(h[np.ix_(free, free)]))) * scale[free]
    for i, u in enumerate(problem.unknowns):
        bounded = np.isfinite(u.lower) or np.isfinite(u.upper)
        if np.isfinite(u.sigma):
            total -= float(np.log(u.sigma)) + 0.5 * float(np.log(2 * np.pi))
            if bounded and u.kind == "parameter":
                total -= _log_mass(u.lower, u.upper, u.mean, u.sigma)
        if bounded and u.kind == "parameter" and free[i]:
            total += _log_mass(u.lower, u.upper, float(theta[i]), float(spread[i]))
    return float(total)


def _log_mass(low: float, high: float, mean: float, sigma: float) -> float:
    """Log of what a normal distribution has between two bounds."""
    a, b = (low - mean) / sigma, (high - mean) / sigma
    if a > 0:
        a, b = -b, -a
    mass = scipy.special.ndtr(b) - scipy.special.ndtr(a)
    return float(np.log(max(mass, 1e-300)))


@dataclass(frozen=True, kw_only=True)
class _There:
    """A solver that knows the answer."""

    theta: FloatArray
    status: Status
    name: str = "levenberg-marquardt"

    def solve(
        self, problem: Objective, start: FloatArray, progress: Progress | None = None
    ) -> tuple[FloatArray, Status]:
        """The answer."""
        return self.theta, self.status


@dataclass(kw_only=True, eq=False)
class Flights:
    """Fits of structures on one set of flights, each done once. Further causes may join."""

    causes: Causes
    data: Dataset
    options: FitOptions = field(default_factory=FitOptions)
    effort: Effort = EFFORT
    executor: concurrent.futures.Executor | None = None
    _known: dict[Structure, Fitted] = field(default_factory=dict)

    def on(self, data: Dataset) -> Flights:
        """The same causes on other flights."""
        return Flights(causes=self.causes, data=data, options=self.options, effort=self.effort)

    def choices(self, structure: Iterable[str], host: Iterable[str] = ()) -> FitOptions:
        """What is free, and every prior, in a fit of a structure on the model of `host`."""
        chosen = [self.causes.offered[n] for n in structure]
        model = self.causes.built(host or structure)
        declared = {d.name: d for d in model.parameters}
        own = [p for c in chosen for p in c.parameters if p in declared]
        parts = [n for n in declared if n.split(".")[0] == "disturbance"]
        free = (*self.causes.core, *own, *parts)
        priors = {n: p for n, d in declared.items() if (p := self.causes.prior(d)) is not None}
        null = {n: p[0] for n, p in priors.items() if n.split(".")[0] in self.causes.effects}
        return self.options.but(
            free=free,
            build=[n for n in declared if n in free or n in null],
            values=null,
            priors=priors,
            flight_priors=priors,
            per_flight=[n for n in self.causes.per_flight if n in declared],
            initialisation="nominal",
        )

    def problem(self, structure: Structure, host: Structure | None = None) -> Problem:
        """The unknowns and the cost of a structure, on the model of `host` which has more effects."""
        there = structure if host is None else host
        model = self.causes.built(sorted(there))
        return make_problem(model, self.data, self.choices(sorted(structure), sorted(there)))

    def fit(
        self,
        structure: Iterable[str],
        starts: Sequence[Mapping[Key, float]] = (),
        *,
        than: Fitted | None = None,
        host: Structure | None = None,
    ) -> Fitted:
        """The structure at its maximum a posteriori, from the likeliest of `starts` (what they do
        not say is as declared), on its own model or on that of the `host`, which has more effects.

        Where it is only held against `than`, it is carried on as long as it may catch up, and made
        exact where it comes near.
        """
        chosen = frozenset(structure)
        known = self._known.get(chosen)
        if known is not None and (than is not None or known.exact):
            return known
        with threadpool_limits(limits=1):
            if known is None:
                problem = self.problem(chosen, host)
                offered = [problem.inside(vector(problem, s)) for s in starts]
                offered = offered or [noise_start(problem)]
                start = offered[0]
                if len(offered) > 1:
                    start = min(offered, key=lambda t: problem.evaluate(t, 0).cost)
            else:
                problem, start = known.problem, known.theta
            found = _solved(problem, chosen, start, self.effort, than)
        self._known[chosen] = found
        return found

    def known(self, structure: Iterable[str]) -> Fitted | None:
        """The fit of a structure that was done already."""
        return self._known.get(frozenset(structure))

    def prepare(self, structures: Iterable[Structure]) -> None:
        """Build the steps that fits of these structures need, side by side: compilers are
        processes."""
        quick = few_samples(self.data)

        def build(structure: Structure) -> None:
            model = self.causes.built(sorted(structure))
            options = self.choices(sorted(structure))
            wanted = set(options.build or ())
            engine_for(model, tuple(d.name for d in model.parameters if d.name in wanted), quick=quick)

        with concurrent.futures.ThreadPoolExecutor(cores()) as pool:
            list(pool.map(build, structures))

    def settled(self, found: Fitted) -> Fit:
        """The whole result of a fit, with errors, as `greybox.estimation.fit` gives it."""
        p = found.problem
        options = self.choices(sorted(found.structure))
        solver = _There(theta=found.theta, status=found.status)
        return fit(p.dynamics, self.data, options, solver=solver)


def _solved(
    problem: Problem, structure: Structure, start: FloatArray, effort: Effort, than: Fitted | None
) -> Fitted:
    """The optimum from `start`; a rough one that is far behind `than` stays as it is."""
    solver = LevenbergMarquardt(tolerance=effort.exact, max_iterations=effort.iterations)
    if than is not None:
        first = LevenbergMarquardt(tolerance=effort.rough, max_iterations=effort.opening)
        theta, status = first.solve(problem, start)
        found = _at(problem, structure, theta, status)
        if not status.converged:
            goes_on = LevenbergMarquardt(
                tolerance=effort.rough,
                max_iterations=effort.iterations - effort.opening,
                target=than.value.likelihood + effort.behind,
            )
            theta, status = goes_on.solve(problem, theta)
            found = _at(problem, structure, theta, status)
        if found.log_evidence < than.log_evidence - effort.behind:
            return found
        start = theta
    theta, status = solver.solve(problem, start)
    return _at(problem, structure, theta, status, exact=True)


def _at(
    problem: Problem, structure: Structure, theta: FloatArray, status: Status, exact: bool = False
) -> Fitted:
    value = problem.evaluate(theta)
    evidence = -np.inf
    if value.valid and value.hessian is not None:
        evidence = log_evidence(problem, theta, value)
    return Fitted(
        structure=structure,
        problem=problem,
        theta=theta,
        value=value,
        status=status,
        log_evidence=evidence,
        exact=exact,
    )


def vector(problem: Problem, known: Mapping[Key, float]) -> FloatArray:
    """Unknowns of the problem (n,) at the known values; one flight's own at what all share, or at
    the mean of other flights, where that is known; else as they start."""
    others: dict[str, list[float]] = {}
    for (name, flight), value in known.items():
        if flight is not None:
            others.setdefault(name, []).append(value)

    def of(name: str, flight: str | None, start: float, kind: str) -> float:
        if (name, flight) in known:
            return known[name, flight]
        if (name, None) in known:
            return known[name, None]
        if kind == "parameter" and name in others:
            return float(np.mean(others[name]))
        return start

    return np.array(
        [of(u.name, u.flight, u.start, u.kind) for u in problem.unknowns], dtype=np.float64
    )


def say_nothing(text: str, share: float) -> None:
    """A progress that is not shown."""


Say = Callable[[str, float], None]
