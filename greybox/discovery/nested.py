"""Nested: fits of any subset of the candidates, each warm-started from the one before, and score tests of the others.

Every effect is exactly absent at its null, so that likelihoods of different subsets compare to the last digit. A subset is
fitted on the model that holds just its effects (a step of that model costs a third of one of the whole catalogue); the
catalogue's model is only run, never differentiated (see `differences`).

Fits are tasks: plain values in, plain values out. With an executor (concurrent.futures, or what looks like one, as
`client.get_executor()` of dask.distributed) the tasks of a step run side by side, with the same numbers.
"""

from __future__ import annotations

import concurrent.futures
import pickle
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from threadpoolctl import threadpool_limits

from greybox.cores import cores
from greybox.data import Dataset
from greybox.discovery.candidates import TIMING, Candidates
from greybox.discovery.differences import widened
from greybox.discovery.screen import Key, Score, screen, unscored
from greybox.discovery.velocity import has_velocity
from greybox.estimation.engine import engine_for
from greybox.estimation.fit import Fit, fit, noise_of
from greybox.estimation.initialisation import noise_start
from greybox.estimation.options import FitOptions
from greybox.estimation.problem import Problem, Value, few_samples, make_problem
from greybox.estimation.solver import Objective, Progress
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt
from greybox.estimation.status import Code, Status
from greybox.model.dynamics import Dynamics
from greybox.model.effects import CATALOGUE
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import with_physics
from greybox.model.model import PhysicsModel
from greybox.model.noise import Augmented
from greybox.statistics.blocks import BLOCK_SECONDS, block_samples
from greybox.symbolic import CASADI, FloatArray

BLOCKS = 64
"""Blocks that there should be, in short flights of a shorter length: their scores are a metric of up to six directions,
which few blocks hardly know."""
SHORTEST = 0.2
"""Not below this, or innovations that are correlated over a tenth of a second would count as evidence."""
RECENT = 48
"""How many fits are remembered."""
TOLERANCE = 1e-4
"""Where a fit stops: within about a hundredth of a standard error; the score tests project what is left off."""
ROUGH = 0.1
"""Where a fit that need not be exact stops: the cost that is left is a few times that."""
ROOM = 30.0
"""BIC behind the best within which rough fits are made exact: what matters is decided within 10."""
OPENING = 10
"""Iterations after which rivals are held against the best for the first time."""
FEW = 15
"""Iterations that show which of several starts leads somewhere."""
CAREFUL = 1.0
"""Damping with which the rough fits from several starts begin: a whole first step from a size that is only typical may raise
the noise levels to what the effect brings there, and the effect dies out."""
LONGER = 5
"""How often a fit that ran out of iterations goes on: a long curved valley, as of a start that nothing measured, ends."""
SHARES = (1.0, 0.3, 0.1, 0.03)
"""Parts of a first estimate to start from. The whole of a large one, linear from the null, can lie far outside; the noise
levels then grow and shrink again for twenty iterations."""
FINE = tuple(k / 10 for k in range(12, 0, -1))
"""The same for an effect with a threshold, which has no slope on the side of it where nothing is felt."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """One fit in plain values: `model` holds just the effects that are free; `starts` are unknowns to start from, of which
    the likeliest is taken; a fit without any starts its noise levels from the data. `options` are those of the fit: what is
    free, values, noise levels. `marginal`: rivals differ in what they
    must guess of the start of a flight (its velocity), and pay for it. `damping`, `tolerance`, `iterations` and `target` are
    those of the solver."""

    effects: tuple[str, ...]
    model: PhysicsModel | Augmented
    options: FitOptions
    starts: tuple[Mapping[Key, float], ...]
    tolerance: float = TOLERANCE
    iterations: int = 60
    damping: float = LevenbergMarquardt.initial_damping
    marginal: bool = False
    target: float = np.inf


@dataclass(frozen=True, kw_only=True)
class Refit:
    """What a task found: `theta` the unknowns, `bounds` the names of parameters that ended at a bound."""

    task: Task
    theta: Mapping[Key, float]
    status: Status
    loglik: float
    n_samples: int
    n_parameters: int
    bounds: frozenset[str]
    occam: float = 0.0

    @property
    def effects(self) -> tuple[str, ...]:
        """The effects that were free."""
        return self.task.effects

    @property
    def evidence(self) -> float:
        """Log likelihood less what the initial states cost where that is counted."""
        return self.loglik - self.occam

    @property
    def converged(self) -> bool:
        """Whether the optimum was reached."""
        return self.status.converged

    @property
    def comparable(self) -> bool:
        """Whether its likelihood can be held against others: the optimum, or a kink (a delay of whole samples) where no
        step lowers the cost. It is a lower bound of what the model can do in any case."""
        return self.converged or self.status.code is Code.NO_PROGRESS

    @property
    def overtaken(self) -> bool:
        """Whether it was ended far behind a rival."""
        return self.status.code is Code.BEHIND

    @property
    def bic(self) -> float:
        """-2 log L + k ln N over parameters and noise levels, N the number of samples (Schwarz 1978)."""
        return -2 * self.evidence + self.n_parameters * float(np.log(max(self.n_samples, 1)))

    def at_bound(self, effect: str) -> bool:
        """Whether every parameter of the effect ended at its bound (nothing was found there)."""
        own = {n for n, _ in self.theta if n.split(".")[0] == effect}
        return bool(own) and own <= self.bounds


@dataclass(frozen=True, kw_only=True, eq=False)
class NestedFit:
    """The fit with `effects` free, the others at their null; `occam` as in its `Refit`."""

    effects: tuple[str, ...]
    fit: Fit
    occam: float = 0.0

    @property
    def evidence(self) -> float:
        """Log likelihood of all training flights, less what the initial states cost where that is counted."""
        return self.fit.loglik - self.occam

    @property
    def n_parameters(self) -> int:
        """How many parameters and noise levels were fitted."""
        return self.fit.n_parameters

    @property
    def bic(self) -> float:
        """-2 log L + k ln N over parameters and noise levels, N the number of samples (Schwarz 1978)."""
        return self.fit.bic + 2 * self.occam

    def at_bound(self, effect: str) -> bool:
        """Whether every parameter of the effect ended at its bound (nothing was found there)."""
        own = [e for n, e in self.fit.parameters.items() if n.split(".")[0] == effect]
        return bool(own) and all(e.at_bound for e in own)


@dataclass(frozen=True, kw_only=True)
class _There:
    """A solver that knows the answer."""

    theta: Mapping[Key, float]
    status: Status
    name: str = "levenberg-marquardt"

    def solve(
        self, problem: Objective, start: FloatArray, progress: Progress | None = None
    ) -> tuple[FloatArray, Status]:
        """The answer."""
        return _vector(problem, self.theta), self.status


def _vector(problem: Objective, known: Mapping[Key, float]) -> FloatArray:
    """Unknowns of the problem at the known values; one flight's own at what all shared, if that is known."""
    return np.array(
        [known.get((u.name, u.flight), known.get((u.name, None), u.start)) for u in problem.unknowns], dtype=np.float64
    )


def _unknowns(found: NestedFit, free: Iterable[str]) -> dict[Key, float]:
    """What a fit found, of its parameters those that are free."""
    pairs = zip(found.fit.problem.unknowns, found.fit.theta, strict=True)
    wanted = set(free)
    return {(u.name, u.flight): float(t) for u, t in pairs if u.kind != "parameter" or u.name in wanted}


def _levels(found: IdentifiedModel, model: Dynamics) -> dict[str, float]:
    """Noise levels of a fit that the `model` has, too: a search may go on without the filter that an earlier fit had."""
    there = {f"noise.process.{n}" for n in model.noises.names} | {f"noise.sensor.{n}" for n in model.innovations.names}
    return {n: v for n, v in noise_of(found).items() if n in there}


def _onwards(task: Task, found: Refit, bic: float) -> Task:
    """The task from where its first iterations led; it need not be carried out if it cannot come below that BIC."""
    price = found.n_parameters * float(np.log(max(found.n_samples, 1)))
    return replace(
        task, tolerance=ROUGH, starts=(found.theta,), iterations=task.iterations - OPENING,
        target=np.inf if task.marginal else 0.5 * (bic - price),
    )  # fmt: skip


def _canonical(model: PhysicsModel | Augmented) -> PhysicsModel | Augmented:
    """The model with the catalogue's own effect objects: what came over the wire then shares one build."""
    own = {type(e): e for e in CATALOGUE}
    return with_physics(model, lambda m: replace(m, effects=tuple(own.get(type(e), e) for e in m.effects)))


def _prepare(task: Task, data: Dataset) -> None:
    """Build the step that the task needs."""
    with CASADI:
        model = _canonical(task.model)
        wanted = task.options.free or ()
        free = tuple(d.name for d in model.parameters if d.name in wanted)
    engine_for(model, free, quick=few_samples(data))


def solve(task: Task, data: Dataset) -> Refit:
    """Carry out one task. Raises `DataError`, `ModelError`."""
    with threadpool_limits(limits=1):
        problem = make_problem(_canonical(task.model), data, task.options)
        offered = [_vector(problem, k) for k in task.starts] or [noise_start(problem)]
        starts = [problem.inside(t) for t in offered]
        start = min(starts, key=lambda t: problem.evaluate(t, 0).cost) if len(starts) > 1 else starts[0]
        solver = LevenbergMarquardt(
            tolerance=task.tolerance, max_iterations=task.iterations, initial_damping=task.damping, target=task.target
        )  # fmt: skip
        theta, status = solver.solve(problem, start)
        value = problem.evaluate(theta, 1 if task.marginal else 0)
    ends = [
        u.name for u, t in zip(problem.unknowns, theta, strict=True)
        if u.kind == "parameter" and not u.lower < t < u.upper
    ]  # fmt: skip
    return Refit(
        task=task, theta={(u.name, u.flight): float(t) for u, t in zip(problem.unknowns, theta, strict=True)},
        status=status, loglik=-value.likelihood, n_samples=sum(r.n for r in problem.records),
        n_parameters=sum(u.kind != "initial" for u in problem.unknowns), bounds=frozenset(ends),
        occam=_occam(problem, theta, value) if task.marginal and value.valid else 0.0,
    )  # fmt: skip


def _occam(problem: Problem, theta: FloatArray, value: Value) -> float:
    """What the initial states cost: log likelihood at their estimate less that in the mean over their prior (Laplace's
    approximation, parameters held; Kass and Raftery 1995, sec. 4.1). What the flight does not show costs nothing."""
    at = [i for i, u in enumerate(problem.unknowns) if u.kind == "initial"]
    if not at or value.data_hessian is None:
        return 0.0
    sigma = np.array([problem.unknowns[i].sigma for i in at])
    off = (theta[at] - np.array([problem.unknowns[i].mean for i in at])) / sigma
    _, logdet = np.linalg.slogdet(np.eye(len(at)) + sigma[:, None] * value.data_hessian[np.ix_(at, at)] * sigma)
    return 0.5 * float(off @ off + logdet)


@dataclass(frozen=True, kw_only=True, eq=False)
class Nest:
    """Candidates on the training flights. `options` are those of every fit, less what a task says: of them `per_flight`,
    `estimate_noise` and `noise`, the levels that the first fit starts from, are looked at.
    `executor` runs the fits of one step side by side."""

    candidates: Candidates
    data: Dataset
    options: FitOptions = field(default_factory=FitOptions)
    executor: concurrent.futures.Executor | None = None
    recent: list[Refit] = field(default_factory=list)
    """The last tasks that were carried out: a step that is decided again (a name was withheld) fits nothing twice."""

    def task(
        self, effects: Iterable[str], start: NestedFit | None = None, first: Mapping[Key, float] | None = None,
        also: NestedFit | None = None, shares: Sequence[float] = SHARES,
    ) -> Task:  # fmt: skip
        """Fit with `effects` free, from the estimates of `start` and first estimates (of a score test) for new ones, or
        `shares` of them, or from the noise levels or everything of `also`."""
        chosen = tuple(effects)
        free = (*self.candidates.core, *(p for e in chosen for p in self.candidates.parameters[e]))
        model = self.candidates.only(chosen)
        declared = {d.name: d for d in model.parameters}
        null = self.candidates.null
        values = {n: v for n, v in null.items() if n in declared}
        starts: list[dict[Key, float]] = []
        if start is not None:
            base = _unknowns(start, free)
            new = {k: v for k, v in (first or {}).items() if k[0] in declared}
            for share in shares if any(n in null for n, _ in new) else (1.0,):
                part = {(n, f): null.get(n, v) + share * (v - null.get(n, v)) for (n, f), v in new.items()}
                moved = {k: float(np.clip(v, declared[k[0]].lower, declared[k[0]].upper)) for k, v in part.items()}
                starts.append(base | moved)
            if also is not None:
                other = _unknowns(also, free)
                starts += [starts[0] | {k: v for k, v in other.items() if k[0] not in declared}, starts[0] | other]
        options = self.options.but(
            free=free, values=values, per_flight=[n for n in self.options.per_flight if n in declared],
            noise=self.options.noise if start is None else _levels(start.fit.model, model), initialisation="nominal",
        )  # fmt: skip
        return Task(
            effects=chosen, model=model, options=options, starts=tuple(starts), marginal=bool(self.candidates.moving)
        )

    def contest(self, tasks: Sequence[Task], held: float = np.inf) -> list[Refit]:
        """Carry out tasks that are held against each other, and against a fit of BIC `held`: exactly where BIC comes within
        `ROOM` of the best, roughly where it does not (then it is a little too large), and no further than it takes to see
        that it cannot catch up. What ran out of iterations there goes on, `LONGER` times at most."""
        found = self.refits([replace(t, tolerance=ROUGH, iterations=min(OPENING, t.iterations)) for t in tasks])
        best = min([held, *(r.bic for r in found if r.comparable and not any(map(r.at_bound, r.effects)))])
        slow = [i for i, r in enumerate(found) if r.status.code is Code.MAX_ITERATIONS and tasks[i].iterations > OPENING]
        further = self.refits([_onwards(tasks[i], found[i], best + ROOM) for i in slow])
        for i, refit in zip(slow, further, strict=True):
            found[i] = refit
        done = [0] * len(tasks)
        while True:
            best = min([held, *(r.bic for r in found if r.comparable)])
            turns = [1 if r.comparable else LONGER if r.status.code is Code.MAX_ITERATIONS else 0 for r in found]
            close = [i for i, r in enumerate(found) if r.bic < best + ROOM and done[i] < turns[i]]
            if not close:
                return found
            for i in close:
                done[i] += 1
            again = self.refits([replace(tasks[i], starts=(found[i].theta,)) for i in close])
            for i, refit in zip(close, again, strict=True):
                found[i] = refit

    def from_each(self, task: Task) -> Task:
        """The task started from the best of rough fits from every one of its starts.

        Where the model tells how far a velocity carries, the likeliest start may lead into a local optimum: noise levels
        grow until nothing holds the velocity, and the effect dies out.
        """
        found = self.refits(
            [replace(task, starts=(s,), tolerance=ROUGH, iterations=FEW, damping=CAREFUL) for s in task.starts]
        )
        return replace(task, starts=(min(found, key=lambda r: r.bic).theta,))

    def refits(self, tasks: Sequence[Task]) -> list[Refit]:
        """Carry out tasks, side by side where there is an executor. What cannot be sent runs here."""
        known = {i: r for i, t in enumerate(tasks) for r in self.recent if r.task == t}
        left = [i for i in range(len(tasks)) if i not in known]
        if self.executor is None or len(left) < 2 or not all(_sendable(tasks[i]) for i in left):
            # Compilers are processes: those of several models run side by side.
            with concurrent.futures.ThreadPoolExecutor(cores()) as pool:
                list(pool.map(lambda i: _prepare(tasks[i], self.data), left))
            new = [solve(tasks[i], self.data) for i in left]
        else:
            new = [f.result() for f in [self.executor.submit(solve, tasks[i], self.data) for i in left]]
        self.recent[:] = [*self.recent, *new][-RECENT:]
        known |= dict(zip(left, new, strict=True))
        return [known[i] for i in range(len(tasks))]

    def settle(self, refit: Refit) -> NestedFit:
        """The whole result of a fit that was carried out as a task."""
        t = refit.task
        result = fit(t.model, self.data, t.options, solver=_There(theta=refit.theta, status=refit.status))
        return NestedFit(effects=t.effects, fit=result, occam=refit.occam)

    def refit(
        self, effects: Iterable[str], start: NestedFit | None = None, first: Mapping[Key, float] | None = None,
        also: NestedFit | None = None,
    ) -> NestedFit:  # fmt: skip
        """One fit and its whole result, see `task`."""
        return self.settle(self.refits([self.task(effects, start, first, also)])[0])

    def screen(self, at: NestedFit, *, alpha: float = 0.05, draws: int = 999, seed: int = 0) -> list[Score]:
        """Score tests of every candidate that is not in `at`."""
        unfelt = () if has_velocity(at.fit.model.dynamics) else self.candidates.moving
        names = {n: p for n, p in self.candidates.parameters.items() if n not in (*at.effects, *unfelt)}
        null = {p: self.candidates.null[p] for ps in names.values() for p in ps}
        with threadpool_limits(limits=1):
            there = {*names, *at.effects}
            # Without a lag the accelerometer follows a late command within a part of a sample, and that slope leads nowhere.
            late = set(TIMING) & set(names) if self.candidates.lags & set(names) else set()
            whole = self.candidates.only(there)
            problem, theta = widened(
                at.fit.problem, at.fit.theta, self.candidates.only(there - late) if late else whole, self.data, null,
                per_flight=self.options.per_flight, apart=whole if late else None,
            )  # fmt: skip
            seconds = sum(r.n for r in problem.records) * problem.dt
            block = block_samples(problem.dt, min(BLOCK_SECONDS, max(seconds / BLOCKS, SHORTEST)))
            value = problem.evaluate(theta, scores=block)
            tested = screen(
                problem, value, names, alpha=alpha, draws=draws, seed=seed, samples=block,
                predicted=list(problem.predictor.blocks(problem, theta, True)),
            )  # fmt: skip
        return [*tested, *(unscored(n, self.typical((n,))) for n in unfelt)]

    def typical(self, effects: Iterable[str]) -> dict[Key, float]:
        """Parameters of effects at the size that their files call typical: where a refit starts that no score leads."""
        declared = {d.name: d.scale for d in self.candidates.model.parameters}
        own = [p for e in effects for p in self.candidates.parameters[e]]
        return {(p, None): self.candidates.null[p] + declared[p] for p in own}

    def unled(self, effects: Iterable[str], start: NestedFit) -> NestedFit:
        """`refit` of effects some of which no score leads to: these from their typical size."""
        chosen = tuple(effects)
        moving = [n for n in chosen if n in self.candidates.moving and n not in start.effects]
        if not moving:
            return self.refit(chosen, start=start)
        return self.settle(self.refits([self.from_each(self.task(chosen, start, self.typical(moving)))])[0])


def _sendable(task: Task) -> bool:
    """Whether the task can be pickled."""
    try:
        pickle.dumps(task)
    except (pickle.PicklingError, AttributeError, TypeError):
        return False
    return True
