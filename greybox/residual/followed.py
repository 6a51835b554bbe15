"""Whether the pushes that a fit leaves without a name follow the motion: gusts do not, a missing
law does. And whether a force without a name helps to carry the craft.

The disturbance states of a fitted model take up what no parameter explains. Their smoothed values
are regressed on body velocity and rates in all flights but one, and foretold in that one. Most of
what a law gives is foretold; of gusts nothing is, although a craft in a loop answers them.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from greybox.automatic.changed import SHOWN, steady_share
from greybox.data import Dataset
from greybox.errors import GreyboxError
from greybox.frames import GRAVITY
from greybox.model.identified import IdentifiedModel
from greybox.model.noise import disturbances
from greybox.model.verdict import GroupSkill
from greybox.residual.discrepancy import GROUPS, Discrepancy, discrepancy_and_features
from greybox.residual.features import available
from greybox.symbolic import BoolArray, FloatArray

MOST = 0.5
"""Share of a push that the motion must foretell to be called its cause."""
FELT = 0.1
"""Share of the error ahead that the push must move the craft by to matter."""


@dataclass(frozen=True, kw_only=True)
class Followed:
    """A push of `group` ("force", "torque") of which the motion foretells `share`, and which moves
    `channel` by `change` in the time ahead, where the model errs by `error` (means of the norm, SI
    units)."""

    group: str
    share: float
    channel: str
    change: float
    error: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Pushes:
    """What the flights of `model` were pushed by without a name, in the `groups` that were judged,
    and the motion at every sample (`samples`, (n, n_in) of every segment)."""

    model: IdentifiedModel
    seen: Discrepancy
    samples: Sequence[FloatArray]
    groups: Sequence[str]

    def followed(self, errors: Mapping[str, float], ahead: float) -> tuple[Followed, ...]:
        """Those that follow the motion and matter. `errors`: mean error of the model by channel
        group, `ahead` [s] ahead. A push that moves the craft by more than the model errs is refuted
        by that."""
        return tuple(
            found
            for group in self.groups
            if (share := _foretold(self.seen, _columns(self.seen, group))) > MOST
            for found in _felt(self.model, self.seen, self.samples, group, share, errors, ahead)
        )

    def weight_carried(self) -> float:
        """Share of the weight that a force along the thrust carries (negative: pulls down) in every
        flight, steadier than it varies; 0 where there is none that is worth a word. Thrust over
        mass is off by that, or something pulls all the time."""
        if "force" not in self.groups:
            return 0.0
        physics = self.model.physics
        weight = self.model.values["mass"] * physics.vehicle.gravity
        push = self.seen.y[:, _columns(self.seen, "force")[2]] / weight
        flights = np.array(self.seen.flights)
        return steady_share([push[flights == n] for n in dict.fromkeys(self.seen.flights)])


def pushes(model: IdentifiedModel, data: Dataset, channels: Collection[str]) -> Pushes | None:
    """The pushes of a fitted vehicle of which one of the `channels` that were judged shows
    anything; None where it has no disturbance states, or its motion is not known or not finite.
    Raises `ModelError` where no flight is long enough."""
    there = available(model.dynamics)
    names = [n for n in there if n.split(".")[0] == "body_velocity" or n in ("p", "q", "r")]
    groups = [
        d.group
        for d in disturbances(model.dynamics)
        if d.group in GROUPS and any(c in channels for c in SHOWN[d.group])
    ]
    if not groups or not {"body_velocity.x", "p"} <= set(names):
        return None
    seen, samples = discrepancy_and_features(model, data, names)
    if not all(np.isfinite(v).all() for v in (seen.y, *samples)):
        return None
    return Pushes(model=model, seen=seen, samples=samples, groups=groups)


def told_of_pushes(
    model: IdentifiedModel, data: Dataset, judged: Sequence[GroupSkill]
) -> tuple[list[str], str]:
    """In words, the pushes that follow the motion and matter beside the errors of the `judged`
    groups, and the force that carries the craft; and what is to be said first
    where the model is worse than holding the last value as soon as that force is not told. Nothing
    of flights that are too short to see pushes in, or too wild."""
    errors, ahead = {g.name: g for g in judged}, judged[0].seconds
    try:
        seen = pushes(model, data, errors)
        found = seen.followed({n: g.error for n, g in errors.items()}, ahead) if seen else ()
        carried = seen.weight_carried() if seen else 0.0
    except (GreyboxError, np.linalg.LinAlgError):
        return [], ""
    told = [
        f"the motion foretells {100 * p.share:.0f} % of the {p.group} without a name, which moves "
        f"{p.channel} by {p.change:.2g} of {p.error:.2g} {errors[p.channel].unit} that the model "
        f"errs {ahead:g} s ahead"
        for p in found
    ]
    if carried:
        told.append(
            f"a force without a name carries {100 * carried:.1f} % of the weight in every flight: "
            "mass or thrust is off by that, or something pulls all the time"
        )
    return told, _filter_only(carried, judged)


def _filter_only(carried: float, judged: Sequence[GroupSkill]) -> str:
    """What a fall by this share of the weight says of a model that knows it from its filter."""
    pull = abs(carried) * GRAVITY
    for g in judged:
        fall = {"velocity": pull * g.seconds, "position": 0.5 * pull * g.seconds**2}
        if fall.get(g.name, 0.0) > g.last_value:
            return (
                f"a force without a name carries {100 * carried:.0f} % of the weight: thrust, mass "
                f"or inertia is wrong; alone the model errs by {fall[g.name]:.2g} {g.unit} in "
                f"{g.name} {g.seconds:g} s ahead"
            )
    return ""


def _columns(seen: Discrepancy, group: str) -> list[int]:
    return [i for i, n in enumerate(seen.outputs.names) if n.split(".")[0] == group]


def _law(seen: Discrepancy, rows: BoolArray, columns: list[int]) -> tuple[FloatArray, FloatArray]:
    """Slopes (n_in, k) of the pushes by the features, of some rows, and the pushes (k,) where the
    features are zero."""
    z, y = seen.z[rows], seen.y[rows][:, columns]
    z_mean, y_mean = z.mean(axis=0), y.mean(axis=0)
    size = np.maximum(z.std(axis=0), 1e-12)
    slopes = np.linalg.lstsq((z - z_mean) / size, y - y_mean, rcond=1e-6)[0] / size[:, None]
    return slopes, y_mean - z_mean @ slopes


def _foretold(seen: Discrepancy, columns: list[int]) -> float:
    """Share of the pushes' variance about the mean of each flight (halves of a single one) that the
    law of the others foretells."""
    flights = np.array(seen.flights)
    names = dict.fromkeys(seen.flights)
    first = np.arange(len(flights)) < len(flights) // 2
    parts = [flights == n for n in names] if len(names) > 1 else [first, ~first]
    left = total = 0.0
    for part in parts:
        if part.sum() < 2 or (~part).sum() < 2:
            continue
        y = seen.y[part][:, columns]
        slopes, level = _law(seen, ~part, columns)
        rest = y - seen.z[part] @ slopes - level
        total += float(np.sum((y - y.mean(axis=0)) ** 2))
        left += float(np.sum((rest - rest.mean(axis=0)) ** 2))
    return 1.0 - left / total if total > 0 else 0.0


def _felt(
    model: IdentifiedModel,
    seen: Discrepancy,
    samples: Sequence[FloatArray],
    group: str,
    share: float,
    errors: Mapping[str, float],
    ahead: float,
) -> Iterator[Followed]:
    """The push, if what it moves is a part of the error of the first channel that was judged."""
    channel = next(c for c in SHOWN[group] if c in errors)
    slopes, level = _law(seen, np.ones(len(seen.z), dtype=bool), _columns(seen, group))
    mobility = _mobility(model, group)
    moved = np.concatenate(
        [_moved((z @ slopes + level) @ mobility, model, group, ahead) for z in samples]
    )
    if not len(moved):
        return
    change, error = float(moved.mean(axis=0)[SHOWN[group].index(channel)]), errors[channel]
    if FELT * error < change < error:
        yield Followed(group=group, share=share, channel=channel, change=change, error=error)


def _mobility(model: IdentifiedModel, group: str) -> FloatArray:
    """(3, 3) From a force [N] or torque [N m], a row, to the acceleration."""
    if group == "force":
        return np.eye(3) / model.values["mass"]
    return np.diag([1.0 / model.values[f"inertia.{a}"] for a in ("xx", "yy", "zz")])


def _moved(push: FloatArray, model: IdentifiedModel, group: str, ahead: float) -> FloatArray:
    """How far (m, 2) accelerations (n, 3) that change have moved the craft `ahead` [s] later,
    after one integration and after two; the present one fades, as the model lets it."""
    dt, time = model.sample_time, model.values[f"disturbance.{group}.T"]
    steps = round(ahead / dt)
    m = max(len(push) - steps, 0)
    once, twice = np.zeros((m, 3)), np.zeros((m, 3))
    for k in range(1, steps + 1):
        once += dt * (push[k : k + m] - push[:m] * np.exp(-k * dt / time))
        twice += dt * once
    return np.stack([np.linalg.norm(v, axis=1) for v in (once, twice)], axis=1)
