"""Any number of rotors, known or unknown rotor speed, commands or measured speeds as input: every
effect is felt."""

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
    parameter_vector,
    random_state,
    random_window,
)

from greybox.errors import ModelError
from greybox.model.effects import effect_by_name
from greybox.model.model import PhysicsModel
from greybox.model.sensors import SENSORS
from greybox.model.vehicle_parts import Rotor

SIX = tuple(
    Rotor(position=(0.12 * np.cos(a), 0.12 * np.sin(a), 0.01), spin=1 if k % 2 else -1)
    for k, a in enumerate(np.arange(6) * np.pi / 3 + 0.2)
)
CRAFT = {
    "six rotors": {"rotors": SIX},
    "three rotors": {"rotors": SIX[:3]},
    "speed unknown": {"actuator": replace(crooked().actuator, speed_max=None)},
    "linear hold": {"actuator": replace(crooked().actuator, hold="linear")},
}


def model_on(craft, effect, **settings):
    """The effect, and where it is felt only through others one of those, on that craft."""
    partners = tuple(effect_by_name(n) for n in effect.needs.effects[:1])
    sensors = SENSORS[:5] if settings else SENSORS
    return PhysicsModel(
        vehicle=replace(crooked(), **craft),
        effects=(effect, *partners),
        sensors=sensors,
        sample_time=DT,
        **settings,
    )


def assert_felt(model, effect):
    """Step and output are finite, and every parameter of the effect moves one of them somewhere."""
    rng = np.random.default_rng(11)
    vehicle = model.vehicle
    x, p = ca.SX.sym("x", len(model.states)), ca.SX.sym("p", len(model.parameters))
    window = ca.SX.sym("U", len(model.inputs), sum(model.window) + 1)
    w = ca.SX.sym("w", len(model.noises))
    both = ca.vertcat(model.step(0, x, window, p, w, DT), model.output(0, x, window, p, w, DT))
    names = [d.name for d in model.parameters]
    own = [names.index(f"{effect.name}.{d.name}") for d in effect.parameters(vehicle)]
    f = ca.Function("f", [x, window, p, w], [both, ca.jacobian(both, p)[:, own]])
    felt = np.zeros(len(own))
    for _ in range(5):
        u = random_window(model, rng)
        if model.input == "speed":
            u = u * vehicle.actuator.speed_max
        values = {k: v for e in model.effects for k, v in at_random(e, vehicle, rng).items()}
        state = random_state(model, rng)
        state[model.states["position.z"]] = 0.3
        value, slope = f(
            state, u, parameter_vector(model, values), 0.1 * rng.normal(size=len(model.noises))
        )
        assert np.isfinite(column(value)).all()
        assert np.isfinite(slope.full()).all()
        felt = np.maximum(felt, np.abs(slope.full()).max(axis=0))
    assert (felt > 0).all(), dict(zip([names[i] for i in own], felt, strict=True))


@pytest.mark.parametrize("effect", effects_under_test())
@pytest.mark.parametrize("craft", CRAFT)
def test_every_parameter_is_felt(effect, craft):
    lacking = effect.missing(replace(crooked(), **CRAFT[craft]), {s.name for s in SENSORS})
    if lacking:
        assert (craft, lacking) == ("speed unknown", ("actuator.speed_max in the vehicle file",))
        with pytest.raises(ModelError, match=f"{effect.name} needs actuator.speed_max"):
            model_on(CRAFT[craft], effect)
    else:
        assert_felt(model_on(CRAFT[craft], effect), effect)


@pytest.mark.parametrize("effect", effects_under_test())
def test_measured_speeds_as_input(effect):
    if effect.stage in ("command", "rotor") and set(effect.early) != {"delay"}:
        with pytest.raises(ModelError, match=f"{effect.name} shapes the command"):
            model_on({}, effect, input="speed")
    elif effect.missing(crooked(), {s.name for s in SENSORS[:5]}):
        bare = {"vehicle": crooked(), "sensors": SENSORS[:5], "input": "speed"}
        with pytest.raises(ModelError, match="needs sensor rotor_speed"):
            PhysicsModel(effects=(effect,), **bare)
    else:
        assert_felt(model_on({}, effect, input="speed"), effect)


@pytest.mark.parametrize("effect", effects_under_test())
def test_what_an_effect_needs_is_said(effect):
    bare = replace(
        crooked(),
        nominal_voltage=None,
        actuator=replace(crooked().actuator, rotor_radius=None, speed_max=None),
    )
    assert effect.missing(crooked(), {s.name for s in SENSORS}, {"vbat"}) == ()
    lacking = effect.missing(bare, (), ())
    needs = effect.needs
    for word in (*needs.columns, *needs.vehicle, *needs.sensors, *needs.other_sensors):
        assert any(word in line for line in lacking)
    groups = sum(map(bool, (needs.sensors, needs.other_sensors)))
    assert len(lacking) == len(needs.columns) + len(needs.vehicle) + groups
