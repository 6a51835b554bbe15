"""Errors of a learned push at two places are correlated as the functions of its posterior are."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from greybox.residual.errors_together import errors_at
from greybox.residual.feature_posterior import FeaturePosterior
from greybox.residual.posterior import Domain
from greybox.symbolic import Layout, Signal
from tests.residual.gp_cases import sparse_case as process

FAMILIES = ("se", "matern32", "linear+se", "linear+matern52")


def places(n_in: int, count: int = 12) -> np.ndarray:
    return np.random.default_rng(3).normal(0.0, 0.7, (count, n_in))


def matrix(post, z: np.ndarray, *, open_only: bool = False) -> np.ndarray:
    """Covariance (n_out, m, m) between all places z (m, n_in)."""
    m = len(z)
    one = errors_at(post, z)
    others = [errors_at(post, np.roll(z, -k, axis=0)) for k in range(1, m)]
    found = one.together([one, *others], open_only=open_only)
    at = np.arange(m)
    return np.stack([found[(at - i) % m, i] for i in at]).transpose(2, 0, 1)


@pytest.mark.parametrize("family", FAMILIES)
def test_at_one_place_it_is_the_variance(family: str) -> None:
    post = process(family)
    z = places(len(post.inputs))
    errors = errors_at(post, z)
    assert errors.together([errors])[0] == pytest.approx(post.evaluate(z)[1], rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("family", FAMILIES)
def test_it_is_a_covariance_and_what_is_open_is_part_of_it(family: str) -> None:
    post = process(family)
    z = places(len(post.inputs))
    whole, left = matrix(post, z), matrix(post, z, open_only=True)
    size = np.abs(whole).max()
    for part in (left, whole - left):
        assert np.linalg.eigvalsh(0.5 * (part + part.transpose(0, 2, 1))).min() > -1e-6 * size
    assert (whole - left).max() > 0.0


def test_at_its_support_nothing_is_open_to_a_process() -> None:
    post = process("se")
    left = matrix(post, post.support_points, open_only=True)
    assert np.abs(left).max() < 1e-3 * np.abs(matrix(post, places(len(post.inputs)))).max()


def test_weighed_features_err_as_their_weights_do() -> None:
    x, rng = ca.SX.sym("x", 2), np.random.default_rng(1)
    phi = ca.Function("phi", [x], [ca.vertcat(x, ca.sin(x), 1)])
    root = rng.standard_normal((2, 5, 5))
    post = FeaturePosterior(
        inputs=Layout([Signal(name="a", unit="rad"), Signal(name="b", unit="rad/s")]),
        outputs=Layout([Signal(name=n, unit="N") for n in ("force.x", "force.y")]),
        method="mlp",
        phi=phi,
        input_mean=np.array([0.1, -0.2]),
        input_scale=np.array([0.5, 2.0]),
        output_scale=np.array([0.3, 4.0]),
        weights=np.column_stack([rng.standard_normal(5), np.zeros(5)]),
        root=root,
        prior=np.ones(2),
        noise=np.ones(2),
        domain=Domain(lower=-np.ones(2), upper=np.ones(2)),
    )
    z = places(2)
    features = np.array(
        [phi((row - post.input_mean) / post.input_scale).full().ravel() for row in z]
    )
    found = matrix(post, z)
    assert found[0] == pytest.approx(0.09 * features @ root[0].T @ root[0] @ features.T)
    assert not found[1].any()  # an output that is off errs where noise is counted
    assert not matrix(post, z, open_only=True).any()
