"""GPPosterior: a trained Gaussian process as plain numbers (float64), with its predictions as
CasADi expressions.

One independent process per output; all share the support points. Without PyTorch. For output j and
an input z,

    x = (z - input_mean)/input_scale,   k = k_j(support, x)
    mean_j     = output_mean_j + output_scale_j weights_j'k
    variance_j = output_scale_j^2 factor_j (max(k_j(x, x) - |L1_j k|^2, 0) + |L2_j k|^2)        [+ noise_j]

which covers the exact posterior (L2 = 0), SGPR and SVGP (greybox/residual/sparse.py). The Jacobians
are written out analytically: from dk_i/dx = 2 g_i (x - b_i)/lengthscale^2 both are matrix-vector
products with one `exp` over the support. In MX the vectors stay vectors, which is the fast form
inside optimisers; SX gives scalars, and numbers give numbers.

On disk: `<name>.json` (schema "greybox.gp/1", all but the large arrays, with a checksum) and
`<name>.npz` beside it.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.errors import FileFormatError, ModelError, UnknownNameError
from greybox.files import MALFORMED, Json, Parsed, checksum, read_json, write_atomic, write_json
from greybox.plots import Curve, panels
from greybox.residual.array_file import load_arrays, packed
from greybox.residual.as_function import AsFunction
from greybox.residual.gp_inputs import rows_of, standardised
from greybox.residual.kernels import Kernel
from greybox.shown import Cell, Shown
from greybox.symbolic import Expr, FloatArray, Layout, Signal, evaluate

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SCHEMA = "greybox.gp/1"
METHODS = ("exact", "sgpr", "svgp")
QUANTITIES = ("mean", "variance", "mean_jacobian", "variance_jacobian", "distance")
SLICE = 200
"""Points of a plotted slice."""
_VECTORS = ("input_mean", "input_scale", "output_mean", "output_scale", "noise")
_ARRAYS = ("support", "weights", "explained", "uncertain")


@dataclass(frozen=True, kw_only=True, eq=False)
class Domain:
    """Where the training inputs lie: lower and upper (n_in,) in the inputs' units, and the 50, 95,
    99 and 100 % quantiles of `GPPosterior.distance` over them (they say which distance is usual
    inside the domain)."""

    lower: FloatArray
    upper: FloatArray
    distance: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    samples: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "lower", _frozen(self.lower))
        object.__setattr__(self, "upper", _frozen(self.upper))
        object.__setattr__(self, "distance", tuple(float(v) for v in self.distance))


@dataclass(kw_only=True)
class _Common:
    """What outputs with one kernel share: k and g of the kernel, and the product of the last factor
    L1 with k."""

    k: Expr
    g: Expr
    factor: FloatArray | None = None
    first: Expr = None
    explained: Expr = None


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class GPPosterior(AsFunction, Shown):
    """A trained GP; all fields are plain numbers. Shapes: n_in inputs, n_out outputs, M support
    points.

    `kernels` one per output (outputs that share a kernel share its evaluation). `support` (M, n_in)
    and the kernels are in standardised inputs, `weights` (M, n_out), `explained` and `uncertain`
    (n_out, M, M; lower triangular L1 and L2) in standardised outputs. `output_mean` (n_out,)
    includes the prior mean and is what the mean returns to far from the data. `noise` (n_out,) is
    the noise variance of a new sample in output units squared, `group_noise` the same of each known
    group (flight). `noise_inflation` and `jitter` (n_out,) say how the numbers were made;
    `variance_factor` (n_out,), 1 or more, multiplies the variance (`sparse.variance_guard`). An
    output whose weights are all zero carries no information: its mean is constant and its variance
    the prior's. Raises `ModelError`.
    """

    inputs: Layout
    outputs: Layout
    method: str
    kernels: tuple[Kernel, ...]
    input_mean: FloatArray
    input_scale: FloatArray
    output_mean: FloatArray
    output_scale: FloatArray
    support: FloatArray
    weights: FloatArray
    explained: FloatArray
    uncertain: FloatArray
    noise: FloatArray
    domain: Domain
    group_noise: Mapping[str, FloatArray] = field(default_factory=dict)
    noise_inflation: tuple[float, ...] = ()
    jitter: tuple[float, ...] = ()
    variance_factor: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name in (*_VECTORS, *_ARRAYS):
            object.__setattr__(self, name, _frozen(getattr(self, name)))
        object.__setattr__(
            self,
            "group_noise",
            MappingProxyType({k: _frozen(v) for k, v in self.group_noise.items()}),
        )
        object.__setattr__(self, "kernels", tuple(self.kernels))
        n_in, n_out = len(self.inputs), len(self.outputs)
        for name, default in (("noise_inflation", 1.0), ("jitter", 0.0), ("variance_factor", 1.0)):
            given = tuple(float(v) for v in getattr(self, name)) or (default,) * n_out
            if len(given) != n_out:
                raise ModelError(
                    f"GPPosterior.{name} has {len(given)} values",
                    expected=f"{n_out}, one per output",
                )
            object.__setattr__(self, name, given)
        m = len(self.support)
        shapes = {
            "input_mean": (n_in,),
            "input_scale": (n_in,),
            "output_mean": (n_out,),
            "output_scale": (n_out,),
            "noise": (n_out,),
            "support": (m, n_in),
            "weights": (m, n_out),
            "explained": (n_out, m, m),
            "uncertain": (n_out, m, m),
        }
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value.shape != shape:
                raise ModelError(f"GPPosterior.{name} has shape {value.shape}", expected=f"{shape}")
            if not np.isfinite(value).all():
                raise ModelError(f"GPPosterior.{name} is not finite")
        if self.method not in METHODS:
            raise UnknownNameError("GP method", self.method, METHODS)
        if len(self.kernels) != n_out or any(len(k.lengthscales) != n_in for k in self.kernels):
            raise ModelError(
                "GPPosterior.kernels do not fit the layouts",
                expected=f"{n_out} kernels of {n_in} inputs",
            )
        if (
            not (self.input_scale > 0).all()
            or not (self.output_scale > 0).all()
            or not (self.noise >= 0).all()
            or not all(1.0 <= f < np.inf for f in self.variance_factor)
        ):
            raise ModelError(
                "GPPosterior: scales must be positive, noise variances not negative, factors of "
                "the variance 1 or more"
            )

    def __getstate__(self) -> dict[str, object]:
        """The numbers, so that a model with a learned part can be pickled, copied and sent to
        another process."""
        given = {f.name: getattr(self, f.name) for f in fields(self)}
        return given | {"group_noise": dict(self.group_noise)}

    def __setstate__(self, state: dict[str, object]) -> None:
        for name, value in state.items():
            object.__setattr__(self, name, value)
        self.__post_init__()

    # --------------------------------------------------------------------------------- predictions

    @property
    def points(self) -> int:
        """M, the number of support points."""
        return len(self.support)

    @property
    def active(self) -> tuple[bool, ...]:
        """Per output: whether the data say anything about it (else its mean is constant)."""
        return tuple(bool(v) for v in np.any(self.weights != 0.0, axis=0))

    @property
    def support_points(self) -> FloatArray:
        """The support points in the inputs' units, (M, n_in)."""
        return self.support * self.input_scale + self.input_mean

    def distances(self, z: Expr) -> Expr:
        """Per output (n_out, 1) the share of the prior variance that the support points leave
        unexplained, 1 - |L1 k(x)|^2/k(x, x): the conditional variance in which Burt, Rasmussen and
        van der Wilk (JMLR 21, 2020) place inducing points, over the prior's. 1 for outputs that are
        not active."""
        return self.expressions(z, ("distances",))["distances"]

    def expressions(
        self,
        z: Expr,
        which: Iterable[str],
        *,
        noise: bool | str = False,
        weights: Expr | None = None,
    ) -> dict[str, Expr]:
        """Several quantities (of `QUANTITIES`, and "distances") of one z, sharing all common work.

        `weights` (M, n_out) stand in for the stored ones, so that they can change at run time.
        """
        wanted = set(which)
        for name in wanted - {*QUANTITIES, "distances"}:
            raise UnknownNameError("GP quantity", name, (*QUANTITIES, "distances"))
        rows = self._standardised(
            standardised(z, self.input_mean, self.input_scale), wanted, weights
        )
        variance_scale = self.output_scale**2 * self.variance_factor
        out: dict[str, Expr] = {}
        if "mean" in wanted:
            out["mean"] = self.output_mean + self.output_scale * ca.vertcat(*rows["mean"])
        if "variance" in wanted:
            out["variance"] = variance_scale * ca.vertcat(*rows["variance"]) + self.noise_variance(
                noise
            )
        # Rows are per output (scale from the left), columns per input (scale from the right).
        if "mean_jacobian" in wanted:
            out["mean_jacobian"] = (self.output_scale[:, None] / self.input_scale) * ca.vertcat(
                *rows["jm"]
            )
        if "variance_jacobian" in wanted:
            out["variance_jacobian"] = (variance_scale[:, None] / self.input_scale) * ca.vertcat(
                *rows["jv"]
            )
        if "distances" in wanted:
            out["distances"] = ca.vertcat(*rows["distances"])
        if "distance" in wanted:
            active = [rows["distances"][j] for j, is_active in enumerate(self.active) if is_active]
            out["distance"] = ca.mmax(ca.vertcat(*active)) if active else ca.DM(1.0)
        return out

    def _standardised(
        self, x: Expr, wanted: set[str], weights: Expr | None
    ) -> dict[str, list[Expr]]:
        """Quantity -> its standardised value of every output, at the standardised column x."""
        rows: dict[str, list[Expr]] = {
            name: [] for name in ("mean", "variance", "jm", "jv", "distances")
        }
        shared: dict[int, _Common] = {}
        for j, kernel in enumerate(self.kernels):
            if self.active[j] and id(kernel) not in shared:
                k, g = kernel.covariance_and_slope(self.support.T, x, ca)
                shared[id(kernel)] = _Common(k=k, g=g)
            own = ca.DM(self.weights[:, j]) if weights is None else weights[:, j]
            parts = self._output(j, x, shared.get(id(kernel)), wanted, own)
            for name, value in parts.items():
                rows[name].append(value)
        return rows

    def _output(
        self, j: int, x: Expr, common: _Common | None, wanted: set[str], weights: Expr
    ) -> dict[str, Expr]:
        """Standardised quantities of output j at the standardised column x."""
        kernel = self.kernels[j]
        prior = kernel.prior_variance(x, ca)
        out: dict[str, Expr] = {}
        need_variance = wanted & {"variance", "variance_jacobian", "distance", "distances"}
        if common is None:
            out["mean"], out["variance"], out["distances"] = ca.DM(0.0), prior, ca.DM(1.0)
            out["jm"] = out["jv"] = ca.DM.zeros(1, len(self.inputs))
            if "variance_jacobian" in wanted:
                out["jv"] = kernel.prior_variance_slope(x)
            return out
        k, g = common.k, common.g
        support = self.support.T
        if "mean" in wanted:
            out["mean"] = ca.dot(weights, k)
        if "mean_jacobian" in wanted:
            out["jm"] = kernel.contract(support, x, g, weights)
        if need_variance:
            if common.factor is None or not np.array_equal(common.factor, self.explained[j]):
                common.factor, common.first = (
                    self.explained[j],
                    ca.sparsify(ca.DM(self.explained[j])),
                )
                common.explained = common.first @ k
            first, explained = common.first, common.explained
            conditional = prior - ca.sumsqr(explained)
            if wanted & {"distance", "distances"}:
                out["distances"] = ca.fmax(conditional, 0.0) / prior
            second = ca.sparsify(ca.DM(self.uncertain[j]))
            uncertain = second @ k
            if "variance" in wanted:
                out["variance"] = ca.fmax(conditional, 0.0) + ca.sumsqr(uncertain)
            if "variance_jacobian" in wanted:
                cut = conditional > 0.0
                slope = kernel.contract(
                    support, x, g, second.T @ uncertain - cut * (first.T @ explained)
                )
                out["jv"] = 2.0 * slope + cut * kernel.prior_variance_slope(x)
        return out

    def noise_variance(self, noise: bool | str = True) -> FloatArray:
        """(n_out,) in output units squared: zero for False, that of a new sample for True, or of
        the named group."""
        if noise is False:
            return np.zeros(len(self.outputs))
        if noise is True:
            return self.noise
        if noise not in self.group_noise:
            raise UnknownNameError("group of the GP's noise", str(noise), self.group_noise)
        return self.group_noise[noise]

    @cached_property
    def _mean(self) -> ca.Function:
        return self.function("mean", ("mean",))

    def evaluate(
        self, z: npt.ArrayLike, *, noise: bool | str = False
    ) -> tuple[FloatArray, FloatArray]:
        """(mean, variance), each (N, n_out), at the rows of z (N, n_in): the expressions above over
        many samples."""
        both = evaluate(self._moments, rows_of(z, len(self.inputs)))
        n = len(self.outputs)
        return both[:, :n].copy(), both[:, n:] + self.noise_variance(noise)

    def evaluate_mean(self, z: npt.ArrayLike) -> FloatArray:
        """The mean alone, (N, n_out), at the rows of z (N, n_in); about ten times cheaper than
        `evaluate`."""
        return evaluate(self._mean, rows_of(z, len(self.inputs)))

    def evaluate_distance(self, z: npt.ArrayLike) -> FloatArray:
        """`distance` (N,) at the rows of z (N, n_in)."""
        return evaluate(self._distance, rows_of(z, len(self.inputs)))[:, 0]

    def _shown_text(self) -> str:
        """What it learned from what, with how many points."""
        return "\n".join(
            [
                f"GP({', '.join(self.outputs.names)}) from {', '.join(self.inputs.names)}",
                f"  {self.points} support points, {self.method}, {self.domain.samples} training "
                "samples",
            ]
        )

    def _shown_rows(self) -> list[dict[str, Cell]]:
        """One row per output: kernel and noise."""
        return [
            {
                "output": s.name,
                "unit": s.unit,
                "kernel": k.family,
                "noise std": float(np.sqrt(v)),
                "mean far from the data": float(m),
            }
            for s, k, v, m in zip(
                self.outputs, self.kernels, self.noise, self.output_mean, strict=True
            )
        ]

    def plot(
        self,
        along: str,
        outputs: Sequence[str] | None = None,
        *,
        at: Mapping[str, float] | None = None,
        ax: Sequence[Axes] | None = None,
    ) -> list[Axes]:
        """A slice: mean and two standard deviations of `outputs` (all) along the input `along` over
        its training range, the other inputs at the middle of theirs or `at` given values.
        Matplotlib axes, one panel per output.

        Raises `UnknownNameError` for an input or output that is not there.
        """
        for name in (along, *(at or {})):
            if name not in self.inputs:
                raise UnknownNameError("input of the GP", name, self.inputs.names)
        middle = (self.domain.lower + self.domain.upper) / 2.0
        z = np.tile(middle, (SLICE, 1))
        for name, value in (at or {}).items():
            z[:, self.inputs[name]] = value
        column = self.inputs[along]
        z[:, column] = np.linspace(self.domain.lower[column], self.domain.upper[column], SLICE)
        mean, variance = self.evaluate(z)
        rows = {}
        for name in self.outputs.names if outputs is None else outputs:
            if name not in self.outputs:
                raise UnknownNameError("output of the GP", name, self.outputs.names)
            j = self.outputs[name]
            curve = Curve(
                label="", x=z[:, column], y=mean[:, j], spread=2.0 * np.sqrt(variance[:, j])
            )
            rows[f"{name} [{self.outputs.signals[j].unit}]"] = [curve]
        return panels(rows, x=f"{along} [{self.inputs.signals[column].unit}]", ax=ax)

    # --------------------------------------------------------------------------------------- files

    def parts(self) -> tuple[dict[str, Json], dict[str, FloatArray]]:
        """(plain JSON values, arrays by name): the triangular factors are packed, kernels that are
        shared are one."""
        unique: list[Kernel] = []
        for kernel in self.kernels:
            if not any(kernel is u for u in unique):
                unique.append(kernel)
        places = [next(i for i, u in enumerate(unique) if u is kernel) for kernel in self.kernels]
        lower = np.tril_indices(self.points)
        arrays = {
            "support": self.support,
            "weights": self.weights,
            "explained": self.explained[:, lower[0], lower[1]],
            "uncertain": self.uncertain[:, lower[0], lower[1]],
        }
        plain = {
            "inputs": [vars(s) for s in self.inputs],
            "outputs": [vars(s) for s in self.outputs],
            "method": self.method,
            "points": self.points,
            "kernels": [k.to_dict() for k in unique],
            "kernel_of_output": places,
            **{name: getattr(self, name).tolist() for name in _VECTORS},
            "group_noise": {k: v.tolist() for k, v in self.group_noise.items()},
            "noise_inflation": list(self.noise_inflation),
            "jitter": list(self.jitter),
            "variance_factor": list(self.variance_factor),
            "domain": {
                "lower": self.domain.lower.tolist(),
                "upper": self.domain.upper.tolist(),
                "distance": list(self.domain.distance),
                "samples": self.domain.samples,
            },
        }
        return plain, arrays

    @classmethod
    def from_parts(cls, plain: Parsed, arrays: Mapping[str, npt.ArrayLike]) -> GPPosterior:
        """Inverse of `parts`. Raises `FileFormatError` where something is missing or does not
        fit."""
        try:
            kernels = [Kernel.from_dict(k) for k in plain["kernels"]]
            m = int(plain["points"])
            n_out = len(plain["outputs"])
            values = {n: np.asarray(arrays[n], dtype=np.float64) for n in ("support", "weights")}
            given = {
                name: np.asarray(arrays[name], dtype=np.float64)
                for name in ("explained", "uncertain")
            }
            for name, packed in given.items():  # before anything of size M^2 is made
                if m < 0 or packed.size != n_out * (m * (m + 1) // 2):
                    raise ValueError(
                        f"{name} has {packed.size} numbers, not those of {m} points and {n_out} "
                        "outputs"
                    )
            lower = np.tril_indices(m if n_out else 0)
            for name, packed in given.items():
                full = np.zeros((n_out, m, m))
                full[:, lower[0], lower[1]] = packed.reshape(n_out, lower[0].size)
                values[name] = full
            return cls(
                inputs=Layout([Signal(**s) for s in plain["inputs"]]),
                outputs=Layout([Signal(**s) for s in plain["outputs"]]),
                method=plain["method"],
                kernels=tuple(kernels[i] for i in plain["kernel_of_output"]),
                group_noise=plain["group_noise"],
                noise_inflation=tuple(plain["noise_inflation"]),
                jitter=tuple(plain["jitter"]),
                variance_factor=tuple(plain["variance_factor"]),
                domain=Domain(**plain["domain"]),
                **{name: plain[name] for name in _VECTORS},
                **values,
            )
        except MALFORMED as error:
            raise FileFormatError(
                f"not a GP posterior: {error!r}", fix="pass what greybox wrote"
            ) from None

    def to_dict(self) -> dict[str, Json]:
        """All of it as plain JSON values, large arrays included (packed, row by row)."""
        plain, arrays = self.parts()
        return {"schema": SCHEMA, **plain, "arrays": {k: v.tolist() for k, v in arrays.items()}}

    @classmethod
    def from_dict(cls, value: Parsed) -> GPPosterior:
        """Inverse of `to_dict`, bit by bit. Raises `FileFormatError`."""
        if value.get("schema") != SCHEMA:
            raise FileFormatError("wrong schema", expected=SCHEMA, got=repr(value.get("schema")))
        return cls.from_parts(value, value.get("arrays", {}))

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write `path` (JSON) and the arrays beside it (same stem, .npz), each atomically. Returns
        the path."""
        target = Path(path)
        plain, arrays = self.parts()
        body = {
            "schema": SCHEMA,
            **plain,
            "arrays": target.with_suffix(".npz").name,
            "arrays_sha256": _digest(arrays),
        }
        write_atomic(target.with_suffix(".npz"), packed(arrays))
        return write_json(target, {**body, "checksum": checksum(body)})

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> GPPosterior:
        """Read what `save` wrote. Raises `FileFormatError` (schema, checksum, missing or foreign
        array file)."""
        where = str(path)
        body = read_json(path, schema=SCHEMA)
        if body.pop("checksum", None) != checksum(body):
            raise FileFormatError(
                "the checksum does not match", where=where, fix="the file was edited or is damaged"
            )
        beside = Path(path).parent / Path(str(body.get("arrays"))).name
        stored = load_arrays(beside)
        if missing := [name for name in _ARRAYS if name not in stored]:
            message = f"cannot read the arrays (no {', '.join(missing)})"
            raise FileFormatError(message, where=str(beside), fix="keep the .npz beside its .json")
        arrays = {name: stored[name] for name in _ARRAYS}
        if _digest(arrays) != body.get("arrays_sha256"):
            raise FileFormatError(
                "these are not the arrays of that file",
                where=str(beside),
                fix="copy both files together",
            )
        return cls.from_parts(body, arrays)


def _digest(arrays: Mapping[str, FloatArray]) -> str:
    return checksum({name: np.ascontiguousarray(a).tobytes().hex() for name, a in arrays.items()})


def _frozen(values: npt.ArrayLike) -> FloatArray:
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array
