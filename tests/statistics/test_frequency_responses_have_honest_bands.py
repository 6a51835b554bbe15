"""Claims: the 95 % bands hold the true response in 95 % of records, also by references in a closed
loop and with two inputs at once; a gap is never bridged; feedback is told from its absence."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal

from greybox.statistics.feedback import MOST_ROWS, follows
from greybox.statistics.spectra import (
    averages_in,
    band,
    by_chance,
    circle,
    frequencies,
    response,
    spectra,
)

DT, POLE = 0.02, np.exp(-2 * 0.02)
GAIN = 25 * (1 - POLE)
FREQUENCY = frequencies(0.4, 20.0, 8.0)
Z = np.exp(2j * np.pi * FREQUENCY * DT)
TRUE = GAIN * Z**-3 / (1 - POLE / Z)


def flown(
    seed: int, feedback: float = 0.0, seconds: float = 60.0, noise: float = 0.02
) -> np.ndarray:
    """u, y, r of y' = -2 y + 50 u(t - 0.04 s) + noise, u = r - feedback y, r coloured."""
    rng = np.random.default_rng(seed)
    n = round(seconds / DT)
    r = scipy.signal.lfilter(*scipy.signal.butter(1, 0.4), 0.3 * rng.standard_normal(n))
    e = noise * rng.standard_normal((n, 2))
    # The loop as one filter: y = (G r + v + w) / (1 + feedback G).
    open_loop, delayed = np.array([1.0, -POLE]), np.array([0.0, 0.0, 0.0, GAIN])
    closed = np.concatenate([open_loop, [0.0, 0.0]]) + feedback * delayed
    y = scipy.signal.lfilter(delayed, closed, r) + scipy.signal.lfilter(open_loop, closed, e[:, 0])
    y += scipy.signal.lfilter([0.0, 1.0], closed, e[:, 1])
    return np.column_stack([r - feedback * y, y, r])


def share_inside(
    references: bool, feedback: float, noise: float = 0.02, seeds: int = 40
) -> tuple[float, float]:
    """Shares of complex values inside the circle and of magnitudes inside the band."""
    inside = []
    for seed in range(seeds):
        s = spectra([flown(seed, feedback, noise=noise)], DT, FREQUENCY, 8.0)
        r = response(s, [1], [0], [2] if references else ())
        value = r.value[:, 0, 0]
        inside.append(
            [
                np.abs(value - TRUE) < circle(r)[:, 0, 0],
                np.abs(np.abs(value) - np.abs(TRUE)) < band(r)[:, 0, 0],
            ]
        )
    circles, bands = np.mean(inside, axis=(0, 2))
    return float(circles), float(bands)


def test_bands_hold_the_truth_as_often_as_they_say():
    for references, feedback in ((False, 0.0), (True, 0.05)):
        circles, bands = share_inside(references, feedback)
        assert 0.92 < circles < 0.98 and 0.92 < bands < 0.98, references


def test_a_loop_is_biased_at_any_coherence_and_a_reference_mends_it():
    closed = {"feedback": 0.2, "noise": 0.6}
    s = spectra([flown(0, **closed)], DT, FREQUENCY, 8.0)
    assert np.median(response(s, [1], [0]).coherence) > 0.6
    assert share_inside(False, seeds=6, **closed)[0] < 0.5
    assert share_inside(True, seeds=20, **closed)[0] > 0.88


def test_feedback_is_told_from_its_absence():
    for seed in range(5):
        assert follows([flown(seed, 0.2, noise=0.6)], 0, [1]) is True
        assert follows([flown(seed)], 0, [1]) is False
        assert follows([flown(seed, 0.2, noise=0.6)], 2, [1]) is False
    t = DT * np.arange(3000)
    chirp = scipy.signal.chirp(t, 0.2, 60.0, 10.0, method="logarithmic")
    assert follows([np.column_stack([chirp, flown(0)[:, 1]])], 0, [1]) is not True
    assert follows([flown(0)[:100]], 0, [1]) is None


def test_feedback_that_leaves_nothing_open_is_feedback():
    for seed in range(40):
        y = np.random.default_rng(seed).standard_normal(300 + 60 * seed)
        assert follows([np.column_stack([-0.7 * np.roll(y, 1), y])[1:]], 0, [1]) is True


@pytest.mark.parametrize("rest", [5, 15, 39, 80])
def test_a_rest_of_a_stretch_that_is_too_short_is_left_out(rest: int):
    whole = flown(0, 0.2, seconds=DT * (MOST_ROWS - rest), noise=0.6)
    assert follows([whole, flown(1)], 0, [1]) is True


def test_two_inputs_at_once_are_told_apart_by_partial_coherence():
    inside, wrong = [], []
    for seed in range(12):
        a, b = flown(seed), flown(seed + 100)
        u2 = 0.7 * a[:, 0] + b[:, 0]
        y = a[:, 1] + 0.5 * np.roll(u2, 1)
        s = spectra([np.column_stack([a[:, 0], u2, y])[5:]], DT, FREQUENCY, 8.0)
        both, one = response(s, [2], [0, 1]), response(s, [2], [0])
        inside.append(
            np.abs(both.value[:, 0] - np.column_stack([TRUE, 0.5 / Z])) < circle(both)[:, 0]
        )
        wrong.append(np.abs(one.value[:, 0, 0] - TRUE) > circle(one)[:, 0, 0])
        assert both.shared.max() < 0.95
    assert 0.91 < np.mean(inside) < 0.985
    assert np.mean(np.array(wrong)[:, -10:]) > 0.5
    s = spectra([np.column_stack([a[:, 0], a[:, 0], a[:, 1]])], DT, FREQUENCY, 8.0)
    assert response(s, [2], [0, 1]).shared.min() > 0.99


def test_stretches_are_never_joined():
    whole = flown(0, seconds=32.0)
    apart = spectra([whole[:800], whole[800:]], DT, FREQUENCY, 8.0)
    joined = spectra([whole], DT, FREQUENCY, 8.0)
    assert apart.averages[0] < joined.averages[0]
    assert averages_in([800, 800], 400) == pytest.approx(2 * averages_in([800], 400))
    assert averages_in([300], 400) == 0
    rows = np.vstack([whole[:800] + 100.0, whole[800:] - 100.0])
    moved = spectra([rows[:800], rows[800:]], DT, FREQUENCY, 8.0)
    np.testing.assert_allclose(moved.matrix, apart.matrix, atol=1e-9 * np.abs(apart.matrix).max())


def test_coherence_of_independent_signals_stays_below_its_chance_level():
    rng = np.random.default_rng(0)
    found = []
    for _ in range(20):
        s = spectra([rng.standard_normal((3000, 2))], DT, FREQUENCY, 8.0)
        found.append(response(s, [1], [0]).coherence[:, 0, 0] < by_chance(s.averages, 0))
    assert 0.91 < np.mean(found) < 0.985
