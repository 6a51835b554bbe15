"""Covariance functions that can be put together, by name in files and by GPyTorch's class names.

A new one is a file here and a line in `COVARIANCES`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from greybox.errors import ModelError
from greybox.residual.covariances.algebra import OnDims, Product, Scaled, Sum
from greybox.residual.covariances.constant import Constant
from greybox.residual.covariances.covariance import KINDS, Covariance, Pick, same_forward
from greybox.residual.covariances.linear import Linear
from greybox.residual.covariances.matern import Matern
from greybox.residual.covariances.periodic import Periodic
from greybox.residual.covariances.polynomial import Polynomial
from greybox.residual.covariances.rational_quadratic import RationalQuadratic
from greybox.residual.covariances.rbf import RBF

if TYPE_CHECKING:
    import torch

COVARIANCES: tuple[type[Covariance], ...] = (
    RBF,
    Matern,
    RationalQuadratic,
    Periodic,
    Linear,
    Polynomial,
    Constant,
    Sum,
    Product,
    Scaled,
    OnDims,
)
KINDS.update({c.kind: c for c in COVARIANCES})
_BY_MODULE = {c.module: c for c in COVARIANCES if c.module}


def read_module(
    module: torch.nn.Module, pick: Pick, where: str, *, whole: bool = False
) -> Covariance:
    """The covariance that a GPyTorch kernel module is; `where` is its place in the model.

    A subclass counts as what it is made from only where it changes nothing in `forward`. With
    `whole` the module's own active dimensions do not count, as inside GPyTorch's ScaleKernel and
    MultitaskKernel. Raises `ModelError` that names a module which is not supported and its place.
    """
    own = type(module)
    known = next((c for c in own.__mro__ if c.__name__ in _BY_MODULE), None)
    name = own.__name__
    if known is None or not same_forward(own, known):
        raise ModelError(
            f"{name} in {where} is not supported",
            expected=", ".join(sorted(_BY_MODULE)),
            fix="use these, or sums, products and scales of them",
        )
    kind = _BY_MODULE[known.__name__]
    found: Covariance
    if kind in (Sum, Product):
        members = [
            read_module(m, pick, f"{where}.kernels.{i}") for i, m in enumerate(module.kernels)
        ]
        found = Sum(parts=tuple(members)) if kind is Sum else Product(parts=tuple(members))
    elif kind is Scaled:
        inner = read_module(module.base_kernel, pick, f"{where}.base_kernel", whole=True)
        found = Scaled(factor=pick.scalar(module.outputscale), inner=inner)
    else:
        found = kind.read(module, pick)
    dims = getattr(module, "active_dims", None)
    if dims is None or whole:
        return found
    return OnDims(dims=tuple(dims.tolist()), inner=found)
