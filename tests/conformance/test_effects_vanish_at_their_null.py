"""Every smaller model is nested: at its null parameters an effect leaves state, outputs and steps
as they were."""

from __future__ import annotations

import numpy as np
import pytest
from specimen import (
    DT,
    at_null,
    column,
    crooked,
    effects_under_test,
    function,
    model_with,
    parameter_vector,
    random_state,
    random_window,
)

from greybox.errors import ModelError

every_effect = pytest.mark.parametrize("effect", effects_under_test())
PLAIN = model_with()


def pair(effect, seed, rotors_settled):
    """(model with the effect, its arguments, arguments of the plain model), the effect at its
    null."""
    rng = np.random.default_rng(seed)
    model = model_with(effect)
    x, window = random_state(model, rng), random_window(model, rng)
    if rotors_settled:
        for i in range(4):
            if f"rotor.{i + 1}" in model.states:
                x[model.states[f"rotor.{i + 1}"]] = window[i, model.window[0]]
    p = parameter_vector(model, at_null(effect, crooked()))
    assert model.states.names[: len(PLAIN.states)] == PLAIN.states.names
    assert [d.name for d in model.parameters[: len(PLAIN.parameters)]] == [
        d.name for d in PLAIN.parameters
    ]
    plain = (
        x[: len(PLAIN.states)],
        window[:4, model.window[0]][:, None],
        p[: len(PLAIN.parameters)],
    )
    return model, (x, window, p), plain


@every_effect
@pytest.mark.parametrize("which", ["f", "h"])
def test_rates_and_outputs_are_those_of_the_smaller_model(effect, which):
    full, plain = None, function(PLAIN, which)
    for seed in range(5):
        model, (x, window, p), (x0, u0, p0) = pair(effect, seed, rotors_settled=True)
        full = full or function(model, which)
        got = column(full(x, window[:, model.window[0]], p))
        expected = column(plain(x0, u0, p0))
        np.testing.assert_allclose(got[: expected.size], expected, rtol=1e-12, atol=1e-12)


@every_effect
def test_a_step_is_that_of_the_smaller_model_wherever_the_effects_own_states_stand(effect):
    full, plain = None, function(PLAIN, "step")
    for seed in range(5):
        model, (x, window, p), (x0, u0, p0) = pair(effect, seed, rotors_settled=False)
        full = full or function(model, "step")
        w = 0.1 * np.random.default_rng(seed).normal(size=6)
        got, expected = column(full(x, window, p, w, DT)), column(plain(x0, u0, p0, w, DT))
        np.testing.assert_allclose(got[: expected.size], expected, rtol=1e-12, atol=1e-12)


@every_effect
def test_an_output_sample_is_that_of_the_smaller_model(effect):
    full, plain = None, function(PLAIN, "output")
    for seed in range(3):
        model, (x, window, p), (x0, u0, p0) = pair(effect, seed, rotors_settled=True)
        full = full or function(model, "output")
        w = 0.1 * np.random.default_rng(seed).normal(size=6)
        np.testing.assert_allclose(
            column(full(x, window, p, w, DT)),
            column(plain(x0, u0, p0, w, DT)),
            rtol=1e-12,
            atol=1e-12,
        )


@every_effect
def test_removal_is_exact(effect):
    model = PLAIN.with_effect(effect.name)
    assert effect.name in model.name
    assert model.without_effect(effect.name) == PLAIN
    assert PLAIN.without_effect() == PLAIN
    with pytest.raises(ModelError, match="no effect"):
        PLAIN.without_effect(effect.name)
