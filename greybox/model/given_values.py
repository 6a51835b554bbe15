"""Given values: numbers that somebody gives for parameters of a model, let in only where the
declaration of the parameter, and a body, can have them."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from greybox.errors import ModelError
from greybox.model.body import PLACES, margins, may_be_stated
from greybox.model.dynamics import Dynamics
from greybox.model.layer import innermost, physics_of
from greybox.model.parameter import Parameter, ParameterValues, nominal_values
from greybox.model.vehicle_parts import EXACT_SCHEMA
from greybox.symbolic import FloatArray

ROUNDED = 5e-3
"""Share of a bound by which a value may be beyond it: printed commands have three digits."""


def demand_given(dynamics: Dynamics, given: Mapping[str, float]) -> None:
    """Raises `UnknownNameError` for a name that is no parameter of `dynamics`, `ModelError` for
    what is no finite number within the bounds of its parameter, and for moments and products of
    inertia that no body has."""
    for d in dynamics.parameters:
        if d.name in given:
            _demand_number(d, given[d.name], d.upper)
    _demand_body(dynamics, given, nominal_values(dynamics.parameters).replace(given))


def demand_changes(
    dynamics: Dynamics, changes: Mapping[str, float], values: ParameterValues
) -> None:
    """`demand_given` for changes of a model's `values`; noise may last longer than a search looks,
    as a disturbance that never decays."""
    core = {d.name for d in innermost(dynamics).parameters}
    for d in dynamics.parameters:
        if d.name in changes:
            _demand_number(d, changes[d.name], d.upper if d.name in core else math.inf)
    _demand_body(dynamics, changes, values.replace(changes))


def _demand_number(d: Parameter, value: object, upper: float) -> None:
    try:
        number = None if isinstance(value, (str, bytes, bool)) else float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        number = None
    if number is None:
        what, got, fix = "not a number", repr(value), "give one number in SI units"
    elif not math.isfinite(number):
        what, got, fix = "not finite", f"{number:g}", "give one number in SI units"
    elif not _beyond(d.lower) <= number <= _beyond(upper, 1):
        what, got = "outside its bounds", f"{number:g}"
        fix = "check sign, unit and exponent, and what the vehicle file states"
    else:
        return
    raise ModelError(f"value of {d.name}: {what}", expected=_range(d, upper), got=got, fix=fix)


def _beyond(bound: float, sign: int = -1) -> float:
    return bound + sign * ROUNDED * abs(bound) if math.isfinite(bound) else bound


def _range(d: Parameter, upper: float) -> str:
    unit = "" if d.unit == "-" else f" {d.unit}"
    if math.isfinite(d.lower) and math.isfinite(upper):
        return f"{d.lower:.4g} to {upper:.4g}{unit}"
    if math.isfinite(d.lower):
        return f"{d.lower:.4g}{unit} or more"
    return f"at most {upper:.4g}{unit}" if math.isfinite(upper) else f"a finite number{unit}"


def _demand_body(dynamics: Dynamics, given: Mapping[str, float], values: ParameterValues) -> None:
    """Raises `ModelError` where the values that are `given` make the inertia one of no body, and
    further from one than what is stated. Not for vehicle files of schema /1, whose fits may end
    there."""
    physics = physics_of(dynamics)
    if physics is None or physics.vehicle.schema == EXACT_SCHEMA:
        return
    named = [n for n, _, _ in PLACES if n in given]
    stated = np.array(physics.vehicle.inertia, dtype=np.float64)
    inertia = _inertia(stated, values)
    if not named or may_be_stated(inertia) or margins(inertia)[-1] >= margins(stated)[-1]:
        return
    moments = ", ".join(f"{v:.3g}" for v in np.linalg.eigvalsh(inertia))
    raise ModelError(
        f"values of {', '.join(named)}: no body has this inertia",
        expected="principal moments above zero, the largest at most the sum of the other two",
        got=f"{moments} kg m^2",
        fix="check units and exponents; give all moments that belong together",
    )


def _inertia(stated: FloatArray, values: ParameterValues) -> FloatArray:
    """J (3, 3) of the values; products are added to those that are stated."""
    out = stated.copy()
    for name, i, j in PLACES:
        if name not in values:
            continue
        if i == j:
            out[i, i] = values[name]
        else:
            out[i, j] += values[name]
            out[j, i] = out[i, j]
    return out
