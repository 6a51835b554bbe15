"""Covariance: one covariance function k(b, x), for NumPy arrays and for CasADi columns, and its
slope.

A kernel is one small file: a frozen dataclass with the formula in `column`, and how it is read from
the GPyTorch module of the same meaning. Sums, products, scales and active dimensions are
covariances of covariances (`algebra.py`), so that any tree of them is one.

Support points are rows (M, n); inputs are columns, (n, N) in NumPy and (n, 1) in CasADi. Formulas:
Rasmussen and Williams, Gaussian Processes for Machine Learning (2006), chapter 4.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, ClassVar

import casadi as ca
import numpy as np
import numpy.typing as npt
from scipy.spatial.distance import cdist

from greybox.errors import FileFormatError, GreyboxError, ModelError
from greybox.files import Json, Parsed
from greybox.symbolic import Expr, FloatArray, Namespace, Numeric

if TYPE_CHECKING:
    import torch

Pullback = Callable[[Expr], Expr]
"""c (M, 1) -> sum_i c_i dk(b_i, x)/dx, a row (1, n): the derivative backwards, written out."""


class Covariance(ABC):
    """k(b, x) >= 0 definite. `kind` is its name in files, `module` the GPyTorch class that it
    is."""

    kind: ClassVar[str]
    module: ClassVar[str] = ""

    @abstractmethod
    def column(self, support: FloatArray, x: Numeric, xp: Namespace) -> tuple[Numeric, Pullback]:
        """(k(support, x) (M, N), its pullback); `xp` is numpy or casadi, N = 1 with casadi."""

    @abstractmethod
    def variance(self, x: Numeric, xp: Namespace) -> Numeric:
        """k(x, x): (1, N)."""

    def variance_slope(self, x: Expr) -> Expr:
        """dk(x, x)/dx as a row (1, n); zero for a stationary covariance."""
        return ca.DM.zeros(1, x.shape[0])

    def matrix(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """k(a, b) (N, M) of rows a (N, n) and b (M, n)."""
        return np.asarray(self.column(a, b.T, np)[0])

    def to_dict(self) -> dict[str, Json]:
        """Plain JSON values."""
        plain = {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]
        for name, value in plain.items():
            if isinstance(value, np.ndarray):
                plain[name] = value.tolist()
        return {"kind": self.kind, **plain}

    @classmethod
    def from_dict(cls, value: Parsed) -> Covariance:
        """Inverse of `to_dict` without its `kind`."""
        return cls(**value)

    @classmethod
    def read(cls, module: torch.nn.Module, pick: Pick) -> Covariance:
        """From the GPyTorch module; `pick` takes the member of its batch out of a tensor."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class Pick:
    """Member `index` of a batched GPyTorch module, as float64."""

    index: int = 0

    def __call__(self, tensor: torch.Tensor, trailing: int) -> FloatArray:
        """The last `trailing` dimensions of `tensor` at the batch index. Raises `ModelError` for a
        batch of more than one dimension."""
        array = numbers(tensor)
        if array.ndim < trailing:
            array = array.reshape((1,) * (trailing - array.ndim) + array.shape)
        lead = array.shape[: array.ndim - trailing]
        if len([n for n in lead if n != 1]) > 1:
            raise ModelError("a batch of more than one dimension", got=str(lead), expected="one")
        flat = array.reshape((-1, *array.shape[array.ndim - trailing :]))
        return np.array(flat[self.index if len(flat) > 1 else 0])

    def scalar(self, tensor: torch.Tensor, trailing: int = 0) -> float:
        """One number whose own dimensions, `trailing` of them, are all 1."""
        return float(self(tensor, trailing).reshape(()))


def numbers(tensor: torch.Tensor) -> FloatArray:
    """A PyTorch tensor as float64 numbers, without importing PyTorch."""
    value = tensor.detach().cpu() if hasattr(tensor, "detach") else tensor
    return np.asarray(value.numpy() if hasattr(value, "numpy") else value, dtype=np.float64)


def same_forward(own: type[torch.nn.Module], known: type[torch.nn.Module]) -> bool:
    """Whether a class of modules computes what the one that it is made from does."""
    return bool(own.forward is known.forward)


def frozen(values: npt.ArrayLike) -> FloatArray:
    """A copy that cannot be written to."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


class Stationary(Covariance):
    """k = c(r^2) of r^2 = sum_d ((x_d - b_d)/lengthscales_d)^2; one length-scale for all inputs is
    given as one number in the array."""

    lengthscales: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "lengthscales", frozen(self.lengthscales).reshape(-1))
        if not (self.lengthscales > 0).all():
            raise ModelError(f"{self.kind}: length-scales must be positive")

    @abstractmethod
    def of(self, square: Numeric, xp: Namespace) -> tuple[Numeric, Numeric]:
        """(c, dc/d(r^2)) elementwise."""

    def column(self, support: FloatArray, x: Numeric, xp: Namespace) -> tuple[Numeric, Pullback]:
        """k and its pullback."""
        scale = np.broadcast_to(self.lengthscales, support.shape[1:])
        center = support.mean(axis=0) if len(support) else np.zeros(support.shape[1])
        b = (support - center) / scale
        z = (x - center[:, None]) / scale[:, None]
        if xp is np:
            square = cdist(b, z.T, "sqeuclidean")
        else:  # |z - b|^2 expanded about the centre: one product instead of M differences
            square = ca.fmax(ca.sumsqr(z) + np.sum(b * b, axis=1) - 2.0 * (ca.DM(b) @ z), 0.0)
        c, g = self.of(square, xp)

        def back(v: Expr) -> Expr:
            weighted = v * g
            row = z.T * ca.sum1(weighted) - (ca.DM(b.T) @ weighted).T
            return 2.0 * row / scale[None, :]

        return c, back

    def variance(self, x: Numeric, xp: Namespace) -> Numeric:
        """k(x, x)."""
        return np.ones((1, x.shape[1])) if xp is np else ca.DM(1.0)


KINDS: dict[str, type[Covariance]] = {}
"""Covariances by their name in files; the package fills it with its members."""


def covariance_from_dict(value: Parsed) -> Covariance:
    """Inverse of `Covariance.to_dict`. Raises `FileFormatError`."""
    try:
        return KINDS[value["kind"]].from_dict({k: v for k, v in value.items() if k != "kind"})
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        if isinstance(error, GreyboxError) and not isinstance(error, ModelError):
            raise
        raise FileFormatError(f"not a covariance: {error}") from None
