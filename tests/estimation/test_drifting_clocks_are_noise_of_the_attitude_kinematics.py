"""Noise on the attitude kinematics, and held sensor levels: the gradient is exact, the model file
keeps the choice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.data import Dataset, Flight, Segment
from greybox.estimation.criteria.gaussian import Gaussian
from greybox.estimation.fit import fit, noise_of
from greybox.estimation.predictors.innovation import Innovation
from greybox.estimation.problem import make_problem
from greybox.examples import vehicle_path
from greybox.model.identified import IdentifiedModel
from greybox.model.model import build_model
from greybox.model.vehicle import read_vehicle

COLUMNS = ("x", "y", "z", "qw", "qx", "qy", "qz", "p", "q", "r")


def flight(n: int = 60) -> Dataset:
    rng = np.random.default_rng(3)
    channels = {c: 1e-3 * rng.standard_normal(n) for c in COLUMNS}
    channels["qw"] = np.ones(n)
    channels |= {f"u{i}": 0.849 + 0.01 * rng.standard_normal(n) for i in range(1, 5)}
    return Dataset(
        flights=(
            Flight(
                name="f", segments=(Segment(t=0.01 * np.arange(n), channels=channels, flight="f"),)
            ),
        )
    )


def model():
    vehicle = read_vehicle(vehicle_path("nanobench"))
    return build_model(vehicle, COLUMNS, ("pose_delay",), kinematic_noise=True)


def test_the_gradient_is_exact_with_held_sensor_levels() -> None:
    problem = make_problem(
        model(),
        flight(),
        predictor=Innovation(),
        criterion=Gaussian(),
        estimate_noise="process",
        use_compiler=False,
    )
    names = [u.name for u in problem.unknowns if u.kind == "noise"]
    assert names[-3:] == ["noise.process.turn.x", "noise.process.turn.y", "noise.process.turn.z"]
    assert not any(n.startswith("noise.sensor") for n in names)
    theta = problem.start
    value = problem.evaluate(theta)
    for i, u in enumerate(problem.unknowns):
        if u.kind != "noise" and u.name != "pose_delay.d":
            continue
        step = np.zeros(problem.n)
        step[i] = 1e-5 * u.scale
        slope = (
            problem.evaluate(theta + step, 0).cost - problem.evaluate(theta - step, 0).cost
        ) / (2 * step[i])
        assert abs(slope - value.gradient[i]) < 1e-4 * max(abs(slope), 1.0 / u.scale), u.name


@pytest.mark.slow
def test_a_fit_from_an_innovation_fit_keeps_its_noise_levels() -> None:
    result = fit(
        model(),
        flight(200),
        predictor="multi-step",
        initialisation="innovation",
        estimate_noise="process",
        free=("thrust.c2",),
        use_compiler=False,
    )
    levels = noise_of(result.model)
    assert levels["noise.sensor.position.x"] == 0.0003
    assert levels["noise.process.turn.x"] != 0.1
    assert set(result.parameters) == {"thrust.c2"}


def test_the_model_file_keeps_the_kinematic_noise(tmp_path) -> None:
    dynamics = model()
    n = len(dynamics.error_states)
    saved = IdentifiedModel(
        dynamics=dynamics,
        values=nominal(dynamics),
        process_noise=dynamics.noise_scale(0.01),
        sensor_noise=dynamics.sensor_scale(),
        weak=np.full(n, 10.0),
        reference_state=dynamics.reference({}),
        reference_inputs=np.full(4, 0.85),
        sample_time=0.01,
    )
    again = IdentifiedModel.load(saved.save(tmp_path / "m.json"))
    assert again.dynamics.noises.names == dynamics.noises.names
    assert replace(dynamics, kinematic_noise=False).noises.names == dynamics.noises.names[:6]


def nominal(dynamics):
    from greybox.model.parameter import nominal_values

    return nominal_values(dynamics.parameters)
