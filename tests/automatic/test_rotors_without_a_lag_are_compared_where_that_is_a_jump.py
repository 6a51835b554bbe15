"""A file with the rotors' angular momentum: without a lag they change speed in no time and push
nothing, with a very short one they do. Both are compared."""

from __future__ import annotations

import pytest

from greybox.automatic.decide import decide
from greybox.automatic.facts import facts_of
from greybox.automatic.fit import prepare
from greybox.automatic.setting import Given
from greybox.data import Dataset
from greybox.excitation.hover import Hover
from greybox.excitation.injection import rich_excitation
from greybox.model.vehicle import read_vehicle
from greybox.plants.effects import CommandDelay, MotorLag, RotorGyroscopic
from greybox.plants.flight_log import fly
from greybox.plants.presets import controller_for, nano
from greybox.plants.vehicle_file import write_vehicle
from tests.automatic.craft import flight


@pytest.mark.parametrize(("lag", "delay"), [(0.0, 0.0), (0.05, 0.0), (0.0, 0.02)])
def test_a_lag_is_taken_up_where_there_is_one(lag, delay, tmp_path):
    """Before, the momentum of rotors without a lag was fitted away, for a lag of 5 ms; beside a
    delay of the commands it still was, for one of 1 ms."""
    own = [*([MotorLag(tau=lag)] if lag else []), *([CommandDelay(d=delay)] if delay else [])]
    plant = nano([RotorGyroscopic(J_r=3e-7), *own])
    path = write_vehicle(
        tmp_path / "v.toml",
        plant,
        sigma={"inertia": 0.2, "thrust.c2": 0.2},
        known=("rotor_gyroscopic",),
        schema="greybox.vehicle/2",
    )
    craft, parts = read_vehicle(path), []
    for seed in (1, 2):
        flown = fly(
            plant, controller_for(plant), Hover(), rich_excitation(), 8.0, seed=seed, warm_up=0.5
        )
        parts += flight(flown, f"run{seed}").flights
    ready = prepare(craft, Dataset(flights=tuple(parts)))
    found = decide(craft, ready.data, facts_of(ready.data, craft, ready.report), Given())
    assert ("motor_lag" in found.recipe.effect_names) is (lag > 0)
    (said,) = [d for d in found.decisions if d.about == "effects"]
    assert "no lag" in said.reason
    assert found.candidate is not None
    momentum = found.candidate.fit.parameters["rotor_gyroscopic.J_r"]
    assert momentum.value == pytest.approx(3e-7, abs=4 * momentum.std)
