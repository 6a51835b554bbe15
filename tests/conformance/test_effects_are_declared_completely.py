"""Every effect says what it is: name, stage, formula, source, range of validity, and what it
needs."""

from __future__ import annotations

import importlib
import inspect
import math
import re
from operator import attrgetter
from typing import get_args

import pytest
from specimen import crooked, effects_under_test, model_with
from units import dimensions

from greybox.errors import ModelError, UnknownNameError
from greybox.model.effect import EARLY, SLOTS, Effect, Stage
from greybox.model.effects import CATALOGUE, effect_by_name
from greybox.model.sensors import SENSORS

TAGS = {"dissipative", "workless", "zero-at-rest", "linear-in-parameters", "rotor-acceleration"}
every_effect = pytest.mark.parametrize("effect", effects_under_test())


@every_effect
def test_one_file_holds_one_effect_of_the_same_name(effect):
    module = importlib.import_module(f"greybox.model.effects.{effect.name}")
    assert type(effect).__module__ == module.__name__
    assert type(effect).__name__ == "".join(part.capitalize() for part in effect.name.split("_"))
    own = [
        c
        for c in vars(module).values()
        if inspect.isclass(c) and issubclass(c, Effect) and c is not Effect
    ]
    assert own == [type(effect)]
    assert module.__doc__.startswith(f"{effect.name}: ")


@every_effect
def test_words_are_there(effect):
    assert re.fullmatch(r"[a-z]+(_[a-z]+)*", effect.name)
    assert effect.stage in get_args(Stage)
    assert effect.stage in SLOTS
    assert 10 <= len(effect.summary) <= 100
    assert not effect.summary.endswith(".")
    assert re.search(r"=|<-", effect.formula), "the formula is an equation"
    assert len(effect.validity) > 5
    assert effect.references
    assert all(re.search(r"\b(19|20)\d\d\b|documentation|guide", r) for r in effect.references)
    assert len(effect.case.working) > 10


@every_effect
def test_parameters_are_declared_with_unit_null_and_meaning(effect):
    declared = effect.parameters(crooked())
    assert declared
    assert len({p.name for p in declared}) == len(declared)
    for p in declared:
        dimensions(p.unit)  # raises for a unit that nobody knows
        assert p.meaning
        assert p.lower <= p.upper
        assert p.null is not None, f"{p.name} has no null"
        assert p.lower <= p.null <= p.upper
        assert p.scale > 0
        assert math.isfinite(p.nominal)
    assert set(effect.case.parameters) == {p.name for p in declared}


@every_effect
def test_tags_and_needs_are_known_words(effect):
    assert effect.tags <= TAGS
    assert {*effect.needs.sensors, *effect.needs.other_sensors} <= {s.name for s in SENSORS}
    assert set(effect.needs.effects) <= {e.name for e in CATALOGUE} - {effect.name}
    assert all(attrgetter(fact)(crooked()) is not None for fact in effect.needs.vehicle)


@every_effect
def test_slots_belong_to_the_stage(effect):
    assert set(effect.case.expected) <= SLOTS[effect.stage]
    assert effect.early == set(effect.case.expected) & EARLY


@every_effect
def test_an_effect_given_twice_is_refused(effect):
    with pytest.raises(ModelError, match="twice"):
        model_with(effect, effect)


def test_names_are_unique():
    assert len({e.name for e in CATALOGUE}) == len(CATALOGUE)


@pytest.mark.parametrize(
    ("typed", "meant"),
    [("rotor_drga", "rotor_drag"), ("motorlag", "motor_lag"), ("gyrobias", "gyro_bias")],
)
def test_an_unknown_effect_is_answered_with_the_nearest_names(typed, meant):
    for ask in (effect_by_name, model_with().with_effect):
        with pytest.raises(
            UnknownNameError, match=f"unknown effect '{typed}'.*did you mean.*{meant}"
        ):
            ask(typed)
