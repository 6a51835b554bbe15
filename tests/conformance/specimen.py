"""What every conformance suite needs: one craft without any symmetry to hide behind, and numbers to
put into models."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np

from greybox.model.effects import CATALOGUE
from greybox.model.model import PhysicsModel
from greybox.model.sensors import SENSORS
from greybox.model.vehicle import Vehicle, read_vehicle
from greybox.plants.airframe import Rotor
from greybox.plants.presets import X250
from greybox.plants.quadrotor import Quadrotor
from greybox.plants.vehicle_file import write_vehicle

DT = 0.01

CROOKED = replace(
    X250,
    products=(2e-4, -1e-4, 1.5e-4),
    center_of_mass=(3e-3, -2e-3, 4e-3),
    imu_position=(0.02, -0.01, 0.015),
    rotors=(
        Rotor((0.09, -0.08, 0.01), 1),
        Rotor((-0.085, -0.09, 0.012), -1),
        Rotor((-0.095, 0.085, 0.009), 1),
        Rotor((0.08, 0.095, 0.011), -1),
    ),
    thrust=(0.02, 0.3, 4.0),
    torque=(1e-4, 4e-3, 0.05),
    nominal_voltage=3.8,
)


@cache
def crooked() -> Vehicle:
    """A 0.5 kg quadrotor whose every number that is often zero is not."""
    with tempfile.TemporaryDirectory() as folder:
        return read_vehicle(write_vehicle(Path(folder) / "v.toml", Quadrotor(CROOKED)))


def effects_under_test():
    """Parameters for pytest: every effect of the catalogue under its name."""
    import pytest

    return [pytest.param(e, id=e.name) for e in CATALOGUE]


def sensors_for_all():
    """All sensors (a log that has everything)."""
    return SENSORS


def model_with(*effects, **settings) -> PhysicsModel:
    """The crooked craft with these effects and all sensors."""
    return PhysicsModel(
        vehicle=crooked(), effects=tuple(effects), sensors=SENSORS, sample_time=DT, **settings
    )


def random_state(model, rng) -> np.ndarray:
    """A state in fast, tilted flight."""
    q = rng.normal(size=4)
    blocks = {
        "position": rng.normal(size=3),
        "velocity": 3 * rng.normal(size=3),
        "attitude": q / np.linalg.norm(q),
        "rate": 4 * rng.normal(size=3),
        "rotor": rng.uniform(0.3, 0.8, size=16),
    }
    letters = {"position": "xyz", "velocity": "xyz", "attitude": "wxyz", "rate": "xyz"}
    out = []
    for name in model.states.names:
        block, axis = name.replace("_shown", "").replace("_pull", "").split(".")
        out.append(blocks[block][letters[block].index(axis) if block in letters else int(axis) - 1])
    return np.array(out)


def random_window(model, rng) -> np.ndarray:
    """Commands near both limits too, and a voltage near the nominal one, for every sample of the
    model's window."""
    past, future = model.window
    window = rng.uniform(0.02, 0.98, size=(len(model.inputs), past + 1 + future))
    if "vbat" in model.inputs:
        window[model.inputs["vbat"]] = rng.uniform(3.3, 4.1)
    return window


def parameter_vector(model, values) -> np.ndarray:
    """The parameter vector with some values set, the others nominal."""
    return np.array([values.get(p.name, p.nominal) for p in model.parameters])


def at_null(effect, vehicle) -> dict[str, float]:
    """The effect's parameters at their null, under their full names."""
    return {f"{effect.name}.{p.name}": p.null for p in effect.parameters(vehicle)}


def at_random(effect, vehicle, rng) -> dict[str, float]:
    """The effect's parameters away from the null by about the size of a typical change, inside
    their bounds."""
    out = {}
    for p in effect.parameters(vehicle):
        value = p.nominal + p.scale * rng.uniform(0.3, 1.5) * (
            1 if p.lower == p.nominal else rng.choice([-1, 1])
        )
        out[f"{effect.name}.{p.name}"] = float(np.clip(value, p.lower, p.upper))
    return out


def function(model, which: str, kind=ca.SX):
    """f(x, u, p), h(x, u, p), step(x, U, p, w, dt) or output(x, U, p, w, dt) as a CasADi
    function."""
    x, p = kind.sym("x", len(model.states)), kind.sym("p", len(model.parameters))
    if which in ("f", "h"):
        u = kind.sym("u", len(model.inputs))
        return ca.Function(which, [x, u, p], [ca.densify(getattr(model, which)(0, x, u, p))])
    past, future = model.window
    window = kind.sym("U", len(model.inputs), past + 1 + future)
    w, dt = kind.sym("w", len(model.noises)), kind.sym("dt")
    return ca.Function(
        which, [x, window, p, w, dt], [ca.densify(getattr(model, which)(0, x, window, p, w, dt))]
    )


def column(result) -> np.ndarray:
    """A CasADi result as a flat array."""
    return np.asarray(result.full()).ravel()
