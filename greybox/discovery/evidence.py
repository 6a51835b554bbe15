"""Evidence: how likely flights are under a structure, its parameters integrated over their priors
(greybox/estimation/laplace.py). Parameters of a cause have the prior that it declares, core
parameters that of the vehicle file, starts of flights that of first readings.
"""

from __future__ import annotations

import concurrent.futures
import functools
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from threadpoolctl import threadpool_limits

from greybox.data import Dataset
from greybox.discovery.cause import Causes
from greybox.discovery.rules import EFFORT, Effort
from greybox.estimation.few_samples import demand_samples
from greybox.estimation.fit import Fit, concluded
from greybox.estimation.initialisation import noise_start
from greybox.estimation.laplace import at_bound, free_information, log_evidence
from greybox.estimation.options import FitOptions
from greybox.estimation.other_scales import on_other_scales
from greybox.estimation.prior import Prior
from greybox.estimation.problem import Problem, Value, make_problem
from greybox.estimation.solvers.levenberg_marquardt import BEYOND, LevenbergMarquardt
from greybox.estimation.start import Key, Start, vector
from greybox.estimation.status import Code, Status
from greybox.estimation.unknown import SearchSpace, Unknown
from greybox.journal import answers
from greybox.model.dynamics import Dynamics
from greybox.symbolic import BoolArray, FloatArray
from greybox.workers import side_by_side

Structure = frozenset[str]
ARRIVED = (Code.CONVERGED, Code.NO_PROGRESS)
"""At the optimum, or at a kink (a delay of whole samples) where no step lowers the cost."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Solution:
    """Where one task ended: its unknowns, where they are (`theta`, n), status and value there."""

    space: SearchSpace
    theta: FloatArray
    status: Status
    value: Value


PARTS = (Solution, SearchSpace, Unknown, Status, Code, Value)
"""What a solution is made of."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Fitted:
    """A structure at its maximum a posteriori on some flights. `log_evidence` is that of the
    flights, `theta` (n,) all unknowns of `space`, `value` cost, gradient and Hessian there;
    `set_up` gives the problem, which another process may have solved."""

    structure: Structure
    space: SearchSpace
    set_up: Callable[[], Problem]
    theta: FloatArray
    value: Value
    status: Status
    log_evidence: float
    exact: bool = True

    @property
    def may_gain(self) -> float:
        """Log likelihood that the optimum may lie above a fit that is not exact, however it ended:
        `BEYOND` times what the full step from there promises."""
        done = self.exact and self.status.converged
        return 0.0 if done else BEYOND * self.status.decrement

    @property
    def problem(self) -> Problem:
        """What was solved."""
        return self.set_up()

    @property
    def known(self) -> dict[Key, float]:
        """All unknowns by name and flight."""
        pairs = zip(self.space.unknowns, self.theta, strict=True)
        return {(u.name, u.flight): float(t) for u, t in pairs}

    @property
    def held(self) -> BoolArray:
        """Which unknowns ended at a bound."""
        return at_bound(self.space, self.theta, self.value)

    def information(self, places: Sequence[int]) -> FloatArray:
        """On the unknowns at `places` (k, k), all others that are free integrated out."""
        return free_information(self.space, self.theta, self.value, places)


@dataclass(frozen=True, kw_only=True)
class Task:
    """One fit: a structure, starts, of which the likeliest is taken (none: noise levels from the
    data), and where the solver stops."""

    structure: Structure
    starts: tuple[Start, ...]
    tolerance: float
    iterations: int
    target: float = np.inf


@dataclass(kw_only=True, eq=False)
class Flights:
    """Fits of structures on one set of flights, each done once. Further causes may join."""

    causes: Causes
    data: Dataset
    options: FitOptions = field(default_factory=FitOptions)
    effort: Effort = EFFORT
    executor: concurrent.futures.Executor | None = None
    say: Callable[[str, float], None] = lambda _text, _share: None
    _known: dict[Structure, Fitted] = field(default_factory=dict)

    def on(self, data: Dataset, *, flat: bool = False) -> Flights:
        """The same causes on other flights; `flat`: no parameter has a prior."""
        return replace(self, causes=replace(self.causes, flat=flat), data=data, _known={})

    def fit(
        self, structure: Iterable[str], starts: Sequence[Start] = (), *, within: float = 0.0
    ) -> Fitted:
        """The structure at its maximum a posteriori, from the likeliest of `starts` (what they do
        not say is as declared); `within`: the promise of a step that is small enough."""
        return self.fits([(frozenset(structure), starts)], [within])[0]

    def fits(
        self, asked: Sequence[tuple[Structure, Sequence[Start]]], within: Sequence[float]
    ) -> list[Fitted]:
        """`fit` of several structures, side by side."""
        tasks, e = {}, self.effort
        for (structure, starts), near in zip(asked, within, strict=True):
            known = self._known.get(structure)
            if known is None or not (
                known.exact
                or known.status.decrement <= near
                or (near >= e.rough and known.status.code in ARRIVED)
            ):
                tasks[structure] = Task(
                    structure=structure,
                    starts=tuple(starts) if known is None else (known.known,),
                    tolerance=max(near, e.exact),
                    iterations=e.iterations,
                )
        self._carried_out(list(tasks.values()))
        return [self._known[structure] for structure, _ in asked]

    def arrived(self, found: Fitted) -> Fitted:
        """The fit of an answer, carried on from where its iterations ended until nothing moves."""
        e, start = self.effort, (found.known,)
        task = Task(structure=found.structure, starts=start, tolerance=e.exact, iterations=e.last)
        return self._carried_out([task])[0] if found.status.code is Code.MAX_ITERATIONS else found

    def contest(
        self, asked: Sequence[tuple[Structure, Sequence[Start]]], than: Fitted
    ) -> list[Fitted]:
        """Structures that are held against each other and against `than`, each from the likeliest
        of its starts: carried on as long as they may catch up, and exact where they may win."""
        e = self.effort
        opened = [
            Task(structure=s, starts=tuple(t), tolerance=e.rough, iterations=e.opening)
            for s, t in asked
            if s not in self._known
        ]
        if len(opened) == 1:  # a start again loses what the solver learned
            reach = than.value.likelihood + e.behind
            whole = replace(opened[0], tolerance=e.exact, iterations=e.iterations, target=reach)
            self._carried_out([whole])
        else:
            self._carried_out(opened)

        def found() -> list[Fitted]:
            return [self._known[s] for s, _ in asked]

        best = max([than, *found()], key=lambda f: f.log_evidence)
        target = best.value.likelihood + e.behind
        on = [f for f in found() if not f.exact and f.status.code is Code.MAX_ITERATIONS]
        on = [f for f in on if f.value.likelihood - target <= f.may_gain]
        left = e.iterations - e.opening
        goes_on = Task(
            structure=frozenset(), starts=(), tolerance=e.rough, iterations=left, target=target
        )
        self._carried_out([replace(goes_on, structure=f.structure, starts=(f.known,)) for f in on])
        most = max(f.log_evidence for f in (than, *found()))
        near = [f for f in found() if f.log_evidence > most - min(f.may_gain, e.behind)]
        self.fits([(f.structure, ()) for f in near], [0.0] * len(near))
        return found()

    def _carried_out(self, tasks: Sequence[Task]) -> list[Fitted]:
        """Tasks, and once more, from the likeliest fit of a part of their structure, those that
        ended less likely than that, as no optimum is: they had started where noise has vanished."""
        self._solved(tasks)
        cost, again = {s: f.value.likelihood for s, f in self._known.items()}, []
        for t in tasks:
            part = min((s for s in cost if s <= t.structure), key=cost.__getitem__)
            if cost[t.structure] > cost[part] + self.effort.rough:
                again.append(replace(t, starts=(self._known[part].known,)))
        self._solved(again)
        return [self._known[t.structure] for t in tasks]

    def _solved(self, tasks: Sequence[Task]) -> None:
        """Tasks, side by side where there is an executor; what cannot be sent runs here. Who solves
        them sets them up: most problems are never asked for here."""
        common = self.causes, self.data, self.options
        new = [functools.partial(problem_of, *common, t.structure) for t in tasks]
        known = [self._known.get(t.structure) for t in tasks]
        set_up = [functools.cache(n) if k is None else k.set_up for n, k in zip(new, known)]

        def work(asked: Sequence[int]) -> Iterator[tuple[int, Solution]]:
            done = set[int]()
            if self.executor is not None and len(asked) > 1:
                sent = {k: tasks[k] for k in asked}
                for place, answer in side_by_side(self.executor, solved, common, sent):
                    done.add(place)
                    yield place, answer
            yield from ((k, solution(set_up[k](), tasks[k])) for k in asked if k not in done)

        found = answers(tasks, work, Solution, PARTS)
        for task, make, there in zip(tasks, set_up, found, strict=True):
            evidence, status, value = -np.inf, there.status, there.value
            loose = min(status.decrement, task.tolerance) > self.effort.rough
            if loose and status.code in ARRIVED:  # all that was asked
                status = replace(status, code=Code.BEHIND)
            if value.valid and value.hessian is not None:
                evidence = log_evidence(there.space, there.theta, value)
            self._known[task.structure] = Fitted(
                structure=task.structure,
                space=there.space,
                set_up=make,
                theta=there.theta,
                value=value,
                status=status,
                log_evidence=evidence,
                exact=task.tolerance <= self.effort.exact
                and task.iterations >= self.effort.iterations
                and status.code is not Code.BEHIND,
            )

    def known(self, structure: Iterable[str]) -> Fitted | None:
        """The fit of a structure that was done already."""
        return self._known.get(frozenset(structure))

    def forget(self, names: Collection[str]) -> None:
        """No fit with causes of these names: others bear them now."""
        self._known = {s: f for s, f in self._known.items() if s.isdisjoint(names)}

    def settled(self, found: Fitted) -> Fit:
        """The whole result of a fit, with errors, as `greybox.estimation.fit` gives it."""
        problem = found.problem
        demand_samples(problem)
        options = choices(self.causes, self.options, found.structure, problem.dynamics)
        given = problem, self.data, options, found.theta, found.status
        with threadpool_limits(limits=1):
            return on_other_scales(concluded(*given, time.perf_counter()), self.causes.untold)


def choices(
    causes: Causes, options: FitOptions, structure: Structure, model: Dynamics
) -> FitOptions:
    """What is free, and every prior, in a fit of a structure, whose `model` it is."""
    chosen = [causes.offered[n] for n in sorted(structure)]
    declared = {d.name: d for d in model.parameters}
    own = [p for c in chosen for p in c.parameters if p in declared]
    lasting = [n for n in declared if n.split(".")[0] == "disturbance"]
    priors = {n: p for n, d in declared.items() if (p := causes.prior(d, chosen)) is not None}
    if causes.flat:
        free = (*causes.core, *own, *lasting)
        means = {n: priors[n][0] if n in priors else declared[n].nominal for n in free}
        priors = {n: Prior(m, np.inf) for n, m in means.items()}
    values = {n: p[0] for n, p in priors.items() if causes.prior_of(n) is not None}
    return options.but(
        free=(*causes.core, *own, *lasting),
        values={**values, **{n: v for n, (v, _) in causes.known.items() if n in declared}},
        priors=priors,
        flight_priors=priors,
        per_flight=[n for n in causes.per_flight if n in declared],
        initialisation="nominal",
    )


@threadpool_limits.wrap(limits=1)
def problem_of(causes: Causes, data: Dataset, options: FitOptions, structure: Structure) -> Problem:
    """The unknowns and the cost of a structure. Raises `DataError`, `ModelError`."""
    model = causes.built(sorted(structure))
    return make_problem(model, data, choices(causes, options, structure, model))


def solved(causes: Causes, data: Dataset, options: FitOptions, task: Task) -> Solution:
    """Carry out one task that was sent."""
    return solution(problem_of(causes.canonical(), data, options, task.structure), task)


def solution(problem: Problem, task: Task) -> Solution:
    """Carry out one task on its problem, which keeps the value where a search ends."""
    with threadpool_limits(limits=1):
        starts = [problem.inside(vector(problem, s)) for s in task.starts] or [noise_start(problem)]
        start = starts[0]
        if len(starts) > 1:
            start = min(starts, key=lambda t: problem.evaluate(t, 0).cost)
        solver = LevenbergMarquardt(
            tolerance=task.tolerance, max_iterations=task.iterations, target=task.target
        )
        theta, status = solver.solve(problem, start)
        value = replace(problem.evaluate(theta), data_hessian=None, scores=None)
        space = SearchSpace(unknowns=problem.unknowns)
        return Solution(space=space, theta=theta, status=status, value=value)
