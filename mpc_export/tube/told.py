"""Told: run-time parameters whose present value comes from outside, such as the battery's voltage.

A value is used as long as the model can hover with it within the limits of its commands: that is
what it must be able to do, whatever was flown in training (`Told.low`, `Told.high`). Beyond the
training range it is used, and said.

Where none was told for PRESENT the value is not known. What it should be is then read off the push
along the thrust that the filter estimates, for thrust that is lost is no force: tilt and torque
lose as much, which no disturbance says, and a plan that counts on them swings until it is lost.
With g the change of the parameter that explains a push of 1 N at hover,

    p+ = p + g a d,   d+ = d - a d,   a = dt / SLOW,

so that the push moves into the parameter and their sum stays. A value that is told after T in the
dark hands back what it does not explain: d+ = d - (1 - exp(-T / SLOW)) (told - p) / g.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from greybox.frames import GRAVITY
from greybox.model.identified import IdentifiedModel
from greybox.symbolic import FloatArray
from mpc_export.functions import ModelFunctions

PRESENT = 5.0
"""For so long a value that was told counts as the present one [s]."""
SLOW = 2.0
"""Time constant at which a push goes over into a parameter that is not known [s]: slower than what
steers, faster than a battery."""
SPAN = 16.0
"""A value so many times the identified one, or a part of it as small, is in another unit."""
PART = 0.75
"""Part of the thrust that a plan counts on, below which, if it is thrust that was lost, the loops
have lost too much gain."""
SAMPLES = 17
"""Values at which the hover command is looked up."""
PUSH = "disturbance.force.z"
"""The push along the thrust."""


@dataclass(frozen=True, kw_only=True)
class Told:
    """A parameter: its row in p, name and unit; `reference`, the identified value; `low` and `high`,
    between which it can be used; `seen`, its range in training; `per_force`, what of it explains
    1 N along the thrust at hover, 0 where it does not move thrust; `values` (SAMPLES,) and `ratio`,
    the hover command at the reference over that at each of them."""

    row: int
    name: str
    unit: str
    reference: float
    low: float
    high: float
    seen: tuple[float, float]
    per_force: float
    values: FloatArray
    ratio: FloatArray

    def says(self) -> str:
        """Name, unit and ranges in words."""
        low, high = self.seen
        trained = f"{low:.4g} to {high:.4g} in training" if math.isfinite(high - low) else ""
        used = f"{self.low:.4g} to {self.high:.4g} can be used"
        return f"{self.name} [{self.unit}]: {', '.join(filter(None, (used, trained)))}"


def heaviest(model: IdentifiedModel) -> float:
    """The push along the thrust [N] below which PART of what a plan counts on would be left, if it
    is thrust that was lost."""
    return float(model.values["mass"]) * GRAVITY * (1.0 - 1.0 / PART)


def told(
    model: IdentifiedModel,
    f: ModelFunctions,
    steady: tuple[FloatArray, FloatArray],
    limits: tuple[float, float],
) -> tuple[Told, ...]:
    """The parameters of `f`, functions of `model`, that are told, given its hover and the limits of
    its commands."""
    names = f.sampled.exogenous
    rows = [i for i, n in enumerate(f.parameters.names) if n in names]
    return tuple(_told(model, f, steady, limits, i) for i in rows)


def _told(
    model: IdentifiedModel,
    f: ModelFunctions,
    steady: tuple[FloatArray, FloatArray],
    limits: tuple[float, float],
    row: int,
) -> Told:
    signal, reference = f.parameters.signals[row], float(f.parameter_values[row])
    least, most = min(limits[0], steady[1].min()), max(limits[1], steady[1].max())

    def hovers(value: float) -> bool:
        u = _command(f, steady, row, value)
        return u is not None and bool((u >= least).all() and (u <= most).all())

    low, high = (_end(hovers, reference, by) for by in (1.0 / SPAN, SPAN))
    values = np.geomspace(low, high, SAMPLES)
    commands = [_command(f, steady, row, v) for v in values]
    ratio = [1.0 if u is None else float(steady[1].mean() / u.mean()) for u in commands]
    return Told(
        row=row,
        name=signal.name,
        unit=signal.unit,
        reference=reference,
        low=low,
        high=high,
        seen=model.domain.get(signal.name, (-math.inf, math.inf)),
        per_force=_per_force(f, steady, row, -1e-3 * float(model.values["mass"]) * GRAVITY),
        values=values,
        ratio=np.array(ratio),
    )


def _command(
    f: ModelFunctions,
    steady: tuple[FloatArray, FloatArray],
    row: int,
    value: float,
    push: float = 0.0,
) -> FloatArray | None:
    """The hover command (n_u,) with this value of a parameter, under a push along the thrust [N];
    None where there is none."""
    (x, u), p = (np.array(v, dtype=float) for v in steady), f.parameter_values.copy()
    p[row] = value
    if PUSH in f.states.names:
        x[f.states[PUSH]] = push
    with np.errstate(all="ignore"):
        for _ in range(30):
            found = f["target_step"](x, u, p, np.zeros(len(f.targets)))
            x, u, residual = (v.full().ravel() for v in found)
            if not (np.isfinite(x).all() and np.isfinite(u).all()):
                return None
            if residual[0] < 1e-9:
                return np.asarray(u)
    return None


def _end(hovers: Callable[[float], bool], reference: float, farthest: float) -> float:
    """The last value from `reference` toward `farthest` times it at which the model hovers."""
    steps = reference * np.geomspace(1.0, farthest, 2 * SAMPLES)
    last = next((k for k, v in enumerate(steps[1:]) if not hovers(v)), len(steps) - 1)
    near, far = float(steps[last]), float(steps[min(last + 1, len(steps) - 1)])
    for _ in range(12):
        middle = math.sqrt(near * far)
        near, far = (middle, far) if hovers(middle) else (near, middle)
    return near


def _per_force(
    f: ModelFunctions, steady: tuple[FloatArray, FloatArray], row: int, force: float
) -> float:
    """What of the parameter does as much to the hover command as 1 N along the thrust; by `force`
    and a hundredth of the parameter."""
    reference = float(f.parameter_values[row])
    other = _command(f, steady, row, 1.01 * reference)
    pushed = _command(f, steady, row, reference, force)
    if PUSH not in f.states.names or other is None or pushed is None:
        return 0.0
    by_value, by_force = (float((u - steady[1]).mean()) for u in (other, pushed))
    # what hardly moves thrust explains no push
    felt = abs(by_value) > 1e-3 * float(steady[1].mean())
    return by_force / force / by_value * 0.01 * reference if felt else 0.0


class Telling:
    """What is known in flight of the parameters of `told`."""

    def __init__(self, own: tuple[Told, ...], f: ModelFunctions) -> None:
        self.own = own
        names = f.states.names
        self._push = names.index(PUSH) if PUSH in names else None
        self.start()

    def start(self) -> None:
        """Nothing was told yet."""
        self._age = [math.inf for _ in self.own]
        self._flown = 0.0
        self._said: set[str] = set()

    def sees(
        self, dt: float, given: Mapping[str, float], p: FloatArray, x: FloatArray
    ) -> Iterator[str]:
        """Takes what is `given` by name, numbers that are not NaN, into p, and moves the push of the
        estimate x and p toward each other where nothing is; yields what is new to say."""
        now: set[str] = set()
        for k, one in enumerate(self.own):
            dark = min(self._age[k] - PRESENT, self._flown)
            self._age[k] += dt
            value, i = given.get(one.name, math.nan), one.row
            if one.low <= value <= one.high:
                if dark > 0.0:
                    self._moves(x, one, -(1.0 - math.exp(-dark / SLOW)) * (value - p[i]))
                p[i], self._age[k] = value, 0.0
            elif not math.isnan(value):
                now.add(f"{one.name} cannot be used")
            if self._age[k] > PRESENT:
                now.add(f"{one.name} is not known")
                if self._push is not None:
                    wanted = p[i] + dt / SLOW * one.per_force * x[self._push]
                    found = min(max(float(wanted), one.low), one.high)
                    self._moves(x, one, p[i] - found)
                    p[i] = found
            if not one.seen[0] <= p[i] <= one.seen[1]:
                now.add(f"{one.name} is beyond what was seen in training")
        self._flown += dt
        yield from sorted(now - self._said)
        self._said = now

    def _moves(self, x: FloatArray, one: Told, by: float) -> None:
        if self._push is not None and one.per_force:
            x[self._push] += by / one.per_force
