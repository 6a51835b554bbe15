"""The controller's solver: stage functions and controller.c compiled into one library, HPIPM for
the QP, called by ctypes.

HPIPM and BLASFEO (Frison and Diehl 2020, IFAC-PapersOnLine 53(2)) come with CasADi's wheel,
libraries and headers alike. Memory is taken once, when a solver is made; a step takes none. One
solver serves one thread.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import re
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import casadi as ca
import numpy as np

from greybox.estimation.build import BuildError, build
from greybox.estimation.cache import cache_dir
from greybox.files import write_atomic
from greybox.symbolic import FloatArray
from mpc_export.c_code import (
    FAST_FLAGS,
    GENERATED_FLAGS,
    CKernel,
    CSource,
    Port,
    Real,
    single_precision,
    write_c,
)
from mpc_export.functions import ModelFunctions
from mpc_export.semidefinite import half
from mpc_export.tube.problem import TubeProblem
from mpc_export.tube.stages import Stages, stages
from mpc_export.tube.structure import RESULTS, in_c, views

PRIMAL = 1e-4
"""A QP that was not solved to the end counts where it misses dynamics (m, m/s, rad, rad/s) and
limits by no more than this: below what a sensor sees."""
COARSE = 1e3
"""Tolerances in float are so many times those in double, but the QP's."""
QP_TOLERANCE: dict[Real, float] = {"double": 1e-6, "float": 1e-4}
"""Up to which a QP counts as solved. Float gets no nearer in every QP, and commands are within 1e-3."""
QP = Literal["hpipm", "riccati", "condensed"]
"""Who solves the QP."""
HERE = Path(__file__).parent
HOSTED = "#define TUBE_HOSTED\n#define _POSIX_C_SOURCE 199309L\n"
"""What a desktop adds: memory taken when a solver is made, and a clock."""
WORK = ("ARG", "RES", "IW", "W")
"""Memory that stage functions need."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What a call of the solver says. status: 0 solved, 1 a model function failed, 2 the QP was not
    solved, 3 the model does not fly the plan: Newton's steps grow (missed is not below step).

    kkt: residual of the KKT conditions with the multipliers of the last QP (infinite where it was
    not asked for); step: largest change of the last iteration; times in seconds. qp_status is
    HPIPM's: 0 solved, 1 iteration limit, 2 smallest step, 3 NaN, -1 none was tried. With 1 and 2 a
    plan was taken over all the same (status 0) where qp_residual, by which dynamics, commands and
    rates were missed, was small. missed: how far the model, flown from the plan's start under its
    commands, is from the plan (to first order; largest over stages and error states). clipped: by
    how much a command of the plan was moved by its limits.
    """

    status: int
    cost: float
    kkt: float
    step: float
    iterations: int
    qp_iterations: int
    qp_status: int
    qp_residual: float
    missed: float
    clipped: float
    seconds: float
    seconds_linear: float
    seconds_tube: float
    seconds_qp: float


class TubeSolver:
    """Compiled solver of one problem. Arrays of `data` by name are views of the C structure: write,
    call, read.

    white, estimate and fresh: see `stages`. qp: "riccati" is the QP solver of an export, which also
    computes in float (real). Raises `BuildError` without a C compiler or where HPIPM
    is not with CasADi, `ModelError` from `stages`.
    """

    _solver: int | None = None
    """Where it lies in memory, once it is made."""

    def __init__(
        self,
        model: ModelFunctions,
        problem: TubeProblem,
        *,
        kernels: Sequence[CKernel] = (),
        white: bool = False,
        estimate: FloatArray | None = None,
        fresh: FloatArray | None = None,
        qp: QP = "hpipm",
        real: Real = "double",
    ) -> None:
        self.model, self.problem = model, problem
        self.stages: Stages = stages(model, problem, white=white, estimate=estimate, fresh=fresh)
        n = model.sizes
        self.sizes = {
            "N": problem.horizon,
            "NX": n["n_x"],
            "ND": n["n_d"],
            "NU": n["n_u"],
            "NP": n["n_p"],
            "NK": len(self.stages.keep),
            "NPL": problem.planes,
            "NL": problem.planes + 1,
            "NREF": 7 + n["n_u"],
            "NGP": n["n_g"],
            "NTH": n["n_theta"],
            "NFREE": len(self.stages.free),
        }
        # no array of C has no elements
        self.sizes |= {f"{k}1": max(1, self.sizes[k]) for k in ("NP", "NGP", "NTH", "NFREE")}
        # Before all others in the process: acados brings an HPIPM of its own, of another layout.
        mode = ctypes.DEFAULT_MODE | getattr(os, "RTLD_DEEPBIND", 0)
        self._library = ctypes.CDLL(
            str(_compiled(sources(self.sizes, self.stages, kernels, real=real, qp=qp), qp=qp)),
            mode=mode,
        )
        self._library.tube_create.restype = ctypes.c_void_p
        self._library.tube_data_size.restype = ctypes.c_size_t
        self._library.tube_free.argtypes = [ctypes.c_void_p]
        self._library.tube_solve.argtypes = [ctypes.c_void_p, ctypes.c_void_p]
        self._buffer, self.data = views(self.sizes, real)
        if self._buffer.nbytes != self._library.tube_data_size():
            raise BuildError("tube_data in C is not what structure.py describes")
        self._real: Real = real
        self._solver = self._library.tube_create()
        if not self._solver:
            raise MemoryError("no memory for the controller")
        self.reset()

    def __del__(self) -> None:
        if self._solver:
            self._library.tube_free(self._solver)
            self._solver = None

    def reset(self) -> None:
        """Back to hover at the origin, no planes, no tightening, one iteration per call."""
        d, problem = self.data, self.problem
        self._buffer[:] = 0.0
        x, u = self.stages.steady
        d["x0"][:], d["x_end"][:], d["x"][:] = x, x, x
        d["u"][:], d["u_before"][:] = u, u
        d["ref"][:, 7:] = u
        d["p"][: self.sizes["NP"]] = self.model.parameter_values
        d["plane"][..., 3], d["wider"][:] = 1.0, 1.0
        d["bent"][:] = self.stages.bent
        d["u_min"][:], d["u_max"][:] = problem.command_min, problem.command_max
        d["rate_max"][:] = problem.rate_max
        d["penalty"][()], d["penalty_square"][()] = problem.penalty, problem.penalty_square
        d["tolerance"][()] = 1e-6 * (COARSE if self._real == "float" else 1.0)
        d["qp_tolerance"][()] = QP_TOLERANCE[self._real]
        d["primal_tolerance"][()] = PRIMAL
        d["iterations_max"][()], d["qp_iterations_max"][()], d["tube_updates_max"][()] = 1, 40, 1
        d["attempts_max"][()] = problem.attempts

    def solve(self) -> Outcome:
        """Iterate from the plan in `data`; the new plan stands there afterwards."""
        status = self._library.tube_solve(self._solver, self._buffer.ctypes.data)
        v = {name: self.data[name][()] for name in RESULTS}
        whole = ("iterations", "qp_iterations", "qp_status")
        numbers: dict[str, Any] = {k: int(x) if k in whole else float(x) for k, x in v.items()}
        return Outcome(status=status, **numbers)


def hpipm() -> tuple[Path, Path]:
    """(headers, libraries) of HPIPM as CasADi's wheel has them. Raises `BuildError`."""
    root = Path(ca.__file__).parent
    include = root / "include"
    if not (include / "hpipm_d_ocp_qp.h").exists() or not list(root.glob("libhpipm.*")):
        raise BuildError(
            "this CasADi comes without HPIPM",
            fix="install casadi from PyPI, or use the CasADi or acados solver",
        )
    return include, root


def _private(libraries: Path) -> Path:
    """Copies of HPIPM and BLASFEO under names of their own.

    The loader takes a library by its name: where another HPIPM is in the process (acados has one),
    ours would be run with that one's memory layout.
    """
    names = {"libhpipm.so": "libgbhpi.so", "libblasfeo.so.0": "libgbblasf.so.0"}
    files = {new: (libraries / old).read_bytes() for old, new in names.items()}
    folder = cache_dir() / f"hpipm-{hashlib.sha256(b''.join(files.values())).hexdigest()}"
    folder.mkdir(exist_ok=True, mode=0o700)
    for new, content in files.items():
        for old, other in names.items():
            content = content.replace(f"\0{old}\0".encode(), f"\0{other}\0".encode())
        # what is there is about to be run: it must be what would be written
        if not (folder / new).is_file() or (folder / new).read_bytes() != content:
            write_atomic(folder / new, content)
    return folder


def sources(
    sizes: dict[str, int],
    made: Stages,
    kernels: Sequence[CKernel],
    *,
    real: Real = "double",
    qp: QP = "hpipm",
) -> dict[str, str]:
    """C of the stage functions and of the controller, in this precision, by file name; their
    headers are inside."""
    compiled = [f for name, f in made.functions.items() if name != "tube_spread"]
    with tempfile.TemporaryDirectory() as folder:
        source = write_c(compiled, Path(folder), prefix="tube_model", kernels=kernels, real=real)
        model, header = (
            source.source.read_text(encoding="utf-8"),
            source.header.read_text(encoding="utf-8"),
        )
    return {
        "tube_model.c": model.replace('#include "tube_model.h"\n', header),
        "controller.c": f"{HOSTED}{driver(header, settled(sizes, made, source), real, qp)}",
    }


def driver(header: str, settings: str, real: Real, qp: QP) -> str:
    """controller.c with everything that it includes of ours."""
    text = (HERE / "controller.c").read_text(encoding="utf-8")
    parts = {
        "numbers.h": included("numbers.h"),
        "tube_model.h": header,
        "tube_sizes.h": settings,
        "qp.h": (HERE / "qp.h").read_text(encoding="utf-8"),
        "qp_solver.c": _qp(qp),
    }
    for name, part in parts.items():
        # headers of a library know nothing of macros like N: they come first
        libraries = re.findall(r"^#include <.*>\n", part, re.MULTILINE)
        text = "".join(libraries) + text.replace(
            f'#include "{name}"\n', re.sub(r"^#include <.*>\n", "", part, flags=re.MULTILINE)
        )
    return single_precision(text) if real == "float" else text


def _qp(qp: QP) -> str:
    """C of the QP's solver."""
    if qp == "hpipm":
        return included("qp_hpipm.c")
    return included("qp_planned.c").replace('#include "qp_steps.c"\n', included(f"qp_{qp}.c"))


def included(name: str) -> str:
    """A C file of ours with those of ours that it includes; what is chosen stays."""
    text = (HERE / name).read_text(encoding="utf-8")
    own = re.findall(r'^#include "(qp_(?:interior|dense)\.c)"\n', text, re.MULTILINE)
    for part in own:
        text = text.replace(f'#include "{part}"\n', included(part))
    return text


def settled(sizes: dict[str, int], made: Stages, source: CSource) -> str:
    """tube_sizes.h: sizes, constants and tube_data, for stage functions in `source`."""
    works = {k: max(1, *(getattr(f, f"sz_{k.lower()}") for f in source.functions)) for k in WORK}
    linear = next(f for f in source.functions if f.name == "tube_linear")
    plan, whole = linear.outputs[1], linear.outputs[3]
    cost = next(f for f in source.functions if f.name == "tube_cost").outputs[2]
    lines = [f"typedef {source.real} tube_real;", *(f"#define {k} {v}" for k, v in sizes.items())]
    lines += [f"#define TUBE_{k} {v}" for k, v in works.items()]
    lines += [
        f"#define TUBE_WHITE {int(made.white)}",
        f"#define TUBE_WORST_CASE {int(made.worst_case)}",
        f"#define TUBE_NONZEROS {whole.nnz}",
        f"#define TUBE_PLAN_NONZEROS {plan.nnz}",
        f"#define TUBE_COST_NONZEROS {cost.nnz}",
    ]
    tables: dict[str, Sequence[float]] = {
        "KEEP": made.keep,
        "FREE": made.free or (0,),
        "COLUMN": whole.colind,
        "ROW": whole.row,
        "PLAN_COLUMN": plan.colind,
        "PLAN_ROW": plan.row,
        **_by_row(plan),
        "COST_ROW": cost.row,
        "COST_ACROSS": _across(cost).tolist(),
        "ESTIMATE": made.estimate.ravel().tolist(),
        "FRESH": made.fresh.ravel().tolist(),
        "PLACES": made.places,
        "BACK": made.back,
    }
    for name, values in tables.items():
        lines.append(f"#define TUBE_{name} {braced(values, source.real)}")
    for name, m in (("GAIN", made.gain), ("ROOT", half(made.covariance))):
        rows = [braced(row, source.real) for row in m.tolist()]
        lines.append(f"#define TUBE_{name} {{{', '.join(rows) or '{0}'}}}")
    return "\n".join(lines) + "\n" + in_c()


def _across(port: Port) -> FloatArray:
    """Column of every nonzero."""
    return np.repeat(np.arange(port.columns), np.diff(port.colind))


def _by_row(port: Port) -> dict[str, Sequence[float]]:
    """Tables of the nonzeros row by row: where rows begin, their columns and places."""
    rows, size = np.array(port.row), port.rows
    order = np.argsort(rows, kind="stable")
    begin = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=size))])
    return {
        "PLAN_BY_ROW": begin.tolist(),
        "PLAN_ROW_COLUMN": _across(port)[order].tolist(),
        "PLAN_ROW_AT": order.tolist(),
    }


def braced(values: Sequence[float], real: Real) -> str:
    """An initialiser of C."""
    return f"{{{', '.join(map(_literal(real), values))}}}"


def _literal(real: Real) -> Callable[[float], str]:
    def text(v: float) -> str:
        if isinstance(v, int):
            return str(v)
        return repr(v) if real == "double" else f"{float(np.float32(v))!r}f"

    return text


def link_flags() -> tuple[str, ...]:
    """Flags of the linker for HPIPM and BLASFEO. Raises `BuildError`."""
    private = _private(hpipm()[1])
    return f"-L{private}", "-lgbhpi", "-l:libgbblasf.so.0", f"-Wl,-rpath,{private}"


def _compiled(texts: dict[str, str], qp: QP = "hpipm") -> Path:
    own = qp == "hpipm"
    return build(
        [
            ("tube_model.c", texts["tube_model.c"], (*GENERATED_FLAGS, "-fPIC")),
            (
                "controller.c",
                texts["controller.c"],
                (
                    *FAST_FLAGS,
                    "-Wall",
                    "-Wextra",
                    "-fPIC",
                    *([f"-I{hpipm()[0]}"] if own else []),
                ),
            ),
        ],
        link=link_flags() if own else ("-lm",),
        shared=frozenset({"tube_model.c"}),  # of every horizon and of every solver of the QP
    )
