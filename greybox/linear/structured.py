"""Structured linear grey box: PEM over named physical parameters of A(theta), B(theta), C(theta),
D(theta).

The gain K is free, or zero, so that the noise model never biases the physics: with K free the
estimate is the prediction error estimate of the innovation form whose deterministic part has the
given structure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from greybox.errors import DataError, FitError, UnknownNameError
from greybox.linear.pem import Settings, Status, minimise
from greybox.linear.records import Record, Scaling, prepare
from greybox.model.linear import LinearModel
from greybox.model.linearise import StructuredLinear
from greybox.model.matrices import Matrices, spectral_radius, steady_gain
from greybox.symbolic import FloatArray, Layout, Signal


@dataclass(frozen=True, kw_only=True)
class StructuredPoint:
    """theta in units of `unit`, and K, as one point of the class; a `Parametrisation`. Signals at
    unit scale."""

    model: StructuredLinear
    theta: FloatArray
    unit: FloatArray
    gain: FloatArray
    free_gain: bool
    input_scale: FloatArray
    output_scale: FloatArray

    @property
    def system(self) -> Matrices:
        """Sampled matrices between scaled signals."""
        a, b, c, d = self.model.matrices(self.theta * self.unit)
        plain = Matrices(a, b, c, d, self.gain / self.output_scale)
        return plain.scaled(self.input_scale, self.output_scale)

    def tangent(self) -> FloatArray:
        """Derivatives of the full vector of the predictor along theta and then along the entries of
        K."""
        n, m, p = self.system.sizes
        c, d, k = self.system.c, self.system.d, self.system.k
        su, sy = self.input_scale, self.output_scale
        columns = []
        for (da, db, dc, dd), unit in zip(
            self.model.derivatives(self.theta * self.unit), self.unit
        ):
            da, db, dc, dd = (
                da * unit,
                db * unit * su,
                dc * unit / sy[:, None],
                dd * unit * su / sy[:, None],
            )
            rows = np.hstack([da - k @ dc, db - k @ dd, np.zeros((n, p))])
            columns.append(np.concatenate([rows.ravel(), dc.ravel(), dd.ravel()]))
        if self.free_gain:
            for i in range(n):
                for j in range(p):
                    dk = np.zeros((n, p))
                    dk[i, j] = 1.0
                    rows = np.hstack([-dk @ c, -dk @ d, dk])
                    columns.append(np.concatenate([rows.ravel(), np.zeros(p * n + p * m)]))
        return np.array(columns).T

    def moved(self, step: FloatArray) -> StructuredPoint:
        """The point after a step."""
        count = len(self.theta)
        gain = self.gain + step[count:].reshape(self.gain.shape) if self.free_gain else self.gain
        return replace(self, theta=self.theta + step[:count], gain=gain)


@dataclass(frozen=True, kw_only=True)
class StructuredFit:
    """Estimates with standard errors, their covariance (n_theta, n_theta), the linear model, and
    the status."""

    values: dict[str, float]
    std: dict[str, float]
    covariance: FloatArray
    model: LinearModel
    status: Status
    criterion: float
    innovations: tuple[FloatArray, ...]

    @property
    def converged(self) -> bool:
        """Did the iteration converge?"""
        return self.status.converged


def fit_structured(
    model: StructuredLinear,
    records: Sequence[Record],
    start: Mapping[str, float],
    *,
    noise_model: bool = True,
    offsets: bool = True,
    settings: Settings | None = None,
) -> StructuredFit:
    """Fit the named parameters (and K) from `start`. Records in channel units, offsets estimated
    per record.

    Raises `UnknownNameError` for a start of another name, `DataError` for channels that do not fit,
    and `FitError` where the data do not determine the parameters (the message names the
    combination).
    """
    _check_start(model, start)
    scaled, scaling = prepare(records, center=offsets)
    point = _start(model, np.array([start[n] for n in model.names]), scaled, scaling, noise_model)
    settings = replace(settings or Settings(), offsets=offsets)
    solution = minimise(point, scaled, settings)
    _demand_determined(model.names, solution.information)
    end, count = solution.point, len(model.names)
    assert isinstance(end, StructuredPoint)
    covariance = np.linalg.pinv(solution.information, rcond=1e-14, hermitian=True)
    covariance = covariance[:count, :count] * np.outer(end.unit, end.unit)
    sy = scaling.output_scale
    return StructuredFit(
        values=dict(zip(model.names, map(float, end.theta * end.unit))),
        std=dict(zip(model.names, map(float, np.sqrt(np.maximum(np.diag(covariance), 0.0))))),
        covariance=covariance,
        model=_linear(model, end, solution.evaluation.noise, scaling),
        status=solution.status,
        criterion=solution.evaluation.criterion
        + 2 * float(sum(np.isfinite(r.y).sum(axis=0) @ np.log(sy) for r in scaled)),
        innovations=tuple(q.e * sy for q in solution.evaluation.predictions),
    )


def _check_start(model: StructuredLinear, start: Mapping[str, float]) -> None:
    for name in start:
        if name not in model.names:
            raise UnknownNameError("parameter", name, model.names)
    missing = [n for n in model.names if n not in start]
    if missing:
        raise DataError(
            f"no start for {', '.join(missing)}", fix="give every parameter a nominal value"
        )


def _start(
    model: StructuredLinear,
    value: FloatArray,
    scaled: Sequence[Record],
    scaling: Scaling,
    noise_model: bool,
) -> StructuredPoint:
    """The point at the parameters `value` (n_theta,); with a noise model its gain is that of white
    noise on the inputs. Raises `DataError`, `FitError`."""
    a, b, c, _ = model.matrices(value)
    if b.shape[1] != scaled[0].u.shape[1] or c.shape[0] != scaled[0].y.shape[1]:
        raise DataError(
            f"records have {scaled[0].u.shape[1]} inputs and {scaled[0].y.shape[1]} outputs",
            expected=f"{b.shape[1]} and {c.shape[0]}",
        )
    su, sy = scaling.input_scale, scaling.output_scale
    n, p = len(a), len(c)
    gain = np.zeros((n, p))
    if noise_model:
        spread = np.diag((b * su) @ (b * su).T) + 1e-6
        gain = steady_gain(a, c / sy[:, None], np.diag(spread), np.eye(p))[0]
    elif spectral_radius(a) >= 1.0:
        raise FitError("without a noise model the start must be stable", fix="noise_model=True")
    unit = np.where(value != 0, np.abs(value), 1.0)
    return StructuredPoint(
        model=model,
        theta=value / unit,
        unit=unit,
        gain=gain,
        free_gain=noise_model,
        input_scale=su,
        output_scale=sy,
    )


def _demand_determined(names: Sequence[str], h: FloatArray) -> None:
    """Raise `FitError` where the information (n, n) has none of a combination of the named
    parameters, which come first."""
    scale = np.sqrt(np.maximum(np.diag(h), 1e-14 * max(float(np.diag(h).max(initial=0.0)), 1e-300)))
    values, vectors = np.linalg.eigh(h / np.outer(scale, scale))
    weak = [v / scale for v, s in zip(vectors.T, values) if s < 1e-9 * values[-1]]
    for direction in weak:
        physical = np.abs(direction[: len(names)])
        if physical.max() > 1e-3 * np.abs(direction).max():
            involved = [m for m, w in zip(names, physical) if w > 1e-2 * physical.max()]
            raise FitError(
                f"the data determine only a combination of {', '.join(involved)}",
                fix="fix one of them, or excite more",
            )


def _linear(
    model: StructuredLinear, end: StructuredPoint, noise: FloatArray, scaling: Scaling
) -> LinearModel:
    """The linear model in channel units; `noise` (p, p) is the scaled innovations' covariance."""
    su, sy = scaling.input_scale, scaling.output_scale
    noise = noise * np.outer(sy, sy)
    return LinearModel(
        name=model.name,
        matrices=end.system.scaled(1 / su, 1 / sy),
        noise=(noise + noise.T) / 2,
        dt=model.dt,
        inputs=model.inputs if len(model.inputs) else _names("u", len(su)),
        outputs=model.outputs if len(model.outputs) else _names("y", len(sy)),
        input_offset=scaling.input_offset,
        output_offset=scaling.output_offset,
    )


def _names(letter: str, count: int) -> Layout:
    return Layout([Signal(name=f"{letter}{i + 1}", unit="1") for i in range(count)])
