"""A learner's candidate that was not made again without the flights that judge it says so: what it
saves of their errors may be memory, and is no reason to prefer it to the one that was chosen."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib import resources

import jsonschema
import numpy as np

from greybox import learn
from greybox.files import dump_json
from greybox.report.learn_report import learn_report
from greybox.residual.learners import RandomFeatures
from tests.residual.hybrid_cases import hybrid, pendulum_model, swings

SAW = "which its features saw"
PAGE = "its features saw these"


def test_what_was_not_asked_again_is_marked_and_nothing_else() -> None:
    train = swings(3, 1, hidden=0.35, period=4.0, seconds=8.0)
    found = learn(
        pendulum_model(), train, features=("rate",), points=6, learner=RandomFeatures(), seed=0
    )
    assert not found.null and len(found.candidates) == 2
    (other,) = set(found.candidates) - {found.chosen}
    assert found.fit.unasked == {other} and found.candidates[other] > 0
    marked = [line for line in found.summary().splitlines() if SAW in line]
    assert len(marked) == 1 and f"candidate {other}:" in marked[0]
    content = json.loads(dump_json(found.to_dict()))
    schema = json.loads(resources.files("greybox.schemas").joinpath("learn.json").read_text())
    jsonschema.validate(content, schema)
    assert {c["name"]: c.get("features_saw", False) for c in content["candidates"]} == {
        found.chosen: False,
        other: True,
    }
    content["candidates"].sort(key=lambda c: c["name"] != other)
    content["candidates"][0]["held_out_gain"] = 0.99
    page = learn_report(content).partition("What competed")[2]
    assert page.count(PAGE) == 1 and page.index(found.chosen) < page.index(other)


def test_a_model_is_named_after_what_was_learned_alone() -> None:
    both = hybrid()
    names = both.posterior.outputs.names
    assert f"({', '.join(names)})" in both.name
    weights = both.posterior.weights * np.array([n.startswith("force") for n in names])
    force = replace(both, posterior=replace(both.posterior, weights=weights))
    assert force.name.endswith("(force.x, force.y)")
