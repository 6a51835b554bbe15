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

from dataclasses import replace
from typing import Any

from greybox.data import Dataset
from greybox.discovery.leftover import Promoted
from greybox.discovery.nested import Nest, NestedFit
from greybox.discovery.sensor_noise import suspicious, with_levels
from greybox.estimation.fit import Fit
from greybox.model.disturbance import Disturbed


def may_carry(leftover: Promoted) -> bool:
    """Whether axes of force or torque are clearly deficient, and none follows a law, which would be the better model."""
    return leftover.known and bool(leftover.unnamed) and not leftover.laws


def carried(nest: Nest, at: NestedFit, leftover: Promoted) -> tuple[Nest, NestedFit]:
    """The candidates on a model with the disturbance states of the `leftover` of `at`, time constants free in every fit, and
    the fit of `at` there."""
    states: Any = leftover.fit.model.dynamics
    offered = nest.candidates
    model: Any = Disturbed(inner=offered.model, groups=states.groups)
    times = tuple(f"disturbance.{g}.T" for g in states.groups)
    again = replace(nest, candidates=replace(offered, model=model, core=(*offered.core, *times)), recent=[])
    problem = leftover.fit.problem
    levels = {
        (u.name, u.flight): float(t) for u, t in zip(problem.unknowns, leftover.fit.theta, strict=True)
        if u.kind == "noise" or u.name in times
    }  # fmt: skip
    task = again.task(at.effects, start=at)
    starts = tuple(dict(known) | levels for known in task.starts)
    return again, again.settle(again.refits([replace(task, starts=starts)])[0])


def put_down(found: Fit, data: Dataset) -> Fit:
    """The physics of `found` as it is, without its disturbance states."""
    dynamics: Any = found.model.dynamics
    return with_levels(found, dynamics.inner, data)


def whitens(before: Fit, after: Fit) -> bool:
    """Whether innovations that were clearly not white `before` are `after`, and none the other way round; or all are."""
    left = set(suspicious(after))
    return not left or left < set(suspicious(before))


def is_carried(found: Fit) -> bool:
    """Whether the model of `found` has disturbance states."""
    return isinstance(found.model.dynamics, Disturbed)


def memories(found: Fit) -> dict[str, float]:
    """Correlation times [s] of force and torque in a fit that carries them."""
    states: Any = found.model.dynamics
    return {g: float(found.model.values[f"disturbance.{g}.T"]) for g in states.groups}
