"""An error of a learned push travels along a path with the covariance that it has between its
places."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest

from greybox.estimation.error_along_path import SAME, ErrorAlongPath
from greybox.model.layer import LearnedErrors

STEPS, PREDICTIONS, ND, OUTPUTS, NE = 30, 4, 3, 2, 2


@dataclass(frozen=True)
class At(LearnedErrors):
    """The error at step t of paths whose covariance between steps is `covariance` (m, n_out, T,
    T)."""

    t: int
    covariance: np.ndarray

    def together(self, others: Sequence[At], *, open_only: bool = False) -> np.ndarray:
        return np.moveaxis(self.covariance[:, :, self.t, [o.t for o in others]], -1, 0)


def covariance(lengthscale: float) -> np.ndarray:
    """Of an error that is alike over so many steps; the second output is three times as large, and
    each prediction moves at a pace of its own."""
    t = np.arange(STEPS)
    pace = 1.0 + 0.2 * np.arange(PREDICTIONS)
    square = ((t[:, None] - t) / lengthscale) ** 2
    one = np.exp(-0.5 * pace[:, None, None] ** 2 * square)
    return np.stack([one, 9.0 * one], axis=1)


def travelled(k: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """(covariance of the error state and of a measurement at the last step as carried, their truth,
    numbers per output) for random transitions."""
    rng = np.random.default_rng(0)
    into, through = rng.standard_normal((ND, OUTPUTS)), rng.standard_normal((NE, OUTPUTS))
    a = np.eye(ND) + 0.1 * rng.standard_normal((STEPS, PREDICTIONS, ND, ND))
    c = rng.standard_normal((PREDICTIONS, NE, ND))
    error = ErrorAlongPath(into, PREDICTIONS, open_only=False)
    for t in range(STEPS):
        error.arrive(At(t, k))
        if t < STEPS - 1:
            error.step(a[t])
    state = error.carried
    seen = c @ state - error.seen(through)
    # The truth: the responses to the push of every step, and its covariance between steps.
    push = np.zeros((PREDICTIONS, ND, OUTPUTS, STEPS))
    for t in range(STEPS - 1):
        after = np.broadcast_to(np.eye(ND), (PREDICTIONS, ND, ND))
        for s in range(t + 1, STEPS - 1):
            after = a[s] @ after
        push[..., t] = after @ into
    direct = np.zeros((PREDICTIONS, NE, OUTPUTS, STEPS))
    direct[..., -1] = -through
    both = np.concatenate([push, np.einsum("med,mdjt->mejt", c, push) + direct], axis=1)
    true = np.einsum("majt,mjts,mbjs->mab", both, k, both)
    found = np.concatenate([state, seen], axis=1)
    return found @ found.transpose(0, 2, 1), true, state.shape[2] // OUTPUTS


def apart(found: np.ndarray, true: np.ndarray) -> float:
    """Largest difference of covariances (m, k, k) in true standard deviations."""
    size = np.sqrt(np.einsum("maa->ma", true))
    return float(np.abs((found - true) / (size[:, :, None] * size[:, None])).max())


@pytest.mark.parametrize("lengthscale", [1e6, 40.0, 8.0, 2.0, 0.01])
def test_covariance_is_that_of_the_errors_of_every_step(lengthscale: float) -> None:
    found, true, _ = travelled(covariance(lengthscale))
    assert apart(found, true) < 4 * SAME


def test_an_error_that_stays_is_one_number_and_one_that_changes_is_many() -> None:
    numbers = [travelled(covariance(s))[2] for s in (1e6, 40.0, 8.0, 0.01)]
    assert numbers[0] == 1
    assert numbers[-1] == STEPS
    assert numbers == sorted(numbers)
    assert numbers[2] < STEPS // 2


def test_an_output_without_error_adds_nothing() -> None:
    k = covariance(8.0)
    k[:, 0] = 0.0
    found, true, _ = travelled(k)
    assert apart(found, true) < 4 * SAME
    k[:, 1] = 0.0
    assert not travelled(k)[0].any()


@pytest.mark.parametrize("scale", [1e18, np.nan])
@pytest.mark.parametrize("lengthscale", [40.0, 2.0])
def test_a_prediction_that_runs_away_changes_no_other(scale: float, lengthscale: float) -> None:
    """A cubic law far outside, or a craft that cannot be: the rest states what it states alone."""
    k = covariance(lengthscale)
    k[-1, :, 5:] *= scale
    k[-1, :, :, 5:] *= scale
    found, true, _ = travelled(k)
    assert apart(found[:-1], true[:-1]) < 4 * SAME


def test_a_prediction_that_starts_without_error_gets_it_where_it_comes_to() -> None:
    """As at rest, where a law of the speed is exact, among many that move from the start."""
    k = np.tile(covariance(1e6)[:1], (500, 1, 1, 1))
    k[0, :, :5] = k[0, :, :, :5] = 0.0
    along = ErrorAlongPath(np.eye(OUTPUTS), len(k), open_only=False)
    for t in range(8):
        along.arrive(At(t, k))
    seen = along.seen(np.eye(OUTPUTS))[0]
    assert np.diag(seen @ seen.T) == pytest.approx([1.0, 9.0])


def test_without_predictions_there_is_nothing_to_carry() -> None:
    along = ErrorAlongPath(np.zeros((ND, OUTPUTS)), 0, open_only=False)
    along.arrive(At(0, covariance(8.0)[:0]))
    along.step(np.zeros((0, ND, ND)))
    assert along.carried.size == along.seen(np.zeros((NE, OUTPUTS))).size == 0


def test_covariance_that_is_rounding_alone_states_no_more_than_the_errors_of_every_step() -> None:
    """Where support points leave nothing open, what is left of large numbers is no covariance."""
    noise = np.random.default_rng(1).standard_normal((PREDICTIONS, OUTPUTS, STEPS, STEPS))
    k = 0.5 * (noise + noise.transpose(0, 1, 3, 2))
    k[..., range(STEPS), range(STEPS)] = 1.0
    assert np.linalg.eigvalsh(k).min() < 0.0
    along = ErrorAlongPath(np.eye(OUTPUTS), PREDICTIONS, open_only=False)
    for t in range(STEPS):
        along.arrive(At(t, k))
        seen = along.seen(np.eye(OUTPUTS))
        assert np.einsum("mjk,mjk->mj", seen, seen) == pytest.approx(1.0, rel=1e-5)
        along.step(np.broadcast_to(np.eye(OUTPUTS), (PREDICTIONS, OUTPUTS, OUTPUTS)))
    assert np.einsum("mjk,mjk->mj", along.carried, along.carried).max() <= STEPS**2
