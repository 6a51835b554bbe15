"""acados: an AcadosModel of an exported model, and a session in which an unpacked acados is used.

Discrete dynamics with f_d are the default: delay, rotor lag and the held command are in them as
they were identified. f_expl and f_impl are offered too; `explicit_difference` measures what they
leave out.

acados finds itself through environment variables and its linker path. `session` sets them for the
time of a `with` block and loads the shared libraries by path, so that nothing has to be set before
Python starts. It takes an installed acados (a folder with lib, include, bin and interfaces) or the
folder into which the wheel `comma-deps-acados` was unpacked (`pip install --no-deps --target DIR
comma-deps-acados`); the old casadi in that wheel is never imported.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import casadi as ca
import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from acados_template import AcadosModel, AcadosOcpSolver

    from mpc_export.exported import Exported, Expr

MAX_ITERATIONS = 2
"""acados' status for iterations that were used up."""
SETTLED = 1e-6
"""Back-offs that move by less, in the unit of their limit, have settled."""
LIBRARIES = ("blasfeo", "hpipm", "qpOASES_e", "acados")
"""In the order of their dependencies; those that a build does not have are left out."""


def lay_out(wheel: str | Path, home: str | Path) -> Path:
    """A folder `home` of links in which acados finds itself, from an unpacked wheel. Raises
    `FileNotFoundError`."""
    source, place = Path(wheel).resolve() / "acados", Path(home).resolve()
    links = {part: source / "install" / part for part in ("lib", "include", "bin")}
    links["interfaces/acados_template/acados_template"] = source / "acados_template"
    for name, target in links.items():
        if not target.is_dir():
            raise FileNotFoundError(
                f"{target}: not there, so {wheel} is no unpacked comma-deps-acados"
            )
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        if not (place / name).exists():
            (place / name).symlink_to(target, target_is_directory=True)
    return place


@contextlib.contextmanager
def session(folder: str | Path) -> Iterator[Path]:
    """acados from `folder` (installed, or an unpacked wheel) while the block runs; yields its home.

    The environment and sys.path are put back afterwards; the imported module and the loaded
    libraries stay.
    """
    wheel = (Path(folder) / "acados" / "install").is_dir()
    home = Path(_laid_out(str(folder)).name if wheel else folder).resolve()
    interface = str(home / "interfaces" / "acados_template")
    wanted = {"ACADOS_SOURCE_DIR": str(home), "TERA_PATH": str(home / "bin" / "t_renderer")}
    before = {name: os.environ.get(name) for name in wanted}
    os.environ.update(wanted)
    sys.path.append(interface)  # at the end: nothing else in there may hide what is installed
    try:
        _load_libraries(home / "lib")
        yield home
    finally:
        sys.path.remove(interface)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@functools.cache
def _laid_out(wheel: str) -> tempfile.TemporaryDirectory[str]:
    """The links of a wheel, until the process ends: the module that stays imported finds its
    templates there."""
    home = tempfile.TemporaryDirectory(prefix="acados-")
    lay_out(wheel, home.name)
    return home


def _load_libraries(folder: Path) -> None:
    """What the generated solver is linked against, so that the loader finds it already in the
    process."""
    suffix = {"darwin": ".dylib", "win32": ".dll"}.get(sys.platform, ".so")
    for name in LIBRARIES:
        path = folder / f"lib{name}{suffix}"
        if path.exists():
            ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)


def acados_model(
    model: Exported,
    *,
    dynamics: Literal["discrete", "continuous"] = "discrete",
    second_order: bool = False,
) -> AcadosModel:
    """An `acados_template.AcadosModel` inside a `session`; set `ocp.parameter_values =
    model.parameter_values` beside it.

    "discrete": states x (n_x, with the command history), `disc_dyn_expr` = f_d. "continuous": the
    model's own states, `f_expl_expr` = f and `f_impl_expr` = xdot - f, without the delay. acados
    always generates second derivatives of discrete dynamics, although Gauss-Newton never looks at
    them; without `second_order` they are NaN and cost nothing (the code is a tenth and compiles in
    a tenth of the time), and an exact Hessian fails at once instead of being wrong.
    """
    from acados_template import AcadosModel

    out = AcadosModel()
    out.name = model.name
    n = len(model.states) if dynamics == "discrete" else model.own_states
    x, u, p = (
        ca.MX.sym("x", n),
        ca.MX.sym("u", len(model.inputs)),
        ca.MX.sym("p", len(model.parameters)),
    )
    out.x, out.u = x, u
    if model.parameters:
        out.p = p
    if dynamics == "discrete":
        step = model["f_d"] if second_order else first_order(model)
        out.disc_dyn_expr = step(x, u, p)
    else:
        out.xdot = ca.MX.sym("xdot", n)
        out.f_expl_expr = model["f"](x, u, p)
        out.f_impl_expr = out.xdot - out.f_expl_expr
    return out


def first_order(model: Exported) -> ca.Function:
    """f_d whose derivative is the analytic f_d_jac_raw, computed in one go, and whose second
    derivatives are NaN."""
    step, slopes = model["f_d"], model["f_d_jac_raw"]
    sizes = {"x": len(model.states), "u": len(model.inputs), "p": len(model.parameters)}
    n = sizes["x"]
    given = {name: ca.MX.sym(name, size) for name, size in sizes.items()}
    result = ca.MX.sym("out_x_next", n)
    arguments, names = [*given.values(), result], [*given, "out_x_next"]
    blocks = [f"jac_x_next_{name}" for name in given]
    whole = {"enable_forward": False, "enable_reverse": False, "never_inline": True}
    # One NaN per block, where the slopes do change, spoils every product with it and costs nothing.
    second, labels = [], []
    for i, (block, size) in enumerate(zip(blocks, sizes.values())):
        for j, (name, argument) in enumerate(zip(names, arguments)):
            pattern = slopes.jac_sparsity(1 + i, j) if j < len(sizes) else ca.Sparsity(n * size, n)
            entry = [v[:1] for v in pattern.get_triplet()]
            second.append(
                ca.MX(
                    ca.DM(
                        ca.Sparsity.triplet(n * size, argument.numel(), *entry),
                        [np.nan] * len(entry[0]),
                    )
                )
            )
            labels.append(f"jac_{block}_{name}")
    results = [ca.MX.sym(f"out_{block}", n, size) for block, size in zip(blocks, sizes.values())]
    of_slopes = ca.Function(
        "jac_jac_f_d",
        [*arguments, *results],
        second,
        [*names, *(f"out_{block}" for block in blocks)],
        labels,
    )
    values = slopes(*given.values())[1:]
    jacobian = ca.Function(
        "jac_f_d", arguments, list(values), names, blocks, {"custom_jacobian": of_slopes, **whole}
    )
    return ca.Function(
        "f_d",
        [*given.values()],
        [step(*given.values())],
        [*given],
        ["x_next"],
        {"custom_jacobian": jacobian, **whole},
    )


def robust_solve(
    solver: AcadosOcpSolver,
    model: Exported,
    limits: ca.Function,
    upper: npt.ArrayLike,
    *,
    kappa: float,
    covariance: npt.ArrayLike,
    gain: npt.ArrayLike,
    rounds: int = 20,
    off: npt.ArrayLike | None = None,
    slopes: ca.Function | None = None,
) -> tuple[int, npt.NDArray[np.float64]]:
    """Zero-order robust optimisation with an `AcadosOcpSolver`: (status, back-offs (N + 1, m)).

    The solver's `con_h_expr` and `con_h_expr_e` are `limits`, a function of x (n_x,) with m values
    that must stay below `upper` (m,). In turn it solves, propagates `covariance` (n_d, n_d) of the
    first state along the plan under the feedback `gain` (n_u, n_d), and takes kappa standard
    deviations of every limit off `upper`, stage by stage, until nothing moves by more than
    `SETTLED`. A status other than 0 ends it, with the limits as they were solved with; that of
    `rounds` that were not enough is 2 (acados' "maximum number of iterations"). The covariance is
    fixed while it solves (Feng, Di Cairano and Quirynen 2020;
    Zanelli, Frey, Messerer and Diehl 2021). What is added at a stage is what the model says there,
    learned part included: acados' own template knows one W for all stages, and raw coordinates, in
    which a quaternion has none. Where one problem follows another, as in flight, `off` are the
    back-offs to begin with (those before) and `slopes` is `limit_slopes(model, limits)`; two rounds
    of an SQP_RTI solver are then a real-time iteration. The bundle needs the group "covariance".
    Raises `ValueError` without it, and for fewer rounds than one.
    """
    step, p = model["covariance_feedback"], model.parameter_values
    slope = limit_slopes(model, limits) if slopes is None else slopes
    fixed = np.asarray(gain, dtype=float)
    steps, most = int(solver.N), np.atleast_1d(np.asarray(upper, dtype=float))
    if rounds < 1:
        raise ValueError(f"rounds must be at least 1, not {rounds}")
    off = np.zeros((steps + 1, most.size)) if off is None else np.array(off, dtype=float)
    for _ in range(rounds):
        for k in range(1, steps + 1):
            solver.constraints_set(k, "uh", most - off[k])
        if status := int(solver.solve()):
            return status, off
        spread, before = np.asarray(covariance, dtype=float), off.copy()
        for k in range(steps + 1):
            c = slope(solver.get(k, "x")).full()
            off[k] = kappa * np.sqrt(np.maximum(np.diag(c @ spread @ c.T), 0.0))
            if k < steps:
                spread = step(solver.get(k, "x"), solver.get(k, "u"), p, spread, fixed).full()
        if np.abs(off - before).max() <= SETTLED:
            return 0, before
    return MAX_ITERATIONS, before


def limit_slopes(model: Exported, limits: ca.Function) -> ca.Function:
    """x -> slopes (m, n_d) of `limits`, a function of x (n_x,), in the error of the state."""
    x, d = ca.MX.sym("x", len(model.states)), ca.MX.sym("d", len(model.error_states))
    moved = ca.jacobian(limits(model["boxplus"](x, d)), d)
    return ca.Function("slope", [x], [ca.substitute(moved, d, ca.DM.zeros(d.shape))])


def explicit_difference(model: Exported, points: int = 50, seed: int = 0) -> dict[str, float]:
    """Largest difference per own state after one sample, in units of its typical size: f by one RK4
    step against f_d.

    At random points around the reference; the commands have been the same for as long as the delay
    reaches back, then change by up to a tenth of their range: what remains is the delay, the exact
    rotor lag and the held learned push.
    """
    rng = np.random.default_rng(seed)
    n, n_d = model.own_states, len(model.error_states)
    slope, dt, p = model["f"], model.dt, model.parameter_values
    width = np.where(
        np.isfinite(model.upper - model.lower), model.upper - model.lower, model.input_scale
    )
    free = np.array(
        [
            e.startswith(("history.", "d_history.", "disturbance.", "d_disturbance."))
            for e in model.error_states
        ]
    )
    worst = np.zeros(n)
    for _ in range(points):
        x = (
            model["boxplus"](
                model.reference_state, np.where(free, 0.0, 0.1 * rng.standard_normal(n_d))
            )
            .full()
            .ravel()
        )
        x = model.with_history(x[:n], model.reference_inputs).full().ravel()
        u = model.reference_inputs + 0.1 * width * rng.uniform(-1, 1, len(model.inputs))
        after = model["f_d"](x, u, p).full().ravel()[:n]
        worst = np.maximum(worst, np.abs(_rk4(slope, x[:n], u, p, dt) - after))
    relative = worst / np.where(model.state_scale[:n] > 0, model.state_scale[:n], 1.0)
    return dict(zip(model.states[:n], relative.tolist()))


def _rk4(
    slope: Callable[..., Expr],
    x: npt.NDArray[np.float64],
    u: npt.NDArray[np.float64],
    p: npt.NDArray[np.float64],
    dt: float,
) -> npt.NDArray[np.float64]:
    k1 = slope(x, u, p)
    k2 = slope(x + dt / 2 * k1, u, p)
    k3 = slope(x + dt / 2 * k2, u, p)
    k4 = slope(x + dt * k3, u, p)
    after: npt.NDArray[np.float64] = (x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)).full().ravel()
    return after
