"""tube_data, what the solver and its caller share: one table, from which come the structure in C and
the views of its memory in Python.

Every number is a `tube_real`, so that the structure has no holes.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from greybox.symbolic import FloatArray

FIELDS: tuple[tuple[str, tuple[str, ...], str], ...] = (
    ("x0", ("NX",), "state to plan from"),
    ("u_before", ("NU",), "command in force until then"),
    ("p", ("NP1",), "run-time parameters"),
    ("ref", ("N", "NREF"), "references of the running cost"),
    ("x_end", ("NX",), "reference of the terminal cost"),
    ("plane", ("N + 1", "NPL", "4"), "normal and offset, position . normal <= offset"),
    ("u_min", ("NU",), "limits of commands, hard"),
    ("u_max", ("NU",), ""),
    ("rate_max", ("NU",), "largest change of a command per sample, hard"),
    ("kappa", ("NL",), "standard deviations by which planes and, last, the tilt are tightened"),
    ("kappa_u", (), "and the commands"),
    ("wider", ("N + 1", "NL"), "by how much wider errors are than the model says"),
    ("penalty", (), "price of slack, and of half its square"),
    ("penalty_square", (), ""),
    ("Z0", ("ND", "ND"), "covariance of the estimate about the plan at its start, usually zero"),
    ("bent", ("N + 1", "ND", "ND"), "added to the covariance: what the linear loop leaves out"),
    ("tolerance", (), "KKT residual at which iterations end"),
    ("qp_tolerance", (), "that of the QP"),
    ("damping", (), "added to the Hessian of the commands"),
    ("primal_tolerance", (), "largest primal residual of a QP whose solution is taken over"),
    ("iterations_max", (), ""),
    ("qp_iterations_max", (), ""),
    ("tube_updates_max", (), ""),
    ("attempts_max", (), "2: a plan that fails is tried again at once; 1: by the next call"),
    ("failed", (), "whether the call before gave no plan"),
    ("x", ("N + 1", "NX"), "the plan, also the start of the next solution"),
    ("u", ("N", "NU"), ""),
    ("covariance", ("N + 1", "ND", "ND"), "results from here on"),
    ("backoff", ("N + 1", "NL"), "what it takes off planes and tilt, and off the commands"),
    ("backoff_u", ("N", "NU"), ""),
    ("slack", ("N + 1", "NL"), ""),
    ("cost", (), ""),
    ("kkt", (), "residual with the multipliers of the last QP"),
    ("step", (), "largest change of the last iteration"),
    ("iterations", (), ""),
    ("qp_iterations", (), ""),
    ("qp_status", (), "0 solved, 1 iteration limit, 2 smallest step, 3 NaN, -1 none was tried"),
    ("qp_residual", (), "primal residual of the last QP: dynamics, commands, rates"),
    ("missed", (), "how far the model, flown under the plan's commands, is from the plan"),
    ("clipped", (), "by how much the limits moved a command of the plan at the end"),
    ("seconds", (), ""),
    ("seconds_linear", (), ""),
    ("seconds_tube", (), ""),
    ("seconds_qp", (), ""),
)
"""Name, sizes of the array (last index fastest; none: a number) and meaning, in order."""
SCALARS = tuple(n for n, shape, _ in FIELDS if not shape)
RESULTS = SCALARS[SCALARS.index("cost") :]
"""Numbers that a call of the solver writes."""


def in_c() -> str:
    """The structure as C."""
    lines = []
    for name, shape, meaning in FIELDS:
        text = f"  tube_real {name}{''.join(f'[{n}]' for n in shape)};"
        lines.append(f"{text:<40} /* {meaning} */" if meaning else text)
    return "typedef struct {\n" + "\n".join(lines) + "\n} tube_data;\n"


def views(sizes: Mapping[str, int], real: str) -> tuple[FloatArray, dict[str, FloatArray]]:
    """(The memory of one structure, zeros; its members by name, as views of it); real: "double" or
    "float"."""
    known = {"4": 4, "N + 1": sizes["N"] + 1, **sizes}
    shapes = [(name, tuple(known[n] for n in shape)) for name, shape, _ in FIELDS]
    memory = np.zeros(sum(int(np.prod(s)) for _, s in shapes), dtype=_TYPES[real])
    members, at = {}, 0
    for name, shape in shapes:
        size = int(np.prod(shape))
        members[name] = memory[at : at + size].reshape(shape)
        at += size
    return memory, members


_TYPES = {"double": np.float64, "float": np.float32}
