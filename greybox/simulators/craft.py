"""Craft: an identified model as plain numbers, in the terms that simulators have.

Everything is read from the parameters of the catalogue's effects; what is not in the model has the
value that switches it off. Rotor speeds are Omega = speed_max nu [rad/s].
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from greybox.errors import ModelError
from greybox.model.effect import Effect
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import learned_push_of
from greybox.model.model import PhysicsModel
from greybox.model.noise import disturbances, gauss_markov
from greybox.model.rotors import hover_speed
from greybox.model.sensors import USUAL
from greybox.symbolic import BoolArray, FloatArray

COUNTED_SPEED = 1000.0
"""Full rotor speed [rad/s] that files are written with where the vehicle file states none: thrust,
torque and drag do not depend on the choice, since their coefficients are scaled with it."""
SHORTEST_LAG = 1e-3
"""Lag [s] of rotors that have none, where a simulator divides by it."""
TOLERANCE = 1e-9
"""Of the triangle inequality, as a share of the largest moment: rounding of a flat body's."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Craft:
    """The physics and its parameter values; all numbers of a simulator's file come from here.

    `physics` has every state (position, velocity, attitude, rate), whatever the log measured.
    `values` has each of its parameters by name, SI units. `pushes` says in words what the model has
    beside the physics: unexplained pushes with their size, a learned part. `source` is the model
    that the craft was taken from, with these.
    """

    physics: PhysicsModel
    values: Mapping[str, float]
    domain: Mapping[str, tuple[float, float]]
    sensor_noise: Mapping[str, float]
    sample_time: float
    source: IdentifiedModel
    pushes: str = ""

    @staticmethod
    def of(model: IdentifiedModel) -> Craft:
        """Raises `ModelError` for a model of another kind than a vehicle's, for one driven by
        measured rotor speeds, and for mass or inertia that no body has."""
        model = _levelled(model)
        physics = model.physics
        if physics.input == "speed":
            raise ModelError(
                f"{model.name} is driven by measured rotor speeds",
                expected="a model driven by commands",
                fix="log the commands and fit them, so that lag and command map are in the model",
            )
        usual = {s.name for s in USUAL}
        further = tuple(s for s in physics.sensors if s.name not in usual)
        full = replace(physics, sensors=(*USUAL, *further))
        values = {d.name: float(model.values[d.name]) for d in full.parameters}
        noise = dict(
            zip(model.dynamics.innovations.names, model.sensor_noise.tolist(), strict=True)
        )
        craft = Craft(
            physics=full,
            values=values,
            domain=model.domain,
            sensor_noise=noise,
            sample_time=model.sample_time,
            source=model,
            pushes=_pushes(model),
        )
        craft.check()
        return craft

    def check(self) -> None:
        """Raises `ModelError` where mass or inertia belong to no body."""
        if not self.mass > 0:
            raise ModelError(f"mass {self.mass:g} kg", expected="a positive mass")
        moments = np.asarray(np.linalg.eigvalsh(self.inertia))
        if not of_a_body(moments):
            said = ", ".join(f"{v:.3g}" for v in moments)
            raise ModelError(
                f"no body has the principal moments of inertia {said} kg m^2",
                expected="positive, the largest at most the sum of the other two",
                fix='fit again with schema = "greybox.vehicle/2" in the vehicle file, which keeps '
                "inertia to what a body can have",
            )

    # ---------------------------------------------------------------- names

    @property
    def title(self) -> str:
        """The vehicle's name as it stands in its file."""
        return self.physics.vehicle.name

    @property
    def name(self) -> str:
        """The vehicle's name as an identifier that XML, TOML and Python take."""
        plain = re.sub(r"[^a-z0-9]+", "_", self.title.lower()).strip("_")
        return plain if re.match(r"[a-z]", plain) else f"craft_{plain}".rstrip("_")

    @property
    def effects(self) -> dict[str, Effect]:
        """Effects of the model by name that are not switched off."""
        return {e.name: e for e in self.physics.effects if not self.is_null(e)}

    def is_null(self, effect: Effect) -> bool:
        """Whether all parameters of an effect stand at the values that switch it off."""
        rows = effect.parameters(self.physics.vehicle)
        return all(self.values[f"{effect.name}.{d.name}"] == d.null for d in rows)

    def get(self, name: str, default: float = 0.0) -> float:
        """A parameter by its full name, or `default` where the model has none of that name."""
        return float(self.values.get(name, default))

    def vector(self, prefix: str, axes: str = "xyz") -> FloatArray:
        """Parameters prefix + axis; zeros where the model has none."""
        return np.array([self.get(f"{prefix}{a}") for a in axes])

    # ---------------------------------------------------------------- body

    @property
    def gravity(self) -> float:
        """[m/s^2], downwards."""
        return float(self.physics.vehicle.gravity)

    @property
    def mass(self) -> float:
        """With what it carries [kg]."""
        return self.get("mass") * (1.0 + self.get("payload_mass.mu"))

    @property
    def inertia(self) -> FloatArray:
        """About the centre of mass, body axes (3, 3) [kg m^2]."""
        j = np.array(self.physics.vehicle.inertia, dtype=float)
        for i, a in enumerate(("xx", "yy", "zz")):
            j[i, i] = self.get(f"inertia.{a}")
        for name, i, k in (("Jxy", 0, 1), ("Jxz", 0, 2), ("Jyz", 1, 2)):
            extra = self.get(f"products_of_inertia.{name}")
            j[i, k] += extra
            j[k, i] += extra
        return j

    @property
    def center_of_mass(self) -> FloatArray:
        """From the body origin (3,) [m]."""
        return self.vector("center_of_mass.") + self.vector("center_of_mass_offset.c_")

    # ---------------------------------------------------------------- rotors

    @property
    def count(self) -> int:
        """Number of rotors."""
        return len(self.physics.vehicle.rotors)

    @property
    def hubs(self) -> FloatArray:
        """From the body origin (n, 3) [m]."""
        return np.array([r.position for r in self.physics.vehicle.rotors], dtype=float)

    @property
    def arms(self) -> FloatArray:
        """From the centre of mass (n, 3) [m]."""
        return self.hubs - self.center_of_mass

    @property
    def spins(self) -> FloatArray:
        """+1 counter-clockwise seen from above, -1 clockwise (n,)."""
        return np.array([r.spin for r in self.physics.vehicle.rotors], dtype=float)

    @property
    def speed_known(self) -> bool:
        """Whether the vehicle file says how fast the rotors turn."""
        return self.physics.vehicle.actuator.speed_max is not None

    @property
    def speed_max(self) -> float:
        """Rotor speed at nu = 1 [rad/s]; `COUNTED_SPEED` where it is not known."""
        return self.physics.vehicle.actuator.speed_max or COUNTED_SPEED

    def per_speed(self, name: str) -> float:
        """A coefficient per rad/s of rotor speed, in the speeds that files are written with."""
        return self.get(name) * self.physics.vehicle.omega_scale / self.speed_max

    @property
    def thrust(self) -> FloatArray:
        """c0, c1, c2 of one rotor, powers of nu [N]."""
        return np.array([self.get(f"thrust.c{k}") for k in range(3)])

    @property
    def torque(self) -> FloatArray:
        """c0, c1, c2 of one rotor, powers of nu [N m]."""
        return np.array([self.get(f"torque.c{k}") for k in range(3)])

    @property
    def strength(self) -> FloatArray:
        """Factor on thrust and torque of each rotor (n,)."""
        delta = [self.get(f"rotor_asymmetry.delta_{i}") for i in range(1, self.count)]
        return 1.0 + np.array([*delta, -sum(delta)])

    @property
    def hover_nu(self) -> float:
        """Normalised rotor speed at which equal rotors carry the weight. Raises `ModelError` where
        they cannot."""
        c0, c1, c2 = self.thrust
        need = self.mass * self.gravity / self.count - c0
        if c2 == 0.0:
            nu = need / c1 if c1 > 0 else math.nan
        else:
            root = c1 * c1 + 4.0 * c2 * need
            nu = (-c1 + math.sqrt(root)) / (2.0 * c2) if root >= 0 else math.nan
        if not nu > 0:
            raise ModelError(f"{self.title} cannot hover", fix="check thrust and mass of the model")
        return float(nu)

    @property
    def hover_command(self) -> float:
        """Command whose settled rotor speed is that of hover, at the nominal voltage."""
        nu, f = self.hover_nu, self.get("thrust_curve.f")
        return 2.0 * nu / (1.0 - f + math.sqrt((1.0 - f) ** 2 + 4.0 * f * nu))

    @property
    def lags(self) -> tuple[float, float]:
        """Time constants [s] of rotors that speed up, and that slow down."""
        tau, a = self.get("motor_lag.tau"), self.get("motor_lag_asymmetry.a")
        return tau * (1.0 - a), tau * (1.0 + a)

    def rates(self, shortest: float) -> tuple[float, float, float, float]:
        """(linear, quadratic) rate [1/s] of rotors that speed up, and that slow down: d nu/dt = c1
        (nu_ss - nu) + c2 (nu_ss^2 - nu^2), with lags of at least `shortest` [s]."""
        share = self.get("motor_lag_speed.s")
        hover = float(hover_speed(self.physics.vehicle, self.values)) if share else 1.0
        part = 0.5 * share / hover
        up, down = (1.0 / max(tau, shortest) for tau in self.lags)
        return (1.0 - share) * up, part * up, (1.0 - share) * down, part * down

    @property
    def command_range(self) -> tuple[float, float]:
        """Commands at which motors saturate."""
        low, high = self.stated_range
        low += self.get("command_saturation.a_lo")
        return low, high - self.get("command_saturation.a_hi")

    @property
    def stated_range(self) -> tuple[float, float]:
        """Range of a command in the vehicle file."""
        actuator = self.physics.vehicle.actuator
        return actuator.u_min, actuator.u_max

    @property
    def nominal_voltage(self) -> float | None:
        """Where thrust is what the map says [V]."""
        return self.physics.vehicle.nominal_voltage

    @property
    def rotor_radius(self) -> float | None:
        """[m], None where the vehicle file states none."""
        return self.physics.vehicle.actuator.rotor_radius

    def noise(self, names: tuple[str, ...]) -> FloatArray | None:
        """White noise per sample of these channels, None where one of them is not measured."""
        if not all(n in self.sensor_noise for n in names):
            return None
        return np.array([self.sensor_noise[n] for n in names])


def of_a_body(moments: FloatArray) -> BoolArray:
    """Whether principal moments (..., 3), smallest first, are positive and the largest is at most
    the sum of the other two, which it is for a flat body."""
    low, middle, high = (moments[..., k] for k in range(3))
    return np.asarray((low > 0) & (high <= low + middle + TOLERANCE * high))


def _levelled(model: IdentifiedModel) -> IdentifiedModel:
    """The same craft with its thrust level in the thrust and torque maps, which simulators have."""
    level = model.values.get("thrust_level.s", 0.0)
    if level == 0.0:
        return model
    maps = [f"{m}.c{k}" for m in ("thrust", "torque") for k in range(3)]
    more = {n: (1.0 + level) * model.values[n] for n in maps}
    there = replace(model, values=model.values.replace({**more, "thrust_level.s": 0.0}))
    share = model.values.get("motor_lag_speed.s", 0.0)
    if share == 0.0:
        return there
    # The lag is that about the speed that hovers, which is another one now.
    vehicle = model.physics.vehicle
    ratio = float(hover_speed(vehicle, there.values) / hover_speed(vehicle, model.values))
    rate = 1.0 + share * (ratio - 1.0)
    lag = {"motor_lag.tau": model.values["motor_lag.tau"] / rate}
    return replace(
        there, values=there.values.replace({**lag, "motor_lag_speed.s": share * ratio / rate})
    )


def _pushes(model: IdentifiedModel) -> str:
    """Disturbances with their standard deviation and time, and what was learned."""
    dynamics, dt = model.dynamics, model.sample_time
    level = dict(zip(dynamics.noises.names, model.process_noise.tolist(), strict=True))
    parts = []
    for part in disturbances(dynamics):
        names = [n for n in dynamics.noises.names if n.startswith(f"{part.name}.")]
        time = float(model.values[f"{part.name}.T"])
        share = gauss_markov.renewed(time, dt)
        sigma = math.sqrt(float(np.mean([level[n] ** 2 for n in names])) / share)
        unit = dynamics.noises.signals[dynamics.noises[names[0]]].unit
        parts.append(f"unexplained {part.group} {sigma:.2g} {unit} rms an axis over {time:.2g} s")
    learned = learned_push_of(dynamics)
    if learned is not None:
        parts.append("a learned push")
    return ", ".join(parts)
