"""fit_linear: from records to a linear model with error bars. The one call that scripts and the
command line use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, TypedDict, Unpack

import numpy as np

from greybox.errors import DataError, UnknownNameError
from greybox.estimation.options import chosen, says_choices
from greybox.files import Json
from greybox.linear.order import OrderChoice, choose_order
from greybox.linear.pem import Settings, Solution, Status
from greybox.linear.records import Record, Scaling, prepare
from greybox.linear.robust import correlation_window, score_covariance
from greybox.linear.search import Found, Options, find
from greybox.linear.uncertainty import Uncertainty, rescaled, uncertainty
from greybox.linear.varx import estimate_delays
from greybox.model.linear import LinearModel
from greybox.model.matrices import spectral_radius
from greybox.shown import Cell, Shown
from greybox.statistics.whiteness import is_coloured
from greybox.symbolic import FloatArray, Layout, Signal
from greybox.takes import (
    COUNT,
    POSITIVE,
    RECORDS,
    TEXT,
    Kind,
    Several,
    is_whole,
    taken_fields,
    takes,
)

__all__ = ["LinearFit", "Options", "Record", "Settings", "fit_linear"]

ORDER = Kind(
    words='a whole number above zero, or "auto"',
    fits=lambda v: v == "auto" if isinstance(v, str) else COUNT.fits(v),
)
DELAYS = Several(words='"auto" or a list of one whole number per input', fits=is_whole)
SOLVERS = ("gauss-newton", "ipopt")


@dataclass(frozen=True, kw_only=True, repr=False)
class LinearFit(Shown):
    """A fitted linear model. Holds innovations (per record (N, p), NaN where missing) but no raw
    data.

    `criterion` is -2 log likelihood in the units of the channels, `parameters` the number of free
    directions (initial states and offsets not counted). `x0` and `offsets` belong to the records,
    in state coordinates and channel units. `uncertainty` is the robust one where the innovations
    are `coloured` and the data are long enough for it, else `fisher`.
    """

    model: LinearModel
    uncertainty: Uncertainty
    fisher: Uncertainty
    robust: Uncertainty | None
    coloured: bool
    status: Status
    iterations: int
    decrement: float
    criterion: float
    parameters: int
    rank: int
    samples: int
    start: str
    singular_values: FloatArray
    innovations: tuple[FloatArray, ...]
    x0: tuple[FloatArray, ...]
    offsets: tuple[FloatArray, ...]
    records: tuple[str, ...]
    order_choice: OrderChoice | None = None
    warnings: tuple[str, ...] = field(default_factory=tuple)

    @property
    def order(self) -> int:
        """Number of states."""
        return self.model.order

    @property
    def converged(self) -> bool:
        """Did the polish converge?"""
        return self.status.converged

    @property
    def errors(self) -> str:
        """Which standard errors `uncertainty` holds: "fisher" or "robust"."""
        return "fisher" if self.robust is None else "robust"

    @property
    def log_det(self) -> float:
        """log det Lambda of the training innovations, channel units."""
        return float(np.linalg.slogdet(self.model.noise)[1])

    def _shown_text(self) -> str:
        """The summary."""
        return self.summary()

    def _shown_rows(self) -> list[dict[str, Cell]]:
        """One row per pole (of a pair the upper one): value and standard errors of its parts."""
        poles = self.uncertainty.poles()
        return [
            {
                "real": float(v.real),
                "imag": float(v.imag),
                "std real": float(np.sqrt(c[0, 0])),
                "std imag": float(np.sqrt(c[1, 1])),
                "well determined": bool(sure),
            }
            for v, c, sure in zip(
                poles.value, poles.covariance, self.uncertainty.well_determined(), strict=True
            )
            if v.imag >= 0
        ]

    def summary(self) -> str:
        """A few lines for the terminal."""
        poles = self.uncertainty.poles()
        lines = [
            f"order {self.order}, {len(self.model.inputs)} inputs, {len(self.model.outputs)} "
            f"outputs, {self.samples} samples in {len(self.records)} records, {self.parameters} "
            "free parameters",
            f"{self.status.value} ({self.iterations} iterations, start: {self.start})",
            f"-2 log likelihood {self.criterion:.2f}, log det Lambda {self.log_det:.4f}",
        ]
        for value, cov, sure in zip(
            poles.value, poles.covariance, self.uncertainty.well_determined()
        ):
            if value.imag >= 0:
                std = np.sqrt(np.diag(cov))
                im = f" +- {value.imag:.5f}j (std {std[1]:.5f})" if value.imag > 0 else ""
                weak = "" if sure else "  weak or crowded mode: the error is larger than that"
                lines.append(f"pole {value.real:+.5f} (std {std[0]:.5f}){im}{weak}")
        return "\n".join([*lines, *(f"warning: {w}" for w in self.warnings)])


class LinearChoices(TypedDict, total=False):
    """The keywords of `fit_linear`: the fields of `LinearSetup`, which says what they mean."""

    dt: float
    inputs: Sequence[str | Signal] | None
    outputs: Sequence[str | Signal] | None
    delays: Sequence[int] | str | None
    largest: int
    criterion: Literal["aic", "aicc", "bic"]
    cross_validate: bool
    center: bool
    solver: Literal["gauss-newton", "ipopt"]
    name: str


@dataclass(frozen=True, kw_only=True)
class LinearSetup:
    """What the columns of the records are, and how order and parameters are found."""

    dt: float = 1.0
    """Sample time [s]."""
    inputs: tuple[str | Signal, ...] | None = None
    """Names of the input columns; None: u1, u2, ..."""
    outputs: tuple[str | Signal, ...] | None = None
    """Names of the output columns; None: y1, y2, ..."""
    delays: Sequence[int] | str | None = None
    """Whole samples per input, or "auto" (see `estimate_delays`)."""
    largest: int = 10
    """Largest order that "auto" tries."""
    criterion: str = "bic"
    """What "auto" chooses the order by: "aic", "aicc" or "bic"."""
    cross_validate: bool = False
    """Whether orders are also compared on left-out records."""
    center: bool = True
    """Whether the pooled means are the operating point; where a pole integrates, zero inputs are
    tried too."""
    solver: str = "gauss-newton"
    """"gauss-newton", or "ipopt": slow, a check."""
    name: str = "linear"
    """Name of the model."""

    def __post_init__(self) -> None:
        signals = Several(words="a list of names", fits=lambda v: isinstance(v, str | Signal))
        taken_fields(
            self,
            dt=POSITIVE,
            inputs=signals,
            outputs=signals,
            delays=TEXT if isinstance(self.delays, str) else DELAYS,
            largest=COUNT,
        )


@says_choices(LinearSetup)
@takes(records=RECORDS, order=ORDER)
def fit_linear(
    records: Sequence[Record],
    order: int | str = "auto",
    *,
    options: Options | None = None,
    **choices: Unpack[LinearChoices],
) -> LinearFit:
    """Identify a linear model in innovation form by subspace start and prediction error polish.

    `order` is a number or "auto" (1 .. `largest` by `criterion` "aic", "aicc" or "bic"; see
    `choose_order`). `delays` are whole samples per input, or "auto" (see `estimate_delays`). A
    number is the most states: those that the data do not carry are left out, with a warning
    (`search.find`; `Options(exact_order=True)` keeps them). `dt` in seconds. `center` takes the
    pooled means as the operating point (zero inputs beside an integrator, if likelier). `solver`
    "ipopt" minimises the same criterion by IPOPT from the subspace start, or from the chosen order:
    slow, a check. The choices are keywords, fields of `LinearSetup` with its defaults. Raises
    `DataError` (bad records, too short for the order), `FitError` and `UnknownNameError` (of a
    choice, too).
    """
    if not records:
        raise DataError("no records", fix="pass at least one log to train on")
    options = options or Options()
    setup = chosen("option of a linear fit", LinearSetup, None, choices)
    if setup.solver not in SOLVERS:
        raise UnknownNameError("solver", setup.solver, SOLVERS)
    columns = _columns(records, setup)
    scaled, scaling = prepare(
        records,
        delays=columns.delays,
        center=setup.center,
        input_names=columns.inputs.names,
        output_names=columns.outputs.names,
    )
    fit = _fitted(scaled, scaling, order, options, setup, columns)
    if setup.center and _integrates(fit):
        other = _fitted(*_from_zero(scaled, scaling), order, options, setup, columns)
        fit = min(fit, other, key=lambda f: f.criterion + f.parameters * np.log(f.samples))
    if isinstance(order, str) or fit.order == order:
        return fit
    spare = (
        f"{fit.order} of {order} states: the others gain less than the price of a state in "
        "marginal likelihood, and were left out; --exact-order (exact_order=True) keeps them"
    )
    return replace(fit, warnings=(spare, *fit.warnings))


def _fitted(
    scaled: Sequence[Record],
    scaling: Scaling,
    order: int | str,
    options: Options,
    setup: LinearSetup,
    columns: _Columns,
) -> LinearFit:
    found, choice = _found(scaled, order, options, setup)
    return replace(_assemble(found, scaled, scaling, options, columns), order_choice=choice)


def _integrates(fit: LinearFit) -> bool:
    """Does a pole not settle within the longest record? To such a plant the mean of an input is no
    operating point: it moves away at any input but the right one, and no output offset mends
    that."""
    longest = max(len(e) for e in fit.innovations)
    away = np.abs(np.linalg.eigvals(fit.model.matrices.a) - 1.0)
    return bool(len(fit.model.inputs)) and bool(away.min(initial=1.0) < 1.0 / longest)


def _from_zero(scaled: Sequence[Record], scaling: Scaling) -> tuple[list[Record], Scaling]:
    """The records with inputs counted from zero instead of their mean."""
    shift = scaling.input_offset / scaling.input_scale
    moved = [replace(r, u=r.u + shift) for r in scaled]
    return moved, replace(scaling, input_offset=np.zeros_like(shift))


@dataclass(frozen=True, kw_only=True)
class _Columns:
    """What the columns of the records are, and what the model is called."""

    inputs: Layout
    outputs: Layout
    delays: tuple[int, ...]
    dt: float
    name: str


def _columns(records: Sequence[Record], setup: LinearSetup) -> _Columns:
    """With delays that are estimated where they are "auto". Raises `DataError`."""
    m, p = records[0].u.shape[1], records[0].y.shape[1]
    inputs, outputs = _layout(setup.inputs, m, "u"), _layout(setup.outputs, p, "y")
    delays = setup.delays
    if isinstance(delays, str):
        if delays != "auto":
            raise DataError(f"delays '{delays}'", expected="'auto' or one whole number per input")
        unit, _ = prepare(
            records, center=setup.center, input_names=inputs.names, output_names=outputs.names
        )
        delays = estimate_delays(unit) if m else ()
    late = tuple(delays or (0,) * m)
    return _Columns(inputs=inputs, outputs=outputs, delays=late, dt=setup.dt, name=setup.name)


def _found(
    scaled: Sequence[Record],
    order: int | str,
    options: Options,
    setup: LinearSetup,
) -> tuple[Found, OrderChoice | None]:
    """The minimum of the criterion at the order, and how the order was chosen. Raises
    `DataError`."""
    choice: OrderChoice | None = None
    if isinstance(order, str):
        choice = choose_order(
            scaled,
            setup.largest,
            options,
            criterion=setup.criterion,
            cross_validate=setup.cross_validate,
        )
        found = choice.found[choice.order]
    else:
        if order < 1:
            raise DataError(f"order {order}", expected="at least 1")
        polish = options.polish and setup.solver == "gauss-newton"
        found = find(scaled, order, replace(options, polish=polish))
    if setup.solver == "ipopt" and options.polish:
        from greybox.linear.ipopt import minimise_ipopt

        found = replace(found, solution=minimise_ipopt(found.solution, scaled, options.settings))
    return found, choice


def _assemble(
    found: Found,
    scaled: Sequence[Record],
    scaling: Scaling,
    options: Options,
    columns: _Columns,
) -> LinearFit:
    s: Solution = found.solution
    sy = scaling.output_scale
    samples = sum(len(r) for r in scaled)
    weights = np.array([len(r) for r in scaled], dtype=float)
    offsets = np.array([v.offset for v in s.nuisances]) * sy + scaling.output_offset
    noise = s.evaluation.noise * np.outer(sy, sy)
    free = s.tangent.shape[1]
    innovations = tuple(
        np.where(np.isfinite(r.y), q.e, np.nan) for r, q in zip(scaled, s.evaluation.predictions)
    )
    coloured = is_coloured(list(innovations))
    window = correlation_window(innovations) if coloured else None
    fisher, robust, rank = _uncertainties(s, scaled, scaling, options, window)
    jumps = 2 * float(sum(np.isfinite(r.y).sum(axis=0) @ np.log(sy) for r in scaled))
    status = s.status if options.polish else Status.NOT_RUN
    model = LinearModel(
        name=columns.name,
        matrices=fisher.system,
        noise=(noise + noise.T) / 2,
        dt=columns.dt,
        inputs=columns.inputs,
        outputs=columns.outputs,
        delays=columns.delays,
        input_offset=scaling.input_offset,
        output_offset=weights @ offsets / weights.sum(),
        comment=f"{samples} samples, {len(scaled)} records",
        unsettled="" if status.converged else status.value,
    )
    return LinearFit(
        model=model,
        uncertainty=robust or fisher,
        fisher=fisher,
        robust=robust,
        coloured=coloured,
        status=status,
        iterations=s.iterations,
        decrement=s.decrement,
        criterion=s.evaluation.criterion + jumps,
        parameters=free,
        rank=rank,
        samples=samples,
        start=found.start,
        singular_values=found.singular_values,
        innovations=tuple(e * sy for e in innovations),
        x0=tuple(v.x0 for v in s.nuisances),
        offsets=tuple(offsets),
        records=tuple(r.name for r in scaled),
        warnings=tuple(_warnings(s, rank, free, scaled, model, coloured and robust is None)),
    )


def _uncertainties(
    s: Solution, scaled: Sequence[Record], scaling: Scaling, options: Options, window: int | None
) -> tuple[Uncertainty, Uncertainty | None, int]:
    """(by Fisher information, robust to innovations that are correlated over `window` samples,
    rank), in the units of the data; not robust where `window` is None or the records are too
    short."""
    fisher, rank = uncertainty(s.system, s.information, s.tangent)
    scores = None if window is None else score_covariance(s, scaled, options.settings, window)
    robust = None if scores is None else uncertainty(s.system, s.information, s.tangent, scores)[0]
    # Lambda is estimated with as many degrees of freedom as samples; the covariance uses the
    # unbiased scale.
    seen = sum(int(np.isfinite(r.y).sum()) for r in scaled)
    unbiased = seen / max(seen - s.tangent.shape[1], 1)
    sy, su = scaling.output_scale, scaling.input_scale
    fisher = _in_units(fisher, unbiased, su, sy)
    return fisher, None if robust is None else _in_units(robust, unbiased, su, sy), rank


def _in_units(
    known: Uncertainty, variance_factor: float, su: FloatArray, sy: FloatArray
) -> Uncertainty:
    return rescaled(
        Uncertainty(system=known.system, factor=known.factor * np.sqrt(variance_factor)), su, sy
    )


def _warnings(
    s: Solution, rank: int, free: int, scaled: Sequence[Record], model: LinearModel, boastful: bool
) -> list[str]:
    out: list[str] = []
    if boastful:
        out.append(
            "the innovations are coloured and the records too short (or too long to hold) for "
            "robust standard errors: those given are too small"
        )
    if s.status in (Status.STALLED, Status.MAX_ITERATIONS, Status.FLAT):
        out.append(s.status.value)
    if rank < free:
        out.append(
            f"the data determine {rank} of {free} parameter directions: lower the order or excite "
            "more; standard errors cover the determined directions only"
        )
    missing = sum(r.missing for r in scaled)
    if missing:
        out.append(f"{missing} samples with missing outputs were bridged by the Kalman filter")
    radius = spectral_radius(model.matrices.a)
    if radius >= 1.0:
        out.append(
            f"the model is unstable (largest pole {radius:.4f}): one-step prediction works, free "
            "simulation drifts"
        )
    if spectral_radius(model.matrices.predictor) > 0.9995:
        out.append(
            "the predictor sits at the stability limit: standard errors are not reliable there"
        )
    return out


def _layout(given: Sequence[str | Signal] | None, count: int, letter: str) -> Layout:
    if given is None:
        return Layout([Signal(name=f"{letter}{i + 1}", unit="1") for i in range(count)])
    if len(given) != count:
        raise DataError(
            f"{len(given)} names for {count} channels", got=", ".join(str(g) for g in given)
        )
    return Layout([g if isinstance(g, Signal) else Signal(name=g, unit="1") for g in given])


def to_dict(fit: LinearFit) -> dict[str, Json]:
    """Plain values of a fit (schema greybox.linear_fit/1 is built on this by the command line)."""
    poles, limits = fit.uncertainty.poles(), fit.uncertainty.predictor_poles()
    value: dict[str, Json] = {
        "order": fit.order,
        "status": {
            "name": fit.status.name.lower(),
            "advice": fit.status.value,
            "converged": fit.converged,
        },
        "iterations": fit.iterations,
        "samples": fit.samples,
        "parameters": fit.parameters,
        "rank": fit.rank,
        "start": fit.start,
        "minus_two_log_likelihood": fit.criterion,
        "log_det_lambda": fit.log_det,
        "delays": list(fit.model.delays),
        "standard_errors": fit.errors,
        "innovations_coloured": fit.coloured,
        "poles": [
            {**row, "strength": float(strength), "well_determined": bool(sure)}
            for row, strength, sure in zip(
                _complex_rows(poles.value, poles.covariance),
                fit.uncertainty.pole_strengths(),
                fit.uncertainty.well_determined(),
            )
        ],
        "noise_model_zeros": _complex_rows(limits.value, limits.covariance),
        "singular_values": fit.singular_values.tolist(),
        "records": [
            {"name": n, "x0": x0.tolist(), "offset": offset.tolist()}
            for n, x0, offset in zip(fit.records, fit.x0, fit.offsets)
        ],
        "warnings": list(fit.warnings),
    }
    if fit.order_choice is not None:
        value["order_choice"] = fit.order_choice.to_dict()
    return value


def _complex_rows(values: np.ndarray, covariance: FloatArray) -> list[dict[str, float]]:
    return [
        {
            "real": float(v.real),
            "imag": float(v.imag),
            "std_real": float(np.sqrt(c[0, 0])),
            "std_imag": float(np.sqrt(c[1, 1])),
            "covariance": float(c[0, 1]),
        }
        for v, c in zip(values, covariance)
    ]
