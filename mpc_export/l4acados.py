"""A learned residual in the shape that l4acados takes, from a bundle: no PyTorch, no GPyTorch.

l4acados (Lahr, Naef, Wabersich, Frey, Siehl, Carron, Diehl, Zeilinger, arXiv 2411.19258) adds B
r(x, u) to the step of a nominal acados model and asks an object for r at all N points (x_k, u_k) of
the horizon at once:

    value_and_jacobian(y), y (N, n_x + n_u)  ->  value (N, n_w), Jacobian (n_w, N, n_x + n_u); current_variance (N, n_w)

Here r is the exact difference of the hybrid step and the step of its physics alone, f_d -
f_d_nominal, in the rows of x that the learned push can reach; `B` (n_x, n_w) puts them back. The
nominal model for acados is `nominal(model)`. The variance is the diagonal of B_d_raw Var B_d_raw'
in those rows: l4acados keeps no more of it (see `covariance_step`). Needs a bundle that was
exported `--with nominal`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from mpc_export.exported import Exported

Array = npt.NDArray[np.float64]
NEEDED = (
    "f_d_jac_raw",
    "f_d_nominal",
    "f_d_nominal_jac_raw",
    "gp_features_raw",
    "gp_variance",
    "B_d_raw",
)


def nominal(model: Exported) -> Exported:
    """The model whose step is that of the physics alone, for `acados_model`. Raises `ValueError`
    without one."""
    _check(model)
    step, slopes = model["f_d_nominal"], model["f_d_nominal_jac_raw"]
    return replace(model, functions={"f_d": step, "f_d_jac_raw": slopes})


def _check(model: Exported) -> None:
    missing = [name for name in NEEDED if name not in model]
    if missing:
        raise ValueError(
            f"{model.name} lacks {', '.join(missing)}; expected a model with a learned part, "
            "exported --with nominal"
        )


class LearnedResidual:
    """The residual of one model; `parameters` (n_p,) are the values of p (default: the identified
    ones).

    After each evaluation `current_prediction` and `current_mean` (N, n_w), `current_variance` (N,
    n_w) and, after `jacobian` or `value_and_jacobian`, `current_prediction_dy` (n_w, N, n_x + n_u)
    hold its results. Raises `ValueError`.
    """

    def __init__(self, model: Exported, parameters: Array | None = None) -> None:
        _check(model)
        self.parameters = (
            model.parameter_values if parameters is None else np.asarray(parameters, dtype=float)
        )
        self.sizes = (len(model.states), len(model.inputs))
        push = model["B_d_raw"](
            model.reference_state, model.reference_inputs, self.parameters
        ).full()
        rng = np.random.default_rng(0)
        for _ in range(5):  # a row may be zero by chance at one point
            moved = 0.1 * rng.standard_normal(len(model.error_states))
            x = model["boxplus"](model.reference_state, moved)
            push = np.maximum(
                np.abs(push),
                np.abs(model["B_d_raw"](x, model.reference_inputs, self.parameters).full()),
            )
        self.rows = tuple(np.flatnonzero(push.max(axis=1) > 0).tolist())
        """Indices into x of the residual's channels."""
        self.B = np.eye(self.sizes[0])[:, list(self.rows)]
        self._point = self._build(model)
        self._horizon: dict[int, ca.Function] = {}
        self.current_prediction = self.current_mean = self.current_variance = np.zeros(
            (0, len(self.rows))
        )
        self.current_prediction_dy = np.zeros((len(self.rows), 0, sum(self.sizes)))

    def _build(self, model: Exported) -> ca.Function:
        """(y, p) -> r (n_w, 1), dr/dy (n_w, n_x + n_u), variance (n_w, 1)."""
        nx, nu = self.sizes
        y, p = ca.MX.sym("y", nx + nu), ca.MX.sym("p", self.parameters.size)
        x, u, rows = y[:nx], y[nx:], list(self.rows)
        full, full_x, full_u, _ = model["f_d_jac_raw"](x, u, p)
        plain, plain_x, plain_u, _ = model["f_d_nominal_jac_raw"](x, u, p)
        slope = ca.horzcat(full_x - plain_x, full_u - plain_u)
        variance = ca.fmax(model["gp_variance"](model["gp_features_raw"](x, u, p)[0], p), 0.0)
        spread = model["B_d_raw"](x, u, p) ** 2 @ variance
        return ca.Function("residual", [y, p], [(full - plain)[rows], slope[rows, :], spread[rows]])

    def _all(self, y: Array) -> None:
        points = np.atleast_2d(np.asarray(y, dtype=float))
        nx, nu = self.sizes
        if points.ndim != 2 or points.shape[1] != nx + nu:
            raise ValueError(f"expected y of shape (N, {nx + nu}), got {np.shape(y)}")
        n = len(points)
        if n not in self._horizon:
            self._horizon[n] = self._point.map(n)
        values = self._horizon[n](points.T, np.tile(self.parameters[:, None], n))
        mean, slope, variance = (v.full() for v in values)
        self.current_prediction = self.current_mean = mean.T
        self.current_variance = variance.T
        self.current_prediction_dy = np.stack(
            [slope[:, k * (nx + nu) : (k + 1) * (nx + nu)] for k in range(n)], axis=1
        )

    def evaluate(self, y: Array) -> Array:
        """r (N, n_w) at y (N, n_x + n_u)."""
        self._all(y)
        return self.current_prediction

    def jacobian(self, y: Array) -> Array:
        """dr/dy (n_w, N, n_x + n_u) at y."""
        self._all(y)
        return self.current_prediction_dy

    def value_and_jacobian(self, y: Array) -> tuple[Array, Array]:
        """r (N, n_w) and dr/dy (n_w, N, n_x + n_u) at y (N, n_x + n_u), from one evaluation."""
        self._all(y)
        return self.current_prediction, self.current_prediction_dy
