"""The order in which a user lists effects does not exist: any order gives the same model, to the
last bit."""

from __future__ import annotations

import numpy as np
from specimen import (
    DT,
    at_random,
    column,
    crooked,
    function,
    model_with,
    parameter_vector,
    random_state,
    random_window,
)

from greybox.model.effects import CATALOGUE


def test_any_order_of_listing_gives_the_same_model():
    rng = np.random.default_rng(3)
    reference = model_with(*CATALOGUE)
    values = {k: v for e in CATALOGUE for k, v in at_random(e, crooked(), rng).items()}
    x, window, p = (
        random_state(reference, rng),
        random_window(reference, rng),
        parameter_vector(reference, values),
    )
    w = 0.1 * rng.normal(size=6)
    f, step = (
        column(function(reference, k)(*a))
        for k, a in (("f", (x, window[:, -1], p)), ("step", (x, window, p, w, DT)))
    )
    assert np.isfinite(step).all()
    for _ in range(3):
        shuffled = model_with(*rng.permutation(np.array(CATALOGUE, dtype=object)))
        assert shuffled == reference
        assert shuffled.parameters == reference.parameters
        assert shuffled.states == reference.states
        assert shuffled.inputs == reference.inputs
        np.testing.assert_array_equal(column(function(shuffled, "f")(x, window[:, -1], p)), f)
        np.testing.assert_array_equal(column(function(shuffled, "step")(x, window, p, w, DT)), step)


def test_adding_one_by_one_is_adding_at_once():
    grown = model_with()
    for effect in reversed(CATALOGUE):
        grown = grown.with_effect(effect.name)
    assert grown == model_with(*CATALOGUE)
