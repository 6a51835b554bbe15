"""A made-up but realistic fit, its flights and its validation, for looking at reports and for
testing them."""

from __future__ import annotations

import functools
import json
from typing import Any

import numpy as np
from scipy.signal import lfilter

from greybox.files import dump_json
from greybox.frames import numeric
from greybox.report.flight_section import ChannelSeries, FlightSeries
from greybox.report.replay import ORIGINS, Replay
from greybox.validation.coverage import LEVELS, interval_coverage
from greybox.validation.cross_correlation import cross_correlation
from greybox.validation.horizon import HorizonAccumulator
from greybox.validation.metrics import channel_metrics
from greybox.validation.whiteness import whiteness

FLIGHTS = (
    "B2_circle_fast_rep1",
    "B3_figure8_fast_rep1",
    "B5_helix_medium_rep2",
    "B7_oval_fast_rep1",
)
SHARED = {
    # name: (value, std, unit, prior value, prior sigma, prior influence)
    "mass": (0.0427, 0.0011, "kg", 0.0425, 0.003, 0.78),
    "inertia.xx": (1.83e-5, 4.1e-7, "kg m^2", 1.7e-5, 5e-6, 0.07),
    "inertia.yy": (1.91e-5, 4.4e-7, "kg m^2", 1.7e-5, 5e-6, 0.07),
    "inertia.zz": (3.05e-5, 1.6e-6, "kg m^2", 3.0e-5, 1e-5, 0.03),
    "thrust.c2": (0.1472, 0.0009, "N", 0.15, 0.03, 0.001),
    "torque.c2": (8.71e-4, 4.5e-5, "N m", 9e-4, 3e-4, 0.02),
    "motor_lag.tau": (0.0312, 0.0014, "s", 0.03, 0.02, 0.005),
    "command_delay.d": (0.0, None, "s", 0.01, 0.02, 0.4),
    "rotor_drag.k_x": (4.02e-3, 1.1e-4, "kg/rad", 0.0, 0.05, 0.0),
    "rotor_drag.k_y": (3.88e-3, 1.2e-4, "kg/rad", 0.0, 0.05, 0.0),
    "blade_flapping.k_flap": (-5.4e-5, 2.6e-6, "kg m/rad", 0.0, 0.01, 0.0),
    "rotational_damping.d_p": (6.1e-5, 4e-6, "N m s", 0.0, 0.001, 0.0),
}
UNITS = {
    "p": "rad/s",
    "q": "rad/s",
    "r": "rad/s",
    "ax": "m/s^2",
    "ay": "m/s^2",
    "az": "m/s^2",
    "x": "m",
    "y": "m",
    "z": "m",
}


def make_fit() -> dict[str, Any]:
    rng = np.random.default_rng(0)
    parameters: dict[str, Any] = {}
    for name, (value, std, unit, prior, sigma, share) in SHARED.items():
        parameters[name] = {
            "value": value,
            "std": std,
            "unit": unit,
            "scope": "shared",
            "prior": {"value": prior, "sigma": sigma},
            "at_bound": name == "command_delay.d",
            "prior_influence": share,
            "per_flight": {},
        }
    for name, unit, size in (
        ("gyro_bias.x", "rad/s", 0.01),
        ("accelerometer_bias.x", "m/s^2", 0.2),
        ("constant_force.x", "N", 0.005),
    ):
        values = {f: {"value": size * rng.standard_normal(), "std": 0.2 * size} for f in FLIGHTS}
        mean = float(np.mean([v["value"] for v in values.values()]))
        parameters[name] = {
            "value": mean,
            "std": 0.1 * size,
            "unit": unit,
            "scope": "flight",
            "prior": {"value": 0.0, "sigma": 3 * size},
            "at_bound": False,
            "prior_influence": 0.004,
            "per_flight": values,
        }
    names = list(parameters)
    k = len(names)
    root = rng.standard_normal((k, 2 * k))
    root[1] = root[2] + 0.2 * root[1]
    root[4] = -root[0] + 0.6 * root[4]
    matrix = np.corrcoef(root)
    return json.loads(
        dump_json(
            {
                "schema": "greybox.fit/1",
                "model": {
                    "name": "quadrotor",
                    "effects": [
                        "motor_lag",
                        "command_delay",
                        "rotor_drag",
                        "blade_flapping",
                        "rotational_damping",
                    ],
                    "states": [
                        "x",
                        "y",
                        "z",
                        "vx",
                        "vy",
                        "vz",
                        "qw",
                        "qx",
                        "qy",
                        "qz",
                        "p",
                        "q",
                        "r",
                    ],
                    "inputs": ["u1", "u2", "u3", "u4"],
                    "outputs": list(UNITS),
                },
                "settings": {
                    "predictor": "innovation form, extended Kalman filter",
                    "criterion": "Gaussian likelihood with priors",
                    "solver": "Levenberg-Marquardt, exact sensitivities",
                    "initialisation": "equation error",
                    "disturbance_states": True,
                },
                "status": {
                    "converged": True,
                    "code": "small_step",
                    "advice": "Converged: the last step changed no parameter by more than 0.1 % of "
                    "its std.",
                    "iterations": 17,
                    "seconds": 41.3,
                },
                "cost": {
                    "loglik": 183421.7,
                    "n_samples": 15520,
                    "n_parameters": 24,
                    "aic": -366795.4,
                    "bic": -366612.0,
                },
                "parameters": parameters,
                "noise": {
                    "gyro": {"value": 0.021, "std": 0.0004, "unit": "rad/s"},
                    "accelerometer": {"value": 0.16, "std": 0.003, "unit": "m/s^2"},
                    "disturbance_torque": {"value": 2.1e-5, "std": 1.3e-6, "unit": "N m"},
                },
                "correlations": {"names": names, "matrix": matrix},
                "unidentifiable": [
                    "mass and thrust.c2 only as a ratio: without a measured mass only their ratio "
                    "shows."
                ],
                "flights": [
                    {
                        "name": f,
                        "samples": 3880,
                        "seconds": 38.8,
                        "notes": ["take-off and landing cut"],
                        "sha256": "3f" * 32,
                    }
                    for f in FLIGHTS
                ],
                "warnings": ["B7_oval_fast_rep1: 41 samples of vbat are frozen; they were masked."],
                "data_hash": "sha256:" + "ab12" * 16,
                "versions": {
                    "greybox": "0.1.0",
                    "casadi": "3.8.2",
                    "numpy": "2.4.6",
                    "python": "3.11.7",
                },
                "command": "greybox fit --vehicle vehicle.toml --train B2.csv B3.csv --effects "
                "motor_lag --out fit",
            }
        )
    )


def make_flights(n: int = 3880) -> dict[str, FlightSeries]:
    rng = np.random.default_rng(1)
    flights = {}
    for i, name in enumerate(FLIGHTS):
        t = np.arange(n) * 0.01
        channels = {}
        for j, (channel, unit) in enumerate(UNITS.items()):
            clean = np.sin((0.9 + 0.2 * j) * t + i) * (1 + 0.5 * np.sin(0.31 * t)) + 0.2 * np.sin(
                9 * t
            ) * (j < 3)
            measured = clean + 0.05 * rng.standard_normal(n)
            measured[700:730] = np.nan
            drift = lfilter([0.02], [1, -0.98], rng.standard_normal(n))
            channels[channel] = ChannelSeries(
                measured=measured,
                unit=unit,
                one_step=clean + 0.01 * rng.standard_normal(n),
                ahead=clean + 1.5 * drift,
            )
        role = "test" if i < 2 else "train"
        flights[name] = FlightSeries(
            t=t, channels=channels, role=role, replay=make_replay(n * 0.01)
        )
    return flights


def make_replay(seconds: float) -> Replay:
    """A craft that flies a figure eight and leans into it; the model leaves it by 0.3 m and 10
    degrees in a second."""

    def poses(t: np.ndarray, off: np.ndarray) -> np.ndarray:
        place = np.column_stack(
            [2 * np.sin(0.7 * t), np.sin(1.4 * t) + 0.3 * off**2, 1.5 + 0.3 * np.sin(0.3 * t)]
        )
        angles = np.column_stack(
            [0.4 * np.sin(1.4 * t) + np.radians(10) * off, -0.3 * np.cos(0.7 * t), 0.2 * t]
        )
        return np.hstack([place, numeric("from_euler", angles)])

    step, k = 0.05, 20
    stride = max(0.1, seconds / ORIGINS)
    t = np.arange(0, seconds, step)
    origins = np.arange(0, seconds - 1 - stride, stride)
    grid = origins[:, None] + step * np.arange(k + 1)
    off = np.broadcast_to(step * np.arange(k + 1), grid.shape)
    predicted = poses(grid.ravel(), off.ravel()).reshape(*grid.shape, 7)
    return Replay(
        begin=0.0, step=step, stride=stride, measured=poses(t, 0 * t), predicted=predicted
    )


def make_validation() -> dict[str, Any]:
    return json.loads(_validation())


@functools.cache
def _validation() -> str:
    rng = np.random.default_rng(2)
    n, steps = 1500, 50
    h = np.arange(1, steps + 1)
    grow = {
        "model": (0.0008 * h**1.3, 0.004 * h**1.05, 0.003 * h**0.9, 0.05 * h**0.5),
        "persistence": (0.0085 * h, 0.0125 * h, 0.006 * h**0.85, 0.09 * h**0.6),
        "dead_reckoning": (0.0001 * h**1.35, 0.004 * h**0.75, 0.004 * h**0.55, None),
    }
    tables = {}
    for label, sizes in grow.items():
        accumulator = HorizonAccumulator(label=label, sample_time=0.01)
        predictions, references = {}, {}
        for g, size in zip(("position", "velocity", "rotation", "rate"), sizes, strict=True):
            if size is None:
                continue
            error = size[None, :, None] * rng.standard_normal((n, steps, 3)) / 1.6
            if g == "rotation":
                q = np.concatenate([np.ones((n, steps, 1)), error / 2], axis=2)
                predictions[g] = q / np.linalg.norm(q, axis=2, keepdims=True)
                references[g] = np.tile([1.0, 0, 0, 0], (n + steps, 1))
            else:
                predictions[g], references[g] = error, np.zeros((n + steps, 3))
        for name in FLIGHTS[:2]:
            accumulator.add(name, predictions, references, np.arange(n))
        tables[label] = accumulator.table()
    innovations = rng.standard_normal((3000, 6))
    innovations[:, 1] = lfilter([1], [1, -0.35], innovations[:, 1])
    inputs = lfilter([1], [1, -0.9], rng.standard_normal((3000, 4)), axis=0)
    innovations[2:, 5] += 0.06 * inputs[:-2, 0]
    names = ["p", "q", "r", "ax", "ay", "az"]
    result = {
        "schema": "greybox.validate/1",
        "model": {"name": "quadrotor", "file": "model.json"},
        "flights": [{"name": f, "samples": 3880, "seconds": 38.8} for f in FLIGHTS[:2]],
        "sample_time": 0.01,
        **tables["model"].to_dict([1, 10, 50]),
        "persistence": tables["persistence"].to_dict([1, 10, 50]),
        "dead_reckoning": tables["dead_reckoning"].to_dict([1, 10, 50]),
        "curves": {k: t.curve() for k, t in tables.items()},
        "adapted_on": {
            "seconds": 5.0,
            "flights": {f: {"gyro_bias.x": {"value": 0.01, "std": 0.002}} for f in FLIGHTS[:2]},
        },
        "one_step": {
            c: channel_metrics(
                np.sin(np.arange(3000) / 50),
                np.sin(np.arange(3000) / 50) + 0.02 * innovations[:, i],
                unit=UNITS[c],
            ).to_dict()
            for i, c in enumerate(names)
        },
        "whiteness": whiteness(innovations, names=names, fitted=2).to_dict(),
        "cross_correlation": cross_correlation(
            innovations, inputs, names=names, input_names=["u1", "u2", "u3", "u4"]
        ).to_dict(),
        "coverage": {
            c: [
                interval_coverage([innovations[:, i]], 1.0, nominal=level).to_dict()
                for level in LEVELS
            ]
            for i, c in enumerate(names)
        },
        "warnings": [],
    }
    return dump_json(result)
