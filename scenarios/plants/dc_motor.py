"""A DC motor with viscous and Coulomb friction, driven by voltage: a plant that is not a vehicle.

L di/dt = v - R i - k_e omega;  J domega/dt = k_e i - b omega - c tanh(omega / omega_s). Measured: current and speed.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True)
class DcMotorParameters:
    """Resistance [ohm], inductance [H], motor constant k_e [V s/rad = N m/A], inertia [kg m^2],
    viscous friction b [N m s/rad], Coulomb friction c [N m], and the speed omega_s [rad/s] over
    which it changes sign."""

    resistance: float = 1.2
    inductance: float = 0.02
    constant: float = 0.05
    inertia: float = 2.0e-4
    viscous: float = 1.0e-4
    coulomb: float = 0.01
    slip: float = 1.0


class DcMotor:
    """The motor as a plant: `reset(seed)`, `step(u, dt)`, `measure()`, `truth()`; u is the voltage
    [V].

    current_noise [A] and speed_noise [rad/s] are white sensor noise; torque_noise [N m s^0.5] is
    white process noise, constant over a sample with standard deviation q / sqrt(dt).
    """

    def __init__(
        self,
        parameters: DcMotorParameters | None = None,
        *,
        current_noise: float = 0.02,
        speed_noise: float = 0.3,
        torque_noise: float = 0.0,
        substep: float = 5e-4,
    ) -> None:
        self.values = parameters or DcMotorParameters()
        self.current_noise = current_noise
        self.speed_noise = speed_noise
        self.torque_noise = torque_noise
        self.substep = substep
        self.reset(0)

    def reset(self, seed: int = 0, *, current: float = 0.0, speed: float = 0.0) -> None:
        """Start anew at t = 0 with this current [A] and speed [rad/s]."""
        self._rng = np.random.default_rng(seed)
        self.time = 0.0
        self._current, self._speed, self._voltage = current, speed, 0.0
        self._noise = self._rng.standard_normal(2).tolist()

    def _rate(self, i: float, w: float, v: float, load: float) -> tuple[float, float]:
        p = self.values
        friction = p.viscous * w + p.coulomb * math.tanh(w / p.slip)
        return (v - p.resistance * i - p.constant * w) / p.inductance, (
            p.constant * i - friction + load
        ) / p.inertia

    def step(self, u: float, dt: float) -> None:
        """Hold the voltage u [V] for dt [s]."""
        self._voltage = float(u)
        load = self.torque_noise / math.sqrt(dt) * float(self._rng.standard_normal())
        count = max(1, math.ceil(dt / self.substep - 1e-6))
        h = dt / count
        i, w = self._current, self._speed
        for _ in range(count):
            a1, b1 = self._rate(i, w, self._voltage, load)
            a2, b2 = self._rate(i + 0.5 * h * a1, w + 0.5 * h * b1, self._voltage, load)
            a3, b3 = self._rate(i + 0.5 * h * a2, w + 0.5 * h * b2, self._voltage, load)
            a4, b4 = self._rate(i + h * a3, w + h * b3, self._voltage, load)
            i += h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
            w += h / 6.0 * (b1 + 2.0 * b2 + 2.0 * b3 + b4)
        self._current, self._speed = i, w
        self.time += dt
        self._noise = self._rng.standard_normal(2).tolist()

    def measure(self) -> dict[str, float]:
        """t [s], u [V], current [A], speed [rad/s]; repeating the call gives the same noise."""
        return {
            "t": self.time,
            "u": self._voltage,
            "current": self._current + self.current_noise * self._noise[0],
            "speed": self._speed + self.speed_noise * self._noise[1],
        }

    def truth(self) -> dict[str, Any]:
        """True `parameters` and `states`."""
        return {
            "parameters": asdict(self.values),
            "states": {"current": self._current, "speed": self._speed},
        }

    def run(
        self, voltage: NDArray[np.float64], dt: float, seed: int = 0
    ) -> dict[str, NDArray[np.float64]]:
        """Record an experiment from rest: voltage (N,) [V], each held dt [s]; columns t, u,
        current, speed, (N,)."""
        self.reset(seed)
        rows = []
        for u in voltage:
            seen = self.measure()
            rows.append((seen["t"], float(u), seen["current"], seen["speed"]))
            self.step(float(u), dt)
        return dict(zip(("t", "u", "current", "speed"), np.array(rows).T.copy()))
