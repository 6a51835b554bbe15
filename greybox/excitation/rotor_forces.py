"""Excitation rotor by rotor: thrust added to each, and to all of them together."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from greybox.excitation.injection import Excitation
from greybox.excitation.signal import Array, Signal
from greybox.plants.airframe import Airframe


@dataclass(frozen=True, kw_only=True)
class RotorForces:
    """Thrust [N] added to each rotor (`rotors`, one signal per rotor) on top of another excitation
    (`rest`).

    The controller takes wrenches, not rotor thrusts: the added thrusts enter as the specific force
    and the angular accelerations that they cause on `airframe`, which its mixer turns back into the
    same thrusts where rotors are four.
    """

    airframe: Airframe
    rotors: tuple[Signal, ...]
    rest: Excitation = field(default_factory=Excitation)

    def __post_init__(self) -> None:
        if len(self.rotors) != len(self.airframe.rotors):
            raise ValueError(
                f"{len(self.airframe.rotors)} rotors need as many signals, got {len(self.rotors)}"
            )

    def sample(self, time: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Signals at the times (N,): mixer (N, 4) and setpoint (N, 4) as `Excitation.sample` gives
        them."""
        seeds = rng.integers(0, 2**63, size=len(self.rotors) + 1)
        forces = np.stack(
            [s(time, np.random.default_rng(n)) for s, n in zip(self.rotors, seeds)], axis=-1
        )
        mixer, setpoint = self.rest.sample(time, np.random.default_rng(seeds[-1]))
        frame, hover = self.airframe, float(np.mean(self.airframe.hover_speed))
        (t0, t1, t2), (q0, q1, q2) = frame.thrust, frame.torque
        ratio = (q0 + hover * (q1 + hover * q2)) / (t0 + hover * (t1 + hover * t2))
        arms = np.array([r.position for r in frame.rotors]) - np.array(frame.center_of_mass)
        effect = np.stack(
            [
                np.full(len(arms), 1.0 / frame.mass),
                arms[:, 1] / frame.inertia[0],
                -arms[:, 0] / frame.inertia[1],
                np.array([-r.spin * ratio for r in frame.rotors]) / frame.inertia[2],
            ],
            axis=-1,
        )
        return mixer + forces @ effect, setpoint
