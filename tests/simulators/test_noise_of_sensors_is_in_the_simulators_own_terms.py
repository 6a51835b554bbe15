"""What the model knows of its sensors' noise (white, Gauss-Markov, random walk, filter) stands in
sensors.toml, in the SDF's IMU and in Pegasus' YAML with the same numbers."""

from __future__ import annotations

import re
import tomllib
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np
import pytest

from greybox.model.identified import IdentifiedModel
from greybox.model.noise import Coloured, Drift, LowPass, with_parts
from greybox.simulators.make import twin
from tests.simulators.identified import Array, identified

SIGMA, TIME, WALK, CUT = 0.03, 0.2, 4e-4, 0.004


def noisy() -> IdentifiedModel:
    model = identified({"motor_lag.tau": 0.05, "gyro_bias.b_x": 0.02})
    parts = [Coloured(sensor="gyro"), Drift(sensor="accelerometer"), LowPass(sensor="gyro")]
    dynamics = with_parts(model.dynamics, parts)
    kept = np.exp(-model.sample_time / TIME)
    level = {"coloured": SIGMA * np.sqrt(1 - kept**2), "drift": WALK, "low_pass": 0.01}
    extra = dynamics.noises.names[len(model.dynamics.noises) :]
    own = {"coloured.gyro.T": TIME, "low_pass.gyro.T": CUT}
    return replace(
        model,
        dynamics=dynamics,
        values=type(model.values)({**model.values, **own}),
        process_noise=np.concatenate(
            [model.process_noise, [level[n.split(".")[0]] for n in extra]]
        ),
    )


def dynamic_bias(stddev: float, tau: float, dt: float) -> Array:
    """The bias of gz-sensors' GaussianNoiseModel, 2000 sensors after five times tau."""
    random, bias = np.random.default_rng(1), np.zeros(2000)
    step = np.sqrt(-(stddev**2) * tau / 2 * np.expm1(-2 * dt / tau))
    for _ in range(round(5 * tau / dt)):
        bias = np.exp(-dt / tau) * bias + step * random.standard_normal(2000)
    return bias


def test_colour_walk_and_filter_are_written() -> None:
    model = noisy()
    files = twin(model, ["gazebo", "isaac"]).files
    said = tomllib.loads(str(files["gazebo/sensors.toml"]))
    assert said["gyro"]["coloured"] == pytest.approx({"sigma": SIGMA, "T": TIME})
    assert said["gyro"]["low_pass"]["cutoff"] == pytest.approx(1 / (2 * np.pi * CUT))
    walk = WALK / np.sqrt(model.sample_time)
    assert said["accelerometer"]["drift"]["sigma"] == pytest.approx(walk)
    root = ElementTree.fromstring(str(files["gazebo/model.sdf"]))
    axis = next(root.iter("angular_velocity")).find("x/noise")
    assert axis is not None
    numbers = {e.tag: float(str(e.text)) for e in axis}
    assert numbers["dynamic_bias_correlation_time"] == pytest.approx(TIME)
    stationary = dynamic_bias(numbers["dynamic_bias_stddev"], TIME, model.sample_time).std()
    assert stationary == pytest.approx(SIGMA, rel=0.03)
    assert numbers["mean"] == pytest.approx(0.02)
    assert numbers["bias_mean"] == 0.0, "its sign is drawn when the sensor is loaded"
    walks = re.findall(r"random_walk: (\S+)", str(files["isaac/pegasus.yaml"]))
    assert [float(w) for w in walks] == pytest.approx([0.0, walk])
