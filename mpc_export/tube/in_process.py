"""The C library of a tube MPC in this process: the same calls as `TubeController.sample`, to compare
and to fly it in simulation. One at a time: the library's memory is static."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from greybox.estimation.build import build
from greybox.symbolic import FloatArray
from mpc_export.c_code import GENERATED_FLAGS, Real
from mpc_export.tube.controller import Planes, Reference, TubeController
from mpc_export.tube.library import along, write_library


class TubeInC:
    """`pilot` as its C library, flying the same reference and planes.

    flags: of the compiler; linear: the linear tube. said: the bits of every call. Raises `BuildError`
    without a C compiler and what `write_library` raises.
    """

    def __init__(
        self,
        pilot: TubeController,
        folder: Path,
        *,
        real: Real = "float",
        flags: Sequence[str] = GENERATED_FLAGS,
        linear: bool = False,
    ) -> None:
        name = "flown"
        files, _ = write_library(pilot, folder, name=name, real=real, linear=linear)
        sources = []
        for path in files:
            text = path.read_text(encoding="utf-8")
            for header in folder.glob("*.h"):
                include = f'#include "{header.name}"\n'
                text = text.replace(include, header.read_text(encoding="utf-8"))
            sources.append((path.name, text, (*flags, "-fPIC")))
        library = ctypes.CDLL(str(build(sources, link=("-lm",))))
        self._start, self._step = library.flown_tube_start, library.flown_tube_step
        self._step.restype = ctypes.c_uint
        self._tell = library.flown_tube_parameter
        library.flown_tube_state.restype = ctypes.c_void_p
        self._state, self._states = library.flown_tube_state, len(pilot.filter.states)
        self._type: type[np.floating] = np.float32 if real == "float" else np.float64
        self._c = ctypes.c_float if real == "float" else ctypes.c_double
        self.problem, self.dt = pilot.problem, pilot.model.sample_time
        self.reference: Reference = pilot.reference
        self.planes: Planes | None = pilot.planes
        self.columns = pilot.estimator.columns
        self.told = [one.name for one in pilot.estimator.told.own]
        self.u = np.zeros(len(pilot.u))
        self.said: list[int] = []
        self.start()

    def start(self, time: float = 0.0) -> None:
        """Forget everything; at rest on the reference."""
        first = self.reference.sample(np.array([time]))
        place = np.array([*first.position[0], first.yaw[0]], dtype=self._type)
        self._start(place.ctypes.data_as(ctypes.c_void_p))
        self.said, self._told = [], math.nan

    def sample(self, time: float, measured: Mapping[str, float | None] | None) -> FloatArray:
        """The command that is in force from the next sample on, (n_u,)."""
        measured = measured or {}
        y = np.array([_number(measured.get(c)) for c in self.columns])
        with np.errstate(all="ignore"):
            y = y.astype(self._type)
        given = np.isfinite(y).astype(np.uint8)
        passed = self.dt if math.isnan(self._told) else time - self._told
        self._told = time
        n = self.problem.horizon
        ahead = time + self.dt + self.problem.dt * np.arange(n + 1)
        times: FloatArray = np.asarray(ahead, dtype=float)
        rows = np.ascontiguousarray(along(self.reference, times), dtype=self._type)
        planes = None
        if self.planes is not None:
            planes = np.ascontiguousarray(self.planes(times), dtype=self._type)
        u = np.zeros(len(self.u), dtype=self._type)
        pointers = [a if a is None else a.ctypes.data_as(ctypes.c_void_p) for a in (y, given, rows)]
        wall = None if planes is None else planes.ctypes.data_as(ctypes.c_void_p)
        for i, name in enumerate(self.told):
            value = _number(measured.get(name))
            if not math.isnan(value):
                self._tell(i, self._c(value))
        said = self._step(self._c(passed), *pointers, wall, u.ctypes.data_as(ctypes.c_void_p))
        self.said.append(int(said))
        self.u = u.astype(float)
        return self.u.copy()

    @property
    def estimate(self) -> FloatArray:
        """State of the filter for the next sample, (n_x,)."""
        at = (self._c * self._states).from_address(self._state())
        return np.array(at, dtype=float)


def _number(value: object) -> float:
    try:
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return math.nan
