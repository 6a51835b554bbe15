"""Carried: where much is left that follows no law, the search goes on with force and torque that are correlated in time.

White noise is the wrong model of what is left then: one-step errors weigh what is quick (clocks that drift, a trembling
torque) and hardly show what is slow, as a damping whose work builds up over tenths of a second. With the disturbance states
of the leftover carried along, innovations are nearly white, scores weigh what a name explains over the time that a
disturbance lasts, and standard errors are those of coloured errors (Ljung, System Identification, 2nd ed., ch. 7: with the
true model of the noise a prediction error estimate is efficient). The states could take up what is missing, which costs
power and makes no name. Where innovations are white then, the model of the noise is right and tests hold as they do
elsewhere; where they are not, a name must make them so (`whitens`) or prove itself on flights that were not searched.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from greybox.discovery.leftover import Promoted
from greybox.discovery.nested import Nest, NestedFit
from greybox.discovery.sensor_noise import coloured, suspicious, tested
from greybox.estimation.fit import Fit
from greybox.model.noise import Augmented, Disturbance, disturbances

PLAINLY = 0.01
"""Level above which innovations that were not white count as cured: one that trembles about a limit is not."""


def may_carry(leftover: Promoted) -> bool:
    """Whether axes of force or torque are clearly deficient, and none follows a law, which would be the better model."""
    return leftover.known and bool(leftover.unnamed) and not leftover.laws


def with_states(nest: Nest, groups: Iterable[str]) -> Nest:
    """The same candidates on a model with disturbance states of `groups`, whose time constants are free in every fit."""
    offered, chosen = nest.candidates, tuple(groups)
    model = Augmented(core=offered.model, parts=tuple(Disturbance(group=g) for g in chosen))
    core = (*offered.core, *(f"disturbance.{g}.T" for g in chosen))
    return replace(nest, candidates=replace(offered, model=model, core=core), recent=[])


def carried(nest: Nest, at: NestedFit, leftover: Promoted) -> tuple[Nest, NestedFit] | None:
    """The candidates on a model with the disturbance states of the `leftover` of `at`, and the fit of `at` there; None where
    that finds no optimum that is likelier than `at`."""
    again = with_states(nest, [d.group for d in disturbances(leftover.fit.model.dynamics)])
    problem = leftover.fit.problem
    levels = {
        (u.name, u.flight): float(t) for u, t in zip(problem.unknowns, leftover.fit.theta, strict=True)
        if u.kind == "noise" or u.name.startswith("disturbance.")
    }  # fmt: skip
    task = again.task(at.effects, start=at)
    refit = again.contest([replace(task, starts=tuple(dict(known) | levels for known in task.starts))])[0]
    return (again, again.settle(refit)) if refit.comparable and refit.bic < at.bic else None


def all_white(found: Fit) -> bool:
    """Whether innovations are white. What is too short to be tested is not."""
    channels = tested(found)
    return bool(channels) and not any(coloured(c) for c in channels.values())


def whitens(before: Fit, after: Fit) -> bool:
    """Whether all innovations are white `after`, or some plainly are that clearly were not `before`, and none the other way
    round. What is too short to be tested is not white."""
    now = tested(after)
    was, left = set(suspicious(before)), {n for n, c in now.items() if coloured(c)}
    if not now or not left:
        return bool(now)
    return left < was and all(now[n].test.p_value > PLAINLY for n in (was - left) & set(now))


def is_carried(found: Fit) -> bool:
    """Whether the model of `found` has disturbance states."""
    return bool(disturbances(found.model.dynamics))


def memories(found: Fit, leftover: Promoted) -> dict[str, float]:
    """Correlation times [s] of force and torque in a fit that carries them, of those of which something is left."""
    there = {a.channel.split(".")[0] for a in leftover.unnamed}
    own = {n.split(".")[1]: e for n, e in found.parameters.items() if n.startswith("disturbance.")}
    return {g: float(e.value) for g, e in own.items() if g in there and np.isfinite(e.std)}
