"""Vehicles for the tests of the model, as the simulated plants know them, and numbers in and out of
its expressions."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np

from greybox.model.model import PhysicsModel
from greybox.model.sensors import SENSORS
from greybox.model.vehicle import Vehicle, read_vehicle
from greybox.plants.airframe import Airframe, Rotor
from greybox.plants.presets import DUCKIEDRONE, X250
from greybox.plants.quadrotor import Quadrotor
from greybox.plants.vehicle_file import write_vehicle

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
)
"""No symmetry to hide behind: every number that is often zero is not."""
PLUS = DUCKIEDRONE
"""Rotor 1 front, 2 left, 3 back, 4 right; 1 and 3 clockwise."""


def vehicle_of(frame: Airframe) -> Vehicle:
    """The vehicle file of a simulated plant, read back."""
    with tempfile.TemporaryDirectory() as folder:
        return read_vehicle(write_vehicle(Path(folder) / "v.toml", Quadrotor(frame)))


def model_of(frame: Airframe, *effects: str, sensors=SENSORS, dt: float = 0.01) -> PhysicsModel:
    """A model of a plant's airframe with named effects."""
    return PhysicsModel(
        vehicle=vehicle_of(frame), sensors=tuple(sensors), sample_time=dt
    ).with_effect(*effects)


def sensors(*names: str):
    """Sensors by name, in the order of the output vector."""
    return tuple(s for s in SENSORS if s.name in names)


def vector(model, **values) -> np.ndarray:
    """Nominal parameters with some of them set; "motor_lag__tau" stands for motor_lag.tau."""
    changes = {k.replace("__", "."): v for k, v in values.items()}
    assert set(changes) <= {p.name for p in model.parameters}
    return np.array([changes.get(p.name, p.nominal) for p in model.parameters])


def function(model, which: str):
    """f(x, u, p), h(x, u, p), step(x, U, p, w, dt) or output(x, U, p, w, dt) as a CasADi
    function."""
    x, p = ca.SX.sym("x", len(model.states)), ca.SX.sym("p", len(model.parameters))
    if which in ("f", "h"):
        u = ca.SX.sym("u", len(model.inputs))
        return ca.Function(which, [x, u, p], [ca.densify(getattr(model, which)(0, x, u, p))])
    window = ca.SX.sym("U", len(model.inputs), sum(model.window) + 1)
    w, dt = ca.SX.sym("w", len(model.noises)), ca.SX.sym("dt")
    return ca.Function(
        which, [x, window, p, w, dt], [ca.densify(getattr(model, which)(0, x, window, p, w, dt))]
    )


def flat(value) -> np.ndarray:
    """A CasADi result as a flat array."""
    return np.asarray(ca.DM(value).full()).ravel()


def blocks(model, x) -> dict[str, np.ndarray]:
    """A state vector by block: position, velocity, attitude, rate, rotor."""
    out: dict[str, list[float]] = {}
    for name, value in zip(model.states.names, np.asarray(x), strict=True):
        out.setdefault(name.split(".")[0], []).append(value)
    return {k: np.array(v) for k, v in out.items()}


def state(model, **given) -> np.ndarray:
    """A state from blocks; at rest and level where nothing is given."""
    rest = {
        "position": [0, 0, 0],
        "velocity": [0, 0, 0],
        "attitude": [1, 0, 0, 0],
        "rate": [0, 0, 0],
        "rotor": [0.5] * 4,
    }
    values = rest | given
    for late in ("rotor_pull", "rotor_shown", "rotor_shown_pull"):
        values.setdefault(late, values["rotor"])
    counters: dict[str, int] = {}
    out = []
    for name in model.states.names:
        block = name.split(".")[0]
        out.append(values[block][counters.setdefault(block, 0)])
        counters[block] += 1
    return np.array(out, dtype=float)


def rotation(q) -> np.ndarray:
    """World from body, by the definition v' = q v q*, independent of the package's algebra."""
    w, x, y, z = q
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * skew + 2 * skew @ skew
