"""Linearisations with a fixed point, and the best point asked again: the same numbers as the plain
way."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest

from greybox.estimation import point_functions
from greybox.estimation.gain import Linearisation, linearisation_at
from greybox.estimation.problem import make_problem
from greybox.model.model import PhysicsModel
from greybox.model.sensors import SENSORS
from greybox.model.vehicle import read_vehicle
from greybox.plants.presets import X250
from greybox.plants.quadrotor import Quadrotor
from greybox.plants.vehicle_file import write_vehicle
from tests import gusty


def craft(*effects: str) -> PhysicsModel:
    """With the first five sensors."""
    with tempfile.TemporaryDirectory() as folder:
        vehicle = read_vehicle(write_vehicle(Path(folder) / "v.toml", Quadrotor(X250)))
    return PhysicsModel(vehicle=vehicle, sensors=SENSORS[:5]).with_effect(*effects)


def test_a_tape_at_one_point_is_the_function_in_the_vm(monkeypatch: pytest.MonkeyPatch):
    model = craft("motor_lag", "rotor_drag")
    active = ("inertia.xx", "thrust.c2", "motor_lag.tau", "rotor_drag.k_x")
    x = model.reference({f"u{i}": 0.5 + 0.01 * i for i in range(1, 5)})
    p = np.array([q.nominal + 0.1 * q.scale for q in model.parameters])
    at = x, np.full((len(model.inputs), 1), 0.55), p, 0.01
    if point_functions.tape_library() is None:
        pytest.skip("no C compiler here")
    on_tape = Linearisation(model, active)
    written = [*on_tape(*at), on_tape.values(*at)]
    monkeypatch.setattr(point_functions, "tape_library", lambda: None)
    in_vm = Linearisation(model, active)
    for ours, theirs in zip(written, [*in_vm(*at), in_vm.values(*at)], strict=True):
        assert any(np.abs(v).max() > 0 for v in ours)
        for a, b in zip(ours, theirs, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12 * max(np.abs(b).max(), 1e-300))


def test_a_fixed_point_gives_the_same_linearisation():
    model = craft("motor_lag", "rotor_drag")
    active = ("inertia.xx", "thrust.c2", "motor_lag.tau", "rotor_drag.k_x")
    x = model.reference({f"u{i}": 0.5 + 0.01 * i for i in range(1, 5)})
    special = linearisation_at(
        model, active, x, model.reference({f"u{i}": 1.5 for i in range(1, 5)})
    )
    assert (
        linearisation_at(model, active, x, model.reference({f"u{i}": 1.5 for i in range(1, 5)}))
        is special
    )
    p = np.array([q.nominal + 0.1 * q.scale for q in model.parameters])
    window = np.full((len(model.inputs), 1), 0.55)
    for plain, quick in zip(
        Linearisation(model, active)(x, window, p, 0.01), special(x, window, p, 0.01)
    ):
        for a, b in zip(plain, quick):
            np.testing.assert_allclose(b, a, rtol=1e-12, atol=1e-12 * max(np.abs(a).max(), 1e-300))


def test_the_best_point_asked_again_is_what_it_was():
    """Worse points in between, and points without a gradient, do not take its place."""

    def problem():
        return make_problem(gusty.model(), gusty.rides(2), free=["b"], noise=gusty.LEVELS)

    one = problem()
    best = one.evaluate(one.start)
    worse = one.evaluate(one.start + 3.0)
    assert worse.cost > best.cost
    assert one.evaluate(one.start + 3.0, 0).gradient is None
    assert one.evaluate(one.start) is best
    fresh = problem().evaluate(one.start)
    assert fresh.cost == best.cost
    assert fresh.gradient.tolist() == best.gradient.tolist()
