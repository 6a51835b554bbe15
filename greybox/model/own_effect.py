"""Effects of a model of the user's own: parameters with a value at which they do nothing.

A parameter that is declared with a `null` can be absent: held there it changes nothing. Parameters
whose names agree up to the first dot (`stribeck.level`, `stribeck.speed`) come and go together.
Further effects are terms that are added to the dynamics.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace

import casadi as ca

from greybox.errors import ModelError, UnknownNameError
from greybox.model.dynamics import StateSpaceModel
from greybox.model.parameter import Parameter
from greybox.symbolic import Expr

Terms = Callable[[Expr, Expr, Expr, Mapping[str, Expr]], Mapping[str, Expr]]
"""(t, x, u, p) -> state name -> what is added to its derivative (discrete: to its next value)."""


def effect_of(parameter: Parameter) -> str:
    """The effect that a parameter would belong to."""
    return parameter.name.split(".")[0]


def declared_effects(model: StateSpaceModel) -> dict[str, tuple[Parameter, ...]]:
    """Effect -> its parameters, of which at least one has a `null`."""
    heads = dict.fromkeys(effect_of(d) for d in model.parameters if d.null is not None)
    return {h: tuple(d for d in model.parameters if effect_of(d) == h) for h in heads}


def absent_value(parameter: Parameter) -> float:
    """The value of a parameter whose effect is absent: its null; of a shape without one, as
    declared."""
    return float(parameter.nominal if parameter.null is None else parameter.null)


def without_effects(model: StateSpaceModel, names: Collection[str]) -> StateSpaceModel:
    """The model in which these effects are absent. Raises `UnknownNameError`."""
    there = declared_effects(model)
    for name in names:
        if name not in there:
            raise UnknownNameError("effect", name, there)
    gone = {d.name: absent_value(d) for n in names for d in there[n]}

    def holding(part: object) -> Callable[[Expr, Expr, Expr, Mapping[str, Expr]], object]:
        def value(t: Expr, x: Expr, u: Expr, p: Mapping[str, Expr]) -> object:
            return part(t, x, u, {**p, **gone})  # type: ignore[operator]

        return value

    return replace(
        model,
        parameters=tuple(d for d in model.parameters if d.name not in gone),
        dynamics=holding(model.dynamics),
        measurement=holding(model.measurement),
    )


def with_terms(
    model: StateSpaceModel, parameters: Collection[Parameter], terms: Terms
) -> StateSpaceModel:
    """The model with further `parameters` and the `terms` that they make, added to its dynamics.

    Raises `ModelError` for a parameter that is there already, `UnknownNameError` for another
    state.
    """
    own = {d.name for d in model.parameters}
    if twice := sorted(own & {d.name for d in parameters}):
        raise ModelError(f"parameter {twice[0]} is there already", where=model.name)
    names = model.states.names

    def dynamics(t: Expr, x: Expr, u: Expr, p: Mapping[str, Expr]) -> Expr:
        added = dict(terms(t, x, u, p))
        for state in added:
            if state not in names:
                raise UnknownNameError("state", state, names)
        plain = model.f(t, x, u, ca.vertcat(*(p[d.name] for d in model.parameters)))
        return plain + ca.vertcat(*(added.get(n, 0.0) for n in names))

    return replace(model, parameters=(*model.parameters, *parameters), dynamics=dynamics)
