"""A step of four stages writes the equations of its body once, and is the step that wrote them four
times."""

from __future__ import annotations

import numpy as np
import pytest
from craft import CROOKED, flat, function, model_of

from greybox.model import model as module
from greybox.model.rigid_body import RigidBody

EFFECTS = ("motor_lag", "command_delay", "rotor_drag", "steady_wind", "products_of_inertia")


def test_it_is_the_step_that_writes_them_four_times(monkeypatch: pytest.MonkeyPatch) -> None:
    count, rates = 0, RigidBody.rates

    def counted(*given):
        nonlocal count
        count += 1
        return rates(*given)

    monkeypatch.setattr(RigidBody, "rates", counted)
    model = model_of(CROOKED, *EFFECTS, dt=0.01)
    once = function(model, "step")
    assert count == 1
    monkeypatch.setattr(module, "written_once", lambda rates, *_: rates)
    again = function(model_of(CROOKED, *EFFECTS, dt=0.01), "step")
    assert count == 5
    draw = np.random.default_rng(0)
    for _ in range(20):
        point = [draw.uniform(0.1, 0.9, size=once.size_in(i)) for i in range(once.n_in())]
        np.testing.assert_allclose(flat(once(*point)), flat(again(*point)), rtol=1e-13)
