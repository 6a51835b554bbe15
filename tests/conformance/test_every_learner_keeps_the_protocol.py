"""Every learner, and a user's own, is features with a linear last layer: one posterior, one fit
through the physics, one calibration, one file, one export.

Means, variances and Jacobians are those of Bayesian linear regression on the features; a file needs
nothing of the learner. What a learner memorises of the flights that judge it is not learned.
"""

from __future__ import annotations

import functools
import json
from dataclasses import replace
from importlib import resources
from pathlib import Path

import casadi as ca
import jsonschema
import numpy as np
import pytest

from greybox.data import Dataset
from greybox.errors import FileFormatError, ModelError, UnknownNameError
from greybox.estimation.filtering import Filter
from greybox.files import dump_json
from greybox.model.identified import IdentifiedModel
from greybox.report.learn_report import learn_report
from greybox.residual.candidates import FeatureMaker, feature_candidates
from greybox.residual.discrepancy import Discrepancy, discrepancy
from greybox.residual.feature_posterior import FeaturePosterior
from greybox.residual.files import load_model, save_model
from greybox.residual.hybrid import HybridModel
from greybox.residual.learn import Learned, learn
from greybox.residual.learners import LEARNERS, learner_of
from greybox.residual.learners.deep_ensemble import MEMBERS
from greybox.residual.learners.long_short_term_memory import LongShortTermMemory
from greybox.residual.learners.random_features import RandomFeatures
from greybox.residual.open_loop_fit import fit_open_loop
from greybox.residual.strengths import Halves
from greybox.residual.weight_space import (
    alone,
    factors,
    fitted,
    plain_weights,
    silent,
    weighted,
    whitened,
)
from greybox.symbolic import Layout, Signal
from mpc_export.bundle import write_bundle
from tests.mpc_export import cases, compiled
from tests.residual.hybrid_cases import pendulum_model, swings

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

class Steep(Bumps):
    def features(self, x, y, *, points, seed):
        return {"steep": lambda s: ca.sqrt(ca.fabs(s))}

class Void(Bumps):
    def features(self, x, y, *, points, seed):
        return np.nan * x

class Uneven(Bumps):
    ensemble = True

    def features(self, x, y, *, points, seed):
        return {"a": lambda s: s, "b": lambda s: s[0]}

class Fails(Bumps):
    def features(self, x, y, *, points, seed):
        return {"fails": lambda s: nowhere(s)}

class Wide(Bumps):
    def features(self, x, y, *, points, seed):
        return {"wide": lambda s: s @ s.T}

class Remembers(Bumps):
    def features(self, x, y, *, points, seed):
        def phi(s):
            near = ca.vertcat(*(ca.exp(-ca.sumsqr(s - c) / 0.1) for c in x))
            return ca.mtimes(ca.DM(y.T), near) / (ca.sum1(near) + 1e-3)
        return {"memory": phi}

empty = 3
"""


def schema(name: str) -> str:
    return resources.files("greybox.schemas").joinpath(name).read_text(encoding="utf-8")


def rows(n: int = 400, seed: int = 0) -> Discrepancy:
    rng = np.random.default_rng(seed)
    z = rng.standard_normal((n, 2)) * [2.0, 0.1] + [1.0, 0.0]
    y = np.stack(
        [-0.4 * z[:, 0] * np.abs(z[:, 0]), 3.0 * z[:, 1]], axis=1
    ) + 0.05 * rng.standard_normal((n, 2))
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
    m, noise, before = candidate.points, 0.05**2, np.ones(2)
    theta, covariance = np.zeros(2 * m), np.zeros((2 * m, 2 * m))
    for j, psi in enumerate(whitened(candidate, factors(candidate), x)):
        at, slope = slice(j * m, (j + 1) * m), candidate.output_scale[j] * psi
        covariance[at, at] = np.linalg.inv(
            alone(slope.T @ slope / noise, candidate.members, m) + np.eye(m)
        )
        theta[at] = covariance[at, at] @ slope.T @ seen.y[:, j] / noise / candidate.members
    found = fitted(candidate, theta, covariance, before)
    assert isinstance(found, FeaturePosterior)
    z = ca.SX.sym("z", 2)
    plain = ca.Function(
        "g", [z], [weighted(candidate, z, ca.DM(plain_weights(candidate, [], theta)))]
    )
    assert np.allclose(
        plain(seen.z[3]).full(), found.mean(seen.z[3]).full(), rtol=1e-10, atol=1e-12
    )
    return found


@pytest.mark.parametrize("name", LEARNERS)
def test_it_learns_a_bent_law_and_knows_how_sure_it_is(name: str) -> None:
    """On rows that it has not seen: nine tenths of the spread of both outputs are explained."""
    seen, new = rows(), rows(seed=1)
    learner = learner_of(name)
    assert learner is not None
    candidates = feature_candidates(learner, seen, points=30, seed=0)
    errors = {}
    for label, candidate in candidates.items():
        assert isinstance(candidate, FeaturePosterior)
        found = regressed(candidate, seen)
        variance = found.evaluate(seen.z)[1]
        errors[label] = (np.std(found.evaluate(new.z)[0] - new.y, axis=0) / new.y.std(axis=0)).max()
        assert (variance > 0).all() and (variance < seen.y.var(axis=0)).all()
        assert found.active == (True, True) and silent(found).active == (False, False)
    assert max(errors.values()) < 0.3, errors


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
            ends = [
                found.expressions(ca.DM(z + s * step * np.eye(2)[i]), (quantity,))[quantity].full()
                for s in (1, -1)
            ]
            difference = (ends[0] - ends[1]).ravel() / (2 * step)
            assert np.allclose(
                slopes[f"{quantity}_jacobian"].full()[:, i], difference, rtol=1e-4, atol=1e-7
            )
    back = FeaturePosterior.from_dict(json.loads(json.dumps(found.to_dict())))
    for a, b in zip(found.evaluate(rows().z), back.evaluate(rows().z), strict=True):
        assert np.array_equal(a, b)
    near, far = (
        float(found.expressions(ca.DM(p), ("distance",))["distance"]) for p in (z, [60.0, 4.0])
    )
    assert 0 <= near <= 1 and 0 <= far <= 1
    with pytest.raises(FileFormatError):
        FeaturePosterior.from_dict({**found.to_dict(), "weights": [[1.0]]})


def test_the_sparse_law_finds_the_terms() -> None:
    learner = learner_of("sparse")
    assert learner is not None
    sizes = [c.points for c in feature_candidates(learner, rows(), points=30, seed=0).values()]
    assert min(sizes) <= 3


def test_an_ensemble_is_the_mean_of_members_fitted_alone_and_says_how_they_disagree() -> None:
    seen = rows()
    learner = learner_of("ensemble")
    assert learner is not None
    (candidate,) = feature_candidates(learner, seen, points=30, seed=0).values()
    assert candidate.members == MEMBERS
    whole, width = regressed(candidate, seen), candidate.points // MEMBERS
    z = np.array([[0.7, 0.05], [9.0, 0.9]])
    means, variances = [], []
    for k in range(MEMBERS):
        s = ca.SX.sym("x", 2)
        part = ca.Function("phi", [s], [candidate.phi(s)[k * width : (k + 1) * width]])
        shape = {"weights": np.zeros((width, 2)), "root": np.zeros((2, width, width))}
        member = regressed(replace(candidate, phi=part, members=1, **shape), seen)
        mean, variance = member.evaluate(z)
        means.append(mean)
        variances.append(variance)
    mean, variance = whole.evaluate(z)
    assert np.allclose(mean, np.mean(means, axis=0), rtol=1e-8)
    assert np.allclose(variance, np.mean(variances, axis=0) + np.var(means, axis=0), rtol=1e-6)
    disagreement = np.std(means, axis=0) / seen.y.std(axis=0)
    assert (disagreement[1] > 5 * disagreement[0]).all()


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
    for name, why in (
        ("Fails", "NameError"),
        ("Wide", "no column"),
        ("Steep", "not finite"),
        ("Void", "failed"),
        ("Uneven", "of different size"),
    ):
        bad = learner_of(f"{tmp_path}/own.py:{name}")
        assert bad is not None
        with pytest.raises(ModelError, match=why):
            feature_candidates(bad, rows(), points=12, seed=0)
    with pytest.raises(ModelError, match="not a learner"):
        learner_of(f"{tmp_path}/own.py:empty")
    with pytest.raises(UnknownNameError, match="learner"):
        learner_of("random-feature")


@functools.cache
def flights() -> tuple[IdentifiedModel, Dataset]:
    """A pendulum that does not know of its quadratic damping, and its flights."""
    train = swings(2, 1, hidden=0.35, period=4.0, seconds=8.0)
    return replace(pendulum_model(), trained_on=train.names, data_hash=train.hash), train


@functools.cache
def learned(name: str) -> Learned:
    base, train = flights()
    return learn(base, train, features=("rate",), points=6, learner=name, seed=0)


FITTED = [
    pytest.param(n, marks=pytest.mark.slow if n == LongShortTermMemory.name else ())
    for n in LEARNERS
]
"""A recurrence unrolls to many operations: seconds of compiling, and its sequences are those of the
convolution."""


def squared(model: IdentifiedModel) -> float:
    """Mean squared error of the rate, half a second ahead, on a flight that nobody has seen."""
    runner = Filter(model)
    segment = swings(1, 77, hidden=0.35, period=2.9, seconds=8.0).flights[0].segments[0]
    filtered, origins = runner.run(segment), np.arange(20, segment.n - 26, 3)
    found = runner.rollout(filtered, origins, 25)[:, -1, 1]
    return float(np.mean((found - segment.channels["w"][origins + 25]) ** 2))


@pytest.mark.parametrize("name", FITTED)
def test_it_is_fitted_through_the_physics_and_helps_on_an_unseen_flight(name: str) -> None:
    result = learned(name)
    assert not result.null and result.fit.held_out_gain > 0.1
    assert squared(result.model) < 0.6 * squared(result.base)
    told = result.to_dict()
    jsonschema.validate(json.loads(dump_json(told)), json.loads(schema("learn.json")))
    assert told["learner"] == name and name in result.model.name
    assert "A Gaussian process" not in learn_report(json.loads(dump_json(told)))


@pytest.mark.parametrize("name", FITTED)
def test_its_file_is_the_same_model(name: str, tmp_path: Path) -> None:
    model = learned(name).model
    back = load_model(save_model(model, tmp_path / "hybrid.json"))
    jsonschema.validate(
        json.loads((tmp_path / "hybrid.json").read_text()), json.loads(schema("model.json"))
    )
    assert squared(back) == squared(model)


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if i < 3 else pytest.mark.slow) for i, n in enumerate(LEARNERS)],
)
def test_its_c_is_the_model(name: str, tmp_path: Path) -> None:
    """C and CasADi of the bundle agree to 1e-10 of each output's scale, and CasADi with the learned
    part itself."""
    model = learned(name).model
    assert isinstance(model.dynamics, HybridModel)
    weights = ("gp.weights",)
    bundle = write_bundle(
        model, tmp_path / "export", runtime_parameters=weights, with_=("filter",), use_cache=False
    )
    rng = np.random.default_rng(0)
    f, post = bundle.functions, model.dynamics.posterior
    points = [cases.point(f, rng, 0.5) for _ in range(5)]
    z = np.full(len(post.inputs), 0.7)
    own = post.expressions(ca.DM(z), ("mean", "variance"))
    p = f.parameter_values
    assert np.allclose(f.functions["gp_mean"](z, p).full(), own["mean"].full(), rtol=1e-12)
    assert np.allclose(f.functions["gp_variance"](z, p).full(), own["variance"].full(), rtol=1e-12)
    library = compiled.load(
        bundle, compiled.compile_library(bundle, tmp_path / "lib", "gcc", "-O0")
    )
    gaps = compiled.largest_difference(bundle, library, f.functions, points)
    assert max(gaps.values()) < 1e-10, gaps


def pushed(data: Dataset) -> Dataset:
    """The flights with a slow push of its own in each, that the log of commands does not know
    of."""
    out = []
    for i, flight in enumerate(data.flights):
        segment = flight.segments[0]
        gust = np.convolve(
            np.random.default_rng(i).standard_normal(segment.n), np.ones(100) / 10, mode="same"
        )
        out.append(
            replace(flight, segments=(segment.replace({"u": segment.channels["u"] - gust}),))
        )
    return Dataset(flights=tuple(out))


def test_what_a_learner_memorises_is_not_learned(tmp_path: Path) -> None:
    """A memory of gusts foretells those of its own flights, and none of flights that it has not
    seen."""
    (tmp_path / "own.py").write_text(OWN)
    base = pendulum_model((0.3, 1.0))
    train = pushed(swings(2, 1, hidden=0.0, period=4.0, seconds=8.0))
    own = learner_of(f"{tmp_path}/own.py:Remembers")
    assert own is not None
    seen = {"all": discrepancy(base, train, ("angle", "rate", "u"))}
    maker = FeatureMaker(learner=own, sets=seen, points=6, seed=0)
    found = maker.candidates(lambda _text, _share: None)
    fooled, _, gains = fit_open_loop(base, found, train)
    assert gains["all, memory"] > 0.1 and fooled.status != "null"
    honest, _, gains = fit_open_loop(base, found, train, maker=maker)
    assert gains["all, memory"] < 0.01 and honest.status == "null"


def test_features_made_again_come_from_the_rows_alone() -> None:
    seen = rows()
    maker = FeatureMaker(learner=RandomFeatures(), sets={"a": seen}, points=5, seed=0)
    (label,) = [n for n in maker.candidates(lambda _t, _s: None) if n.endswith("length 1")]
    half = maker.again(label, np.arange(400) < 200)
    assert half is not None and np.array_equal(half.input_scale, seen.z.std(axis=0))
    assert maker.again("a, of no such name", np.arange(400) < 200) is None


def test_halves_keep_kinds_of_flight_together_and_cut_a_single_flight() -> None:
    two = Halves.of(["a", "b", "c"], {"a": 0, "b": 1, "c": 0}, 1, [9, 9, 9], ["a", "b", "b", "c"])
    assert two.of_part == [0, 1, 0] and two.rows.tolist() == [
        [True, False, False, True],
        [False, True, True, False],
    ]
    one = Halves.of(["a", "a"], {"a": 0}, 2, [30, 10], ["a"] * 4)
    assert one.of_part == [0, 1, 1, 1] and one.rows[0].tolist() == [True, True, False, False]
