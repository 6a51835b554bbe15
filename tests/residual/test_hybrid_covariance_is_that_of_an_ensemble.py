"""The uncertainty of a learned push travels along a prediction as that of one function, checked
against drawn functions."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from greybox.estimation import propagation
from greybox.estimation.filtering import Filter
from greybox.estimation.propagation import Propagator
from greybox.model.identified import IdentifiedModel
from greybox.residual.features import feature_layout
from greybox.residual.hybrid import HybridModel
from greybox.residual.kernels import Kernel
from greybox.residual.posterior import Domain, GPPosterior
from greybox.residual.sparse import variational
from greybox.symbolic import Layout
from tests.residual.hybrid_cases import DT, drawn_weights, pendulum_model, swings

ORIGIN, H = 40, 15
NAMES = ("angle", "rate")


def learned(lengthscale: float, level: float) -> tuple[IdentifiedModel, GPPosterior]:
    """A pendulum with a push that is known up to `level` of a prior with this length-scale; a grid
    of support points."""
    base = pendulum_model((1e-3, 1e-3))
    inner = base.dynamics
    kernel = Kernel(family="se", lengthscales=np.full(2, lengthscale), variance=1.0)
    grid = np.array([[a, b] for a in np.linspace(-2, 2, 5) for b in np.linspace(-2, 2, 5)])
    rng = np.random.default_rng(5)
    numbers = variational(kernel, grid.T, 0.5 * rng.standard_normal(25), level * np.eye(25))
    posterior = GPPosterior(
        inputs=feature_layout(inner, NAMES),
        outputs=Layout([inner.noises.signals[inner.noises["rate"]]]),
        method="svgp",
        kernels=(kernel,),
        input_mean=np.zeros(2),
        input_scale=np.array([0.5, 1.5]),
        output_mean=np.zeros(1),
        output_scale=np.ones(1),
        support=grid,
        weights=numbers.weights[:, None],
        explained=numbers.explained[None],
        uncertain=numbers.uncertain[None],
        noise=np.ones(1),
        domain=Domain(lower=-np.ones(2), upper=np.ones(2)),
    )
    return replace(base, dynamics=HybridModel(inner=inner, posterior=posterior)), posterior


def ensemble(
    model: IdentifiedModel, posterior: GPPosterior, x0: np.ndarray, u: np.ndarray, size: int
) -> np.ndarray:
    """States (H + 1, 3, size) of futures, each with its own drawn function and no other noise."""
    weights = drawn_weights(posterior, 0, size, np.random.default_rng(0)).T
    s = [ca.SX.sym(n, k) for n, k in (("x", 3), ("u", 1), ("c", posterior.points))]
    z = ca.vertcat(s[0][0], s[0][1]) / posterior.input_scale
    value = ca.dot(s[2], posterior.kernels[0].covariance(posterior.support.T, z, ca))
    inner = model.dynamics.inner
    p = ca.DM([d.nominal for d in inner.parameters])
    step = ca.Function("step", s, [inner.step(0, s[0], s[1], p, ca.vertcat(value, 0.0), DT)]).map(
        size
    )
    x = np.repeat(x0[:, None], size, axis=1)
    out = [x]
    for k in range(H):
        x = np.asarray(step(x, np.full((1, size), u[ORIGIN + 1 + k]), weights).full())
        out.append(x)
    return np.array(out)


def stated_and_found(
    lengthscale: float, level: float, size: int = 3000
) -> tuple[np.ndarray, np.ndarray]:
    """(stated, found) variances of angle and rate at h = 2..H that the learned push alone
    brings."""
    model, posterior = learned(lengthscale, level)
    runner = Filter(model)
    segment = swings(1, 2, hidden=0.0, period=3.0, seconds=3.0).flights[0].segments[0]
    filtered = runner.run(segment)
    ahead = list(Propagator(runner).run(filtered, np.array([ORIGIN]), H))
    quiet = replace(model, dynamics=model.dynamics.inner)
    silent = replace(
        posterior, uncertain=np.zeros_like(posterior.uncertain), explained=posterior.explained
    )
    known = replace(model, dynamics=HybridModel(inner=quiet.dynamics, posterior=silent))
    rest = list(Propagator(Filter(known)).run(filtered, np.array([ORIGIN]), H))
    stated = np.array(
        [np.diag(a.covariance[0])[:2] - np.diag(b.covariance[0])[:2] for a, b in zip(ahead, rest)]
    )
    found = ensemble(
        model, posterior, filtered.states[ORIGIN + 1], segment.channels["u"], size
    ).var(axis=2)[:, :2]
    return stated[1:], found[1:H]


def test_an_error_that_is_one_along_the_path_is_propagated_exactly():
    # Length-scale far beyond the swing: a drawn function is nearly a constant offset.
    stated, found = stated_and_found(lengthscale=30.0, level=0.15)
    # 3000 members: 4 standard errors of a variance are 10 %.
    assert stated == pytest.approx(found, rel=0.12)


def test_an_error_that_changes_along_the_path_is_propagated_too():
    stated, found = stated_and_found(lengthscale=1.5, level=0.4)
    assert stated == pytest.approx(found, rel=0.12)


def test_between_two_moments_that_are_close_an_error_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of a log at 1 kHz: the places of a path are asked every hundredth of a second."""
    asked = []
    own = HybridModel.learned_errors
    monkeypatch.setattr(HybridModel, "learned_errors", lambda *a: (asked.append(None), own(*a))[1])
    every, _ = stated_and_found(lengthscale=1.5, level=0.4, size=2)
    often = len(asked)
    monkeypatch.setattr(propagation, "HELD", 3 * DT)
    held, _ = stated_and_found(lengthscale=1.5, level=0.4, size=2)
    assert len(asked) - often == often / 3
    assert held == pytest.approx(every, rel=0.1)
