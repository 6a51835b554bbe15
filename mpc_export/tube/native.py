"""A CasADi function as compiled C in this process: the same call, without the virtual machine."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.estimation.build import build
from greybox.symbolic import FloatArray, OnArrays
from mpc_export.c_code import GENERATED_FLAGS, CKernel, write_c


class Native:
    """A compiled function on arrays. A controller calls it at every sample: turning each argument
    into a matrix of CasADi and back took as long as a tenth of a flight."""

    def __init__(self, function: ca.Function) -> None:
        self._run = OnArrays(function)
        self._kept = [
            None if pattern.is_dense() else np.array(pattern.find(), dtype=np.int64)
            for pattern in (function.sparsity_in(i) for i in range(function.n_in()))
        ]

    def __call__(self, *given: npt.ArrayLike) -> list[FloatArray]:
        """The results as matrices, which are the caller's; vectors, matrices and scalars in."""
        flat = (np.asarray(v, dtype=float).ravel(order="F") for v in given)
        told = (v if at is None else v[at] for v, at in zip(flat, self._kept, strict=True))
        return [v.copy() for v in self._run(*told)]


def native(function: ca.Function, kernels: Sequence[CKernel] = ()) -> Native:
    """`function` compiled (cached by content) and loaded. Raises `BuildError` without a C
    compiler."""
    with tempfile.TemporaryDirectory() as folder:
        made = write_c([function], Path(folder), prefix="native", kernels=kernels)
        header = made.header.read_text(encoding="utf-8")
        text = made.source.read_text(encoding="utf-8").replace('#include "native.h"\n', header)
    library = build([("native.c", text, (*GENERATED_FLAGS, "-fPIC"))])
    return Native(ca.external(made.functions[0].symbol, str(library)))
