"""Stopping: how long a plan must be to hold a plane in front of a craft that flies towards it.

Toward the tilt theta that it may take (the limit of tilt, and where all thrust still carries it) a
craft turns with all that its commands give, and then brakes with a = g tan(theta). Turning there
and back in the shortest way it has half of theta at half of that time, so that in the mean it
brakes as if it did so from that moment on:

    T = 2 dt + t(theta / 2) + v / a,

t from the model, lags and delays in it; dt twice, as a plane comes into sight between two plans and
the last command of a plan moves nothing yet. A plan shorter than T sees the plane too late.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from greybox.frames import GRAVITY, numeric
from greybox.model.layer import physics_of
from greybox.symbolic import FloatArray
from mpc_export.tube.controller import TubeController
from mpc_export.tube.stages import block

LONGEST = 1.0
"""A craft that does not tilt within this is not spoken of [s]."""


@dataclass(frozen=True, kw_only=True)
class Stopping:
    """`before`: time until the craft brakes [s]; `brakes`: how much [m/s^2]; `seconds`: length of
    the plan; `trained`: the largest speed along an axis seen in training [m/s], None where nothing
    says it."""

    before: float
    brakes: float
    seconds: float
    trained: float | None

    @property
    def speed(self) -> float:
        """From up to this the plan can stop [m/s]."""
        return max(0.0, (self.seconds - self.before) * self.brakes)

    def needed(self, speed: float, step: float) -> int:
        """Stages of `step` [s] that stopping from a speed [m/s] takes."""
        return math.ceil((self.before + speed / self.brakes) / step - 1e-9)


def stopping(pilot: TubeController) -> Stopping | None:
    """Of the pilot's plan; None for a model that does not tilt at once, hovers with all that it has,
    or has no rotors."""
    problem, rotors = pilot.problem, physics_of(pilot.model.dynamics)
    if rotors is None:
        return None
    hover = float(np.mean(pilot.solver.stages.steady[1]))
    to_hover, most = _thrust(pilot, hover), _thrust(pilot, problem.command_max)
    if not 0.0 < to_hover < most:
        return None
    tilt = min(problem.tilt_max, math.acos(to_hover / most))
    places = np.array([r.position for r in rotors.vehicle.rotors], dtype=float)
    turned = [_turned(pilot, sense, 0.5 * tilt) for sense in (places[:, 1], -places[:, 0])]
    if not max(turned) < LONGEST:
        return None
    return Stopping(
        before=max(turned) + pilot.model.sample_time + 2.0 * problem.dt,
        brakes=GRAVITY * math.tan(min(tilt, 1.5)),
        seconds=problem.dt * problem.horizon,
        trained=_trained(pilot),
    )


def _thrust(pilot: TubeController, command: float) -> float:
    """Thrust [N] of a rotor at a command, by the model's curve."""
    return sum(float(pilot.model.values[f"thrust.c{k}"]) * command**k for k in range(3))


def _turned(pilot: TubeController, lever: FloatArray, tilt: float) -> float:
    """Time [s] to a tilt from hover with the rotors on either side of an axis at their limits."""
    f, problem, (hover, u) = pilot.filter, pilot.problem, pilot.solver.stages.steady
    x = f.sampled.extended(hover[: f.own_states], pilot._column(u))[0]
    ends = np.array([problem.command_min, problem.command_max])
    lever = lever - lever.mean()
    command = np.where(np.abs(lever) < 1e-9, u, ends[(lever > 0).astype(int)])
    attitude, before = block(f, "attitude"), 0.0
    for k in range(math.ceil(LONGEST / f.dt)):
        x = f["f_d"](x, command, f.parameter_values).full().ravel()
        now = math.acos(min(1.0, float(numeric("matrix", x[attitude])[0, 8])))
        if not math.isfinite(now):
            break
        if now >= tilt:
            return f.dt * (k + (tilt - before) / (now - before))
        before = now
    return math.inf


def _trained(pilot: TubeController) -> float | None:
    """The largest speed along an axis [m/s]: as measured, else as the learned part saw it."""
    domain, learned = pilot.model.domain, pilot.functions.posterior
    ranges = [domain[n] for n in ("vx", "vy", "vz") if n in domain]
    if not ranges and learned is not None:
        names = learned.inputs.names
        ends = zip(names, learned.domain.lower, learned.domain.upper, strict=True)
        ranges = [(low, high) for n, low, high in ends if n.startswith("body_velocity.")]
    speeds = [abs(float(v)) for r in ranges for v in r if math.isfinite(v)]
    return max(speeds, default=None)
