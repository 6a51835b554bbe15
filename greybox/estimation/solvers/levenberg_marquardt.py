"""Levenberg-Marquardt on exact sensitivities, with bounds by an active set.

More 1978, The Levenberg-Marquardt algorithm: implementation and theory (scaled damping, gain
ratio); bounds by an active set on the quadratic model (`boxed_step`). Steps of noise levels are
taken in their variances, those of factors in their logarithms (`moved_by`). What the Gauss-Newton
Hessian leaves out is learned on the way (`greybox.estimation.solvers.curvature`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from greybox.estimation.solver import Objective, Progress, Value
from greybox.estimation.solvers.curvature import Curvature
from greybox.estimation.solvers.kink import held_to, kink_near
from greybox.estimation.status import Code, Interrupted, Status
from greybox.symbolic import BoolArray, FloatArray

PARTS = 3
"""Parts of a step whose cost is asked for where the whole is not worth taking."""

SHORT = 0.3
"""Part of a step below which its direction was no good."""

ARRIVED = 1e-3
"""Predicted decrease below which a search that ran out of iterations has arrived: a twentieth of a
standard error. Where the Gauss-Newton Hessian is not the true one, steps creep there for long."""

GOOD = 0.75
"""Part of the predicted decrease above which a step might have been longer."""

POOR = 0.25
"""Part of the predicted decrease below which a step was too long."""

FALL = -0.375
"""Most negative step of a noise level: its variance falls to a quarter."""

PACE = 5
"""Iterations over which the pace of a search is measured."""

BEYOND = 10.0
"""Depth of an optimum, in units of what the full step to it promises, that is not expected once
`PACE` steps were taken. Calibrated on 167 later steps of 23 fits in searches for causes
(development seeds): 95 % of the optima were less deep than 2.8 promises, 99 % than 10, the deepest
14. From starts at random, far from any optimum, tails are longer. Single causes next to a missing
lag: `python -m scenarios.studies.e_values --run depth --seeds 1 1`, 20 later steps, the deepest
1.4."""

Way = Callable[[FloatArray, FloatArray, Objective], FloatArray]
"""How a step (n,) is taken from unknowns (n,) of a problem."""


@dataclass(frozen=True, kw_only=True)
class LevenbergMarquardt:
    """Stops when the predicted decrease of the cost (half the squared Newton decrement) falls below
    `tolerance`.

    The cost is a negative log likelihood, so that 1e-6 means: every estimate is within about a
    thousandth of its standard error of the optimum; after the last iteration, or where rounding
    stops it, or where it creeps, a thousand times that is enough. `damped=False` starts as pure
    Gauss-Newton. Above the `target`, a negative log likelihood, the result is of no interest: the
    search ends where even twice its pace would not lead there in the iterations that are left.
    """

    name: str = "levenberg-marquardt"
    tolerance: float = 1e-6
    max_iterations: int = 60
    initial_damping: float = 1e-3
    damped: bool = True
    target: float = np.inf

    def solve(
        self, problem: Objective, start: FloatArray, progress: Progress | None = None
    ) -> tuple[FloatArray, Status]:
        """Minimise from `start`; the best point and a status. Raises `Interrupted`, which holds
        both."""
        x = np.clip(start, problem.lower, problem.upper)
        value = problem.evaluate(x)
        if not value.valid:
            return x, Status(code=Code.INVALID_START, iterations=0, evaluations=1, decrement=np.inf)
        search = _Search(problem, self, x, value)
        try:
            code = search.run(progress)
        except KeyboardInterrupt:
            code = Code.INTERRUPTED
        if code is Code.MAX_ITERATIONS and search.decrement < min(ARRIVED, 1e3 * self.tolerance):
            code = Code.CONVERGED
        decrement = search.decrement
        if code in (Code.MAX_ITERATIONS, Code.BEHIND) and search.value.gradient is not None:
            decrement = max(decrement, search.plainly())  # secants do not say alone what is left
        status = Status(
            code=code,
            iterations=search.iteration,
            evaluations=search.evaluations,
            decrement=float(decrement),
        )
        if code is Code.INTERRUPTED:
            raise Interrupted((search.x, status))
        return search.x, status


class _Search:
    """The best point `x` (n,) so far with its `value`, and what the search has learned on its way:
    the damping (n,) and what Gauss-Newton leaves out of the Hessian."""

    def __init__(
        self, problem: Objective, rule: LevenbergMarquardt, x: FloatArray, value: Value
    ) -> None:
        self.problem, self.rule = problem, rule
        self.x, self.value = x, value
        self.iteration, self.evaluations, self.decrement = 0, 1, np.inf
        self._level = is_level(problem)
        self._fall = np.where(self._level, FALL, -np.inf)
        self._gentle = rule.initial_damping if rule.damped else 0.0
        self._damping = np.full(x.size, self._gentle)
        self._curvature = Curvature(x.size)
        self._kinks: list[FloatArray] = []
        self._at_end = False
        self._short = 0
        """Steps in a row of which a short part was taken."""
        self._likelihoods: list[float] = []
        self._costs: list[float] = []

    def run(self, progress: Progress | None) -> Code:
        """Step until something ends the search; why it ended."""
        tolerance, most = self.rule.tolerance, self.rule.max_iterations
        for k in range(1, most + 1):
            self.iteration = k
            g, h, plain = self._quadratic()
            if progress:
                progress(k, self.value.cost, self.decrement)
            if self.decrement < tolerance:
                if not self._left_kinks():
                    return Code.CONVERGED
                continue
            if self._short > 1 and self._found_kink(g, h):
                continue
            self._likelihoods.append(self.value.likelihood)
            self._costs.append(self.value.cost)
            if hopeless(self._likelihoods, self.decrement, self.rule.target, most - k):
                return Code.BEHIND
            creeping = creeps(self._costs, tolerance)
            if creeping and not plain:
                self._curvature, self._costs = Curvature(self.x.size), []
            if not (creeping and plain) and self._moves(g, h):
                continue
            if not plain:
                self._curvature = Curvature(self.x.size)
            elif self._arrived:
                return Code.CONVERGED
            elif not self._found_kink(g, h):
                return Code.NO_PROGRESS
        return Code.MAX_ITERATIONS

    @property
    def _arrived(self) -> bool:
        return self.decrement < max(self.rule.tolerance, min(ARRIVED, 1e3 * self.rule.tolerance))

    @property
    def _room(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds (n,) of a step."""
        return self.problem.lower - self.x, self.problem.upper - self.x

    def _found_kink(self, g: FloatArray, h: FloatArray) -> bool:
        """Go to a kink that the full step would cross near here, and stay at it: whether there is
        one."""
        step = boxed_step(g, h, *self._room, 0.0)
        kink, tried = kink_near(self.problem, self.x, self.value, step, h, self._level)
        self.evaluations += tried
        self._short = 0
        if kink is None:
            return False
        self.x, self.value = kink.x, kink.value
        self._kinks.append(kink.across)
        self._damping[:] = self._gentle  # it was raised because of the kink
        self._costs = []
        return True

    def _left_kinks(self) -> bool:
        """Once, at the end: let go of the kinks that hold the search, but for one that is still
        there, to whose lowest point it goes. Whether there were any."""
        assert self.value.gradient is not None and self.value.hessian is not None
        if not self._kinks or self._at_end:
            return False
        self._kinks, self._costs, self._at_end = [], [], True
        self._found_kink(self.value.gradient, self.value.hessian)
        return True

    def plainly(self) -> float:
        """The decrease that a full step promises by the Gauss-Newton Hessian."""
        assert self.value.gradient is not None and self.value.hessian is not None
        return promised(self.value.gradient, held_to(self._kinks, self.value.hessian), *self._room)

    def _quadratic(self) -> tuple[FloatArray, FloatArray, bool]:
        """Gradient (n,) and Hessian (n, n) of the model of the cost here, whose full step promises
        `decrement`; whether it is Gauss-Newton's."""
        assert self.value.gradient is not None and self.value.hessian is not None
        g, h = self.value.gradient, self._curvature.at(self.x, self.value)
        plain, h = h is self.value.hessian, held_to(self._kinks, h)
        self.decrement = promised(g, h, *self._room)
        if self.decrement < self.rule.tolerance and not plain:
            # Secants do not say alone that the search has arrived.
            plainly = self.plainly()
            if plainly > max(ARRIVED, self.rule.tolerance):
                h, self.decrement, plain = held_to(self._kinks, self.value.hessian), plainly, True
        return g, h, plain

    def _moves(self, g: FloatArray, h: FloatArray) -> bool:
        """Take a step that lowers the cost, damped as much as it needs; whether there is one."""
        low, high = self._room
        for _ in range(30):
            taken = boxed_step(g, h, np.maximum(low, self._fall), high, self._damping)
            way, share, cost, tried = worth_taking(self.problem, self.x, self.value, h, taken)
            self.evaluations += tried
            if share > 0:
                part = share * taken
                new = way(self.x, part, self.problem)
                trial = self.problem.evaluate(new)
                self.evaluations += 1
                if trial.valid and trial.cost < self.value.cost:
                    # What a part keeps says nothing of a whole whose cost is not finite.
                    most = np.inf if np.isfinite(cost) else share
                    self._damp(np.minimum(self._kept(g, h, part, trial), most), share)
                    self._short = self._short + 1 if share < SHORT else 0
                    self.x, self.value = new, trial
                    return True
            nothing = 1e-9 * max(abs(self.value.cost), 1.0)
            tiny = promise_of(g, h, taken) < self.rule.tolerance
            if tiny and abs(self.value.cost - cost) < nothing:
                return False
            self._damping = np.maximum(10 * self._damping, 1e-6)
        return False

    def _kept(self, g: FloatArray, h: FloatArray, step: FloatArray, there: Value) -> FloatArray:
        """What came of the promise of a step (n,), see `shares_kept`."""
        ratio = (self.value.cost - there.cost) / max(promise_of(g, h, step), 1e-300)
        return shares_kept(g, h, step, there, self._level, float(ratio))

    def _damp(self, kept: FloatArray, share: float) -> None:
        """More where a short part of a step was taken, less where the promise was kept (n,)."""
        damping = self._damping
        if share < SHORT:
            damping = np.where(kept < GOOD, np.maximum(4 * damping, 1e-6), damping)
        shrunk = np.where(damping > 1e-12, damping / 10, 0.0)
        self._damping = np.where(kept > GOOD, shrunk, damping)


def hopeless(trail: Sequence[float], promise: float, target: float, left: int) -> bool:
    """Whether a search with these values of the negative log likelihood so far will not reach the
    target: the iterations that are `left` are too few at twice its pace over the last `PACE`, or
    the optimum too shallow even if it were `BEYOND` times as deep as the full step promises."""
    if len(trail) <= PACE:
        return False
    pace = (trail[-1 - PACE] - trail[-1]) / PACE
    return trail[-1] - target > min(2 * max(pace, 0.0) * left, BEYOND * promise)


def creeps(costs: Sequence[float], tolerance: float) -> bool:
    """Whether the last `PACE` steps together gained less than the tolerance. Where hardly anything
    tells of a direction, full steps promise what is not there, and a search goes on for long."""
    return len(costs) > PACE and costs[-1 - PACE] - costs[-1] < tolerance


def promised(g: FloatArray, h: FloatArray, low: FloatArray, high: FloatArray) -> float:
    """The decrease that a full step within low <= step <= high promises."""
    full = boxed_step(g, h, low, high, 0.0)
    return max(promise_of(g, h, full), 0.0)


def promise_of(g: FloatArray, h: FloatArray, step: FloatArray) -> float:
    """The decrease that a step (n,) promises."""
    return -float(g @ step + 0.5 * step @ h @ step)


def worth_taking(
    problem: Objective, x: FloatArray, value: Value, h: FloatArray, step: FloatArray
) -> tuple[Way, float, float, int]:
    """(how to take a step, share of it that is worth taking, 0 for none; cost of the whole step;
    evaluations), by costs alone, which are far cheaper than slopes.

    The whole step where a quarter of its promise is kept, else the floor of the parabola through
    the slope here and the cost there: where the Hessian is too small in a few directions, whole
    steps cross their valley to and fro. Straight where that is better: valleys of a sum (two drags,
    the powers of a thrust map) are straight, those of a product are in logarithms (`moved_by`).
    """
    assert value.gradient is not None
    slope, promise = float(value.gradient @ step), promise_of(value.gradient, h, step)

    def cost_at(way: Way, share: float) -> float:
        return problem.evaluate(way(x, share * step, problem), 0).cost

    def poor(cost: float) -> bool:
        return promise > 0 and value.cost - cost < POOR * promise

    whole: dict[Way, float] = {moved_by: cost_at(moved_by, 1.0)}
    # Without factors the two are one.
    if poor(whole[moved_by]) and (moved_by(x, step, problem) != straight(x, step, problem)).any():
        whole[straight] = cost_at(straight, 1.0)
    way = min(whole, key=lambda way: whole[way])
    share, costs = 1.0, {1.0: whole[way]}
    while len(costs) <= PARTS and poor(costs[share]):
        rise = costs[share] - value.cost - share * slope
        floor = -0.5 * share**2 * slope / rise if rise > 0 else np.inf
        floor = min(max(floor, 0.1 * share), 3.0 * share, 0.9) if np.isfinite(rise) else 0.3 * share
        if costs[share] < value.cost and abs(floor - share) < 0.3 * share:
            break
        share = floor
        costs[share] = cost_at(way, share)
    best = min(costs, key=lambda part: costs[part])
    tried = len(whole) + len(costs) - 1
    return way, best if costs[best] < value.cost else 0.0, costs[1.0], tried


def shares_kept(
    g: FloatArray, h: FloatArray, step: FloatArray, there: Value, level: BoolArray, ratio: float
) -> FloatArray:
    """Per unknown (n,), what came of the decrease that the step of its kind promised: noise levels,
    or all others. By the slope where the step ended; `ratio`, that of the whole, where neither or
    no slope tells.

    The two are orthogonal in the information of a Gaussian likelihood (Mardia and Marshall 1984,
    Biometrika 71(1)). Levels whose Hessian is wrong must not damp what moves along a flat valley,
    nor the reverse.
    """
    out = np.full(g.size, ratio)
    if there.valid and there.gradient is not None:
        for part in (level, ~level):
            own = np.where(part, step, 0.0)
            promise = -float(own @ (g + 0.5 * (h @ step)))
            if promise > 0:
                out[part] = -0.5 * float(own @ (g + there.gradient)) / promise
        if ratio < POOR and (out >= POOR).all():
            out[:] = ratio
    return out


def is_level(problem: Objective) -> BoolArray:
    """Which unknowns (n,) are logarithms of noise levels."""
    return np.array([u.kind == "noise" for u in problem.unknowns], dtype=bool)


def origins(problem: Objective) -> FloatArray:
    """Where the factors vanish that the unknowns stand for (n,), see `Unknown`; not a number where
    they are none."""
    return np.array([u.origin for u in problem.unknowns], dtype=np.float64)


def moved_by(x: FloatArray, step: FloatArray, problem: Objective) -> FloatArray:
    """x (n,) moved by a step (n,), the same to first order, within the bounds, in coordinates that
    bend less.

    The variances of noise, not the logarithms of its levels, are linear; steps of levels are above
    -1/2. A single level that is too small then needs one step of Fisher scoring, where in its
    logarithm a step overshoots; one that is too large falls as fast as the steps are allowed to,
    not by a half in the logarithm.

    A factor moves by a factor, up to e: flights show ratios (thrust over mass), and what leaves all
    ratios as they are is a curved valley in products, and a straight line in logarithms. A step to
    the bound at which it vanishes is taken as it is; another bound a factor would only near, so
    that a step there lands on it once it is near.
    """
    lower, size = problem.lower, x - origins(problem)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = step / size
        factor = (size > 0) & (np.abs(share) <= 1.0) & ((x - size < lower) | (x + step > lower))
    moved = _in_variances(step, problem)
    moved[factor] = size[factor] * np.expm1(share[factor])
    with np.errstate(invalid="ignore"):
        there = factor & (x + step <= lower) & (x + moved - lower < 1e-3 * size)
    moved[there] = (lower - x)[there]
    return np.clip(x + moved, lower, problem.upper)


def straight(x: FloatArray, step: FloatArray, problem: Objective) -> FloatArray:
    """x (n,) moved by a step (n,), of noise levels in their variances, within the bounds."""
    return np.clip(x + _in_variances(step, problem), problem.lower, problem.upper)


def _in_variances(step: FloatArray, problem: Objective) -> FloatArray:
    """A step (n,) with that of noise levels, which are logarithms, taken in their variances."""
    moved, level = step.copy(), is_level(problem)
    moved[level] = 0.5 * np.log1p(2.0 * step[level])
    return moved


def newton_decrement(g: FloatArray, h: FloatArray, held: BoolArray) -> float:
    """g' H^-1 g / 2 over the unknowns that are not held: the decrease that a full step promises."""
    return full_step(g, h, held)[1]


def full_step(g: FloatArray, h: FloatArray, held: BoolArray) -> tuple[FloatArray, float]:
    """(the Gauss-Newton step (n,) of the unknowns that are not held, the decrease that it
    promises)."""
    step = damped_step(g, h, held, 0.0)
    return step, max(-0.5 * float(g @ step), 0.0)


def boxed_step(
    g: FloatArray, h: FloatArray, low: FloatArray, high: FloatArray, damping: float | FloatArray
) -> FloatArray:
    """Minimiser of the damped quadratic model within low <= step <= high, by an active set.

    Bounds join one by one along a path that only descends, and the one whose release promises most
    leaves (Nocedal and Wright 2006, sec. 16.5). Bounds that join at once may go round in circles,
    and a Newton step that is clipped instead is not a descent direction when unknowns are
    correlated (Bertsekas 1982, SIAM J. Control and Optimization 20(2)).
    """
    h = h + np.diag(np.broadcast_to(damping, g.shape) * np.diag(h))
    step = np.zeros_like(g)
    held = _pushed_out(g, step, low, high)
    for _ in range(20 * g.size + 20):
        part = damped_step(g + h @ step, h, held, 0.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            room = np.where(part == 0, np.inf, np.where(part < 0, low - step, high - step) / part)
        share = min(1.0, float(room.min()))
        step = np.clip(step + share * part, low, high)
        if share < 1.0:
            met = room <= share
            step = np.where(met, np.where(part < 0, low, high), step)
            held = held | met
            continue
        slope = g + h @ step
        back = held & (low < high) & ~_pushed_out(slope, step, low, high)
        if not back.any():
            break
        held[_steepest(slope, h, back)] = False
    return step


def _pushed_out(
    slope: FloatArray, step: FloatArray, low: FloatArray, high: FloatArray
) -> BoolArray:
    """Which unknowns (n,) are at a bound that the slope pushes them against."""
    return ((step <= low) & (slope > 0)) | ((step >= high) & (slope < 0))


def _steepest(slope: FloatArray, h: FloatArray, among: BoolArray) -> int:
    """The unknown of these whose release promises most."""
    scale = np.sqrt(np.maximum(np.diag(h), 1e-300))
    return int(np.argmax(np.where(among, np.abs(slope) / scale, -1.0)))


def damped_step(
    g: FloatArray, h: FloatArray, held: BoolArray, damping: float | FloatArray
) -> FloatArray:
    """-(H + damping diag H)^-1 g on the unknowns that are not held; directions without information
    do not move."""
    free = ~np.asarray(held, dtype=bool)
    step = np.zeros_like(g)
    if not free.any():
        return step
    sub = h[np.ix_(free, free)]
    scale = np.sqrt(np.maximum(np.diag(sub), 1e-300))
    scaled = sub / np.outer(scale, scale)
    scaled[np.diag_indices_from(scaled)] += np.broadcast_to(damping, g.shape)[free] + 1e-13
    rhs = -g[free] / scale
    try:
        factor = scipy.linalg.cho_factor(scaled, check_finite=False)
        part = scipy.linalg.cho_solve(factor, rhs, check_finite=False)
    except np.linalg.LinAlgError:
        value, vector = np.linalg.eigh(scaled)
        good = value > 1e-12 * value[-1]
        part = vector[:, good] @ ((vector[:, good].T @ rhs) / value[good])
    step[free] = part / scale
    return step
