"""Claim: every learner, and a user's own, is features with a linear last layer: one posterior, one fit, one file format.

Means, variances and Jacobians are those of Bayesian linear regression on the features; a file needs nothing of the learner.
"""

from __future__ import annotations

import json
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from greybox.errors import FileFormatError, ModelError, UnknownNameError
from greybox.residual.discrepancy import Discrepancy
from greybox.residual.feature_posterior import FeaturePosterior
from greybox.residual.learn import feature_candidates
from greybox.residual.learners import LEARNERS, learner_of
from greybox.residual.weight_space import factors, fitted, plain_weights, silent, weighted, whitened
from greybox.symbolic import Layout, Signal

OWN = """
import casadi as ca
import numpy as np

class Bumps:
    name = "bumps"

    def features(self, x, y, *, points, seed):
        centres = x[np.random.default_rng(seed).choice(len(x), points)]
        return {"bumps": lambda s: ca.vertcat(*(ca.exp(-ca.sumsqr(s - c)) for c in centres))}

class Broken(Bumps):
    def features(self, x, y, *, points, seed):
        return {"broken": lambda s: ca.log(s[0])}

empty = 3
"""


def rows(n: int = 400) -> Discrepancy:
    rng = np.random.default_rng(0)
    z = rng.standard_normal((n, 2)) * [2.0, 0.1] + [1.0, 0.0]
    y = np.stack([-0.4 * z[:, 0] * np.abs(z[:, 0]), 3.0 * z[:, 1]], axis=1) + 0.05 * rng.standard_normal((n, 2))
    return Discrepancy(
        inputs=Layout([Signal(name="speed", unit="m/s"), Signal(name="rate", unit="rad/s")]),
        outputs=Layout([Signal(name="force.x", unit="N"), Signal(name="torque.x", unit="N m")]),
        z=z,
        y=y,
        flights=("a",) * n,
    )


def regressed(candidate: FeaturePosterior, seen: Discrepancy) -> FeaturePosterior:
    """Weights by Bayesian linear regression, as the multi-step fit does with other slopes."""
    x = ((seen.z - candidate.input_mean) / candidate.input_scale).T
    m, noise, prior = candidate.points, 0.05**2, np.ones(2)
    theta, covariance = np.zeros(2 * m), np.zeros((2 * m, 2 * m))
    for j, psi in enumerate(whitened(candidate, factors(candidate), x)):
        at, slope = slice(j * m, (j + 1) * m), candidate.output_scale[j] * psi
        covariance[at, at] = np.linalg.inv(slope.T @ slope / noise + np.eye(m))
        theta[at] = covariance[at, at] @ slope.T @ seen.y[:, j] / noise
    found = fitted(candidate, theta, covariance, prior, np.ones(2))
    assert isinstance(found, FeaturePosterior)
    z = ca.SX.sym("z", 2)
    plain = ca.Function("g", [z], [weighted(candidate, z, ca.DM(plain_weights(candidate, [], theta)))])
    assert np.allclose(plain(seen.z[3]).full(), found.mean(seen.z[3]).full(), rtol=1e-10, atol=1e-12)
    return found


@pytest.mark.parametrize("name", LEARNERS)
def test_it_learns_a_bent_law_and_knows_how_sure_it_is(name: str) -> None:
    seen = rows()
    learner = learner_of(name)
    assert learner is not None
    candidates = feature_candidates(learner, seen, points=30, seed=0)
    errors = {}
    for label, candidate in candidates.items():
        assert isinstance(candidate, FeaturePosterior)
        found = regressed(candidate, seen)
        mean, variance = found.evaluate(seen.z)
        errors[label] = np.sqrt(np.mean((mean - seen.y) ** 2, axis=0)).max()
        assert (variance > 0).all() and (variance < seen.y.var(axis=0)).all()
        assert found.active == (True, True) and silent(found).active == (False, False)
        wide, _ = found.with_spread(2.0).evaluate(seen.z)
        assert np.array_equal(wide, mean) and np.allclose(found.with_spread(2.0).evaluate(seen.z)[1], 4 * variance)
    assert min(errors.values()) < 0.08, errors


@pytest.mark.parametrize("name", LEARNERS)
def test_jacobians_are_those_of_differences_and_files_keep_every_bit(name: str) -> None:
    learner = learner_of(name)
    assert learner is not None
    candidate = next(iter(feature_candidates(learner, rows(), points=8, seed=0).values()))
    assert isinstance(candidate, FeaturePosterior)
    found = regressed(candidate, rows())
    z, step = np.array([0.7, 0.05]), 1e-6
    slopes = found.expressions(ca.DM(z), ("mean_jacobian", "variance_jacobian"))
    for quantity in ("mean", "variance"):
        for i in range(2):
            ends = [found.expressions(ca.DM(z + s * step * np.eye(2)[i]), (quantity,))[quantity].full() for s in (1, -1)]
            difference = (ends[0] - ends[1]).ravel() / (2 * step)
            assert np.allclose(slopes[f"{quantity}_jacobian"].full()[:, i], difference, rtol=1e-4, atol=1e-7)
    back = FeaturePosterior.from_dict(json.loads(json.dumps(found.to_dict())))
    for a, b in zip(found.evaluate(rows().z), back.evaluate(rows().z), strict=True):
        assert np.array_equal(a, b)
    near, far = (float(found.expressions(ca.DM(p), ("distance",))["distance"]) for p in (z, [60.0, 4.0]))
    assert 0 <= near <= 1 and 0 <= far <= 1
    with pytest.raises(FileFormatError):
        FeaturePosterior.from_dict({**found.to_dict(), "weights": [[1.0]]})


def test_the_sparse_law_finds_the_terms() -> None:
    learner = learner_of("sparse")
    assert learner is not None
    sizes = [c.points for c in feature_candidates(learner, rows(), points=30, seed=0).values()]
    assert min(sizes) <= 3


def test_a_users_own_learner_is_one_file(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(OWN)
    own = learner_of(f"{tmp_path}/own.py:Bumps")
    assert own is not None and own.name == "bumps"
    (candidate,) = feature_candidates(own, rows(), points=12, seed=0).values()
    assert candidate.points == 12
    broken = learner_of(f"{tmp_path}/own.py:Broken")
    assert broken is not None
    with pytest.raises(ModelError, match="not finite on the training flights"):
        feature_candidates(broken, rows(), points=12, seed=0)
    with pytest.raises(ModelError, match="not a learner"):
        learner_of(f"{tmp_path}/own.py:empty")
    with pytest.raises(UnknownNameError, match="learner"):
        learner_of("random-feature")
