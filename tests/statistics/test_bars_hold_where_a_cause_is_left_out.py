"""Averaged over forms, error bars hold the truth where the fitted form lacks a cause, and stay as
they are where it lacks none."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.statistics.rivals import TOGETHER, Parabola, _errors, _form, averaged

N, NOISE, WORLDS = 400, 0.3, 200
PRIOR = 1.0
"""Precision of the prior of every cause."""


def world(draw: np.random.Generator, cubic: float) -> tuple:
    """A drag along a speed v that is linear in truth 0.5 and `cubic`; the fit has the linear one and
    an offset, the causes are a cube, a sine and noise. (estimate, its variance, parabola)."""
    v = draw.normal(size=N)
    fitted = np.stack([v, np.ones(N)], axis=1)
    causes = np.stack([v**3, np.sin(5 * v), draw.normal(size=N)], axis=1)
    e = NOISE * draw.normal(size=N)
    y = 0.5 * v + cubic * v**3 + e
    estimate = np.linalg.lstsq(fitted, y, rcond=None)[0]
    whole = np.concatenate([fitted, causes], axis=1) / NOISE
    rest = (y - fitted @ estimate) / NOISE
    prior = np.array([0.0, 0.0, PRIOR, PRIOR, PRIOR])
    at = Parabola(
        information=whole.T @ whole + np.diag(prior),
        gradient=-whole.T @ rest,
        prior=prior,
        fitted=[0, 1],
        causes={"cube": [2], "sine": [3], "nothing": [4]},
        low=np.full(5, -np.inf),
        high=np.full(5, np.inf),
    )
    variance = np.linalg.inv(whole[:, :2].T @ whole[:, :2])
    return estimate, variance, at


def held(cubic: float, *, rivals: bool) -> float:
    """Share of worlds in which the 95 % interval of the slope holds the truth."""
    draw, inside = np.random.default_rng(4), 0
    for _ in range(WORLDS):
        estimate, variance, at = world(draw, cubic)
        more = averaged(at).spread[0, 0] if rivals else 0.0
        inside += abs(estimate[0] - 0.5) < 1.96 * np.sqrt(variance[0, 0] + more)
    return inside / WORLDS


def test_bars_of_a_wrong_form_hold_the_truth_with_its_rivals_and_not_without():
    assert held(0.1, rivals=False) < 0.05
    assert held(0.1, rivals=True) > 0.9


def test_bars_of_the_right_form_hold_and_stay_as_they_are():
    assert held(0.0, rivals=True) >= 0.9
    draw, factors = np.random.default_rng(7), []
    for _ in range(WORLDS):
        _, variance, at = world(draw, 0.0)
        factors.append(np.sqrt(1 + averaged(at).spread[0, 0] / variance[0, 0]))
    assert np.median(factors) == 1.0
    assert np.mean(np.array(factors) > 1.1) < 0.05


def test_the_shift_is_that_of_the_larger_fit():
    draw = np.random.default_rng(1)
    estimate, _, at = world(draw, 0.3)
    seen = averaged(at)
    assert seen.best is not None
    assert seen.best.causes[0] == "cube"
    assert estimate[0] + seen.shift[0] == pytest.approx(0.5, abs=0.1)
    assert abs(seen.shift[0]) > 20 * 0.015
    step, error = seen.best.steps[2]
    assert step == pytest.approx(0.3, abs=4 * error)
    assert 0 < error < 0.1 * step


def test_coloured_errors_are_no_cause():
    """A slow cause in slow errors: by the information alone it is found in most worlds."""
    draw, found = np.random.default_rng(3), {"told": 0, "believed": 0}
    for _ in range(100):
        t = np.linspace(0, 4 * np.pi, N)
        e = draw.normal(size=N)
        for k in range(1, N):
            e[k] += 0.9 * e[k - 1]
        e *= np.sqrt(1 - 0.9**2)
        whole = np.stack([np.ones(N), np.sin(t), np.cos(t), np.sin(2 * t)], axis=1)
        rest = e - e.mean()
        rows = -(whole * rest[:, None]).reshape(16, -1, 4).sum(axis=1)
        prior = np.array([0.0, PRIOR, PRIOR, PRIOR])
        common = {
            "information": whole.T @ whole + np.diag(prior),
            "gradient": -whole.T @ rest,
            "prior": prior,
            "fitted": [0],
            "causes": {"a": [1], "b": [2], "c": [3]},
            "low": np.full(4, -np.inf),
            "high": np.full(4, np.inf),
        }
        found["believed"] += averaged(Parabola(**common)).best is not None
        found["told"] += averaged(Parabola(**common, scatter=rows.T @ rows)).best is not None
    assert found["believed"] > 50
    assert found["told"] < 15


def test_a_cause_that_cannot_be_negative_is_no_rival_where_it_would_be():
    draw = np.random.default_rng(2)
    _, _, at = world(draw, -0.3)
    stopped = Parabola(**{**vars(at), "low": np.array([-np.inf, -np.inf, 0.0, -np.inf, -np.inf])})
    assert averaged(at).best.causes[0] == "cube"
    best = averaged(stopped).best
    assert best is None or "cube" not in best.causes


def nearly_alike(room: float) -> Parabola:
    """A fitted number that can fall by `room`, beside a cause that does nearly the same and of which
    the cost asks for much."""
    draw = np.random.default_rng(8)
    x = draw.normal(size=N)
    whole = np.stack([x, x + 0.01 * draw.normal(size=N)], axis=1) / NOISE
    rest = whole @ np.array([-3.0, 3.0]) + 0.1 * draw.normal(size=N)
    rest -= whole[:, 0] * (whole[:, 0] @ rest) / (whole[:, 0] @ whole[:, 0])
    prior = np.array([0.0, 1e-2])
    return Parabola(
        information=whole.T @ whole + np.diag(prior),
        gradient=-whole.T @ rest,
        prior=prior,
        fitted=[0],
        causes={"alike": [1]},
        low=np.array([-room, -np.inf]),
        high=np.array([np.inf, np.inf]),
    )


def test_an_estimate_moves_no_further_than_its_bounds():
    form = averaged(nearly_alike(np.inf)).best
    assert form is not None
    assert form.shift[0] < -2.0
    room = -0.9 * form.shift[0]
    near = nearly_alike(room)
    kept = averaged(near).best
    assert kept is not None
    assert kept.shift[0] == pytest.approx(-room)
    assert kept.more[0, 0] == 0.0
    # The cause then goes where the cost with that bound is lowest, and falls by so much less.
    h, g = near.information, near.gradient
    size = -(g[1] - h[1, 0] * room) / h[1, 1]
    assert kept.steps[1][0] == pytest.approx(size)

    def cost(a: float, b: float) -> float:
        step = np.array([a, b])
        return float(g @ step + 0.5 * step @ h @ step)

    lost = cost(-room, size) - cost(form.shift[0], form.steps[1][0])
    assert form.log_odds - kept.log_odds == pytest.approx(lost, rel=1e-6)


def together(first: str, second: str) -> float:
    """Log odds of two causes, one nearly the same as a bounded estimate and with coloured scores,
    taken up in this order."""
    likely = nearly_alike(0.5)
    h, g, prior = np.eye(3) * 400.0, np.array([0.0, 0.0, -120.0]), np.array([0.0, 1e-2, 1e-2])
    h[:2, :2], g[:2] = likely.information, likely.gradient
    scatter = np.diag(np.diag(h)) @ np.diag([1.0, 10.0, 1.0])
    scatter[:2, :2] = 10.0 * h[:2, :2]
    far = np.full(3, np.inf)
    at = Parabola(
        information=h,
        gradient=g,
        prior=prior,
        fitted=[0],
        causes={"alike": [1], "other": [2]},
        low=np.array([-0.5, -np.inf, -np.inf]),
        high=far,
        scatter=scatter,
    )
    felt = at.felt()
    form = _form(at, felt, _form(at, felt, None, first, 0.0), second, 0.0)
    assert form is not None
    return form.log_odds


def test_what_a_bound_takes_is_charged_once_in_any_order():
    assert together("alike", "other") == pytest.approx(together("other", "alike"))


@pytest.mark.parametrize("pull", [0.0, -20.0, -60.0])
def test_a_pull_of_an_estimate_itself_is_charged_to_no_cause(pull):
    far = np.full(2, np.inf)
    at = Parabola(
        information=np.diag([100.0, 100.0]),
        gradient=np.array([pull, -60.0]),
        prior=np.array([0.0, 1.0]),
        fitted=[0],
        causes={"apart": [1]},
        low=-far,
        high=np.array([0.1, np.inf]),
    )
    form = averaged(at).best
    assert form is not None
    assert form.log_odds == pytest.approx(0.5 * 36 - 0.5 * np.log(100.0))
    assert form.shift[0] == 0.0


def test_what_needs_an_impossible_estimate_is_no_rival():
    assert averaged(nearly_alike(0.01)).best is None


def test_a_double_of_what_is_fitted_is_no_rival():
    """What does the same as a fitted number makes nothing likelier, and widens nothing."""
    draw = np.random.default_rng(5)
    x = draw.normal(size=N) / NOISE
    whole = np.stack([x, x], axis=1)
    rest = draw.normal(size=N)
    rest -= x * (x @ rest) / (x @ x)
    at = Parabola(
        information=whole.T @ whole + np.diag([0.0, 1e-4]),
        gradient=-whole.T @ rest,
        prior=np.array([0.0, 1e-4]),
        fitted=[0],
        causes={"double": [1]},
        low=np.full(2, -np.inf),
        high=np.full(2, np.inf),
    )
    seen = averaged(at)
    assert seen.best is None
    assert seen.spread[0, 0] == 0.0


def test_the_search_ends_after_so_many_causes():
    n = TOGETHER + 3
    at = Parabola(
        information=np.diag([1.0, *np.full(n, 101.0)]),
        gradient=np.array([0.0, *np.full(n, -100.0)]),
        prior=np.array([0.0, *np.ones(n)]),
        fitted=[0],
        causes={f"c{i}": [1 + i] for i in range(n)},
        low=np.full(n + 1, -np.inf),
        high=np.full(n + 1, np.inf),
    )
    seen = averaged(at)
    assert seen.best is not None
    assert len(seen.best.causes) == TOGETHER


@pytest.mark.filterwarnings("error")
def test_what_rounding_leaves_without_information_has_no_error_bar() -> None:
    _, _, at = world(np.random.default_rng(3), 0.0)
    indefinite = np.array([[-1e-9, 0.0], [0.0, 4.0]])
    assert _errors(at, [0, 1], [2, 3], indefinite, np.zeros((2, 2))) == [np.inf, 0.5]
