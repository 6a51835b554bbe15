"""Claim: work is spread over the cores of the process' affinity, not over those of the machine; the
numbers stay."""

from __future__ import annotations

import os

import numpy as np
import pytest

from greybox.cores import cores
from greybox.estimation.criteria.gaussian import Gaussian
from greybox.estimation.predictors.innovation import Innovation
from greybox.estimation.problem import make_problem
from greybox.model.model import build_model
from tests.simulated import flights, vehicle


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the system knows no affinity")
def test_one_core_is_one_core() -> None:
    data = flights(count=2, seconds=2.0)
    model = build_model(vehicle(), data.channels, ("rotor_drag",))
    problem = make_problem(model, data, predictor=Innovation(), criterion=Gaussian())
    allowed = os.sched_getaffinity(0)
    before = problem.evaluate(problem.start)
    try:
        os.sched_setaffinity(0, {min(allowed)})
        assert cores() == 1
        alone = problem.evaluate(problem.start)
    finally:
        os.sched_setaffinity(0, allowed)
    assert cores() == len(allowed)
    assert alone.cost == before.cost
    np.testing.assert_array_equal(alone.gradient, before.gradient)


def test_without_affinity_all_cores_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    assert cores() == (os.cpu_count() or 1)
