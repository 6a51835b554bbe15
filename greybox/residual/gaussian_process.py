"""GaussianProcess: a GP of any covariance as plain numbers, with its predictions as CasADi
expressions.

What `from_gpytorch` makes. Where `GPPosterior` holds the independent processes that greybox
trains, on one support with one kernel family, this holds what others train: kernels put together
from pieces, several supports, outputs that share information (ICM, LMC), affine prior means. All
of it has one form. With the covariances k_q(Z_q, x) of several bases q in one column k,

    mean     = c + s'x + w'k
    variance = max(sum_q a_q k_q(x, x) - |E k|^2, 0) + |F k|^2 + offset

for each latent process, and outputs are a fixed mix of independent latent ones, y = A f: their
means mix with A, their variances with A squared elementwise. Exact, SGPR and SVGP posteriors,
batches, ICM (the Kronecker structure is already in w and E) and LMC differ in the numbers alone.

On disk: `<name>.json` (schema "greybox.gaussian_process/1") and `<name>.npz` beside it.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.errors import FileFormatError, ModelError, UnknownNameError
from greybox.files import MALFORMED, Json, Parsed
from greybox.residual.array_file import read_with_arrays, write_with_arrays
from greybox.residual.as_function import AsFunction
from greybox.residual.covariances.covariance import (
    Covariance,
    Pullback,
    covariance_from_dict,
    frozen,
)
from greybox.residual.gp_inputs import rows_of, standardised
from greybox.residual.posterior import QUANTITIES, Domain
from greybox.shown import Cell, Shown
from greybox.symbolic import Expr, FloatArray, Layout, Signal, evaluate

SCHEMA = "greybox.gaussian_process/1"
_SCALES = ("input_mean", "input_scale", "output_mean", "output_scale", "noise", "offset")


@dataclass(frozen=True, kw_only=True, eq=False)
class Base:
    """A covariance and the support points (M, n_in) that it is evaluated against, in transformed
    inputs. Raises `ModelError` for a covariance of another number of inputs."""

    covariance: Covariance
    support: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "support", frozen(self.support))
        try:
            self.covariance.matrix(self.support[:1], self.support[:1])
        except (ValueError, IndexError):
            raise ModelError(
                "the kernel is not made for this number of inputs",
                got=f"{self.support.shape[1]} inputs",
                fix="ard_num_dims and active_dims must be those of the training inputs",
            ) from None


@dataclass(frozen=True, kw_only=True, eq=False)
class Latent:
    """One latent process on the bases numbered `bases`, M support points in all.

    `prior` (one a_q per base), `weights` (M,), `explained` E and `uncertain` F (rows, M),
    `constant` and `slope` (n_in,) of the prior mean, `offset` an added variance (GPyTorch's
    jitter, where it adds one)."""

    bases: tuple[int, ...]
    prior: FloatArray
    weights: FloatArray
    explained: FloatArray
    uncertain: FloatArray
    constant: float
    slope: FloatArray
    offset: float = 0.0

    def __post_init__(self) -> None:
        for name in ("prior", "weights", "explained", "uncertain", "slope"):
            object.__setattr__(self, name, frozen(getattr(self, name)))


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class GaussianProcess(AsFunction, Shown):
    """A trained GP; all fields are plain numbers. n_in inputs, n_out outputs, n_f latent processes.

    The process sees (z - input_mean)/input_scale and its outputs are output_mean + output_scale (A
    f), with `mixing` A (n_out, n_f). `noise` (n_out,) is the variance of a new sample in output
    units squared, `offset` (n_out,) a variance in transformed units that is added to the outputs'.
    `method` says how the numbers were made. Raises `ModelError` where sizes do not fit.
    """

    inputs: Layout
    outputs: Layout
    method: str
    bases: tuple[Base, ...]
    latents: tuple[Latent, ...]
    mixing: FloatArray
    input_mean: FloatArray
    input_scale: FloatArray
    output_mean: FloatArray
    output_scale: FloatArray
    noise: FloatArray
    offset: FloatArray
    domain: Domain

    def _shown_text(self) -> str:
        """What it learned from what."""
        first = f"GP({', '.join(self.outputs.names)}) from {', '.join(self.inputs.names)}"
        how = f"{len(self.latents)} latent processes on {len(self.bases)} bases, {self.method}"
        return f"{first}\n  {how}, {self.domain.samples} training samples"

    def _shown_rows(self) -> list[dict[str, Cell]]:
        """One row per output: how many latent processes feed it, noise and offset."""
        return [
            {
                "output": s.name,
                "unit": s.unit,
                "latent processes": int(np.count_nonzero(a)),
                "noise std": float(np.sqrt(v)),
                "mean far from the data": float(m),
            }
            for s, a, v, m in zip(
                self.outputs, self.mixing, self.noise, self.output_mean, strict=True
            )
        ]

    def __post_init__(self) -> None:
        for name in (*_SCALES, "mixing"):
            object.__setattr__(self, name, frozen(getattr(self, name)))
        n_in, n_out, n_f = len(self.inputs), len(self.outputs), len(self.latents)
        shapes = {
            "input_mean": (n_in,),
            "input_scale": (n_in,),
            "output_mean": (n_out,),
            "output_scale": (n_out,),
            "noise": (n_out,),
            "offset": (n_out,),
            "mixing": (n_out, n_f),
        }
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value.shape != shape or not np.isfinite(value).all():
                raise ModelError(
                    f"GaussianProcess.{name}",
                    expected=f"finite numbers {shape}",
                    got=str(value.shape),
                )
        if (
            not (self.input_scale != 0).all()
            or not (self.output_scale > 0).all()
            or not (self.noise >= 0).all()
        ):
            raise ModelError(
                "GaussianProcess: scales must not be zero, noise variances not negative"
            )
        for base in self.bases:
            if base.support.ndim != 2 or base.support.shape[1] != n_in:
                raise ModelError(
                    "support points of the wrong size",
                    expected=f"(M, {n_in})",
                    got=str(base.support.shape),
                )
        for latent in self.latents:
            m = sum(len(self.bases[q].support) for q in latent.bases)
            sizes = (latent.weights.shape, latent.explained.shape[1:], latent.uncertain.shape[1:])
            if any(s != (m,) for s in sizes) or latent.slope.shape != (n_in,):
                raise ModelError(
                    "a latent process does not fit its bases",
                    expected=f"{m} weights",
                    got=str(sizes),
                )
            parts = (latent.prior, latent.weights, latent.explained, latent.uncertain, latent.slope)
            if not all(np.isfinite(part).all() for part in parts):
                raise ModelError("a latent process is not finite")

    @property
    def points(self) -> int:
        """Number of support points, of all bases together."""
        return sum(len(base.support) for base in self.bases)

    @property
    def active(self) -> tuple[bool, ...]:
        """Per output: whether the data say anything about it."""
        said = np.array([bool(np.any(latent.weights != 0.0)) for latent in self.latents])
        return tuple(bool(np.any(said & (row != 0.0))) for row in self.mixing)

    # -------------------- predictions

    def expressions(
        self,
        z: Expr,
        which: Iterable[str],
        *,
        noise: bool | str = False,
        weights: Expr | None = None,
    ) -> dict[str, Expr]:
        """Several quantities (mean, variance, mean_jacobian, variance_jacobian, distance) of one
        z, sharing all common work. Raises `UnknownNameError`, and `ModelError` for a z of another
        length or for `weights`, which cannot change at run time here."""
        wanted = set(which)
        for name in wanted - set(QUANTITIES):
            raise UnknownNameError("GP quantity", name, QUANTITIES)
        if weights is not None:
            raise ModelError(
                "the weights of this GP cannot change at run time",
                fix="leave gp.weights out of --runtime",
            )
        x = standardised(z, self.input_mean, self.input_scale)
        columns = [base.covariance.column(base.support, x, ca) for base in self.bases]
        told = [self._latent(latent, x, columns, wanted) for latent in self.latents]
        mix, square = ca.sparsify(ca.DM(self.mixing)), ca.sparsify(ca.DM(self.mixing**2))
        factor = self.output_scale**2
        out: dict[str, Expr] = {}
        if "mean" in wanted:
            out["mean"] = self.output_mean + self.output_scale * (
                mix @ ca.vertcat(*(t["mean"] for t in told))
            )
        if "variance" in wanted:
            mixed = square @ ca.vertcat(*(t["variance"] for t in told)) + self.offset
            out["variance"] = factor * mixed + self.noise_variance(noise)
        if "mean_jacobian" in wanted:
            rows = mix @ ca.vertcat(*(t["mean_jacobian"] for t in told))
            out["mean_jacobian"] = (self.output_scale[:, None] / self.input_scale) * rows
        if "variance_jacobian" in wanted:
            rows = square @ ca.vertcat(*(t["variance_jacobian"] for t in told))
            out["variance_jacobian"] = (factor[:, None] / self.input_scale) * rows
        if "distance" in wanted:
            out["distance"] = ca.mmax(ca.vertcat(*(t["distance"] for t in told)))
        return out

    def _latent(
        self, of: Latent, x: Expr, columns: Sequence[tuple[Expr, Pullback]], wanted: set[str]
    ) -> dict[str, Expr]:
        """Quantities of one latent process at the transformed column x."""
        k = ca.vertcat(*(columns[q][0] for q in of.bases))
        ends = np.cumsum([len(self.bases[q].support) for q in of.bases]).tolist()
        starts = [0, *ends[:-1]]

        def back(c: Expr) -> Expr:
            parts = [columns[q][1](c[a:b]) for q, a, b in zip(of.bases, starts, ends)]
            return sum(parts[1:], parts[0])

        weights, out = ca.DM(of.weights), {}
        if "mean" in wanted:
            out["mean"] = of.constant + ca.dot(ca.DM(of.slope), x) + ca.dot(weights, k)
        if "mean_jacobian" in wanted:
            out["mean_jacobian"] = ca.DM(of.slope).T + back(weights)
        if not wanted & {"variance", "variance_jacobian", "distance"}:
            return out
        bases = [self.bases[q].covariance for q in of.bases]
        prior = sum(a * c.variance(x, ca) for a, c in zip(of.prior.tolist(), bases))
        first, second = ca.sparsify(ca.DM(of.explained)), ca.sparsify(ca.DM(of.uncertain))
        explained, uncertain = first @ k, second @ k
        left = prior - ca.sumsqr(explained)
        if "variance" in wanted:
            out["variance"] = ca.fmax(left, 0.0) + ca.sumsqr(uncertain) + of.offset
        if "variance_jacobian" in wanted:
            cut = left > 0.0
            own = sum(a * c.variance_slope(x) for a, c in zip(of.prior.tolist(), bases))
            slope = back(second.T @ uncertain - cut * (first.T @ explained))
            out["variance_jacobian"] = 2.0 * slope + cut * own
        if "distance" in wanted:
            out["distance"] = ca.fmax(left, 0.0) / prior
        return out

    def noise_variance(self, noise: bool | str = True) -> FloatArray:
        """(n_out,) in output units squared: zero for False, that of a new sample for True."""
        if isinstance(noise, str):
            raise UnknownNameError("group of the GP's noise", noise, ())
        return self.noise if noise else np.zeros(len(self.outputs))

    def evaluate(
        self, z: npt.ArrayLike, noise: bool | str = False
    ) -> tuple[FloatArray, FloatArray]:
        """Mean and variance (N, n_out) at the rows of z (N, n_in)."""
        both, n = evaluate(self._moments, rows_of(z, len(self.inputs))), len(self.outputs)
        return both[:, :n].copy(), both[:, n:] + self.noise_variance(noise)

    def evaluate_mean(self, z: npt.ArrayLike) -> FloatArray:
        """The mean alone, (N, n_out), at the rows of z (N, n_in)."""
        return self.evaluate(z)[0]

    def evaluate_distance(self, z: npt.ArrayLike) -> FloatArray:
        """`distance` (N,) at the rows of z (N, n_in)."""
        return evaluate(self._distance, rows_of(z, len(self.inputs)))[:, 0]

    # -------------------- files

    def parts(self) -> tuple[dict[str, Json], dict[str, FloatArray]]:
        """(plain JSON values, arrays by name)."""
        arrays = {f"support.{q}": base.support for q, base in enumerate(self.bases)}
        for i, latent in enumerate(self.latents):
            arrays |= {
                f"{n}.{i}": getattr(latent, n) for n in ("weights", "explained", "uncertain")
            }
        plain = {
            "inputs": [vars(s) for s in self.inputs],
            "outputs": [vars(s) for s in self.outputs],
            "method": self.method,
            "covariances": [base.covariance.to_dict() for base in self.bases],
            "latents": [
                {
                    "bases": list(f.bases),
                    "prior": f.prior.tolist(),
                    "constant": f.constant,
                    "slope": f.slope.tolist(),
                    "offset": f.offset,
                }
                for f in self.latents
            ],
            "mixing": self.mixing.tolist(),
            **{name: getattr(self, name).tolist() for name in _SCALES},
            "domain": {
                "lower": self.domain.lower.tolist(),
                "upper": self.domain.upper.tolist(),
                "distance": list(self.domain.distance),
                "samples": self.domain.samples,
            },
        }
        return plain, arrays

    @classmethod
    def from_parts(cls, plain: Parsed, arrays: Mapping[str, FloatArray]) -> GaussianProcess:
        """Inverse of `parts`. Raises `FileFormatError` where something is missing or does not
        fit."""
        try:
            latents = tuple(
                Latent(
                    bases=tuple(f["bases"]),
                    prior=f["prior"],
                    constant=float(f["constant"]),
                    slope=f["slope"],
                    offset=float(f["offset"]),
                    **{n: arrays[f"{n}.{i}"] for n in ("weights", "explained", "uncertain")},
                )
                for i, f in enumerate(plain["latents"])
            )
            return cls(
                inputs=Layout([Signal(**s) for s in plain["inputs"]]),
                outputs=Layout([Signal(**s) for s in plain["outputs"]]),
                method=str(plain["method"]),
                bases=tuple(
                    Base(covariance=covariance_from_dict(c), support=arrays[f"support.{q}"])
                    for q, c in enumerate(plain["covariances"])
                ),
                latents=latents,
                mixing=plain["mixing"],
                domain=Domain(**plain["domain"]),
                **{name: plain[name] for name in _SCALES},
            )
        except MALFORMED as error:
            raise FileFormatError(
                f"not a Gaussian process: {error!r}", fix="pass what greybox wrote"
            ) from None

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write `path` (JSON) and the arrays beside it (same stem, .npz), each atomically. Returns
        the path."""
        return write_with_arrays(path, SCHEMA, *self.parts())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> GaussianProcess:
        """Read what `save` wrote. Raises `FileFormatError`."""
        return cls.from_parts(*read_with_arrays(path, SCHEMA))
