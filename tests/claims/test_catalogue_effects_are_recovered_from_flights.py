"""An effect that a simulated craft has is found at its true size, within its error bars, by a fit
that asks for it."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest
import scipy.stats

from greybox import build_model, dataset_from_arrays, fit
from greybox.excitation.injection import rich_excitation
from greybox.excitation.waypoints import RandomWaypoints
from greybox.model.vehicle import read_vehicle
from greybox.plants.airframe import Airframe
from greybox.plants.effects import CATALOGUE
from greybox.plants.effects.base import PlantEffect
from greybox.plants.flight_log import fly, member
from greybox.plants.presets import controller_for
from greybox.plants.quadrotor import Quadrotor
from greybox.plants.vehicle_file import write_vehicle
from scenarios.studies.recovery import EFFECTS, plant

PLANTS = {e.name: e for e in CATALOGUE}
LOW = RandomWaypoints(center=(0.0, 0.0, 0.12), box=(1.0, 1.0, 0.06))
CASES = {
    "motor_lag_asymmetry": {"a": 0.3},
    "motor_lag_speed": {"s": 0.5},
    "motor_lag_second": {"b": 0.6},
    "command_saturation": {"a_hi": 0.35},
    "axial_inflow": {"k_z": 2e-6},
    "translational_lift": {"k_h": 2e-4},
    "ground_effect": {"k": 2.0},
    "linear_drag": {"d_x": 0.010, "d_y": 0.014, "d_z": 0.008},
    "parasitic_drag": {"c_x": 0.002, "c_y": 0.003, "c_z": 0.004},
    "steady_wind": {"w_x": 1.0, "w_y": -0.8, "w_z": 0.0},
    "products_of_inertia": {"Jxy": 1e-6, "Jxz": -1e-6, "Jyz": 1.5e-6},
    "payload_mass": {"mu": 0.15},
    "accelerometer_scale": {"s_x": 0.03, "s_y": -0.02, "s_z": 0.05},
    "accelerometer_lever_arm": {"r_x": 0.01, "r_y": -0.005, "r_z": 0.015},
    "gyro_scale": {"s_x": 0.03, "s_y": -0.02, "s_z": 0.05},
    "sensor_delay": {"d": 0.02},
    "pose_delay": {"d": 0.02},
    "rotor_speed_delay": {"d": 0.02},
    "rotor_speed_scale": {"s_1": 0.05, "s_2": -0.02, "s_3": 0.03, "s_4": 0.01},
}


def in_the_plant(name: str, airframe: Airframe) -> PlantEffect:
    """The plant's effect; it lists what each rotor has, and knows what the vehicle file states."""
    sizes = CASES[name]
    if name == "rotor_speed_scale":
        return PLANTS[name](s=tuple(sizes.values()))
    facts = {
        "ground_effect": {"rotor_radius": airframe.rotor_radius},
        "motor_lag_speed": {"hover": airframe.hover_speed},
    }
    return PLANTS[name](**sizes, **facts.get(name, {}))


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_the_true_size_is_within_the_error_bars(name: str) -> None:
    base, sizes = plant(), CASES[name]
    true_plant = Quadrotor(
        base.airframe,
        [*base.effects, in_the_plant(name, base.airframe)],
        sensors=base.sensors,
        process=base.process,
        sample_time=base.sample_time,
        substep=base.substep,
    )
    reference = LOW if name == "ground_effect" else RandomWaypoints()
    log = fly(
        true_plant,
        controller_for(true_plant),
        reference,
        rich_excitation(),
        8.0,
        seed=[40, 41],
        warm_up=1.0,
    )
    flights = []
    left_out = () if name.startswith("rotor_speed") else ("omega",)
    for i in range(2):
        one = {k: v for k, v in member(log, i).items() if not k.startswith(left_out)}
        flights.append(dataset_from_arrays(one.pop("t"), one, name=f"run{i}"))
    data = flights[0] + flights[1]
    with tempfile.TemporaryDirectory() as folder:
        vehicle = read_vehicle(write_vehicle(Path(folder) / "v.toml", Quadrotor(base.airframe)))
    model = build_model(vehicle, data.channels, [*EFFECTS, name], sample_time=0.01)
    # Down to one rotor radius the height decides the gain.
    result = fit(model, data, predictor="kalman" if name == "ground_effect" else "innovation")
    assert result.converged
    found = [result[f"{name}.{k}"] for k in sizes]
    squared = sum(((e.value - v) / e.std) ** 2 for e, v in zip(found, sizes.values(), strict=True))
    shown = {e.name: (e.value, e.std) for e in found}
    print(shown, f"chi-square {squared:.1f} of {len(found)}")
    assert squared < scipy.stats.chi2.ppf(0.9995, len(found)), shown
    assert min(e.std / abs(v) for e, v in zip(found, sizes.values(), strict=True) if v) < 0.1, (
        "a precise estimate"
    )
