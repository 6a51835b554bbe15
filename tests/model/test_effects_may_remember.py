"""An effect with states of its own: integrated with the body, fitted, simulated and exported like
all else."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from craft import X250, function, model_of, vector, vehicle_of

import greybox as gb
from greybox.errors import ModelError
from greybox.model.effect import Effect, Remembered
from greybox.model.effect_check import check_effect
from greybox.model.model import PhysicsModel, build_model
from greybox.plants.presets import x250
from greybox.validation.gap import predict_ahead
from scenarios.plants.outside import RelaxingDrag
from scenarios.studies.discovery_outside import flights
from tests.conformance.remembering import Wake


class Clock(Wake):
    """A memory that settles at one, whatever is flown: solved by hand."""

    name = "clock"

    def memory(self, vehicle):
        return (Remembered(name="c", unit="-", size=1.0),)

    def remember(self, flow, p):
        return (1.0 - flow.memory) / p["T"]

    def apply(self, flow, p):
        return {"force": p["k"] * ca.vertcat(0, 0, flow.memory)}


def model(*effects: Effect | str) -> PhysicsModel:
    return model_of(X250).with_effect(*effects)


def test_its_states_stand_behind_the_body_and_before_the_rotors():
    both = model(Wake(), Clock(), "motor_lag")
    assert both.states.names[13:] == (
        "memory.clock.c",
        "memory.wake.x",
        "memory.wake.y",
        "memory.wake.z",
        *(f"rotor.{i}" for i in range(1, 5)),
    )
    assert both.error_states.names[12] == "d_memory.clock.c"
    assert both.states.signals[14].unit == "m/s"
    x0, sigma = both.initial_state({})
    assert len(x0) == len(both.states)
    assert len(sigma) == len(both.error_states)
    assert (x0[13:17] == 0).all()
    assert sigma[12:16].tolist() == [1.0, 0.5, 0.5, 0.5]
    assert len(both.reference({})) == len(both.states)


def test_it_moves_as_its_equation_says():
    own = model(Clock())
    step = function(own, "step")
    x = own.reference({})
    for _ in range(50):
        p = vector(own, clock__k=0.1, clock__T=0.2)
        x = np.array(step(x, [0.4] * 4, p, np.zeros(len(own.noises)), 0.01)).ravel()
    assert x[13] == pytest.approx(1 - np.exp(-0.5 / 0.2), rel=1e-6)


def test_each_sees_its_own_memory():
    both = model(Clock(), Wake())
    x = both.reference({})
    x[13:] = [2.0, 1.0, 0.5, -1.0]
    p = vector(both, clock__k=0.3, wake__k=0.1)
    f = function(both, "f")
    pushed = (np.array(f(x, [0.4] * 4, p)) - np.array(f(x, [0.4] * 4, vector(both)))).ravel()
    expected = np.array([-0.1, -0.05, 0.6 + 0.03]) / vehicle_of(X250).mass.value
    np.testing.assert_allclose(pushed[3:6], expected, atol=1e-12)
    np.testing.assert_allclose(
        np.array(f(x, [0.4] * 4, p)).ravel()[13:], [-5.0, -5.0, -2.5, 5.0], atol=1e-9
    )


def test_the_chart_is_addition():
    own = model(Wake(), "motor_lag")
    x, d = ca.SX.sym("x", len(own.states)), ca.SX.sym("d", len(own.error_states))
    back = ca.Function("back", [x, d], [own.boxminus(own.boxplus(x, d), x)])
    rng = np.random.default_rng(0)
    start = own.reference({}) + 0.0
    start[13:] = rng.normal(size=7)
    move = 0.1 * rng.normal(size=len(own.error_states))
    np.testing.assert_allclose(np.array(back(start, move)).ravel(), move, atol=1e-9)


def test_it_may_hold_what_a_log_feels_only_through_it():
    """Gyro alone feels no velocity, but a moment by a wake does."""

    class Turning(Wake):
        name = "turning"

        def apply(self, flow, p):
            return {"moment": p["k"] * flow.memory}

    vehicle = vehicle_of(X250)
    assert "velocity.x" not in build_model(vehicle, ("p", "q", "r")).states.names
    assert "velocity.x" in build_model(vehicle, ("p", "q", "r"), [Turning()]).states.names


def test_rules_of_all_effects_hold():
    check_effect(Wake())

    class Stuck(Wake):
        name = "stuck"
        stage = "sensor"

    class Short(Wake):
        name = "short"

        def remember(self, flow, p):
            return flow.memory[:2]

    class Silent(Wake):
        name = "silent"
        remember = Effect.remember

    class Endless(Wake):
        name = "endless"

        def remember(self, flow, p):
            return flow.memory / (flow.velocity * 0)

    class Gust(Wake):
        name = "gust"
        early = frozenset({"wind"})

    class Negative(Wake):
        name = "negative"

        def memory(self, vehicle):
            return (Remembered(name="a", unit="-", size=float("nan")),)

    class Named(Wake):
        name = "named"

        def memory(self, vehicle):
            return (Remembered(name="a b", unit="-", size=1.0),)

    for wrong, message in (
        (Gust(), "has a memory and returns wind"),
        (Negative(), "size in its memory is not positive"),
        (Named(), "bad names in its memory"),
        (Stuck(), "has a memory; expected one of stage thrust or wrench"),
        (Short(), r"remember\(\) gives 2x1 values; expected a column of 3"),
        (Silent(), "does not say how it changes"),
        (Endless(), "not finite"),
    ):
        with pytest.raises(ModelError, match=message):
            check_effect(wrong)


def test_a_memory_may_follow_the_place():
    class Hill(Wake):
        """A cushion of air that builds up slowly."""

        name = "hill"

        def memory(self, vehicle):
            return (Remembered(name="a", unit="1/m", size=1.0),)

        def remember(self, flow, p):
            return [(1 / flow.position[2] ** 2 - flow.memory) / p["T"]]

        def apply(self, flow, p):
            return {"force": p["k"] * ca.vertcat(0, 0, flow.memory)}

    own = model(Hill())
    assert own.reference({"z": 1.5})[2] == 1.5  # where the filter is linearised


@pytest.mark.slow
def test_a_fit_finds_size_and_time_of_an_independent_plant_and_simulates_them():
    plant = x250([RelaxingDrag(k=0.25, time=0.3)])
    train, test = (flights(plant, s, 8.0, n) for n, s in {"train": (41, 42), "test": (43,)}.items())
    vehicle = vehicle_of(X250)
    own = build_model(vehicle, train.channels, [Wake()], sample_time=0.01)
    found = gb.fit(own, train, free=("wake.k", "wake.T", "thrust.c2"), initialisation="nominal")
    assert found.converged
    for name, truth in (("wake.k", 0.25), ("wake.T", 0.3)):
        estimate = found.parameters[name]
        assert abs(estimate.value - truth) < 4 * estimate.std < 0.1 * truth
    bare = gb.fit(replace(own, effects=()), train, free=("thrust.c2",), initialisation="nominal")
    ahead = [
        np.concatenate(predict_ahead(f.model, test).own[("position", 0.5)]).mean()
        for f in (bare, found)
    ]
    assert ahead[1] < 0.25 * ahead[0]
