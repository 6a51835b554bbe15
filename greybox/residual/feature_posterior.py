"""FeaturePosterior: a learned part that is linear in features, as plain numbers, with its
predictions as CasADi expressions.

    x = (z - input_mean)/input_scale,   mean_j = output_scale_j w_j'phi(x),   variance_j = output_scale_j^2 |F_j phi(x)|^2

It is to a learner's features (`greybox.residual.learners`) what `GPPosterior` is to a kernel and
its support points, and answers the same questions. phi is kept operation by operation
(`greybox.model.expressions`), so that a file needs nothing of the learner that made it. `method` is
the learner's name.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.errors import FileFormatError, GreyboxError, ModelError, UnknownNameError
from greybox.files import Json, Parsed
from greybox.model.expressions import read_function, write_function
from greybox.residual.as_function import AsFunction
from greybox.residual.posterior import QUANTITIES, Domain
from greybox.shown import Cell, Shown
from greybox.symbolic import Expr, FloatArray, Layout, Signal, evaluate

SCHEMA = "greybox.learned_features/1"
_VECTORS = ("input_mean", "input_scale", "output_scale", "noise")
_ARRAYS = ("weights", "root")


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class FeaturePosterior(AsFunction, Shown):
    """Shapes: n_in inputs, n_out outputs, M features. `phi`: SX function x (n_in) -> (M,);
    `weights` (M, n_out); `root` (n_out, M, M), F with F'F the covariance of the weights; `prior`
    (n_out,) their variance before the data, in whose unit `distance` is told; `noise` (n_out,)
    variance of a new sample. Raises `ModelError`."""

    called: ClassVar[str] = "learned"

    inputs: Layout
    outputs: Layout
    method: str
    phi: ca.Function
    input_mean: FloatArray
    input_scale: FloatArray
    output_scale: FloatArray
    weights: FloatArray
    root: FloatArray
    prior: FloatArray
    noise: FloatArray
    domain: Domain
    members: int = 1
    """How many equal blocks of features were fitted each on its own (an ensemble); a file does not
    need it."""

    def __post_init__(self) -> None:
        n_in, n_out, m = len(self.inputs), len(self.outputs), self.phi.numel_out(0)
        shapes = {
            "input_mean": (n_in,),
            "input_scale": (n_in,),
            "output_scale": (n_out,),
            "noise": (n_out,),
            "prior": (n_out,),
            "weights": (m, n_out),
            "root": (n_out, m, m),
        }
        for name, shape in shapes.items():
            value = np.array(getattr(self, name), dtype=np.float64)
            value.setflags(write=False)
            if value.shape != shape or not np.isfinite(value).all():
                raise ModelError(
                    f"FeaturePosterior.{name}",
                    expected=f"finite numbers {shape}",
                    got=str(value.shape),
                )
            object.__setattr__(self, name, value)
        if (
            self.phi.numel_in(0) != n_in
            or not (self.input_scale > 0).all()
            or not (self.output_scale > 0).all()
        ):
            raise ModelError(
                "the features do not fit the inputs", expected=f"{n_in} inputs, positive scales"
            )

    def _shown_text(self) -> str:
        """What is learned of what."""
        learned = [n for n, on in zip(self.outputs.names, self.active, strict=True) if on]
        return (
            f"{self.method}, {self.points} features of {', '.join(self.inputs.names)}: "
            f"{', '.join(learned) or 'nothing'}"
        )

    def _shown_rows(self) -> list[dict[str, Cell]]:
        """One row per output."""
        return [
            {"output": s.name, "unit": s.unit, "learned": on}
            for s, on in zip(self.outputs, self.active, strict=True)
        ]

    @property
    def points(self) -> int:
        """M, the number of features."""
        return len(self.weights)

    @property
    def output_mean(self) -> FloatArray:
        """Zero: what is far from the data is left to the physics."""
        return np.zeros(len(self.outputs))

    @property
    def variance_factor(self) -> tuple[float, ...]:
        """One: nothing is inflated."""
        return (1.0,) * len(self.outputs)

    @property
    def active(self) -> tuple[bool, ...]:
        """Per output: whether the data say anything about it."""
        return tuple(bool(v) for v in np.any(self.weights != 0.0, axis=0))

    def expressions(
        self,
        z: Expr,
        which: Iterable[str],
        *,
        noise: bool | str = False,
        weights: Expr | None = None,
    ) -> dict[str, Expr]:
        """Several quantities (of `greybox.residual.posterior.QUANTITIES`) of one z, as
        `GPPosterior.expressions`."""
        wanted = set(which)
        for name in wanted - {*QUANTITIES, "distances"}:
            raise UnknownNameError("quantity of a learned part", name, (*QUANTITIES, "distances"))
        x = (ca.reshape(z, len(self.inputs), 1) - self.input_mean) / self.input_scale
        slopes = wanted & {"mean_jacobian", "variance_jacobian"}
        phi, slope = self._phi_and_slope(x) if slopes else (self.phi(x), ca.DM())
        own = ca.DM(self.weights) if weights is None else weights
        spread = [ca.sparsify(ca.DM(f)) @ phi for f in self.root]
        on = [i for i, a in enumerate(self.active) if a]
        square = self.output_scale**2
        out: dict[str, Expr] = {}
        if "mean" in wanted:
            out["mean"] = self.output_scale * (own.T @ phi)
        if "variance" in wanted:
            out["variance"] = square * ca.vertcat(*(ca.sumsqr(s) for s in spread)) + (
                self.noise if noise else 0.0
            )
        if "mean_jacobian" in wanted:
            out["mean_jacobian"] = (self.output_scale[:, None] / self.input_scale) * (own.T @ slope)
        if "variance_jacobian" in wanted:
            rows = [
                2 * (ca.sparsify(ca.DM(f)).T @ s).T @ slope
                for f, s in zip(self.root, spread, strict=True)
            ]
            out["variance_jacobian"] = (square[:, None] / self.input_scale) * ca.vertcat(*rows)
        if wanted & {"distance", "distances"}:
            before = [p * ca.sumsqr(phi) + 1e-12 for p in self.prior]
            shares = [ca.fmin(ca.sumsqr(s) / b, 1.0) for s, b in zip(spread, before, strict=True)]
            out["distances"] = ca.vertcat(
                *(s if i in on else ca.DM(1.0) for i, s in enumerate(shares))
            )
            out["distance"] = ca.mmax(ca.vertcat(*(shares[i] for i in on))) if on else ca.DM(1.0)
        return {n: out[n] for n in wanted}

    @cached_property
    def _phi_and_slope(self) -> ca.Function:
        x = ca.SX.sym("x", len(self.inputs))
        phi = ca.densify(self.phi(x))
        return ca.Function("phi", [x], [phi, ca.densify(ca.jacobian(phi, x))])

    def evaluate(self, z: npt.ArrayLike, *, noise: bool = False) -> tuple[FloatArray, FloatArray]:
        """Mean and variance (N, n_out) at the rows of z (N, n_in)."""
        both = evaluate(self._moments, np.ascontiguousarray(z, dtype=np.float64))
        n = len(self.outputs)
        return both[:, :n].copy(), both[:, n:] + (self.noise if noise else 0.0)

    def at_home(self, z: FloatArray) -> FeaturePosterior:
        """The same, knowing which `distance` is usual at its training inputs z (N, n_in)."""
        seen = evaluate(self._distance, np.ascontiguousarray(z)).ravel()
        usual = tuple(float(v) for v in np.quantile(seen, [0.5, 0.95, 0.99, 1.0]))
        return replace(
            self, domain=replace(self.domain, distance=(usual[0], usual[1], usual[2], usual[3]))
        )

    def to_dict(self) -> dict[str, Json]:
        """All of it as plain JSON values."""
        return {
            "schema": SCHEMA,
            "inputs": [vars(s) for s in self.inputs],
            "outputs": [vars(s) for s in self.outputs],
            "method": self.method,
            "features": write_function(self.phi),
            **{n: getattr(self, n).tolist() for n in (*_VECTORS, *_ARRAYS, "prior")},
            "domain": {
                "lower": self.domain.lower.tolist(),
                "upper": self.domain.upper.tolist(),
                "distance": list(self.domain.distance),
                "samples": self.domain.samples,
            },
        }

    @classmethod
    def from_dict(cls, value: Parsed) -> FeaturePosterior:
        """Inverse of `to_dict`. Raises `FileFormatError`."""
        if value.get("schema") != SCHEMA:
            raise FileFormatError("wrong schema", expected=SCHEMA, got=repr(value.get("schema")))
        try:
            numbers = {
                n: np.asarray(value[n], dtype=np.float64) for n in (*_VECTORS, *_ARRAYS, "prior")
            }
            return cls(
                inputs=Layout([Signal(**s) for s in value["inputs"]]),
                outputs=Layout([Signal(**s) for s in value["outputs"]]),
                method=str(value["method"]),
                phi=read_function("phi", value["features"]),
                domain=Domain(**value["domain"]),
                input_mean=numbers["input_mean"],
                input_scale=numbers["input_scale"],
                output_scale=numbers["output_scale"],
                noise=numbers["noise"],
                weights=numbers["weights"],
                root=numbers["root"],
                prior=numbers["prior"],
            )
        except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
            if isinstance(error, GreyboxError) and not isinstance(error, ModelError):
                raise
            raise FileFormatError(
                f"not a learned part ({error})", fix="pass what greybox wrote"
            ) from None


def silent_features(
    phi: ca.Function,
    *,
    method: str,
    inputs: Layout,
    outputs: Layout,
    input_mean: FloatArray,
    input_scale: FloatArray,
    output_scale: FloatArray,
    domain: Domain,
    members: int = 1,
) -> FeaturePosterior:
    """Features ready for `fit_open_loop`, their weights still zero."""
    m, n_out = phi.numel_out(0), len(outputs)
    return FeaturePosterior(
        inputs=inputs,
        outputs=outputs,
        method=method,
        phi=phi,
        input_mean=input_mean,
        input_scale=input_scale,
        output_scale=output_scale,
        weights=np.zeros((m, n_out)),
        root=np.zeros((n_out, m, m)),
        prior=np.ones(n_out),
        noise=output_scale**2,
        domain=domain,
        members=members,
    )
