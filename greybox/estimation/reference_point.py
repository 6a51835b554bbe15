"""Reference point: one step of a Dynamics and its sample there, differentiated once as functions of
the parameters."""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import casadi as ca

from greybox.model.dynamics import Dynamics
from greybox.symbolic import Expr

Fixed = tuple[float | None, ...]
Built = TypeVar("Built")


FEW = 8
"""Steps that are kept: those of the latest models."""


@dataclass(frozen=True, eq=False)
class Reference:
    """A model, the parameters that derivatives are asked for, and what never changes at a state
    (`fixed` as in `ReferenceStep.at_point`): what functions are derived from, again where they were
    forgotten."""

    dynamics: Dynamics
    active: tuple[str, ...]
    fixed: Fixed = ()


def symbols(dynamics: Dynamics) -> dict[str, Expr]:
    """SX symbols x, U (n_u x window), p, w, dt, y of a Dynamics."""
    past, future = dynamics.window
    return {
        "x": ca.SX.sym("x", len(dynamics.states)),
        "U": ca.SX.sym("U", len(dynamics.inputs), past + 1 + future),
        "p": ca.SX.sym("p", len(dynamics.parameters)),
        "w": ca.SX.sym("w", len(dynamics.noises)),
        "dt": ca.SX.sym("dt"),
        "y": ca.SX.sym("y", len(dynamics.outputs)),
    }


def chart_jacobians(dynamics: Dynamics, x: Expr, z: Expr) -> tuple[Expr, Expr]:
    """(d boxplus(x, d)/dd at d = 0 (n_x x n_d), d boxminus(z', z)/dz' at z' = z (n_d x n_x)): in
    and out of the chart."""
    d, other = ca.SX.sym("d", len(dynamics.error_states)), ca.SX.sym("z", len(dynamics.states))
    into = ca.substitute(ca.jacobian(dynamics.boxplus(x, d), d), d, ca.DM.zeros(d.numel()))
    out = ca.substitute(ca.jacobian(dynamics.boxminus(other, z), other), other, z)
    return into, out


class ReferenceStep:
    """Symbols x, U (`window`), p, w, dt and of what is `measured`; the state `after` a step, the
    innovation `e`, and the charts `into` and `out` of the error state, of a point that is not
    fixed, see `at_point`. `whole`: all that derivatives follow from, as one function."""

    def __init__(self, dynamics: Dynamics) -> None:
        s = symbols(dynamics)
        self.x, self.window, self.p, self.w, self.dt = s["x"], s["U"], s["p"], s["w"], s["dt"]
        self.names = [q.name for q in dynamics.parameters]
        self.after = dynamics.step(0, self.x, self.window, self.p, self.w, self.dt)
        self._predicted = dynamics.output(0, self.x, self.window, self.p, self.w, self.dt)
        self.into, self.out = chart_jacobians(dynamics, self.x, self.after)
        self.measured = ca.SX.sym("y", self._predicted.numel())
        self.e = dynamics.innovation(self.measured, self._predicted, self.x)
        self._point = self.x
        given = [self.x, self.window, self.p, self.w, self.measured, self.dt]
        made = [self.after, self._predicted, self.e, self.into, self.out]
        self.whole = ca.Function("step", given, made)

    @functools.cached_property
    def stepped(self) -> ca.Function:
        """x, U, p, w, dt -> the state one step later."""
        given = [self.x, self.window, self.p, self.w, self.dt]
        return ca.Function("stepped", given, [self.after])

    @functools.cached_property
    def predicted(self) -> ca.Function:
        """x, U, p, w, dt -> outputs at the sample."""
        given = [self.x, self.window, self.p, self.w, self.dt]
        return ca.Function("predicted", given, [self._predicted])

    def at_point(self, fixed: Fixed) -> ReferenceStep:
        """The same step where some state entries never change.

        `fixed` (n_x entries or none): their values, None where one does. Zeros and ones among them
        make the expressions, their construction and their evaluation smaller.
        """
        if not fixed:
            return self
        there = copy.copy(self)
        there._point = ca.vertcat(*(self.x[i] if v is None else v for i, v in enumerate(fixed)))
        return there

    def at_rest(self, parts: Sequence[Expr]) -> list[Expr]:
        """Derivatives without noise, where the measured value equals the prediction."""
        seen = ca.substitute(list(parts), [self.measured], [self._predicted])
        return list(
            ca.substitute(seen, [self.x, self.w], [self._point, ca.DM.zeros(self.w.numel())])
        )

    def along(self, active: Sequence[str]) -> tuple[Expr, Expr]:
        """A direction of the parameters, and its numbers for the active ones, which span it."""
        seed, whole = ca.SX.sym("seed", len(active)), ca.SX(len(self.names), 1)
        for i, name in enumerate(active):
            whole[self.names.index(name)] = seed[i]
        return whole, seed


def unchanging(x: Iterable[float], other: Iterable[float]) -> Fixed:
    """`fixed` for the state x where `other` is the same kind of state from other data."""
    return tuple(float(a) if a == b else None for a, b in zip(x, other, strict=True))


def once_per_model(
    build: Callable[[Dynamics, tuple[str, ...], Fixed], Built], most: int = 64
) -> Callable[[Dynamics, tuple[str, ...], Fixed], Built]:
    """`build` with a memory of its last results, `most` of them, in this process; models that
    cannot be hashed are built anew."""
    remembered = functools.lru_cache(maxsize=most)(build)

    def built(dynamics: Dynamics, active: tuple[str, ...], fixed: Fixed) -> Built:
        try:
            return remembered(dynamics, active, fixed)  # type: ignore[arg-type]
        except TypeError:
            return build(dynamics, active, fixed)

    return built


_steps = once_per_model(lambda dynamics, *_: ReferenceStep(dynamics), FEW)


def reference_step(dynamics: Dynamics, fixed: Fixed) -> ReferenceStep:
    """The step of a model, built once per process, at a point."""
    return _steps(dynamics, (), ()).at_point(fixed)
