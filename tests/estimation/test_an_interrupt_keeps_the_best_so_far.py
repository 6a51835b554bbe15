"""Ctrl-C in a fit: nobody goes on with half of it, and what was found until then is not lost."""

from __future__ import annotations

import itertools
import threading
import time

import pytest

import greybox as gb
from greybox.cores import cores
from greybox.estimation.criteria.gaussian import Gaussian
from greybox.estimation.fit import Fit
from greybox.estimation.multistart import multistart
from greybox.estimation.predictors.innovation import Innovation
from greybox.estimation.problem import make_problem
from greybox.estimation.solvers import SOLVERS
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt
from greybox.estimation.status import Code, Interrupted
from tests import motor


class CtrlC:
    """Progress that is interrupted at its third call."""

    calls = 0

    def __call__(self, *_: float) -> None:
        self.calls += 1
        if self.calls == 3:
            raise KeyboardInterrupt


@pytest.mark.parametrize("name", SOLVERS)
def test_every_solver_hands_out_its_best_point(name: str) -> None:
    data = motor.record(torque_noise=0.002)
    problem = make_problem(motor.model(), data, predictor=Innovation(), criterion=Gaussian())
    with pytest.raises(Interrupted) as stop:
        SOLVERS[name](tolerance=1e-30).solve(problem, problem.start, CtrlC())
    theta, status = stop.value.kept
    assert status.code is Code.INTERRUPTED
    assert problem.evaluate(theta, 0).cost < problem.evaluate(problem.start, 0).cost


@pytest.mark.parametrize("initialisation", ["nominal", "innovation"])
def test_a_fit_hands_out_what_it_has(initialisation: str) -> None:
    progress = CtrlC()
    with pytest.raises(Interrupted) as stop:
        gb.fit(
            motor.model(),
            motor.record(torque_noise=0.002),
            initialisation=initialisation,
            predictor="multi-step",
            progress=progress,
        )
    kept = stop.value.kept
    assert isinstance(kept, Fit)
    assert not kept.converged
    assert "interrupted" in kept.warnings[0]
    assert progress.calls == 3, "it went on"


@pytest.mark.skipif(cores() < 2, reason="starts run side by side on two cores")
def test_many_starts_stop_together() -> None:
    problem = make_problem(
        motor.model(),
        motor.record(torque_noise=0.002),
        predictor=Innovation(),
        criterion=Gaussian(),
    )
    second, told = threading.Event(), threading.Event()
    turn = itertools.count()

    class Watched(LevenbergMarquardt):
        def solve(self, problem, start, progress=None):  # type: ignore[no-untyped-def]
            if next(turn) == 0:
                second.wait(20)
                raise KeyboardInterrupt
            second.set()
            until = time.monotonic() + 20
            while time.monotonic() < until:  # as long as nobody says stop
                try:
                    progress(1, 0.0, 0.0)
                except KeyboardInterrupt:
                    told.set()
                    raise
                time.sleep(0.005)
            return super().solve(problem, start, progress)

    with pytest.raises(KeyboardInterrupt):
        multistart(problem, Watched(), n=20)
    assert told.is_set()
