"""A shock changes what it says and nothing else of a flight in a foreign simulator, and the study
counts it honestly."""

from __future__ import annotations

import numpy as np
import pytest

from scenarios.foreign.draw import draw, plant_of
from scenarios.studies.shocks import (
    BACK,
    HEIGHT,
    LEVEL,
    SHOCKS,
    WINDOW,
    WINDOWS,
    Corner,
    back,
    row_of,
    summary,
)


@pytest.fixture(params=["rotorpy", "mujoco"])
def plant(request):
    pytest.importorskip(request.param)
    made = plant_of(draw(25, request.param))
    made.reset(3, position=(0.0, 0.0, 1.5))
    return made


def flown(plant, samples, seed=0):
    rng = np.random.default_rng(seed)
    hover = float(plant.airframe.hover_speed)
    for _ in range(samples):
        plant.step((hover + 0.02 * rng.standard_normal(4)).tolist(), 0.01)
    return plant


def test_the_same_craft_goes_on_to_the_last_bit(plant):
    flown(plant, 20)
    other = plant.goes_on_as(plant.craft)
    after = flown(other, 20, seed=1).measure()
    again = plant_of(draw(25, plant.simulator))
    again.reset(3, position=(0.0, 0.0, 1.5))
    expected = flown(flown(again, 20), 20, seed=1).measure()
    assert after == expected


def test_every_shock_does_what_it_says(plant):
    flown(plant, 20)
    before, gravity = plant._now(), plant.airframe.gravity

    def lift(shock):
        change = SHOCKS[shock]
        return plant.goes_on_as(change(plant.craft, 1))

    rest = np.array([0.0, 0.0, gravity])
    up = np.array(before.acceleration) + rest
    heavy = np.array(lift("payload")._now().acceleration) + rest
    # MuJoCo's air acts on a box that follows from mass and inertia
    np.testing.assert_allclose(1.2 * heavy, up, rtol=2e-3, atol=0.01)
    weak = lift("rotor")
    assert np.argmax(np.abs(np.array(weak._now().turning) - before.turning)) in (0, 1)
    assert weak._now().nu == pytest.approx(before.nu), "rotors keep their speed"
    drained = np.array(lift("battery")._now().acceleration)[2] + gravity
    assert drained == pytest.approx(0.85**2 * up[2], rel=0.05)
    assert lift("wind")._gusts.wind[1] == pytest.approx(plant.craft.air.wind[1] + 5.0, abs=6.0)


def test_a_longer_delay_holds_the_old_command_longer(plant):
    flown(plant, 5)
    late = plant.goes_on_as(SHOCKS["delay"](plant.craft, 0))
    u = plant._history[0][1]
    assert [(round(d, 6), c) for d, c in late._pieces(0.01)] == [(0.01, u)]
    late.step([0.9] * 4, 0.01)
    late.step([0.9] * 4, 0.01)
    assert late._pieces(0.01)[-1][1] == (0.9,) * 4


def test_the_path_runs_in_the_corner_and_its_derivatives_are_its_own():
    corner = Corner()
    times = np.linspace(0.0, 6.0, 50)
    path, step = corner.sample(times), 1e-5
    assert (path.position[:, 1] == 0.0).all() and (path.position[:, 2] == HEIGHT).all()
    later, sooner = corner.sample(times + step), corner.sample(np.maximum(times - step, 0.0))
    wide = (times + step - np.maximum(times - step, 0.0))[:, None]
    np.testing.assert_allclose((later.position - sooner.position) / wide, path.velocity, atol=1e-4)
    np.testing.assert_allclose(
        (later.velocity - sooner.velocity) / wide, path.acceleration, atol=1e-3
    )


def test_rows_count_time_beyond_and_a_lost_flight_is_beyond_for_good():
    away = np.zeros(1100)
    beyond = np.full(1100, -0.01)
    beyond[450:475] = 0.02
    row = row_of(beyond, away, 4.5, 1100)
    assert (row["lost"], row["before"], row["deepest"]) == (False, 0.0, 20.0)
    assert row["after"][:2] == [0.5, 0.0] and len(row["after"]) == WINDOWS == round(6.0 / WINDOW)
    assert back([row]) == WINDOW
    lost = row_of(beyond[:600], away[:600], 4.5, 1100)
    assert lost["lost"] and lost["after"][-1] == 1.0 and back([lost]) == np.inf
    rows = [r | {"shock": "wind", "controller": "tube", "descended": False} for r in (row, lost)]
    line = summary(rows).splitlines()[-1]
    assert "| wind | tube | 2 | 1, 0 |" in line and "| 1 (1 to 99 %) |" in line
    assert LEVEL < 0.5 < BACK
