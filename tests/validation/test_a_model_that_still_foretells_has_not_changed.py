"""What flights of now are likelier with is no change where the model of then foretells as well."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import greybox.validation.then
from greybox.data import Dataset
from greybox.model.identified import IdentifiedModel
from greybox.validation.gap import HeldOutErrors
from greybox.validation.judges import Judges
from greybox.validation.then import Then

SPAN = (0.1, 1.0)
ADDED = ["pose_lever_arm", "gyro_scale"]
FINE = SimpleNamespace(refused=False, line="useful for 1 s and more")
BAD = SimpleNamespace(refused=True, line="NOT USABLE: position is worse")


def errors(size: float) -> HeldOutErrors:
    """Of 20 seconds at two horizons, and half of that one sample ahead."""
    rng = np.random.default_rng(0)
    keys = {("rate", h): size for h in (0.1, 0.5)} | {("rate", 0.0): 1.0 / size}
    blocks = {k: [s * rng.uniform(0.8, 1.2, 10) for _ in range(20)] for k, s in keys.items()}
    return HeldOutErrors(own=blocks, floor={})


@pytest.fixture
def then(monkeypatch: pytest.MonkeyPatch) -> Then:
    seen = SimpleNamespace(now=FINE)
    monkeypatch.setattr(greybox.validation.then, "verdict_on", lambda *_: seen.now)
    model: Any = SimpleNamespace(verdict=FINE, seen=seen)
    judges = Judges(flights=cast(Dataset, None), adapt=0.0)
    return Then(model=cast(IdentifiedModel, model), judges=judges, errors=errors(1.0))


def test_a_model_with_more_that_foretells_worse_names_no_change(then):
    """However much better it is one sample ahead."""
    said = then.unchanged(errors(2.0), ADDED, SPAN)
    assert said.startswith("NOTHING HAS CHANGED that is felt")
    assert FINE.line in said
    assert "go on with it, not with what is written here" in said
    assert ", ".join(ADDED) in said
    assert then.beats(errors(2.0), SPAN)
    assert not then.beats(errors(1.0), SPAN)
    assert not then.beats(None, SPAN)


def test_one_that_foretells_better_may(then):
    assert then.unchanged(errors(0.5), ADDED, SPAN) == ""


def test_one_that_foretells_as_well_names_none(then):
    assert then.unchanged(errors(1.0), ADDED, SPAN).startswith("NOTHING HAS CHANGED")


def test_where_nothing_was_added_there_is_nothing_to_hold_against_it(then):
    assert then.unchanged(errors(2.0), [], SPAN) == ""
    assert then.unchanged(None, ADDED, SPAN) == ""


def test_a_model_that_foretells_no_more_has_changed_all_the_same(then):
    then.model.seen.now = BAD
    said = then.unchanged(errors(2.0), ADDED, SPAN)
    assert said.startswith("CHANGED, BY NOTHING ON OFFER")
    assert BAD.line in said
    assert "go on with it" not in said
    then.model.verdict = BAD  # then as now
    assert then.unchanged(errors(2.0), ADDED, SPAN).startswith("NOTHING HAS CHANGED")
