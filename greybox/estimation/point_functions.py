"""Functions at one point of a model, and their slopes in some of its parameters, exact.

A function and its derivative along one direction of the parameters are derived together once, and
run for all directions side by side (forward mode; Griewank and Walther 2008, Evaluating
Derivatives, ch. 3): slopes written out one by one are twenty times as many operations. They are
kept between processes as tapes; without a compiler CasADi's VM runs them.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable

import casadi as ca
import numpy as np

from greybox.errors import ModelError
from greybox.estimation.reference_point import Reference, ReferenceStep, reference_step
from greybox.estimation.tape import tape_library
from greybox.estimation.tape_cache import linears
from greybox.symbolic import CASADI, Expr, FloatArray


class PointFunction:
    """(x, window, p, dt) to m numbers, and to these with their slopes in the active parameters;
    derived when it is first asked for.

    `derive` makes the expressions (m,) of the step of a model; `name` stands for it among all that
    is derived of a step.
    """

    def __init__(
        self, reference: Reference, name: str, derive: Callable[[ReferenceStep], Expr]
    ) -> None:
        self._reference, self._name, self._derive = reference, name, derive

    def values(self, x: FloatArray, window: FloatArray, p: FloatArray, dt: float) -> FloatArray:
        """The numbers (m,)."""
        return self._asked(x, window, p, dt, np.zeros((1, len(self._reference.active))))[0]

    def with_slopes(
        self, x: FloatArray, window: FloatArray, p: FloatArray, dt: float
    ) -> tuple[FloatArray, FloatArray]:
        """The numbers (m,) and their slopes (n_active, m)."""
        many = len(self._reference.active)
        if not many:
            values = self.values(x, window, p, dt)
            return values, np.zeros((0, values.size))
        return self._asked(x, window, p, dt, np.eye(many))

    def _asked(self, *arguments: FloatArray | float) -> tuple[FloatArray, FloatArray]:
        run, (some, moving) = self._made
        found, along = run(*arguments)
        values, slopes = np.zeros(some.size1()), np.zeros((len(along), some.size1()))
        values[some.row()], slopes[:, moving.row()] = found[0], along
        return values, slopes

    @functools.cached_property
    def _made(self) -> tuple[Callable[..., list[FloatArray]], list[ca.Sparsity]]:
        """(What runs it at one point along several directions, the patterns of both results)."""
        with CASADI:
            library, active = tape_library(), self._reference.active
            if library is not None:
                at = reference_step(self._reference.dynamics, self._reference.fixed)
                by = f"{self._name} along {active} of {at.names} at {self._reference.fixed}"
                with contextlib.suppress(ModelError):  # it is too large for a tape
                    tape = linears(at.whole, by, {self._name: self._both})[self._name]
                    patterns = [ca.Sparsity.compressed(tape.sparsity(i).tolist()) for i in (0, 1)]
                    return functools.partial(tape.at_points, library), patterns
            function = self._both()
            return functools.partial(_in_vm, function), [function.sparsity_out(i) for i in (0, 1)]

    def _both(self) -> ca.Function:
        """(x, window, p, dt, direction) to the numbers and their slope along it."""
        at = reference_step(self._reference.dynamics, self._reference.fixed)
        values = ca.cse(ca.sparsify(self._derive(at)))
        along, seed = at.along(self._reference.active)
        slope = ca.jtimes(values, at.p, along)
        return ca.Function(self._name, [at.x, at.window, at.p, at.dt, seed], [values, slope])


def _in_vm(function: ca.Function, *arguments: FloatArray) -> list[FloatArray]:
    """As `Linear.at_points`."""
    *common, directions = arguments
    with CASADI:
        rows = [[v.nonzeros() for v in function.call([*common, d])] for d in directions]
    return [np.array(v, dtype=np.float64) for v in zip(*rows, strict=True)]
