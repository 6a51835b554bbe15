"""learn lowers the errors of motions that it has not seen, learns nothing from clean flights, and
repeats itself."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from importlib import resources

import jsonschema
import numpy as np
import pytest

from greybox.errors import ModelError, UnknownNameError
from greybox.estimation.filtering import Filter
from greybox.estimation.propagation import Propagator, run_together
from greybox.files import dump_json
from greybox.model.identified import IdentifiedModel
from greybox.report.learn_report import learn_report
from greybox.residual.hybrid import HybridModel
from greybox.residual.learn import Learned, learn
from tests.residual.hybrid_cases import pendulum_model, swings

HIDDEN = 0.35
HORIZONS = (5, 20, 50)


@cache
def learned(hidden: float) -> Learned:
    train = swings(3, 1, hidden=hidden, period=4.0)
    base = replace(pendulum_model(), trained_on=train.names, data_hash=train.hash)
    return learn(base, train, features=("angle", "rate"), points=12, seed=0)


def errors(model: IdentifiedModel, hidden: float) -> np.ndarray:
    """RMSE of angle and rate (len(HORIZONS), 2) on two flights of a faster drive."""
    runner, found = Filter(model), []
    for flight in swings(2, 77, hidden=hidden, period=2.9, name="unseen"):
        segment = flight.segments[0]
        filtered = runner.run(segment)
        origins = np.arange(20, segment.n - 51, 3)
        y = runner.rollout(filtered, origins, 50)
        seen = np.column_stack([segment.channels["y"], segment.channels["w"]])
        found.append(np.array([y[:, h - 1] - seen[origins + h] for h in HORIZONS]))
    return np.sqrt(np.mean(np.concatenate(found, axis=1) ** 2, axis=1))


def test_unseen_motions_are_predicted_better():
    result = learned(HIDDEN)
    assert not result.null
    assert isinstance(result.model.dynamics, HybridModel)
    assert result.fit.held_out_gain > 0.2
    before, after = errors(result.base, HIDDEN), errors(result.model, HIDDEN)
    assert np.all(after < before)
    assert np.all(after[1:] < 0.9 * before[1:])
    assert np.all(after[2] < 0.6 * before[2])


def test_uncertainty_counts_errors_of_flights_as_if_they_had_not_been_seen():
    """Regions ahead hold on flights of another drive, and the spread of what was learned, which the
    errors of its own flights do not hold, comes on top of the calibrated noise."""
    result, inside = learned(HIDDEN), {h: [] for h in HORIZONS}
    runner = Filter(result.model)
    whole, noise = (Propagator(runner, learned=told) for told in (True, False))
    for flight in swings(3, 77, hidden=HIDDEN, period=2.9, name="unseen"):
        segment = flight.segments[0]
        filtered = runner.run(segment)
        origins = np.arange(20, segment.n - 51, 3)
        y = runner.rollout(filtered, origins, 50)
        seen = np.column_stack([segment.channels["y"], segment.channels["w"]])
        for both in run_together([whole, noise], filtered, origins, max(HORIZONS)):
            sure, less = (at.innovation_covariance for at in both)
            assert np.linalg.eigvalsh(sure - less).min() > -1e-12
            if (h := both[0].h) in inside:
                e = y[:, h - 1] - seen[origins + h]
                distance = np.einsum("ni,ni->n", e, np.linalg.solve(sure, e[..., None])[..., 0])
                inside[h].append(np.mean(distance < 5.99))
    assert all(0.88 < np.mean(shares) <= 1.0 for shares in inside.values()), inside
    assert np.mean(sure[:, 1, 1] / less[:, 1, 1]) > 1.01


def test_clean_flights_do_no_harm():
    result = learned(0.0)
    before, after = errors(result.base, 0.0), errors(result.model, 0.0)
    assert np.all(after < 1.02 * before)
    assert result.null or result.fit.held_out_gain < 0.05


def test_the_same_seed_gives_the_same_numbers():
    first = learned(HIDDEN)
    again = learned.__wrapped__(HIDDEN)
    assert again.chosen == first.chosen
    a, b = first.fit.posterior, again.fit.posterior
    assert np.allclose(a.weights, b.weights, rtol=1e-10, atol=1e-10 * np.abs(a.weights).max())
    assert np.allclose(a.support, b.support, rtol=0, atol=1e-12)
    assert first.model.horizon_noise == pytest.approx(again.model.horizon_noise, rel=1e-10)
    assert list(first.candidates.values()) == pytest.approx(
        list(again.candidates.values()), rel=1e-10
    )


@pytest.mark.parametrize("hidden", [HIDDEN, 0.0])
def test_the_result_follows_the_published_schema_and_makes_a_page(hidden: float):
    content = json.loads(dump_json(learned(hidden).to_dict()))
    schema = json.loads(resources.files("greybox.schemas").joinpath("learn.json").read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.Draft202012Validator(schema).validate(content)
    page = learn_report(content)
    assert ("Nothing was learned" in page) is content["null"]
    assert learned(hidden).summary()
    del content["fit"]
    assert not jsonschema.Draft202012Validator(schema).is_valid(content)


def test_what_cannot_be_learned_from_is_refused():
    train = swings(1, 1, hidden=0.0, period=4.0, seconds=4.0)
    with pytest.raises(UnknownNameError, match="rate"):
        learn(pendulum_model(), train, features=("rat",))
    with pytest.raises(ModelError, match="already"):
        learn(learned(HIDDEN).model, train)
    plain = pendulum_model()
    core = replace(plain.core, noise_states=())
    bare = replace(plain, dynamics=core, process_noise=plain.process_noise[:0], weak=plain.weak[:2])
    with pytest.raises(ModelError, match="no process noise"):
        learn(bare, train)
