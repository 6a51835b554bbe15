"""What a craft of any simulator is made of: an airframe, rotors that lag, the air around it, and
what is hidden."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.plants.airframe import Airframe
from greybox.plants.battery import Battery
from greybox.plants.vectors import ZERO, Vector


@dataclass(frozen=True, kw_only=True)
class Air:
    """Drag and wind.

    rotor_drag and inflow [kg/rad]: force at a hub per rotor speed and airspeed, in the disc plane
    and along its axis. parasitic [N s^2/m^2]: drag of the body per axis, quadratic in airspeed.
    lift [N s^2/m^2] and flapping [kg m/rad]: thrust per squared airspeed in the disc plane and
    moment per rotor speed and airspeed (nose up in forward flight); RotorPy only.
    wind [m/s]: mean wind, world. gusts [m/s]: standard deviation of the wind on every axis about
    its mean. swirl [rad/s^2]: standard deviation of the angular acceleration that gusts cause by
    themselves. push [N] and turn [rad/s^2]: standard deviations per axis of a force and of an
    angular acceleration by which gusts act in every simulator, drag or not. gust_time [s]:
    correlation time of all of them.
    """

    rotor_drag: float = 0.0
    inflow: float = 0.0
    parasitic: Vector = ZERO
    lift: float = 0.0
    flapping: float = 0.0
    wind: Vector = ZERO
    gusts: float = 0.0
    swirl: float = 0.0
    push: float = 0.0
    turn: float = 0.0
    gust_time: float = 0.8


@dataclass(frozen=True, kw_only=True)
class Craft:
    """A craft before a simulator takes it.

    airframe: the true body (its centre of mass is the true one). lag [s]: time constant of the
    rotors. delay [s]: of the commands. uneven: shares by which the rotors' thrust and torque are
    off, of sum zero. battery: None means that commands do not feel the voltage; sag: how much rotor
    speed follows it (nu scales with 1 + sag (V - V0) / V0).
    """

    airframe: Airframe
    lag: float
    air: Air = Air()
    delay: float = 0.0
    uneven: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    battery: Battery | None = None
    sag: float = 0.0

    def __post_init__(self) -> None:
        if self.lag <= 0.0:
            raise ValueError(
                f"the simulators need rotors with a lag above zero, got {self.lag!r} s"
            )
        if len(self.uneven) != len(self.airframe.rotors):
            raise ValueError(
                f"{len(self.airframe.rotors)} rotors need as many shares, got {len(self.uneven)}"
            )
        if self.battery is not None and self.airframe.nominal_voltage is None:
            raise ValueError("a craft with a battery needs a nominal voltage")

    @property
    def speed_max(self) -> float:
        """Rotor speed at nu = 1 [rad/s]."""
        if self.airframe.speed_max is None:
            raise ValueError("foreign simulators need speed_max [rad/s]")
        return self.airframe.speed_max

    def parameters(self) -> dict[str, float]:
        """True values by the names of greybox's catalogue: what every simulator does exactly."""
        found = {name: float(value) for name, value in self.airframe.parameters().items()}
        found["motor_lag.tau"] = self.lag
        if self.delay:
            found["command_delay.d"] = self.delay
        if any(self.uneven):
            found |= {f"rotor_asymmetry.delta_{i}": d for i, d in enumerate(self.uneven, 1)}
        if self.sag:
            found["battery_sag.c_V"] = self.sag
        return found


def thrust_and_torque(
    frame: Airframe, strength: NDArray[np.float64], nu: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Thrust [N] and drag torque [N m] of every rotor (n,) of its strength (n,) at speeds nu
    (n,)."""
    thrust, torque = (
        strength * (c0 + nu * (c1 + nu * c2)) for c0, c1, c2 in (frame.thrust, frame.torque)
    )
    return thrust, torque
