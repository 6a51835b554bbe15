"""Learner x model x export: every learner adds to linear models, per axis and of several outputs,
what they miss, as it does to physics (`test_every_learner_keeps_the_protocol`). It foretells
flights that nobody has seen, says how sure it is, is refused where it only remembers, and its file
and its C are the same predictor."""

from __future__ import annotations

import functools
import json
from pathlib import Path

import numpy as np
import pytest

from greybox.baselines.base_predictor import BasePredictor
from greybox.baselines.linear_predictor import LinearPredictor
from greybox.baselines.output_learner import fit_features
from greybox.baselines.output_residual import OutputHybrid, fit_output_residual, output_features
from greybox.baselines.predictor_features import features_of
from greybox.data import Segment, dataset_from_arrays
from greybox.model.linear import LinearModel
from greybox.model.matrices import Matrices
from greybox.residual.discrepancy import Discrepancy
from greybox.residual.feature_posterior import FeaturePosterior
from greybox.residual.learners import LEARNERS, LooksBack, learner_of
from greybox.symbolic import FloatArray, Layout, Signal
from mpc_export.bundle import write_bundle
from mpc_export.functions import model_functions
from mpc_export.verify import main as verify
from tests.mpc_export import compiled
from tests.mpc_export.predictor_cases import CHANNELS, DT, axes, body

FEATURES = ("p", "u1[t-1]", "u2[t-1]")
NOISE = 0.02
LATE = 4
"""Samples after which commands bend the innovation, where a learner shall look back."""
SHOWN = ("ensemble", "linear SISO")


def coupled() -> BasePredictor:
    """Two states that drive each other, in innovation form."""
    model = body(
        Matrices(
            np.array([[0.9, 0.05], [-0.1, 0.8]]),
            np.array([[0.4, 0.1], [-0.1, 0.5]]),
            np.eye(2),
            np.zeros((2, 2)),
            np.array([[0.3, 0.0], [0.1, 0.2]]),
        )
    )
    return LinearPredictor(model=model, outputs=("p", "q"), channels=CHANNELS)


BASES = {"linear SISO": axes, "linear MIMO": coupled}
ALL = ("gp", *LEARNERS)
QUICK = ("random-features", "sparse")
"""Learners whose training takes next to nothing; one model is enough for `ensemble` in every
run."""
CELLS = [
    pytest.param(n, kind, marks=() if n in QUICK or (n, kind) == SHOWN else pytest.mark.slow)
    for n in ALL
    for kind in BASES
]


def bend(u1: float, u2: float) -> FloatArray:
    """The mean of the next innovation (2,), which no linear model knows."""
    return np.array(
        [0.10 * (u1 - 0.5) * abs(u1 - 0.5) / 0.25, 0.15 * (u1 - 0.5) * (u2 - 0.5) / 0.25]
    )


def flight(base: BasePredictor, seed: int, n: int = 300, learner: str = "gp") -> Segment:
    """A record that the model with bent innovations made; commands bend them late for a learner
    that looks back."""
    late = LATE if isinstance(learner_of(learner), LooksBack) else 1
    model, rng = base.model, np.random.default_rng(seed)
    assert isinstance(model, LinearModel)
    u = np.repeat(rng.uniform(0, 1, (-(-n // 7), 2)), 7, axis=0)[:n]
    sums = [[(w, int(c[1]) - 1) for w, c in base.channels[k]] for k in model.inputs.names]
    driven = np.array([[sum(w * row[c] for w, c in s) for s in sums] for row in u])
    a, b, c, d, k = model.matrices
    x, y = np.zeros(model.order), np.zeros((n, 2))
    for t in range(n):
        delayed = [driven[max(t - lag, 0), i] for i, lag in enumerate(model.delays)]
        command = np.array(delayed) - model.input_offset
        e = bend(*u[max(t - late, 0)]) + NOISE * rng.standard_normal(2)
        y[t] = c @ x + d @ command + model.output_offset + e
        x = a @ x + b @ command + k @ e
    columns = {"p": y[:, 0], "q": y[:, 1], "u1": u[:, 0], "u2": u[:, 1]}
    return dataset_from_arrays(DT * np.arange(n), columns, name=f"f{seed}").segments[0]


@functools.cache
def learned(kind: str, learner: str) -> OutputHybrid:
    """Who looks back asks for its own inputs, six times as many, and has more flights to learn
    from."""
    base, back = BASES[kind](), isinstance(learner_of(learner), LooksBack)
    train = [flight(base, seed, learner=learner) for seed in range(8 if back else 4)]
    names = None if back else FEATURES
    return fit_output_residual(
        base, train, features=names, learner=learner, points=20, seed=0, hold_out=0.0
    )


def test_who_looks_back_asks_for_earlier_commands_by_itself() -> None:
    """140 ms of them before the newest one that may be known."""
    own = output_features(axes(), ("p", "q", "u1", "u2"))
    assert own == ("p", "q", "u1[t-1]", "u2[t-1]")
    more = output_features(axes(), ("p", "q", "u1", "u2"), learner_of("lstm"))
    assert more == (*own, *(f"{c}[t-{k}]" for k in range(2, 9) for c in ("u1", "u2")))


@pytest.mark.parametrize(("learner", "kind"), CELLS)
def test_it_foretells_an_unseen_flight_and_says_how_sure_it_is(learner: str, kind: str) -> None:
    hybrid = learned(kind, learner)
    assert hybrid.posterior.active == (True, True) and hybrid.name in repr(hybrid)
    new = flight(hybrid.base, 99, 1500, learner)
    y, plain = new.matrix(("p", "q")), hybrid.base.one_step(new)[0]
    mean, variance = hybrid.one_step(new)
    late = np.arange(new.n) > 150
    before, after = ((y - m)[late].var(axis=0) - NOISE**2 for m in (plain, mean))
    assert (after < 0.15 * before).all(), (before, after)
    inside = np.mean(np.abs(y - mean)[late] < 1.96 * np.sqrt(variance[late]), axis=0)
    assert (inside > 0.90).all() and (inside < 0.99).all(), inside


@pytest.mark.parametrize(("learner", "kind"), CELLS)
def test_its_file_and_its_export_are_the_same_predictor(
    learner: str, kind: str, tmp_path: Path
) -> None:
    hybrid = learned(kind, learner)
    back = OutputHybrid.load(hybrid.save(tmp_path / "hybrid.json"))
    new = flight(hybrid.base, 98, 60, learner)
    for a, b in zip(hybrid.one_step(new), back.one_step(new), strict=True):
        assert np.array_equal(a, b, equal_nan=True)
    functions = model_functions(back)
    mean, variance = hybrid.free_run(new, [39], 1)
    run, names = hybrid.base.run(new), hybrid.posterior.inputs.names
    z = features_of(hybrid.base, new, run, names)[40]
    told = np.asarray(functions["gp_mean"](z, functions.parameter_values)).ravel()
    assert told == pytest.approx(mean[0, 0] - run.mean[40], rel=1e-9, abs=1e-12)
    own = np.asarray(functions["gp_variance"](z, functions.parameter_values)).ravel()
    assert own == pytest.approx(variance[0, 0] - hybrid.posterior.noise, rel=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("kind", BASES)
@pytest.mark.parametrize("learner", ALL)
def test_its_bundle_passes_the_verifier(
    learner: str, kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """C under strict flags without malloc, rebuild and golden vectors agree to 1e-10."""
    compiled.needs_compiler()
    groups = ("covariance", "filter")
    write_bundle(learned(kind, learner), tmp_path / "thing", with_=groups, use_cache=False)
    assert "malloc" not in (tmp_path / "thing" / "c" / "thing.c").read_text()
    assert verify([str(tmp_path / "thing")]) == 0, capsys.readouterr().out


@pytest.mark.parametrize(
    "learner", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in LEARNERS]
)
def test_errors_that_no_input_tells_of_are_left_alone(learner: str) -> None:
    """White errors and inputs that wander from flight to flight: the model stays what it was."""
    rng = np.random.default_rng(3)
    flights = np.repeat(np.arange(5), 80)
    z = rng.standard_normal((400, 2)) + 3 * rng.standard_normal((5, 2))[flights]
    rows = Discrepancy(
        inputs=Layout([Signal(name=n, unit="1") for n in ("a", "b")]),
        outputs=Layout([Signal(name="e", unit="m")]),
        z=z,
        y=0.1 * rng.standard_normal((400, 1)),
        flights=tuple(f"f{i}" for i in flights),
    )
    made = learner_of(learner)
    assert made is not None
    found = fit_features(made, rows, np.array([0.01]), points=20, seed=0)
    assert found.posterior.active == (False,)
    mean, variance = found.posterior.evaluate(z[:3], noise=True)
    assert not mean.any() and np.allclose(variance, 0.01)


def test_the_variance_of_a_bayesian_last_layer_is_that_of_its_regression() -> None:
    """One feature, one output: mean and variance of the textbook."""
    rng = np.random.default_rng(0)
    x = rng.standard_normal((400, 1))
    y = 0.7 * x + 0.1 * rng.standard_normal((400, 1))
    rows = Discrepancy(
        inputs=Layout([Signal(name="a", unit="1")]),
        outputs=Layout([Signal(name="e", unit="m")]),
        z=x,
        y=y,
        flights=tuple(f"f{i // 100}" for i in range(400)),
    )

    class Line:
        name = "line"

        def features(self, x, y, *, points, seed):  # type: ignore[no-untyped-def]
            return {"line": lambda s: s}

    found = fit_features(Line(), rows, np.array([0.5]), points=1, seed=0)
    assert isinstance(found.posterior, FeaturePosterior)
    level = found.scores[0]["nlpd"]
    z = (x - x.mean()) / x.std()
    truth = 0.1**2 * (1.5 - x.mean()) ** 2 / x.std() ** 2 / float(np.sum(z**2))
    mean, variance = found.posterior.evaluate([[1.5]])
    assert abs(mean.item() - 0.7 * (1.5 - x.mean())) < 0.05 and level < 0
    assert variance.item() == pytest.approx(truth, rel=0.2)
    told = json.loads(json.dumps(found.posterior.to_dict()))
    again = FeaturePosterior.from_dict(told).evaluate([[1.5]])
    assert again[0].item() == mean.item() and again[1].item() == variance.item()


@pytest.mark.parametrize("learner", QUICK)
def test_far_from_all_training_inputs_nothing_is_believed(learner: str) -> None:
    """The mean is that of the model again; the variance is no smaller than anywhere in a flight."""
    post = learned("linear MIMO", learner).posterior
    inside = np.random.default_rng(5).uniform(0.2, 0.8, (50, 3))
    inside[:, 0] = post.input_mean[0]
    far = post.input_mean + np.outer([8.0, -8.0, 20.0], post.input_scale)
    near, near_variance = post.evaluate(inside)
    mean, variance = post.evaluate(far)
    assert np.abs(mean).max() < 1e-3 * np.abs(near).max()
    assert (variance.min(axis=0) > near_variance.max(axis=0)).all()
