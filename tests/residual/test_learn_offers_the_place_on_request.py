"""What depends on the place in the room is a choice: a set of features on request, where a position
is measured."""

from __future__ import annotations

import pytest

from greybox.errors import ModelError
from greybox.model.example import example_vehicle
from greybox.model.model import build_model
from greybox.residual.learn import feature_sets
from tests.residual.hybrid_cases import craft, craft_model

WHERE = {f"position.{a}" for a in "xyz"} | {f"heading.{a}" for a in "xy"}
"""A wall pushes along an axis of the room: where to in body axes, the heading tells."""


def test_the_place_competes_on_request_alone():
    model = craft_model(craft())
    usual, more = feature_sets(model), feature_sets(model, place=True)
    assert not any(WHERE & set(names) for names in usual.values())
    assert {n: s for n, s in more.items() if n in usual} == usual
    assert set(more["place"]) == WHERE
    assert set(more["place and motion"]) > {*WHERE, "p", "q", "r"}


def test_a_place_that_nobody_measures_is_refused():
    blind = build_model(
        example_vehicle(), ["qw", "qx", "qy", "qz", "p", "q", "r", "ax", "ay", "az"]
    )
    with pytest.raises(ModelError, match="no position is measured"):
        feature_sets(craft_model(blind), place=True)
