"""pushes.py: what pushes a craft about and has no name, as a force and a moment that are applied
from outside.

No simulator has a term for it; every simulator takes an external wrench.
"""

from __future__ import annotations

from dataclasses import dataclass

from greybox.model.noise import disturbances, gauss_markov
from greybox.simulators.craft import Craft

_GROUPS = ("force", "torque")
_TEXT = '''"""What pushes {title} about and has no name: written by greybox twin, needs NumPy only.

    pushes = Pushes(seed=1)                           # of a flight, as strong and as slow as the fit found them
    pushes = Pushes(force=[...], moment=[...])        # only one that is known now, and fades
    force, moment = pushes.step(dt, rate)             # body axes, over the next dt seconds

`rate` (3,) is the body's [rad/s]: a push that stands still in the world (its share is FORCE_WORLD or MOMENT_WORLD) turns
against it. Apply both at the centre of mass. White noise beside them, and what was learned, are not in it.
"""

import numpy as np

FORCE, FORCE_TIME = np.array({force}), {force_time!r}  # N, standard deviation of each axis; s
MOMENT, MOMENT_TIME = np.array({moment}), {moment_time!r}  # N m; s
FORCE_WORLD, MOMENT_WORLD = {force_world!r}, {moment_world!r}


class Pushes:
    """Force [N] and moment [N m] (3,) that fade as exp(-t/T). With a seed new ones come, so that their strength stays;
    without one they start at `force` and `moment` (zero by default) and die away."""

    def __init__(self, force=None, moment=None, seed=None):
        self._random = None if seed is None else np.random.default_rng(seed)
        self._now = [self._first(force, FORCE), self._first(moment, MOMENT)]

    def _first(self, given, sigma):
        if given is not None:
            return np.array(given, dtype=float)
        return np.zeros(3) if self._random is None else sigma * self._random.standard_normal(3)

    def step(self, dt, rate=(0.0, 0.0, 0.0)):
        """Those of the next dt [s], in which they are held."""
        held = tuple(p.copy() for p in self._now)
        own = zip(self._now, (FORCE, MOMENT), (FORCE_TIME, MOMENT_TIME), (FORCE_WORLD, MOMENT_WORLD))
        for push, sigma, time, world in own:
            kept = np.exp(-dt / time)
            push *= kept
            half = -0.5 * dt * world * np.asarray(rate, dtype=float)
            push += 2 / (1 + half @ half) * np.cross(half, push + np.cross(half, push))
            if self._random is not None:
                push += sigma * np.sqrt(1.0 - kept * kept) * self._random.standard_normal(3)
        return held
'''


@dataclass(frozen=True, kw_only=True)
class _Push:
    """Standard deviation per axis, in the unit of the push, correlation time [s], and the share of
    the craft's turning that it does not follow."""

    sigma: list[float]
    time: float
    world: float = 0.0


def push_text(craft: Craft) -> str | None:
    """The module for this craft; None where its model has no unexplained push that lasts."""
    found = _pushes(craft)
    if not found:
        return None
    none = _Push(sigma=[0.0] * 3, time=1.0)
    force, moment = (found.get(g, none) for g in _GROUPS)
    return _TEXT.format(
        title=craft.title.replace("\\", "/").replace('"""', "'"),
        force=force.sigma,
        force_time=force.time,
        moment=moment.sigma,
        moment_time=moment.time,
        force_world=force.world,
        moment_world=moment.world,
    )


def _pushes(craft: Craft) -> dict[str, _Push]:
    model = craft.source
    names = model.dynamics.noises.names
    level = dict(zip(names, model.process_noise.tolist(), strict=True))
    out = {}
    for part in disturbances(model.dynamics):
        if part.group in _GROUPS:
            sigma = [
                gauss_markov.described(
                    level.get(f"{part.name}.{a}", 0.0), model.values, model.sample_time, part.name
                )["sigma"]
                for a in "xyz"
            ]
            time = float(model.values[f"{part.name}.T"])
            world = float(model.values.get(f"{part.name}.world", 0.0))
            out[part.group] = _Push(sigma=[float(v) for v in sigma], time=time, world=world)
    return out
