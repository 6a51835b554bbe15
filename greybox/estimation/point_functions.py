"""Functions at one point of a model, and their slopes in some of its parameters, exact.

A function and its derivative along one direction of the parameters are derived together once, and
run for all directions side by side (forward mode; Griewank and Walther 2008, Evaluating
Derivatives, ch. 3): slopes written out one by one are twenty times as many operations. They are
kept between processes as tapes; without a compiler CasADi's VM runs them.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from importlib import resources
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.errors import ModelError
from greybox.estimation.build import DRIVER_FLAGS, opened
from greybox.estimation.reference_point import Reference, ReferenceStep, reference_step
from greybox.estimation.tape_cache import linears
from greybox.symbolic import CASADI, Expr, FloatArray


class PointFunction:
    """(x, window, p, dt) to m numbers, and to these with their slopes in the active parameters.

    `derive` makes the expressions (m,) of the step of a model; `name` stands for it among all that
    is derived of a step.
    """

    def __init__(
        self, reference: Reference, name: str, derive: Callable[[ReferenceStep], Expr]
    ) -> None:
        self._many = len(reference.active)

        def both() -> ca.Function:
            at = reference_step(reference.dynamics, reference.fixed)
            values = ca.cse(ca.sparsify(derive(at)))
            along, seed = at.along(reference.active)
            slope = ca.jtimes(values, at.p, along)
            return ca.Function(name, [at.x, at.window, at.p, at.dt, seed], [values, slope])

        with CASADI:
            library = tape_library()
            self._run = self._taped(reference, name, both, library) if library else None
            if self._run is None:
                self._run = self._in_vm(both())

    def _taped(
        self, reference: Reference, name: str, both: Callable[[], ca.Function], library: Any
    ) -> Callable[..., list[FloatArray]] | None:
        at = reference_step(reference.dynamics, reference.fixed)
        by = f"{name} along {reference.active} of {at.names} at {reference.fixed}"
        try:
            tape = linears(at.whole, by, {name: both})[name]
        except ModelError:  # too large for a tape
            return None
        self._places([ca.Sparsity.compressed(tape.sparsity(i).tolist()) for i in (0, 1)])
        return functools.partial(tape.at_points, library)

    def _in_vm(self, function: ca.Function) -> Callable[..., list[FloatArray]]:
        self._places([function.sparsity_out(i) for i in (0, 1)])

        def run(*arguments: FloatArray) -> list[FloatArray]:
            *common, seeds = arguments
            with CASADI:
                rows = [[v.nonzeros() for v in function.call([*common, s])] for s in seeds]
            return [np.array(v, dtype=np.float64) for v in zip(*rows, strict=True)]

        return run

    def _places(self, patterns: list[ca.Sparsity]) -> None:
        self._size = patterns[0].size1()
        self._rows: list[npt.NDArray[np.intp]] = [np.array(v.row(), np.intp) for v in patterns]

    def values(self, x: FloatArray, window: FloatArray, p: FloatArray, dt: float) -> FloatArray:
        """The numbers (m,)."""
        return self._asked(x, window, p, dt, np.zeros((1, self._many)))[0]

    def with_slopes(
        self, x: FloatArray, window: FloatArray, p: FloatArray, dt: float
    ) -> tuple[FloatArray, FloatArray]:
        """The numbers (m,) and their slopes (n_active, m)."""
        if not self._many:
            return self.values(x, window, p, dt), np.zeros((0, self._size))
        return self._asked(x, window, p, dt, np.eye(self._many))

    def _asked(self, *arguments: Any) -> tuple[FloatArray, FloatArray]:
        assert self._run is not None
        found, along = self._run(*arguments)
        values, slopes = np.zeros(self._size), np.zeros((len(along), self._size))
        values[self._rows[0]], slopes[:, self._rows[1]] = found[0], along
        return values, slopes


@functools.cache
def tape_library() -> Any:
    """The compiled interpreter of tapes; None without a compiler."""
    text = resources.files("greybox.estimation").joinpath("tape.c").read_text(encoding="utf-8")
    library: Any = opened([("gb_tape.c", text, DRIVER_FLAGS)])
    if library is not None:
        library.gb_tape.restype = None
    return library
