"""A fit that ended in the wrong one of two optima of lag and delay asks the other: the two exchanged,
as they started, as they are expected."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import pytest

from greybox.estimation.elsewhere import PAIR, elsewhere
from greybox.estimation.fit import _lowest, _rough
from greybox.estimation.problem import Problem
from greybox.estimation.solver import Value
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt
from greybox.estimation.status import Code, Interrupted, Status
from greybox.estimation.unknown import SearchSpace, Unknown
from greybox.symbolic import FloatArray

LAG, DELAY, OTHER = 0.035, 0.004, 2.0


def unknown(name: str, scale: float, start: float = 0.0, mean: float = 0.0) -> Unknown:
    return Unknown(
        name=name,
        kind="parameter",
        flight=None,
        start=start,
        lower=0.0,
        upper=np.inf,
        mean=mean,
        sigma=np.inf,
        scale=scale,
        unit="s",
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class TwoWells(SearchSpace):
    """Least squares about two points, the second likelier by `depth`; the cost is that of the
    nearer one. `names` of the first two unknowns."""

    depth: float

    def inside(self, theta: FloatArray) -> FloatArray:
        return np.clip(theta, self.lower, self.upper)

    def evaluate(self, theta: FloatArray, order: int = 1) -> Value:
        wells = np.array([[DELAY, LAG, 1.9], [LAG, DELAY, OTHER]])
        own = int(np.argmin(np.abs(wells[:, 0] - theta[0])))
        off = (theta - wells[own]) / self.scale
        cost = 0.5 * float(off @ off) - (self.depth if own else 0.0)
        slope, hessian = off / self.scale, np.diag(self.scale**-2)
        return Value(cost=cost, likelihood=cost, gradient=slope, hessian=hessian)


def world(depth: float, names: tuple[str, ...] = PAIR) -> Problem:
    unknowns = (*(unknown(n, 1e-3) for n in names), unknown("inertia.zz", 1e-3))
    return cast(Problem, TwoWells(unknowns=unknowns, depth=depth))


WRONG = np.array([DELAY, LAG, 1.9])


def test_the_likelier_order_is_promised_although_its_point_is_higher():
    problem = world(10.0)
    other = elsewhere(problem, WRONG)
    assert other is not None
    assert other[:2] == pytest.approx([LAG, DELAY])
    assert problem.evaluate(other, 0).cost > problem.evaluate(WRONG, 0).cost


@pytest.mark.parametrize("depth", [-10.0, 0.5])
def test_one_that_is_no_likelier_is_left_alone(depth: float):
    assert elsewhere(world(depth), WRONG) is None


def test_lag_without_delay_has_no_other_order():
    assert elsewhere(world(10.0, ("motor_lag.tau", "rotor_drag.k_x")), WRONG) is None


@pytest.mark.parametrize("known", [{"start": LAG}, {"mean": LAG}])
@pytest.mark.parametrize("second", [PAIR[1], "rotor_drag.k_x"])
def test_the_lag_that_was_given_or_expected_is_asked(known: dict[str, float], second: str):
    unknowns = (unknown(PAIR[0], 1e-3, **known), unknown(second, 1e-3), unknown("mass", 1e-3))
    at = np.array([DELAY, 0.0, 1.9])
    other = elsewhere(cast(Problem, TwoWells(unknowns=unknowns, depth=1e3)), at)
    assert other == pytest.approx([LAG, 0.0, 1.9])


@dataclass(frozen=True, kw_only=True)
class Ends:
    """A solver that ends at `at`, with `code`, or is interrupted."""

    at: FloatArray
    code: Code = Code.CONVERGED

    def solve(self, problem: Problem, theta: FloatArray, progress: Any = None) -> Any:
        if self.code is Code.INTERRUPTED:
            raise Interrupted((self.at, status(self.code)))
        return self.at, status(self.code)


def status(code: Code) -> Status:
    return Status(code=code, iterations=3, evaluations=4, decrement=0.0)


RIGHT = np.array([LAG, DELAY, OTHER])


def test_a_search_goes_on_from_the_other_order_and_keeps_the_lower_end():
    done = status(Code.CONVERGED)
    for end, kept in ((RIGHT, RIGHT), (np.array([LAG, DELAY, OTHER + 1.0]), WRONG)):
        theta, _ = _lowest(world(10.0), cast(Any, Ends(at=end)), WRONG, done, None)
        assert (theta == kept).all()
    lost = cast(Any, Ends(at=RIGHT, code=Code.MAX_ITERATIONS))
    theta, how = _lowest(world(10.0), lost, WRONG, done, None)
    assert (theta == WRONG).all() and how is done


def test_an_interrupt_on_the_way_keeps_the_optimum_that_there_was():
    stopped = cast(Any, Ends(at=RIGHT, code=Code.INTERRUPTED))
    with pytest.raises(Interrupted) as stop:
        _lowest(world(10.0), stopped, WRONG, status(Code.CONVERGED), None)
    theta, how = stop.value.kept
    assert (theta == WRONG).all() and how.code is Code.INTERRUPTED


def test_only_a_search_that_ends_before_its_optimum_is_not_asked():
    assert not _rough(LevenbergMarquardt(max_iterations=100))
    assert _rough(LevenbergMarquardt(tolerance=0.2))
