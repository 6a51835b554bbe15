"""check_effect: the rules that every effect keeps, tried out on one model; for effects that come
from outside."""

from __future__ import annotations

import re
import traceback
from collections.abc import Mapping

import casadi as ca
import numpy as np

from greybox.errors import ModelError
from greybox.model.effect import EARLY, SLOTS, Effect, Flow, Remembered
from greybox.model.example import example_vehicle
from greybox.model.model import PhysicsModel
from greybox.model.parameter import Parameter
from greybox.model.sensors import SENSORS
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr, FloatArray

RIGID = 13
"""Length of the rigid body's state: position, velocity, quaternion, rate."""


def check_effect(effect: Effect, *, where: str = "effect") -> None:
    """Raise `ModelError` where the effect breaks a rule of all effects; `where` names its file.

    Name, stage, parameters with null and bounds, slots that its stage knows, finite values away
    from the null and nothing of its own at the null: tried on `example_vehicle` with all sensors in
    a few states of fast flight.
    """
    say = f"effect {effect.name}"
    if not re.fullmatch(r"[a-z]+(_[a-z]+)*", effect.name):
        raise ModelError(
            f"{say}: bad name", where=where, expected="lower-case words joined by underscores"
        )
    if effect.stage not in SLOTS:
        raise ModelError(
            f"{say}: unknown stage {effect.stage!r}",
            where=where,
            expected=f"one of {', '.join(SLOTS)}",
        )
    try:
        declared = effect.parameters(example_vehicle())
    except Exception as error:
        raise failed(f"{say}, parameters", error, where) from error
    _check_parameters(declared, say, where)
    watched = _Watched(effect)
    try:
        away, at_null = (
            _evaluate(_model(watched), {f"{effect.name}.{k}": v for k, v in own.items()})
            for own in (_moved(declared, 1.0), _moved(declared, 0.0))
        )
    except ModelError as error:
        raise ModelError(f"{say}: {error.line}", where=where) from None
    except Exception as error:
        raise failed(f"{say}, apply", error, where) from error
    _check_slots(effect, watched.returned, say, where)
    if not (np.isfinite(away).all() and np.isfinite(at_null).all()):
        raise ModelError(
            f"{say} gives values that are not finite", where=where, fix="guard divisions and roots"
        )
    without = _evaluate(_model(), {})
    difference = np.abs(at_null[:, : without.shape[1]] - without)
    if (difference > 1e-9 * (1 + np.abs(without))).any():
        raise ModelError(
            f"{say} does not vanish at its null",
            where=where,
            got=f"a difference of {difference.max():.3g}",
            fix="write it so that the null parameters leave everything as it was",
        )


def failed(doing: str, error: Exception, path: str) -> ModelError:
    """What went wrong, with the last line of the file `path` that was reached."""
    lines = [
        frame.lineno
        for frame in traceback.extract_tb(error.__traceback__)
        if frame.filename == path
    ]
    where = f"{path}:{lines[-1]}" if lines else path
    return ModelError(
        f"{doing}: {type(error).__name__}: {error}", where=where, fix="correct that line"
    )


def _check_parameters(declared: object, say: str, where: str) -> None:
    if not (
        isinstance(declared, tuple) and declared and all(isinstance(d, Parameter) for d in declared)
    ):
        raise ModelError(
            f"{say}: parameters() must give a tuple of Parameter",
            where=where,
            got=repr(declared)[:60],
        )
    names = [d.name for d in declared]
    if len(set(names)) < len(names):
        raise ModelError(
            f"{say}: a parameter name is there twice", where=where, got=", ".join(names)
        )
    for d in declared:
        if d.null is None or not d.lower <= d.null <= d.upper:
            raise ModelError(
                f"{say}: parameter {d.name} has no null within its bounds",
                where=where,
                fix="null is the value at which the effect is gone",
            )


def _check_slots(effect: Effect, returned: set[str], say: str, where: str) -> None:
    known = SLOTS[effect.stage]
    if unknown := sorted(returned - known):
        raise ModelError(
            f"{say} returns {', '.join(unknown)}",
            where=where,
            expected=f"what stage {effect.stage} knows: {', '.join(sorted(known))}",
        )
    if (early := returned & EARLY) != effect.early:
        raise ModelError(
            f"{say} returns {', '.join(sorted(early)) or 'no early slot'} but declares early = "
            f"{set(effect.early)}",
            where=where,
            fix=f"early = frozenset({sorted(early)})",
        )


class _Watched(Effect):
    """The effect itself, with a note of every slot that it returned."""

    def __init__(self, inner: Effect) -> None:
        self.inner = inner
        self.returned: set[str] = set()
        for name in ("name", "stage", "order", "early", "needs", "tags"):
            setattr(self, name, getattr(inner, name))

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """As the effect."""
        return self.inner.parameters(vehicle)

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """As the effect."""
        slots = self.inner.apply(flow, p)
        self.returned |= set(slots)
        return slots

    def derived(self, p: Mapping[str, Expr], vehicle: Vehicle) -> Mapping[str, Expr]:
        """As the effect."""
        return self.inner.derived(p, vehicle)

    def memory(self, vehicle: Vehicle) -> tuple[Remembered, ...]:
        """As the effect."""
        return self.inner.memory(vehicle)

    def remember(self, flow: Flow, p: Mapping[str, Expr]) -> Expr:
        """As the effect."""
        return self.inner.remember(flow, p)


def _model(*effects: Effect) -> PhysicsModel:
    return PhysicsModel(vehicle=example_vehicle(), effects=effects, sensors=SENSORS)


def _moved(declared: tuple[Parameter, ...], scales: float) -> dict[str, float]:
    """Values so many scales above the null, within the bounds."""
    return {
        d.name: float(np.clip((d.null or 0.0) + scales * d.scale, d.lower, d.upper))
        for d in declared
    }


def _evaluate(model: PhysicsModel, values: Mapping[str, float]) -> FloatArray:
    """Rates of the rigid body, outputs, and rates of what effects remember, in three states of fast
    flight with settled rotors: shape (3, n)."""
    x, u, p = (
        ca.SX.sym(n, s)
        for n, s in zip("xup", (len(model.states), len(model.inputs), len(model.parameters)))
    )
    remembered = sum(n.startswith("memory.") for n in model.states.names)
    rates = model.f(0, x, u, p)
    seen = ca.vertcat(rates[:RIGID], model.h(0, x, u, p), rates[RIGID : RIGID + remembered])
    f = ca.Function("f", [x, u, p], [ca.densify(seen)])
    vector = [values.get(d.name, d.nominal) for d in model.parameters]
    rng = np.random.default_rng(0)
    rows = []
    for _ in range(3):
        q, u_k = rng.normal(size=4), rng.uniform(0.3, 0.9, size=model.vehicle.n_rotors)
        rigid = [
            *rng.normal(size=2),
            2.0,
            *rng.normal(size=3),
            *(q / np.linalg.norm(q)),
            *(3 * rng.normal(size=3)),
        ]
        memory = np.random.default_rng(1).normal(
            size=remembered
        )  # leaves the states of flight as they are without
        rotors = u_k[: len(model.states) - RIGID - remembered]
        rows.append(
            f([*rigid, *memory, *rotors], [*u_k, 10.5][: len(model.inputs)], vector).full().ravel()
        )
    return np.array(rows)
