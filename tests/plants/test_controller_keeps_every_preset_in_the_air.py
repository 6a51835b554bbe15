"""The cascade controller flies every preset along every reference, from noisy measurements, with
its loops excited."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.excitation import (
    Circle,
    FigureEight,
    Hover,
    Lemniscate,
    RandomWaypoints,
    rich_excitation,
)
from greybox.plants.airframe import Airframe
from greybox.plants.controller import CascadeController
from greybox.plants.effects import BatterySag, CommandDelay, MotorLag, RotorAsymmetry, RotorDrag
from greybox.plants.flight_log import fly
from greybox.plants.presets import DEFAULT, SOFT, STIFF, controller_for, duckiedrone, nano, x250

EFFECTS = (MotorLag(tau=0.03), CommandDelay(d=0.01), RotorDrag(k_x=1e-6, k_y=1e-6))


def deviation(log, goal):
    return np.sqrt(np.mean((np.stack([log[c] for c in "xyz"], axis=-1) - goal) ** 2))


@pytest.mark.parametrize(
    ("make", "gains"),
    [
        (nano, DEFAULT),
        (nano, SOFT),
        (x250, DEFAULT),
        (x250, STIFF),
        (duckiedrone, DEFAULT),
        *(
            pytest.param(m, g, marks=pytest.mark.slow)
            for m, g in ((nano, STIFF), (x250, SOFT), (duckiedrone, SOFT), (duckiedrone, STIFF))
        ),
    ],
)
def test_hover_with_excitation_for_several_seeds(make, gains):
    plant = make(EFFECTS)
    log = fly(
        plant, controller_for(plant, gains), Hover(), rich_excitation(0.5), 2.0, seed=[1, 2, 3]
    )
    assert deviation(log, np.array([0.0, 0.0, 1.0])) < 0.15
    assert all(np.all((log[f"u{i}"] >= 0) & (log[f"u{i}"] <= 1)) for i in range(1, 5))


@pytest.mark.parametrize(
    "reference",
    [Circle(), FigureEight(), Lemniscate(), RandomWaypoints(), Circle(yaw_rate=0.8)],
    ids=repr,
)
def test_references_are_followed(reference):
    plant = nano(EFFECTS)
    log = fly(plant, controller_for(plant), reference, None, 4.0, seed=4)
    goal = reference.sample(log["t"], np.random.default_rng([4, 1])).position
    assert deviation(log, goal) < 0.15
    assert np.ptp(log["x"]) > 0.5


def test_integrators_carry_a_wrong_mass_a_weak_rotor_and_a_falling_battery():
    plant = nano(
        (
            *EFFECTS,
            RotorAsymmetry(delta=(0.06, -0.06, 0.03, -0.03)),
            BatterySag(nominal_voltage=3.8, c_V=1.0),
        )
    )
    belief: Airframe = replace(plant.airframe, mass=0.9 * plant.airframe.mass)
    log = fly(plant, CascadeController(belief), Hover(), None, 12.0, seed=2)
    late = log["t"] > 8.0
    assert np.abs(np.mean(log["z"][late]) - 1.0) < 0.05
    assert np.hypot(np.mean(log["x"][late]), np.mean(log["y"][late])) < 0.03
    assert log["vbat"][-1] < log["vbat"][0]


def test_feedback_of_the_true_state_is_offered():
    plant = nano()
    log = fly(plant, controller_for(plant, feedback="truth"), Hover(), None, 1.0, seed=1)
    assert deviation(log, np.array([0.0, 0.0, 1.0])) < 0.05
    with pytest.raises(ValueError, match="measured"):
        controller_for(plant, feedback="wishes")
