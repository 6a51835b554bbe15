"""A CasADi function as compiled C inside CasADi: the same call, without the virtual machine."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import casadi as ca

from greybox.estimation.build import build
from mpc_export.c_code import GENERATED_FLAGS, CKernel, write_c


def native(function: ca.Function, kernels: Sequence[CKernel] = ()) -> ca.Function:
    """`function` compiled (cached by content) and loaded. Raises `BuildError` without a C
    compiler."""
    with tempfile.TemporaryDirectory() as folder:
        made = write_c([function], Path(folder), prefix="native", kernels=kernels)
        header = made.header.read_text(encoding="utf-8")
        text = made.source.read_text(encoding="utf-8").replace('#include "native.h"\n', header)
    library = build([("native.c", text, (*GENERATED_FLAGS, "-fPIC"))])
    return ca.external(made.functions[0].symbol, str(library))
