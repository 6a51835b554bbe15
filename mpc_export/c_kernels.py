"""A Gaussian process as C of our own, in place of the body that CasADi would generate for it.

`GPKernel` computes the quantities of `GPPosterior.expressions` from the same numbers, differently
arranged:

- squared distances as they are, sum_d ((x_d - b_d)/l_d)^2, for all kernels in one pass over the
  support;
- one vectorised exponential (`c_kernels_common`);
- one triangular factor per output. With L1 = `explained` and L2 = `uncertain` the variance is k(x,
  x) - k'(L1'L1 - L2'L2)k. Where T = L2 L1^-1 has no singular value above one (SGPR: always) that is
  k(x, x) - |E k|^2 with E = (I - T'T)^(1/2) L1, made triangular: half the work, and entries as
  large as the square root of the data's precision instead of the jitter's. I - T'T acts on L1 k,
  whose length is bounded, and T is formed in extended precision, so that nothing cancels. Otherwise
  (SVGP, and wherever `distance` is asked for) both factors are used;
- Jacobians from E'(E k), made in the same pass over E.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
import numpy.typing as npt
from scipy.linalg import qr

from greybox.errors import ModelError, UnknownNameError
from greybox.residual.kernels import FADE_POWER, Kernel, split_name
from greybox.residual.posterior import QUANTITIES, GPPosterior
from greybox.symbolic import FloatArray
from mpc_export import c_kernels_common as common
from mpc_export.c_code import Real
from mpc_export.functions import ModelFunctions
from mpc_export.predictors import PredictorModel

MERGE_TOLERANCE = 1e-9
"""How far below zero the smallest eigenvalue of I - T'T may be (rounding) for the factors to be
merged."""


def merged_factor(explained: FloatArray, uncertain: FloatArray) -> FloatArray | None:
    """Lower triangular E (M, M) with E'E = L1'L1 - L2'L2, or None where there is none (or L1 has no
    inverse)."""
    if not np.any(uncertain):
        return explained
    if not np.all(np.diag(explained) != 0.0):
        return None
    return _merged(explained.tobytes(), uncertain.tobytes(), len(explained))


@functools.lru_cache(maxsize=64)
def _merged(explained: bytes, uncertain: bytes, m: int) -> FloatArray | None:
    """`merged_factor`, remembered: the functions of a model share their factors."""
    first, second = (
        np.frombuffer(b).reshape(m, m).astype(np.longdouble) for b in (explained, uncertain)
    )
    t = np.zeros((m, m), dtype=np.longdouble)
    for j in range(m - 1, -1, -1):  # T L1 = L2, column by column from the right
        t[:, j] = (second[:, j] - t[:, j + 1 :] @ first[j + 1 :, j]) / first[j, j]
    share, turn = np.linalg.eigh((np.eye(m) - t.T @ t).astype(np.float64))
    if share.min() < -MERGE_TOLERANCE:
        return None
    root = np.sqrt(np.maximum(share, 0.0))[:, None] * (turn.T.astype(np.longdouble) @ first).astype(
        np.float64
    )
    # Rows may be turned: of root P = Q U (P reverses columns) follows root = Q P (P U P), lower
    # triangular.
    upper = qr(root[:, ::-1], mode="r")[0]
    out = np.tril(np.asarray(upper)[::-1, ::-1])
    out.setflags(write=False)
    return out


@dataclass(frozen=True, kw_only=True, eq=False)
class GPKernel:
    """The function `name` of z (n_in) -> the quantities `which` of a posterior, as C.

    The CasADi function may have further arguments. `weights` = (argument, offset) says that the
    weights (M, n_out; column by column) are read at run time from that place; else they are
    constants. With `silent` outputs that are not active have variance 0 and no slope
    (`HybridModel.learned_variance`); otherwise the prior's. `noise` as in `GPPosterior.variance`.
    Raises `UnknownNameError` for a quantity that is not known, `ModelError` for an empty list.
    """

    name: str
    posterior: GPPosterior
    which: tuple[str, ...]
    noise: bool | str = False
    weights: tuple[int, int] | None = None
    silent: bool = False

    def __post_init__(self) -> None:
        for quantity in self.which:
            if quantity not in QUANTITIES:
                raise UnknownNameError("GP quantity", quantity, QUANTITIES)
        if not self.which:
            raise ModelError(
                f"{self.name}: no quantity to compute", expected=f"some of {', '.join(QUANTITIES)}"
            )

    def function(self) -> ca.Function:
        """The CasADi function of z alone that this kernel stands for (weights constant, `silent`
        off)."""
        if self.weights is not None or self.silent:
            raise ModelError("GPKernel.function has neither weights at run time nor silent outputs")
        return self.posterior.function(self.name, self.which, noise=self.noise)

    # ------------------------------------------------------------------------------------- numbers

    @cached_property
    def active(self) -> tuple[int, ...]:
        """The outputs that the data say something about."""
        return tuple(j for j, on in enumerate(self.posterior.active) if on)

    @cached_property
    def kernels(self) -> tuple[Kernel, ...]:
        """The different covariance functions of the active outputs."""
        out: list[Kernel] = []
        for j in self.active:
            if not any(self.posterior.kernels[j] is k for k in out):
                out.append(self.posterior.kernels[j])
        return tuple(out)

    def kernel_of(self, j: int) -> int:
        """Place in `kernels` of that of the active output j."""
        return next(q for q, k in enumerate(self.kernels) if k is self.posterior.kernels[j])

    @cached_property
    def factors(self) -> dict[int, tuple[FloatArray, FloatArray | None]]:
        """Active output -> (E, F): its variance is max(k(x, x) - |E k|^2, 0) + |F k|^2; F is None
        where it is zero."""
        out: dict[int, tuple[FloatArray, FloatArray | None]] = {}
        for j in self.active:
            first, second = self.posterior.explained[j], self.posterior.uncertain[j]
            # The distance is what L1 leaves unexplained.
            merged = None if "distance" in self.which else merged_factor(first, second)
            out[j] = (
                (first, second if np.any(second) else None) if merged is None else (merged, None)
            )
        return out

    # ---------------------------------------------------------------------------------------- text

    def c_source(self, symbol: str, real: Real) -> tuple[dict[str, str], str]:
        """(shared definitions by name, the function `symbol`) as `c_code.write_c` takes it."""
        return _Writer(self, symbol, real).write()


def gp_kernels(
    posterior: GPPosterior,
    names: Mapping[str, Iterable[str]],
    *,
    weights_at: int | None = None,
    silent: bool = True,
) -> tuple[GPKernel, ...]:
    """Kernels for the functions of (z, p) of a hybrid model: name -> quantities in the order of its
    results.

    With `silent` outputs that are off have no variance there. `weights_at` is the place in p where
    weights that are set at run time start.
    """
    weights = None if weights_at is None else (1, weights_at)
    return tuple(
        GPKernel(name=name, posterior=posterior, which=tuple(which), weights=weights, silent=silent)
        for name, which in names.items()
    )


class _Writer:
    """Writes one C function. Names in it: z input, x standardised, k and g kernel (in float less
    its variance) and slope per kernel (g only where it is not -k/2), v = E'E k, i point, d input, j
    output, q kernel."""

    def __init__(self, kernel: GPKernel, symbol: str, real: Real) -> None:
        self.of, self.symbol, self.real = kernel, symbol, real
        self.gp = kernel.posterior
        self.n_in, self.n_out = len(self.gp.inputs), len(self.gp.outputs)
        self.points = common.padded(self.gp.points, real)
        self.shared: dict[str, str] = {"vectors": common.vectors(real)}
        self.lines: list[str] = []
        self.place = {name: i for i, name in enumerate(kernel.which)}
        self.second = bool({"variance", "variance_jacobian", "distance"} & set(kernel.which))
        self.back = "variance_jacobian" in self.place
        self.needs_slope = self.back or "mean_jacobian" in self.place
        # Float keeps k - variance: with long length-scales all k are near one and weights are large
        # and alternate, so that what is common is better summed beforehand.
        self.less = real == "float"

    def write(self) -> tuple[dict[str, str], str]:
        if self.of.kernels:
            self.shared |= {"gb_exp": common.exponential(self.real), "gb_sum": common.lane_sum()}
        self._open()
        self._covariances()
        if "distance" in self.place:
            self.lines.append(f"  casadi_real far = {'0.0' if self.of.active else '1.0'};")
        for j, name in enumerate(self.gp.outputs.names):
            self.lines += [f"  {{ /* {name} */"]
            if j in self.of.active:
                self._mean(j)
                if self.second:
                    self._variance(j)
            else:
                self._inactive(j)
            self.lines.append("  }")
        if "distance" in self.place:
            self.lines.append(
                f"  if ({self._result('distance')}) {self._result('distance')}[0] = far;"
            )
        self.lines += ["  return 0;", "}", ""]
        return self.shared, "\n".join(self.lines)

    # Constants get names by content, so that the functions of one file share them.

    def _array(self, values: npt.ArrayLike) -> str:
        flat = np.ascontiguousarray(np.asarray(values, dtype=np.float64).ravel())
        name = f"gb_{hashlib.sha256(flat.tobytes()).hexdigest()[:12]}"
        self.shared.setdefault(name, common.constants(name, flat, self.real))
        return name

    def _padded(self, rows: FloatArray) -> FloatArray:
        """(n, M) -> (n, padded M)."""
        out = np.zeros((len(rows), self.points))
        out[:, : rows.shape[1]] = rows
        return out

    def _result(self, name: str) -> str:
        return f"res[{self.place[name]}]"

    def _over(self, d: int, name: str) -> str:
        """The vector of input d of an array (n_in, padded M)."""
        return f"GB_LOAD({name} + {d * self.points} + i)"

    def _own_slope(self, kernel: Kernel) -> bool:
        """Whether g needs an array: it is -k/2 for a plain squared exponential."""
        return self.needs_slope and (_family(kernel) != "se" or kernel.slopes is not None)

    # --------------------------------------------------------------------------------------- parts

    def _open(self) -> None:
        self.lines += [
            f"static int {self.symbol}(const casadi_real** arg, casadi_real** res, casadi_int* iw, "
            "casadi_real* w,",
            "    int mem) {",
            "  (void)arg; (void)res; (void)iw; (void)w; (void)mem;",
        ]
        kernels = self.gp.kernels
        if self.of.active or (
            self.second and not self.of.silent and any(k.slopes is not None for k in kernels)
        ):
            center, scale = self._array(self.gp.input_mean), self._array(self.gp.input_scale)
            self.lines.append("  const casadi_real* z = arg[0];")
            self.lines += [
                f"  const casadi_real x{d} = ((z ? z[{d}] : 0.0) - {center}[{d}])/{scale}[{d}];"
                for d in range(self.n_in)
            ]
        for q, kernel in enumerate(self.of.kernels):
            self.lines.append(f"  casadi_real k{q}[{self.points}] GB_ALIGNED;")
            if self._own_slope(kernel):
                self.lines.append(f"  casadi_real g{q}[{self.points}] GB_ALIGNED;")
        if self.of.active:
            if self.back:
                self.lines.append(f"  casadi_real v[{self.points}] GB_ALIGNED;")
                if any(self.of.factors[j][1] is not None for j in self.of.active):
                    self.lines.append(f"  casadi_real v2[{self.points}] GB_ALIGNED;")
            self.lines.append("  int i;")

    def _features(self, kernel: Kernel, q: str) -> None:
        """Features f<q>_<d> of the linear part, their fade<q>, the powers y<q>_<d> = x_d^4, and
        prior<q> = k(x, x)."""
        assert kernel.reach is not None
        assert kernel.slopes is not None
        power, slopes = self._array(kernel.reach ** -float(FADE_POWER)), self._array(kernel.slopes)
        n = range(self.n_in)
        self.lines += [f"  const casadi_real y{q}_{d} = (x{d}*x{d})*(x{d}*x{d});" for d in n]
        faded = common.tree([f"{power}[{d}]*(y{q}_{d}*y{q}_{d})" for d in n])
        self.lines.append(f"  const casadi_real fade{q} = 1.0/(1.0 + {faded});")
        self.lines += [f"  const casadi_real f{q}_{d} = x{d}*fade{q};" for d in n]
        if self.second:
            own = common.tree([f"{slopes}[{d}]*(f{q}_{d}*f{q}_{d})" for d in n])
            self.lines.append(f"  const casadi_real prior{q} = {kernel.variance!r} + {own};")

    def _prior(self, kernel: Kernel, q: str) -> str:
        return repr(kernel.variance) if kernel.slopes is None else f"prior{q}"

    def _support_features(self, kernel: Kernel) -> str:
        """slopes phi(b) of all support points, (n_in, M)."""
        assert kernel.slopes is not None
        return self._array(
            self._padded(kernel.slopes[:, None] * kernel.features(self.gp.support.T))
        )

    def _covariances(self) -> None:
        """k and g of every kernel, in one pass over the support."""
        kernels = self.of.kernels
        if not kernels:
            return
        for q, kernel in enumerate(kernels):
            if kernel.slopes is not None:
                self._features(kernel, str(q))
        support = self._array(self._padded(self.gp.support.T))
        inverse = [self._array(k.lengthscales**-2.0) for k in kernels]
        out = [
            f"  for (i=0; i<{self.points}; i+=GB_LANES) {{",
            f"    gb_v t, {', '.join(f's{q}' for q in range(len(kernels)))};",
        ]
        for d in range(self.n_in):
            out.append(f"    t = x{d} - {self._over(d, support)}; t *= t;")
            out += [
                f"    s{q} {'+=' if d else '='} t*{name}[{d}];" for q, name in enumerate(inverse)
            ]
        for q, kernel in enumerate(kernels):
            out += self._correlation(kernel, q)
        self.lines += [*out, "  }"]

    def _correlation(self, kernel: Kernel, q: int) -> list[str]:
        """Squared distance s<q> becomes k and g."""
        family, own, size = _family(kernel), self._own_slope(kernel), repr(kernel.variance)
        if family == "se":
            whole = f"s{q} + {size}" if self.less else f"s{q}"
            out = [f"    s{q} = {'gb_expm1' if self.less else 'gb_exp'}(-0.5*s{q})*{size};"]
            out += [f"    GB_STORE(g{q} + i, -0.5*({whole}));"] if own else []
        else:
            self.shared.setdefault("gb_sqrt", _SQRT)
            root = 3.0 if family == "matern32" else 5.0
            more, g = (
                ("a", "-1.5*e")
                if family == "matern32"
                else (f"(a + a*a*{1 / 3!r})", f"{-5 / 6!r}*((1.0 + a)*e)")
            )
            begin = f"    {{ const gb_v a = gb_sqrt({root!r}*s{q}), "
            if self.less:
                begin += f"m = gb_expm1(-a)*{size}, e = m + {size}; s{q} = m + {more}*e;"
            else:
                begin += f"e = gb_exp(-a)*{size}; s{q} = e + {more}*e;"
            out = [begin, f"      GB_STORE(g{q} + i, {g}); }}" if own else "    }"]
        if kernel.slopes is not None:
            features = self._support_features(kernel)
            out.append(
                f"    s{q} += "
                f"{common.tree([f'f{q}_{d}*{self._over(d, features)}' for d in range(self.n_in)])};"
            )
        return [*out, f"    GB_STORE(k{q} + i, s{q});"]

    def _mean(self, j: int) -> None:
        if not {"mean", "mean_jacobian"} & set(self.place):
            return
        q = self.of.kernel_of(j)
        if self.of.weights is None:
            name = self._array(self._padded(self.gp.weights[:, j][None]))
        else:
            name = "weights"
            argument, offset = self.of.weights
            m = self.gp.points
            self.lines += [
                f"    casadi_real weights[{self.points}] GB_ALIGNED = {{0}};",
                f"    if (arg[{argument}]) for (i=0; i<{m}; ++i) weights[i] = "
                f"arg[{argument}][{offset + j * m} + i];",
            ]
        scale, size = float(self.gp.output_scale[j]), self.gp.kernels[j].variance
        base, whole = float(self.gp.output_mean[j]), f"GB_LOAD(k{q} + i)"
        if self.less and self.of.weights is None:
            base += scale * size * float(self.gp.weights[:, j].sum())
        elif self.less:
            whole = f"({whole} + {size!r})"
        if "mean" in self.place:
            target = self._result("mean")
            self.lines += [
                f"    if ({target}) {{",
                "      gb_v a = {0};",
                f"      for (i=0; i<{self.points}; i+=GB_LANES) a += GB_LOAD({name} + i)*{whole};",
                f"      {target}[{j}] = {base!r} + {scale!r}*gb_sum(a);",
                "    }",
            ]
        if "mean_jacobian" in self.place:
            self._slope("mean_jacobian", j, f"GB_LOAD({name} + i)", scale)

    def _slope(self, quantity: str, j: int, c: str, scale: float, prior: str = "") -> None:
        """Row j of a Jacobian: scale (sum_i c_i dk(b_i, x)/dx [+ prior/2 dk(x, x)/dx]) /
        input_scale.

        total = sum c g and gb_sum(a<d>) = sum c g b_d, with k for g where g = -k/2; h<d> = sum c
        slopes_d phi_d(b).
        """
        kernel, q, n = self.gp.kernels[j], self.of.kernel_of(j), range(self.n_in)
        own, target = self._own_slope(kernel), self._result(quantity)
        slope = f"GB_LOAD({'g' if own else 'k'}{q} + i)"
        if self.less and not own:
            slope = f"({slope} + {kernel.variance!r})"
        support = self._array(self._padded(self.gp.support.T))
        factor = self._array(
            (2.0 if own else -1.0) * scale * kernel.lengthscales**-2.0 / self.gp.input_scale
        )
        out = [
            f"    if ({target}) {{",
            f"      gb_v a = {{0}}, {', '.join(f'a{d} = {{0}}' for d in n)};",
            "      casadi_real total;",
        ]
        if kernel.slopes is not None:
            out.append(f"      gb_v {', '.join(f'b{d} = {{0}}' for d in n)};")
        out += [
            f"      for (i=0; i<{self.points}; i+=GB_LANES) {{",
            f"        const gb_v c = {c};",
            f"        const gb_v t = c*{slope};",
            "        a += t;",
            *(f"        a{d} += t*{self._over(d, support)};" for d in n),
        ]
        if kernel.slopes is not None:
            features = self._support_features(kernel)
            out += [f"        b{d} += c*{self._over(d, features)};" for d in n]
        out += ["      }", "      total = gb_sum(a);"]
        places = [f"{target}[{j + d * self.n_out}]" for d in n]
        out += [f"      {places[d]} = {factor}[{d}]*(x{d}*total - gb_sum(a{d}));" for d in n]
        self.lines += out
        if kernel.slopes is not None:
            slopes = self._array(kernel.slopes)
            own_part = [f" + {prior}*({slopes}[{d}]*f{q}_{d})" if prior else "" for d in n]
            self.lines += [
                "      {",
                *(f"      const casadi_real h{d} = gb_sum(b{d}){own_part[d]};" for d in n),
            ]
            self._through_features(kernel, str(q), places, scale)
            self.lines.append("      }")
        self.lines.append("    }")

    def _through_features(self, kernel: Kernel, q: str, places: list[str], scale: float) -> None:
        """Adds scale h dphi/dx / input_scale for the row h<d>."""
        assert kernel.reach is not None
        steep = self._array(FADE_POWER * kernel.reach ** -float(FADE_POWER))
        outer = self._array(scale / self.gp.input_scale)
        along = common.tree([f"h{d}*x{d}" for d in range(self.n_in)])
        self.lines.append(f"      const casadi_real along = {along}*fade{q}*fade{q};")
        self.lines += [
            f"      {p} += {outer}[{d}]*(fade{q}*h{d} - "
            f"along*{steep}[{d}]*(y{q}_{d}*(x{d}*x{d}*x{d})));"
            for d, p in enumerate(places)
        ]

    def _variance(self, j: int) -> None:
        """Variance, its Jacobian and the distance of output j."""
        kernel, q = self.gp.kernels[j], self.of.kernel_of(j)
        first, second = self.of.factors[j]
        scale = float(self.gp.output_scale[j] ** 2 * self.gp.variance_factor[j])
        prior = self._prior(kernel, str(q))

        def norm(factor: FloatArray, v: str) -> str:
            name = "gb_norm_back" if self.back else "gb_norm"
            self.shared.setdefault(name, common.triangular_product(self.real, back=self.back))
            given = f", {v}" if self.back else ""
            start = ""
            if self.less:
                start = f", {self._array(self._padded((factor.sum(1) * kernel.variance)[None]))}"
            return (
                f"{name}({self._array(common.blocks(factor, self.real))}, k{q}{given}, "
                f"{self.points}{start})"
            )

        self.lines.append(f"    const casadi_real left = {prior} - {norm(first, 'v')};")
        cut = "(left < 0.0 ? 0.0 : left)"  # so that NaN stays
        if second is not None:
            self.lines.append(f"    const casadi_real rest = {norm(second, 'v2')};")
        if "distance" in self.place:
            self.lines.append(f"    if (!({cut}/({prior}) <= far)) far = {cut}/({prior});")
        if "variance" in self.place:
            target = self._result("variance")
            noise = float(self.gp.noise_variance(self.of.noise)[j])
            value = f"{scale!r}*({cut}{' + rest' if second is not None else ''})" + (
                f" + {noise!r}" if noise else ""
            )
            self.lines.append(f"    if ({target}) {target}[{j}] = {value};")
        elif second is not None and not self.back:
            self.lines.append("    (void)rest;")
        if self.back:
            self.lines.append("    const casadi_real on = left > 0.0 ? 1.0 : 0.0;")
            c = (
                "GB_LOAD(v2 + i) - on*GB_LOAD(v + i)"
                if second is not None
                else "-on*GB_LOAD(v + i)"
            )
            self._slope("variance_jacobian", j, c, 2.0 * scale, "on")

    def _inactive(self, j: int) -> None:
        """An output that the data say nothing about: constant mean, the prior's variance (or none,
        if silent)."""
        kernel, tag, n = self.gp.kernels[j], f"o{j}", range(self.n_in)
        scale = float(self.gp.output_scale[j] ** 2 * self.gp.variance_factor[j])
        linear = kernel.slopes is not None and self.second and not self.of.silent
        if linear:
            self._features(kernel, tag)
        for name in ("mean_jacobian", "variance_jacobian"):
            if name in self.place:
                target = self._result(name)
                self.lines.append(f"    if ({target}) {{")
                places = [f"{target}[{j + d * self.n_out}]" for d in n]
                self.lines += [f"      {p} = 0.0;" for p in places]
                if linear and kernel.slopes is not None and name == "variance_jacobian":
                    slopes = self._array(kernel.slopes)
                    self.lines += ["      {"]
                    self.lines += [
                        f"      const casadi_real h{d} = {slopes}[{d}]*f{tag}_{d};" for d in n
                    ]
                    self._through_features(kernel, tag, places, 2.0 * scale)
                    self.lines += ["      }"]
                self.lines.append("    }")
        if "mean" in self.place:
            target = self._result("mean")
            self.lines.append(
                f"    if ({target}) {target}[{j}] = {float(self.gp.output_mean[j])!r};"
            )
        if "variance" in self.place:
            target = self._result("variance")
            noise = float(self.gp.noise_variance(self.of.noise)[j])
            value = "0.0" if self.of.silent else f"{scale!r}*({self._prior(kernel, tag)})"
            self.lines.append(f"    if ({target}) {target}[{j}] = {value} + {noise!r};")
        elif linear:
            self.lines.append(f"    (void)prior{tag};")


def _family(kernel: Kernel) -> str:
    return split_name(kernel.name)[0]


_SQRT = """\
static inline gb_v gb_sqrt(gb_v x) {
#if GB_LANES > 1
  int l;
  for (l=0; l<GB_LANES; ++l) x[l] = sqrt(x[l]);
  return x;
#else
  return sqrt(x);
#endif
}
"""


def kernels_of(functions: ModelFunctions) -> tuple[GPKernel, ...]:
    """Kernels of our own for the functions of the learned part."""
    if not isinstance(functions.posterior, GPPosterior):
        return ()
    names = functions.parameters.names
    at = next((i for i, n in enumerate(names) if n.startswith("gp.weights")), None)
    learned = {
        n: tuple(f.name_out())
        for n, f in functions.functions.items()
        if n.startswith("gp_") and "features" not in n
    }
    silent = not isinstance(functions.model, PredictorModel)
    return gp_kernels(functions.posterior, learned, weights_at=at, silent=silent)
