"""Which predictor a model gets is asked in one place; all that is built on it asks the predictor."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from greybox.baselines.as_predictor import as_predictor, from_dict
from greybox.baselines.filter_predictor import FilterPredictor
from greybox.baselines.linear_predictor import LinearPredictor
from greybox.files import to_plain
from tests.mpc_export.predictor_cases import CHANNELS, axes, mimo, siso
from tests.residual.hybrid_cases import craft, craft_model

ROOT = Path(__file__).parents[2]
ASKS = re.compile(r"isinstance\([^)]*\b(LinearModel|IdentifiedModel|Base)\b")


def test_one_file_of_the_package_asks_for_the_kind():
    files = (ROOT / "greybox/baselines").glob("*.py")
    assert {p.name for p in files if ASKS.search(p.read_text())} == {"as_predictor.py"}


def test_a_linear_model_and_a_physical_one():
    linear = as_predictor(mimo(), outputs=["q"], channels=CHANNELS, adapt=1.0)
    assert isinstance(linear, LinearPredictor)
    assert linear.commands == ("u1", "u2")
    assert linear.offsets == ("q",)
    physical = as_predictor(craft_model(craft(("motor_lag",))))
    assert isinstance(physical, FilterPredictor)
    assert physical.outputs == ("p", "q", "r", "ax", "ay", "az")
    assert (physical.offsets, physical.run_in) == ((), 0.0)
    assert as_predictor(linear) is linear


def test_decoupled_linear_models_are_one():
    base = as_predictor([siso("p", "roll"), siso("q", "pitch", 1)], channels=CHANNELS)
    assert np.array_equal(base.gain[0], axes().gain[0])
    assert base.terms("pitch") == CHANNELS["pitch"]


@pytest.mark.parametrize("base", [as_predictor(mimo(), channels=CHANNELS, adapt=0.5), axes()])
def test_what_it_writes_gives_it_back(base):
    again = from_dict(to_plain(base.to_dict()), where="file")
    assert to_plain(again.to_dict()) == to_plain(base.to_dict())
