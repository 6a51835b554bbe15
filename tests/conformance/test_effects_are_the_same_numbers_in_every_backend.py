"""Physics is written once: SX, MX and compiled C evaluate the same expression."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from specimen import (
    DT,
    at_random,
    column,
    crooked,
    effects_under_test,
    function,
    model_with,
    parameter_vector,
    random_state,
    random_window,
)

from greybox.estimation.build import compiler
from greybox.estimation.engine import Engine
from greybox.estimation.recursion import GainTable
from greybox.model.sensors import SENSORS

every_effect = pytest.mark.parametrize("effect", effects_under_test())


def instance(effect, seed):
    rng = np.random.default_rng(seed)
    model = model_with(effect)
    p = parameter_vector(model, at_random(effect, crooked(), rng))
    return rng, model, random_state(model, rng), random_window(model, rng), p


@every_effect
@pytest.mark.parametrize("which", ["f", "h", "step", "output"])
def test_sx_and_mx_agree(effect, which):
    rng, model, x, window, p = instance(effect, 1)
    arguments = (
        (x, window[:, -1], p)
        if which in ("f", "h")
        else (x, window, p, 0.1 * rng.normal(size=6), DT)
    )
    scalar, matrix = (column(function(model, which, kind)(*arguments)) for kind in (ca.SX, ca.MX))
    assert np.isfinite(scalar).all()
    np.testing.assert_allclose(matrix, scalar, rtol=1e-13, atol=1e-13)


@every_effect
@pytest.mark.skipif(compiler() is None, reason="no C compiler here")
def test_compiled_c_runs_the_same_filter_as_the_virtual_machine(effect):
    # The IMU feels every effect; what else an effect needs comes along. Fewer sensors compile
    # faster.
    names = {"gyro", "accelerometer", *effect.needs.sensors, *effect.needs.other_sensors}
    model = replace(model_with(effect), sensors=tuple(s for s in SENSORS if s.name in names))
    rng = np.random.default_rng(2)
    p = parameter_vector(model, at_random(effect, crooked(), rng))
    x0 = random_state(model, rng)
    active = ("mass", *(f"{effect.name}.{d.name}" for d in effect.parameters(crooked())))
    engines = [Engine(model, active, use_compiler=c) for c in (True, False)]
    assert [e.compiled for e in engines] == [True, False]
    n = 12
    u = np.array([random_window(model, rng)[:, -1] for _ in range(n)])
    y = rng.normal(size=(n, len(model.outputs)))
    mask = (rng.uniform(size=(n, len(model.innovations))) > 0.2).astype(float)
    mild = 1e-3
    shape = (1, len(model.error_states), len(model.innovations))
    gain = GainTable(
        gain=mild * rng.normal(size=shape),
        zero=np.zeros(1, dtype=np.int32),
        derivative=tuple(mild * rng.normal(size=(shape[0], len(active), *shape[1:]))),
    )
    want = frozenset({"states", "innovations", "outputs", "sensitivity", "state_sensitivity"})
    compiled, plain = (
        e.run(
            x0=x0,
            inputs=e.padded_inputs(u),
            outputs=y,
            mask=mask,
            pattern=np.zeros(n, dtype=np.int32),
            gains=gain,
            p=p,
            dt=DT,
            s0=np.zeros((e.nd, len(active))),
            want=want,
        )
        for e in engines
    )
    assert compiled.failed_at is None
    assert plain.failed_at is None
    for name in (*want, "end", "end_sensitivity"):
        a, b = getattr(compiled, name), getattr(plain, name)
        np.testing.assert_allclose(
            a, b, rtol=1e-9, atol=1e-11 * max(1.0, np.abs(b).max()), err_msg=name
        )
    assert np.abs(plain.sensitivity[..., 1:]).max() > 0, "the effect's parameters are felt"
