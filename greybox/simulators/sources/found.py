"""Found: what a simulator's file says of a craft, and the vehicle file made of it.

Numbers are written bare, so that a fit believes them within the default of their quantity: nobody
knows how sure a simulator's file is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from greybox.errors import VehicleError
from greybox.frames import GRAVITY
from greybox.symbolic import FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Found:
    """Body axes FLU from the body origin, SI units; `hubs` (n, 3), `spins` (n,), thrust and torque
    maps of nu (3,). `effects` maps effect.parameter to its value, `to_measure` says what the file
    does not know."""

    name: str
    mass: float
    inertia: FloatArray
    hubs: FloatArray
    spins: FloatArray
    thrust: tuple[float, float, float]
    torque: tuple[float, float, float]
    center_of_mass: FloatArray = field(default_factory=lambda: np.zeros(3))
    gravity: float = GRAVITY
    speed_max: float | None = None
    rotor_radius: float | None = None
    effects: Mapping[str, float] = field(default_factory=dict)
    noise: Mapping[str, float] = field(default_factory=dict)
    to_measure: tuple[str, ...] = ()

    @property
    def hover_nu(self) -> float:
        """Normalised speed at which equal rotors carry the weight. Raises `VehicleError`."""
        c0, c1, c2 = self.thrust
        need = self.mass * self.gravity / len(self.hubs) - c0
        root = c1 * c1 + 4.0 * c2 * need
        if c2 > 0.0 and root >= 0.0:
            nu = (-c1 + math.sqrt(root)) / (2.0 * c2)
        else:
            nu = need / c1 if c1 > 0.0 else math.nan
        if not nu > 0.0:
            raise VehicleError("the rotors cannot carry the craft", where=self.name)
        return nu

    def text(self, source: str) -> str:
        """The vehicle file (TOML, schema "greybox.vehicle/2")."""
        name = self.name.replace("\\", "/").replace('"', "'")
        lines = [
            f"# From {source}. Bare numbers are believed within the default of their quantity;",
            "# weigh and measure, and write what you know as { value = ..., sigma = ... }.",
            'schema = "greybox.vehicle/2"',
            f'name = "{name}"',
            f"gravity = {self.gravity!r}",
            f"mass = {self.mass!r}  # kg",
            f"inertia = {self.inertia.tolist()}  # kg m^2",
            f"center_of_mass = {[float(v) for v in self.center_of_mass]}  # m",
        ]
        for hub, spin in zip(self.hubs, self.spins, strict=True):
            lines += [
                "",
                "[[rotor]]",
                f"position = {[float(v) for v in hub]}  # m",
                f"spin = {int(spin)}",
            ]
        lines += ["", "[actuator]"]
        if self.rotor_radius is not None:
            lines.append(f"rotor_radius = {self.rotor_radius!r}  # m")
        if self.speed_max is not None:
            lines.append(f"speed_max = {self.speed_max!r}  # rad/s")
        lines.append(f"thrust = {[float(v) for v in self.thrust]}  # N, powers of nu")
        lines.append(f"torque = {[float(v) for v in self.torque]}  # N m")
        effects: dict[str, list[str]] = {}
        for full, value in self.effects.items():
            effect, parameter = full.split(".")
            effects.setdefault(effect, []).append(f"{parameter} = {value!r}")
        for effect, rows in effects.items():
            lines += ["", f"[effects.{effect}]", *rows]
        if self.noise:
            lines += ["", "[noise]", *(f"{k} = {v!r}" for k, v in self.noise.items())]
        return "\n".join(lines) + "\n"


def used(effects: Mapping[str, float]) -> dict[str, float]:
    """Without effects all of whose parameters are zero."""
    live = {n.split(".")[0] for n, v in effects.items() if v != 0.0}
    return {n: float(v) for n, v in effects.items() if n.split(".")[0] in live}
