"""What is hidden in a foreign craft acts as its own plant says, and not at all at its null."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.plants import effects as known
from greybox.plants.quadrotor import Quadrotor
from scenarios.foreign.craft import Air
from scenarios.foreign.hidden import (
    CATALOGUED,
    OUTSIDE,
    hidden_effect,
    outside_effect,
    settled,
)
from scenarios.foreign.loads import Instant, Load, Loads
from scenarios.foreign.naming_cells import scaled
from tests.foreign_plants import CRAFT, FOREIGN, FRAME, HOVER, make

EVERY = [*CATALOGUED, *OUTSIDE]
SLOW = {"command_saturation", "battery_sag", "steady_wind"}


def of(name):
    draw = hidden_effect if name in CATALOGUED else outside_effect
    return draw(name, FRAME, np.random.default_rng(3))


def flown(simulator, effects, steps=30):
    """Readings of a lively flight with these effects."""
    craft, left = settled(simulator, CRAFT, effects)
    plant = make(simulator, craft, effects=left)
    plant.reset(1, velocity=(1.5, -1.0, 0.5), rates=(1.0, -0.8, 0.6))
    rows = []
    for k in range(steps):
        t = 0.01 * k
        u = HOVER + 0.12 * np.sin([20.0 * t, 17.0 * t + 1.0, 13.0 * t + 2.0, 15.0 * t + 3.0])
        plant.step(u.tolist(), 0.01)
        rows.append([v for c, v in plant.measure(noise=False).items() if c != "t" and c[0] != "u"])
    return np.array(rows)


@pytest.mark.parametrize("name", [n for n in EVERY if n not in SLOW and n != "motor_lag"])
def test_an_effect_acts_and_vanishes_at_its_null(name):
    bare = flown("mujoco", [])
    acts = np.abs(flown("mujoco", [of(name)]) - bare).max()
    # a parameter that shapes an effect may stay; the effect is gone with its size
    gone = scaled(of(name), 0.0) if name in CATALOGUED else type(of(name))()
    left = np.abs(flown("mujoco", [gone]) - bare).max()
    # a load is held over shorter steps than MuJoCo is without one
    assert left < 1e-5 and acts > 20.0 * left + 1e-5


@pytest.mark.parametrize("simulator", FOREIGN)
@pytest.mark.parametrize(
    "name",
    [
        *("rotor_drag", "axial_inflow", "blade_flapping", "translational_lift", "parasitic_drag"),
        *("sensor_delay", "pose_delay", "rotor_gyroscopic", "constant_force", "gyro_scale"),
        *("center_of_mass_offset", "products_of_inertia", "command_delay"),
    ],
)
def test_a_foreign_craft_moves_as_our_own_plant_with_the_effect(simulator, name):
    effect = of(name)
    steps = 25
    seen = flown(simulator, [effect], steps)
    own = Quadrotor(FRAME, [known.MotorLag(tau=CRAFT.lag), effect], sample_time=0.01)
    own.reset(1, velocity=(1.5, -1.0, 0.5), rates=(1.0, -0.8, 0.6))
    rows = []
    for k in range(steps):
        t = 0.01 * k
        u = HOVER + 0.12 * np.sin([20.0 * t, 17.0 * t + 1.0, 13.0 * t + 2.0, 15.0 * t + 3.0])
        own.step(u.tolist(), 0.01)
        rows.append([v for c, v in own.measure(noise=False).items() if c != "t" and c[0] != "u"])
    bare = flown(simulator, [], steps)
    # late sensors show readings from before the start for a moment, which plants remember apart
    first, rigid = (6 if "delay" in name else 0), slice(0, 16)
    acts = np.abs(seen - bare)[first:, rigid].max(axis=0)
    apart = np.abs(seen - np.array(rows))[first:, rigid].max(axis=0)
    moved = acts > 5e-3
    assert moved.any()
    assert np.all(apart[moved] < 0.1 * acts[moved])


def test_gusts_push_and_turn_every_craft_alike():
    air = Air(push=0.3, turn=1.5, gust_time=0.5)
    found = []
    for simulator in FOREIGN:
        plant = make(simulator, replace(CRAFT, air=air))
        plant.reset(4)
        for _ in range(20):
            plant.step([HOVER] * 4, 0.01)
        state = plant.states()
        found.append([state[c] for c in ("vx", "vy", "vz", *"pqr")])
    assert np.abs(found[0]).max() > 0.02
    assert np.allclose(found, found[0], rtol=0.02, atol=2e-3)


def test_a_load_is_a_force_at_its_hub():
    """Drag of one metre per second along x on four hubs: force and pitching moment by hand."""
    drag = known.RotorDrag(k_x=2e-5, k_y=2e-5)
    frame = replace(
        FRAME, rotors=tuple(replace(r, position=(*r.position[:2], 0.02)) for r in FRAME.rotors)
    )
    loads = Loads([drag], replace(CRAFT, airframe=frame))
    now = Instant(
        time=0.0,
        position=(0.0, 0.0, 1.0),
        velocity=(1.0, 0.0, 0.0),
        attitude=(1.0, 0.0, 0.0, 0.0),
        rates=(0.0, 0.0, 0.0),
        nu=(0.5,) * 4,
        nu_rate=(0.0,) * 4,
        wind=(0.0, 0.0, 0.0),
        voltage=float("nan"),
    )
    force = -4 * 2e-5 * 0.5 * 2300.0
    assert loads.at(now).force == pytest.approx((force, 0.0, 0.0))
    assert loads.at(now).moment == pytest.approx((0.0, 0.02 * force, 0.0))
    assert loads.at(now._replace(wind=(1.0, 0.0, 0.0))) == Load((0.0,) * 3, (0.0,) * 3)


def test_sums_of_uneven_rotors_are_zero_so_that_truths_compare():
    for seed in range(5):
        effect = hidden_effect("rotor_asymmetry", FRAME, np.random.default_rng(seed))
        assert sum(effect.delta) == pytest.approx(0.0, abs=1e-12)
