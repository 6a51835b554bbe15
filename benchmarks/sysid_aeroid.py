"""A quadrotor as differential equations whose numbers AeroID fits: `pip install 'aeroid[jax]'`.

AeroID's `identify` takes one record and one model, and simulates from the record's start. So all
windows are one record: the states of every window side by side, with common parameters. It is its
output-error method with the exact slopes of JAX, its fastest. Its filter-error method, an extended
Kalman filter by finite differences, takes an hour for 20 s of one flight
(`benchmarks.innovation_fit`).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.sysid_windows import (
    COMPARED,
    REFITS,
    SAME,
    START_LAG,
    Window,
    numbers,
    rotors_at_start,
    scale_of,
)
from greybox.model.vehicle import Vehicle
from greybox.symbolic import FloatArray

RANGE = {"gain": (0.3, 3.0), "lag": (0.1, 5.0), "torque": (0.2, 5.0), "inertia": (0.1, 5.0)}
"""Bounds as factors of the start; damping may be anything from 0 to 50 times its start."""
MEASURED, TOGETHER = 13, 300
"""States that are measured, and how many windows are predicted at once: AeroID compares every name
with every other."""


class AeroidPeer:
    """Numbers of a quadrotor whose rotors lag: a gain per rotor, lag, drag torque, damping of
    motion and rotation, three moments of inertia. The mass is that of the file, or `mass` [kg]."""

    def __init__(self, vehicle: Vehicle, dt: float, mass: float | None = None) -> None:
        self.dt, self.gravity = dt, float(vehicle.gravity)
        v = numbers(vehicle)
        self.mass = mass or v["mass"]
        self.place = np.array([r.position for r in vehicle.rotors])
        self.spin = np.array([float(r.spin) for r in vehicle.rotors])
        ratio = sum(v[f"torque.c{k}"] for k in range(3)) / sum(v[f"thrust.c{k}"] for k in range(3))
        self.values = {f"gain{i}": 1.0 for i in range(len(self.spin))}
        self.values |= {"lag": START_LAG, "torque": ratio, "damping.along": self.mass}
        self.values |= {f"inertia.{a}": v[f"inertia.{a}{a}"] for a in "xyz"}
        self.values |= {"damping.around": v["inertia.xx"], "damping.yaw": v["inertia.zz"]}
        self.bounds = {
            n: tuple(f * x for f in RANGE.get(n.rstrip("0123456789").split(".")[0], (0.0, 50.0)))
            for n, x in self.values.items()
        }
        self.stderr: dict[str, float] = {}

    def derivative(self, state: Any, command: Any, p: Any) -> Any:
        """Rates of change (windows, 13 + rotors) under thrusts that are asked for (windows,
        rotors); arrays of NumPy or JAX."""
        xp = state.__array_namespace__()
        q, velocity, rate, asked = (state[:, i:j] for i, j in ((3, 7), (7, 10), (10, 13), (13, 99)))
        thrust = asked * xp.stack([p[f"gain{i}"] for i in range(len(self.spin))])
        w, x, y, z = q.T
        up = xp.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x**2 + y**2)], axis=1)
        force = thrust.sum(axis=1)[:, None] * up - p["damping.along"] * velocity
        moments = xp.stack([p[f"inertia.{a}"] for a in "xyz"])
        slow = xp.stack([p["damping.around"], p["damping.around"], p["damping.yaw"]])
        torque = xp.stack(
            [
                thrust @ self.place[:, 1],
                -thrust @ self.place[:, 0],
                -p["torque"] * (thrust @ self.spin),
            ],
            axis=1,
        )
        torque -= slow * rate + xp.cross(rate, moments * rate)
        a, b, c = rate.T
        turning = xp.stack(
            [
                -x * a - y * b - z * c,
                w * a + y * c - z * b,
                w * b - x * c + z * a,
                w * c + x * b - y * a,
            ],
            axis=1,
        )
        fall = force / self.mass - np.array([0.0, 0.0, self.gravity])
        lagging = (command - asked) / p["lag"]
        return xp.concatenate([velocity, 0.5 * turning, fall, torque / moments, lagging], axis=1)

    def problem(self, windows: Sequence[Window]) -> tuple[Any, Any, FloatArray]:
        """(model, record, initial state) of all windows side by side."""
        import aeroid

        count, rotors = len(windows), len(self.spin)
        states = [f"x{i}_{k}" for i in range(count) for k in range(MEASURED + rotors)]
        controls = [f"u{i}_{k}" for i in range(count) for k in range(rotors)]

        def dynamics(_t: Any, x: Any, u: Any, p: Any) -> Any:
            shaped = x.reshape(count, -1), u.reshape(count, -1)
            return self.derivative(*shaped, p).reshape(-1)

        model = aeroid.Model(
            states=states,
            controls=controls,
            parameters=self.values,
            dynamics=dynamics,
            name="quadrotor",
        )
        asked = np.hstack([w.commanded for w in windows])
        start = np.concatenate(
            [np.r_[w.measured[0], rotors_at_start(w, self.dt, self.values["lag"])] for w in windows]
        )
        seen = {
            f"x{i}_{k}": w.measured[:, k] for i, w in enumerate(windows) for k in range(MEASURED)
        }
        record = aeroid.FlightData(
            time=self.dt * np.arange(len(asked)),
            channels=seen | dict(zip(controls, asked.T, strict=True)),
        )
        return model, record, start

    def fit(self, windows: Sequence[Window]) -> None:
        """Least squares over all windows, again until the rotors start by the lag that is found."""
        import aeroid

        scale = scale_of(windows)
        # half of a small rotation vector is what the quaternion's components change by
        size = np.r_[scale[:3], np.full(4, 0.5 * np.sqrt(np.mean(scale[6:9] ** 2)))]
        size = np.r_[size, scale[3:6], scale[9:]]
        weights = {f"x{i}_{k}": 1.0 / size[k] for i in range(len(windows)) for k in range(MEASURED)}
        for _ in range(REFITS):
            model, record, start = self.problem(windows)
            before = self.values["lag"]
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", aeroid.IdentifiabilityWarning)
                found = aeroid.identify(
                    model,
                    record,
                    list(self.values),
                    bounds=self.bounds,
                    gradient="jax",
                    outputs=list(weights),
                    weights=weights,
                    x0=start,
                )
            self.values, self.stderr = found.parameters, found.stderr
            if abs(self.values["lag"] / before - 1.0) < SAME:
                break

    def estimates(self) -> dict[str, dict[str, float]]:
        """Lag and moments of inertia: value and std, as a table of a fit.json."""
        own = ("lag", *(f"inertia.{a}" for a in "xyz"))
        return {
            name: {"value": self.values[n], "std": self.stderr[n]}
            for name, n in zip(COMPARED, own, strict=True)
        }

    def predict(self, windows: Sequence[Window]) -> FloatArray:
        """States (windows, H, 13)."""
        import aeroid

        told = []
        for i in range(0, len(windows), TOGETHER):
            some = windows[i : i + TOGETHER]
            model, record, start = self.problem(some)
            asked = record.array(model.controls)
            states = aeroid.simulate_rk4(model, record.time, asked, start).states
            told.append(states.reshape(len(states), len(some), -1)[1:, :, :MEASURED].swapaxes(0, 1))
        return np.concatenate(told)
