"""Solvers: one file is one member; `SOLVERS` maps names to them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping

from greybox.estimation.solver import Solver
from greybox.estimation.solvers.gauss_newton import GaussNewton
from greybox.estimation.solvers.ipopt import Ipopt
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt
from greybox.estimation.solvers.scipy_trf import ScipyTrf

SOLVERS: Mapping[str, Callable[..., Solver]] = {
    "levenberg-marquardt": LevenbergMarquardt,
    "gauss-newton": GaussNewton,
    "scipy-trf": ScipyTrf,
    "ipopt": Ipopt,
    "ipopt-exact": functools.partial(Ipopt, name="ipopt-exact", hessian="exact"),
}
