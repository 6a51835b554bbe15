"""An order above the truth stays at its start where the polish gains no more than chance; a regular optimum is left alone.

Where states cancel the likelihood is no bump: its maximum fits the record and foretells less.
"""

from __future__ import annotations

import numpy as np
import pytest

from greybox.linear.fit import fit_linear
from greybox.linear.pem import Settings, Status, minimise, start_nuisances, worth_leaving
from greybox.linear.predictor import predict
from greybox.linear.records import Record, prepare
from greybox.linear.search import Options, find
from greybox.model.matrices import Matrices
from scenarios.plants.linear_systems import random_system, simulate

ORDER = 4


def record(seed: int, samples: int = 4000) -> tuple[Record, Record]:
    """Two halves of one record of a random system with one input and one output."""
    rng = np.random.default_rng(seed)
    u, y = simulate(rng, random_system(rng, ORDER, 1, 1), 2 * samples)
    return Record(u=u[:samples], y=y[:samples]), Record(u=u[samples:], y=y[samples:])


def log_det(system: Matrices, new: Record) -> float:
    """Of the innovations on a record that was not fitted to."""
    start = start_nuisances(system, [new], Settings(offsets=False))[0]
    e = predict(system, new, start.x0, start.offset, np.eye(1)).e
    return float(np.linalg.slogdet(e.T @ e / len(e))[1])


def test_new_data_are_foretold_better_than_by_the_maximum_of_the_likelihood() -> None:
    """Mean over six systems, four states too many: less than two thirds of what the maximum loses to the true order."""
    lost = {"kept": 0.0, "maximum": 0.0}
    for seed in range(10, 16):
        old, new = record(seed)
        (scaled,), scale = prepare([old])
        found = find([scaled], ORDER + 4, Options()).solution
        top = minimise(found.point, [scaled], Settings()) if found.status is Status.START_KEPT else found
        right = find([scaled], ORDER, Options()).solution
        plain = [s.system.scaled(1 / scale.input_scale, 1 / scale.output_scale) for s in (right, found, top)]
        base, kept, maximum = (log_det(system, new) for system in plain)
        lost["kept"] += kept - base
        lost["maximum"] += maximum - base
    assert lost["maximum"] > 0 and lost["kept"] < 0.67 * lost["maximum"], lost


def test_the_fit_says_that_it_kept_its_start() -> None:
    fit = fit_linear([record(10)[0]], ORDER + 4)
    assert fit.status is Status.START_KEPT and not fit.converged and fit.status.final
    assert any("lower the order" in w for w in fit.warnings)


@pytest.mark.parametrize("order", [2, ORDER])
def test_a_regular_optimum_is_the_likelihoods(order: int) -> None:
    """At the true order and below it the result is the maximum, to the last digit."""
    (scaled,), _ = prepare([record(1)[0]])
    found = find([scaled], order, Options())
    assert found.solution.status is Status.CONVERGED
    again = find([scaled], order, Options(settings=Settings(weigh_start=False)))
    for a, b in zip(found.solution.system, again.solution.system, strict=True):
        assert np.array_equal(a, b)


def test_the_bar_is_akaikes() -> None:
    assert worth_leaving(41.0, 20) and not worth_leaving(40.0, 20)
