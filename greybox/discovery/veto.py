"""Veto: a name must also earn its place on flights that were not searched, and explain more than it leaves.

Likelihood on the training flights takes whatever bends the model towards the data, a slightly wrong law included. Two
checks stand against that.

1. Held-out flights. With the effect the one-step errors of flights that were not searched must not be less likely by more
   than the spread between blocks of one second allows (Vuong 1989, Econometrica 57(2)), nor by so much that training and
   held-out flights together no longer speak for it; and, unless they are far more likely or it is an effect of a sensor,
   open-loop errors up to a second ahead must not grow: the relative change of the mean square, averaged over channel
   groups and horizons, with the spread between the same blocks.
2. What is left. Where the axes that the effect acts on still miss more than half of what it explained, or the others of
   its force or torque follow a law that is larger than the effect, or any axis misses far more than it explained, the
   effect only bends towards something else: the name is taken back and the axis is reported as unnamed.
   So it is where a law takes away again what the effect does on an axis.
   A name that made held-out flights far more likely and let their open-loop errors fall clearly has proven itself and
   stays: in a real vehicle much is always left.

Where what is left is carried along (greybox.discovery.carried) the second check has no sense; the first is stricter then.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from greybox.data import Dataset
from greybox.discovery.candidates import TOGETHER
from greybox.discovery.gap import Foresight, foresee
from greybox.discovery.leftover import Leftover
from greybox.discovery.name import PLAIN
from greybox.discovery.nested import NestedFit
from greybox.discovery.velocity import has_velocity
from greybox.errors import GreyboxError
from greybox.estimation.engine import engine_for
from greybox.estimation.filtering import Filter
from greybox.estimation.fit import Fit
from greybox.frames import numeric
from greybox.model.dynamics import Dynamics
from greybox.model.identified import IdentifiedModel
from greybox.model.sensors import SENSORS
from greybox.statistics.evidence import CLEAR
from greybox.symbolic import FloatArray

SEEN = 2.0
"""Standard errors from its null that at least one parameter of a named effect must be away."""
WORSE = -1.0
"""Standard errors below zero from which on the mean square ahead counts as grown."""
CONTRADICTED = -2.0
"""Standard errors of the held-out log likelihood's change below which the flights contradict an effect. A short flight that
hardly excites the effect may lose a little by the other parameters alone."""
NOTHING = 1e-3
"""Relative change of the mean square ahead below which an effect adds nothing, unless that is clear."""
LEFT = 0.5
"""Share of the effect's own variance on an axis that a law of the leftover may have at most."""
LATE = frozenset(n for pair in TOGETHER for n in pair)
"""Effects on when a command acts, not on what force it brings."""
CONSTANT = frozenset({"constant_force", "steady_wind"})
"""Effects without a signal: any law has a mean, which they take."""
HALF = 0.5
"""Part of what the effect explained that the axes on which it acts may still miss after it, in BIC, together."""
MUCH = 5.0
"""How much more than the effect explained an axis next to its own (of the same force or torque) may miss, without a law."""
ELSEWHERE = 10.0
"""The same for all other axes: a force off the centre of mass is a torque, a tilt turns forces."""
PROVEN = 0.1
"""Relative fall of the mean square ahead on held-out flights from which on, `SURE` standard errors clear, a name that also
gained `PLAIN` has proven itself. Any constant does so where a law is missing, and proves nothing."""
SURE = 5.0
OPPOSED = 0.7
"""Correlation below minus which a law works against a name."""
SENSED = {s.name: s.mistaken_for for s in SENSORS if s.mistaken_for}
"""What is mistaken for an error of that sensor, and the other way round; of all others (a late pose) it is either."""
AXES = tuple(f"{kind}.{a}" for kind in ("force", "torque") for a in "xyz")
STEP = 1e-3
"""Relative step of a parameter of the core whose wrench is looked at."""
TOUCHED = 0.3
"""An effect acts on force or torque where its size against the noise is this share of the largest."""


@dataclass(frozen=True, kw_only=True)
class Withheld:
    """`effects` that passed the tests and the refit but not this; `reason` in words, with the two gains (None: not asked):
    log likelihood one step ahead, and relative fall of the mean square ahead, on flights that were not searched."""

    effects: tuple[str, ...]
    reason: str
    loglik_gain: float | None = None
    ahead_gain: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """As in discovery.json."""
        return {
            "effects": list(self.effects), "reason": self.reason, "loglik_gain": self.loglik_gain,
            "ahead_gain": self.ahead_gain,
        }  # fmt: skip


class HeldOut:
    """Flights that judge (in a veto those that were not searched), and what fits say on them: remembered, as every fit is
    asked more than once."""

    def __init__(self, data: Dataset, adapt: float | None = None) -> None:
        self.data, self.adapt = data, adapt
        self._seen: dict[int, tuple[IdentifiedModel, Foresight]] = {}

    def foresight(self, fitted: NestedFit) -> Foresight:
        """Errors of one fit. Raises `DataError`, `FitError`."""
        return self.of(fitted.fit.model)

    def of(self, model: IdentifiedModel) -> Foresight:
        """Errors of one model, found once. Raises `DataError`, `FitError`."""
        key = id(model)
        if key not in self._seen:
            self._seen[key] = model, foresee(model, self.data, adapt=self.adapt)
        return self._seen[key][1]

    def errors(self, fitted: NestedFit) -> list[dict[str, Any]]:
        """RMSE per group and horizon [s] (0: one sample); empty where it cannot be had."""
        try:
            own = self.foresight(fitted).own
        except GreyboxError:
            return []
        sums = {key: (sum(float(b.sum()) for b in bs), sum(b.size for b in bs)) for key, bs in own.items()}
        return [
            {"group": g, "horizon_s": h, "rmse": float(np.sqrt(total / n))} for (g, h), (total, n) in sums.items() if n
        ]

    def withheld(
        self, before: NestedFit, after: NestedFit, *, supported: bool = False, nearer: bool = False
    ) -> Withheld | None:
        """Why what `after` adds to `before` does not hold on these flights; None where it does or, without the following, it
        cannot be asked. With `supported` it must have made them clearly likelier, with `nearer` errors ahead must have
        fallen clearly, which any constant brings about where a law is missing."""
        added = tuple(e for e in after.effects if e not in before.effects)
        try:
            old, new = self.foresight(before), self.foresight(after)
        except GreyboxError:
            asked = supported or nearer
            return Withheld(effects=added, reason="flights that were not searched cannot be predicted") if asked else None
        change = new.logliks - old.logliks
        gain = float(change.sum())
        error = float(change.std(ddof=1) * np.sqrt(change.size)) if change.size > 1 else 0.0
        if gain <= CONTRADICTED * error or before.bic - after.bic + 2 * gain < CLEAR:
            reason = "one-step errors of flights that were not searched speak against it"
            return Withheld(effects=added, reason=reason, loglik_gain=gain)
        if nearer and set(added) <= CONSTANT:
            reason = "much is left, and any constant brings it nearer"
            return Withheld(effects=added, reason=reason, loglik_gain=gain)
        if (supported and gain <= -CONTRADICTED * error) or (nearer and not fallen(old, new)):
            reason = "much is left, and flights that were not searched do not prove it"
            return Withheld(effects=added, reason=reason, loglik_gain=gain, ahead_gain=ahead_gain(old, new)[0])
        if nearer:
            return None
        stages = {e.name: e.stage for e in after.fit.model.physics.effects}
        if all(stages.get(n) == "sensor" for n in added) or gain > PLAIN * new.samples:
            return None
        ahead, spread = ahead_gain(old, new)
        if ahead <= WORSE * spread or (ahead < NOTHING and ahead < spread):
            reason = "errors ahead on flights that were not searched do not shrink with it"
            return Withheld(effects=added, reason=reason, loglik_gain=gain, ahead_gain=ahead)
        return None

    def proven(self, before: NestedFit, after: NestedFit) -> bool:
        """Whether what `after` adds to `before` is plain on these flights, and lets errors ahead fall clearly."""
        if set(after.effects) - set(before.effects) <= CONSTANT:
            return False
        try:
            old, new = self.foresight(before), self.foresight(after)
        except GreyboxError:
            return False
        return new.loglik - old.loglik > PLAIN * new.samples and fallen(old, new)

    def outdoes(self, now: Fit, instead: Fit) -> bool:
        """Whether errors ahead are clearly lower with the fit `now` than with `instead`, or cannot be had with `instead`."""
        try:
            new = self.of(now.model)
        except GreyboxError:
            return False
        try:
            return fallen(self.of(instead.model), new)
        except GreyboxError:
            return True


def unseen(after: NestedFit, effects: Sequence[str], null: Mapping[str, float]) -> Withheld | None:
    """Why `effects` of the fit `after` have no name although it is likelier: no estimate is clear of its `null`.

    A likelihood that rises without that is that of a fit gone astray. Effects at a bound have no error and pass.
    """
    own = [(e, null[n]) for n, e in after.fit.parameters.items() if n.split(".")[0] in effects]
    known = [(e, zero) for e, zero in own if np.isfinite(e.std)]
    if not known or any(abs(e.value - zero) > SEEN * e.std for e, zero in known):
        return None
    return Withheld(effects=tuple(effects), reason="no parameter of it is two standard errors from none")


def fallen(old: Foresight, new: Foresight) -> bool:
    """Whether errors ahead fall by what proves a name."""
    fall, spread = ahead_gain(old, new)
    return fall > PROVEN and fall > SURE * spread


def ahead_gain(old: Foresight, new: Foresight) -> tuple[float, float]:
    """(relative fall of the mean square ahead, mean over groups and horizons above one sample; its standard error)."""
    rows: list[FloatArray] = []
    for key, blocks in old.own.items():
        others = new.own.get(key, [])
        if key[1] == 0 or not blocks or len(others) != len(blocks):
            continue
        size = sum(b.size for b in blocks)
        level = sum(float(b.sum()) for b in blocks) / max(size, 1)
        if level > 0 and size:
            change = [float(b.sum() - o.sum()) for b, o in zip(blocks, others, strict=True)]
            rows.append(np.array(change) / (level * size) * len(blocks))
    if not rows:
        return 0.0, 0.0
    length = min(len(r) for r in rows)
    per_block = np.mean([r[:length] for r in rows], axis=0)
    return float(per_block.mean()), float(per_block.std(ddof=1) / np.sqrt(length)) if length > 1 else 0.0


def wrench_of(
    model: IdentifiedModel, data: Dataset, effects: Sequence[str], null: Mapping[str, float], core: Sequence[str] = ()
) -> FloatArray:
    """Force and torque, body axes [N, N m] (N, 6), that `effects` bring along the filtered flights, without their mean and
    what the free parameters `core` could have done instead, to first order and against the model's white noise: a battery
    that is half empty is a smaller thrust coefficient."""
    dynamics = model.dynamics
    names = [d.name for d in dynamics.parameters]
    runner = Filter(model)
    engine = engine_for(dynamics, ())
    mass = model.values["mass"]
    inertia = np.array([model.values[f"inertia.{a}{a}"] for a in "xyz"])
    out: list[list[FloatArray]] = []
    for flight in data:
        p = model.flight_vector(flight.name)
        without = p.copy()
        for i, n in enumerate(names):
            if n.split(".")[0] in effects:
                without[i] = null.get(n, 0.0)
        moved = [without.copy() for _ in core]
        for vector, n in zip(moved, core, strict=True):
            i = names.index(n)
            vector[i] += STEP * max(abs(p[i]), dynamics.parameters[i].scale)
        for segment in flight.segments:
            filtered = runner.run(segment, p=p)
            rows = np.arange(filtered.record.n - 2)
            ends = []
            for vector in (p, without, *moved):
                _, states = engine.rollout(
                    starts=filtered.states[rows], rows=rows, horizon=2, inputs=filtered.record.inputs, p=vector,
                    dt=filtered.record.dt, want_states=True,
                )  # fmt: skip
                assert states is not None
                ends.append(states[:, 1])
            # A step of the core is taken without the effect: with it, its own wrench would be among what the core can do.
            bare = ends[1]
            changes = [(end - bare) / filtered.record.dt for end in (ends[0], *ends[2:])]
            out.append([_wrench(dynamics, filtered.states[rows], c, mass, inertia) for c in changes])
    own, *others = (np.concatenate(parts) for parts in zip(*out, strict=True))
    own = own - own.mean(axis=0)
    units = _units(white_levels(model), AXES)
    columns = [c for c in (o - o.mean(axis=0) for o in others) if (c * units).any()]
    if not columns:
        return own
    x = np.column_stack([(c * units).ravel() for c in columns])
    size = np.sqrt((x**2).mean(axis=0))
    share = np.linalg.lstsq(x / size, (own * units).ravel(), rcond=1e-6)[0] / size
    return np.asarray(own - sum(k * c for k, c in zip(share, columns, strict=True)))


def _wrench(
    dynamics: Dynamics, states: FloatArray, change: FloatArray, mass: float, inertia: FloatArray
) -> FloatArray:  # fmt: skip
    """Force and torque, body axes (n, 6), that change the `states` (n, n_x) at these rates (n, n_x)."""
    at = {n: i for i, n in enumerate(dynamics.states.names)}
    wrench = np.zeros((len(states), 6))
    if has_velocity(dynamics):
        turned = change[:, [at[f"velocity.{a}"] for a in "xyz"]]
        if "attitude.w" in at:
            q = states[:, [at[f"attitude.{a}"] for a in "wxyz"]]
            turned = numeric("rotate_inverse", q / np.linalg.norm(q, axis=1, keepdims=True), turned)
        wrench[:, :3] = mass * turned
    wrench[:, 3:] = inertia * change[:, [at[f"rate.{a}"] for a in "xyz"]]
    return wrench


def white_levels(model: IdentifiedModel) -> dict[str, float]:
    """White noise of force and torque, by axis."""
    return dict(zip(model.dynamics.noises.names, model.process_noise.tolist(), strict=True))


def _units(levels: Mapping[str, float], axes: Collection[str]) -> FloatArray:
    """One over the white noise of each of `AXES` that is among `axes`, else zero (6,)."""
    return np.array([1 / levels[a] if a in axes and levels.get(a, 0.0) > 0 else 0.0 for a in AXES])


def touched_by(wrench: FloatArray, levels: Mapping[str, float]) -> set[str]:
    """Axes on which a wrench (N, 6) matters against the white noise `levels`."""
    ratio = np.sqrt((wrench**2).mean(axis=0)) * _units(levels, AXES)
    return {a for a, k in zip(AXES, ratio.tolist(), strict=True) if k > 0 and k >= TOUCHED * ratio.max()}


def likeness(one: FloatArray, other: FloatArray, levels: Mapping[str, float]) -> float:
    """Correlation of two wrenches (N, 6), each axis in units of its noise, on the axes that the first touches."""
    units = _units(levels, touched_by(one, levels))
    a, b = (one * units).ravel(), (other * units).ravel()
    return float(a @ b) / max(float(np.sqrt((a @ a) * (b @ b))), 1e-300)


def misfit(
    effects: Sequence[str], wrench: FloatArray, levels: Mapping[str, float], left: Sequence[Leftover], gained: float,
    total: float = np.inf,
) -> Withheld | None:  # fmt: skip
    """Why `effects`, which bring the `wrench` (N, 6) and improved BIC by `gained`, do not fit what is `left` (unnamed axes,
    `total` together).

    Judged on the axes of the force or torque where the wrench matters against the white noise `levels` of the model.
    """
    size = dict(zip(AXES, np.sqrt((wrench**2).mean(axis=0)).tolist(), strict=True))
    touched = touched_by(wrench, levels)
    # What is late shows in jumps of the command, which no force imitates.
    own = [law for law in left if law.channel in touched and not set(effects) <= LATE]
    if min(sum(law.gain for law in own), total) > HALF * gained:
        most = max(own, key=lambda law: law.gain)
        return Withheld(effects=tuple(effects), reason=f"{most.channel} misses more than half of what it explained")
    return misfit_of(effects, {a.split(".")[0] for a in touched}, size, left, gained)


def undone(
    effects: Sequence[str], wrench: FloatArray, laws: FloatArray, left: Sequence[Leftover]
) -> Withheld | None:  # fmt: skip
    """Why `effects` are refuted that bring the `wrench` (N, 6), where the `laws` (N, 6) of what is `left` take it away again
    on an axis: they push against it (correlation beyond -`OPPOSED`) and leave less than half of it."""
    lawful = {law.channel for law in left if law.lawful}
    for axis, own, law in zip(AXES, wrench.T, laws.T, strict=True):
        mine, its, both = float(own @ own), float(law @ law), float(own @ law)
        if axis in lawful and both < -OPPOSED * float(np.sqrt(mine * its)) and abs(1 + both / mine) < HALF:
            return Withheld(effects=tuple(effects), reason=f"the law of what is left undoes what it does to {axis}")
    return None


def misread(
    effects: Sequence[str], left: Sequence[Leftover], gained: float, total: float = np.inf
) -> Withheld | None:  # fmt: skip
    """As `misfit` for effects of sensors. Their errors are mistaken for a wrench, and a wrench for them: they must explain
    twice what the axes of force (accelerometer), torque (gyro) or both (all others) still miss."""
    kinds = {k for n in effects for k in SENSED.get(n.split("_")[0], ("force", "torque"))}
    near = sum(law.gain for law in left if law.channel.split(".")[0] in kinds)
    if min(near, total) > HALF * gained:
        reason = f"the axes of {' and '.join(sorted(kinds))} miss more than half of what it explained"
        return Withheld(effects=tuple(effects), reason=reason)
    return misfit_of(effects, kinds, {}, left, gained)


def misfit_of(
    effects: Sequence[str], kinds: Collection[str], size: Mapping[str, float], left: Sequence[Leftover], gained: float
) -> Withheld | None:
    """The same for effects that act on `kinds` ("force", "torque") with an RMS `size` per axis."""
    near = [law for law in left if law.channel.split(".")[0] in kinds]
    if set(effects) <= CONSTANT and any(law.lawful for law in near) and sum(law.gain for law in near) > gained:
        return Withheld(effects=tuple(effects), reason="it is the mean of what still follows a law after it")
    for law in near:
        if (
            law.lawful
            and law.share * law.rms**2 > LEFT * size.get(law.channel, 0.0) ** 2
            and law.share * law.gain > gained
        ):
            reason = f"{law.channel} follows another law after it, which is larger than the effect"
            return Withheld(effects=tuple(effects), reason=reason)
    for law in left:
        if law.gain > (MUCH if law in near else ELSEWHERE) * gained:
            reason = f"{law.channel} misses far more after it than the effect explained"
            return Withheld(effects=tuple(effects), reason=reason)
    return None
