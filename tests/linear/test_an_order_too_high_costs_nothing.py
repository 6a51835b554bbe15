"""An order above the truth costs nothing: states that the data do not carry are left out; the rest
is the likelihood's.

Where states cancel the likelihood is no bump: its maximum fits the record and foretells less.
"""

from __future__ import annotations

import numpy as np
import pytest

from greybox.linear.fit import fit_linear
from greybox.linear.pem import Settings, Status, start_nuisances
from greybox.linear.predictor import predict
from greybox.linear.records import Record, prepare
from greybox.linear.search import Options, decompose, find, price_of_a_state
from greybox.model.matrices import Matrices
from scenarios.plants.linear_systems import random_system, simulate

ORDER = 4


def record(
    seed: int, samples: int = 4000, inputs: int = 1, outputs: int = 1
) -> tuple[Record, Record]:
    """Two halves of one record of a random system of order 4."""
    rng = np.random.default_rng(seed)
    u, y = simulate(rng, random_system(rng, ORDER, inputs, outputs), 2 * samples)
    return Record(u=u[:samples], y=y[:samples]), Record(u=u[samples:], y=y[samples:])


def log_det(system: Matrices, new: Record) -> float:
    """Of the innovations on a record that was not fitted to."""
    start = start_nuisances(system, [new], Settings(offsets=False))[0]
    e = predict(system, new, start.x0, start.offset, np.eye(new.y.shape[1])).e
    return float(np.linalg.slogdet(e.T @ e / len(e))[1])


@pytest.mark.parametrize(("inputs", "outputs"), [(1, 1), (2, 2)])
def test_new_data_are_foretold_as_by_the_true_order_and_better_than_by_the_maximum(
    inputs: int, outputs: int
) -> None:
    """Sum over two systems, four states too many, beside the maximum at that order and both
    subspace estimates."""
    lost = {"found": 0.0, "maximum": 0.0, "pbsid": 0.0, "ssarx": 0.0}
    for seed in range(10, 12):
        old, new = record(seed, 3000, inputs, outputs)
        (scaled,), scale = prepare([old])
        found = {
            "right": find([scaled], ORDER, Options()).solution.system,
            "found": find([scaled], ORDER + 4, Options()).solution.system,
            "maximum": find([scaled], ORDER + 4, Options(exact_order=True)).solution.system,
            **{s.method: s.realise(ORDER + 4) for s in decompose([scaled], ORDER + 4, Options())},
        }
        score = {
            k: log_det(s.scaled(1 / scale.input_scale, 1 / scale.output_scale), new)
            for k, s in found.items()
        }
        for name in lost:
            lost[name] += score[name] - score["right"]
    assert lost["found"] < 1e-3 and lost["found"] < min(
        lost["maximum"], lost["pbsid"], lost["ssarx"]
    ), lost


def test_the_fit_says_which_states_it_left_out() -> None:
    fit = fit_linear([record(1)[0]], ORDER + 4)
    assert fit.order == ORDER and fit.converged
    assert any(w.startswith(f"{ORDER} of {ORDER + 4} states:") for w in fit.warnings)
    kept = fit_linear([record(1)[0]], ORDER + 4, options=Options(exact_order=True))
    assert kept.order == ORDER + 4


@pytest.mark.parametrize("order", [2, ORDER])
def test_up_to_the_true_order_the_result_is_the_likelihoods_maximum(order: int) -> None:
    (scaled,), _ = prepare([record(1)[0]])
    found = find([scaled], order, Options())
    assert found.solution.status is Status.CONVERGED and found.solution.system.order == order
    again = find([scaled], order, Options(exact_order=True))
    for a, b in zip(found.solution.system, again.solution.system, strict=True):
        assert np.array_equal(a, b)


@pytest.mark.parametrize(("parameters", "samples"), [(3, 3000), (10, 500)])
def test_the_price_is_where_the_evidence_of_a_pair_is_even(parameters: int, samples: int) -> None:
    """Both factors by quadrature: strengths under the most likely prior width, a pole under
    Jeffreys' prior."""
    gain, strengths = 2 * price_of_a_state(parameters, samples), 2 * (parameters - 1)
    widths = np.geomspace(1e-3, 1e3, 20001)  # prior variance of a strength in that of its estimate
    of_strengths = np.max(-0.5 * strengths * np.log1p(widths) + 0.5 * gain * widths / (1 + widths))
    side, edge = np.linspace(-1, 1, 2001), 1 - 3.0 / samples
    disc = side[:, None] + 1j * side[None, 1000:]
    inside = np.abs(disc) < 0.9  # the rest of the prior's mass has a closed form
    prior = (
        np.where(inside, (1 - np.abs(np.where(inside, disc, 0)) ** 2) ** -2, 0.0)
        * (side[1] - side[0]) ** 2
    )
    mass = prior.sum() + np.pi / 2 * (edge**2 / (1 - edge**2) - 0.81 / 0.19)
    truth = 0.3 + 0.4j
    of_pole = np.log(
        np.sum(
            prior * np.exp(-0.5 * gain * np.abs(disc - truth) ** 2 / (1 - np.abs(truth) ** 2) ** 2)
        )
        / mass
    )
    assert of_strengths + of_pole == pytest.approx(0.0, abs=0.4)
