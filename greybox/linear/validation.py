"""Validation of a linear fit: residual tests on the training records, k-step prediction and free
run on unseen ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from greybox.errors import GreyboxError
from greybox.estimation.record import hold_missing
from greybox.files import Json
from greybox.linear.document import JudgedModel
from greybox.linear.fit import LinearFit, to_dict
from greybox.linear.pole_profile import Interval
from greybox.linear.prediction import adapt, k_step
from greybox.linear.records import Record, delayed
from greybox.linear.spectrum import SpectralError, spectral_error
from greybox.model.matrices import spectral_radius
from greybox.symbolic import FloatArray
from greybox.validation.cross_correlation import CrossCorrelation, cross_correlation
from greybox.validation.whiteness import Whiteness, whiteness

MAX_LAG = 25
LEVEL = 0.99
RUN_IN = 2.0
"""Seconds, not scored, after which a model that starts from zero is taken to have forgotten that."""


@dataclass(frozen=True, kw_only=True)
class TestRow:
    """One record at one horizon (0 = free run from the start): RMSE and fit percentage per output,
    persistence RMSE."""

    record: str
    horizon: int
    rmse: FloatArray
    fit: FloatArray
    persistence: FloatArray
    samples: int

    __test__ = False


@dataclass(frozen=True, kw_only=True)
class Identified:
    """A fit with its residual tests (training records) and its test rows (records that the fit
    never saw).

    `log_det_test` is log det of the one-step innovation covariance about zero on the test records,
    NaN without any. `remembers` [s] is how long the predictor keeps e^-1 of a wrong start state.
    """

    fit: LinearFit
    whiteness: Whiteness | None
    cross: CrossCorrelation | None
    spectral: SpectralError | None
    feedback: bool
    rows: tuple[TestRow, ...]
    train_fit: FloatArray
    log_det_test: float
    adapted_on: float
    remembers: float
    columns: tuple[int, ...]
    outputs: tuple[int, ...]
    intervals: tuple[Interval, ...] = ()

    def to_dict(self) -> JudgedModel:
        """Plain values for fit.json."""
        return {
            "name": self.fit.model.name,
            "fit": to_dict(self.fit),
            "model": self.fit.model.to_dict(),
            "profile_intervals": [_interval(i) for i in self.intervals],
            "train": {
                "one_step_fit_percent": dict(zip(self.fit.model.outputs.names, self.train_fit))
            },
            "whiteness": None if self.whiteness is None else self.whiteness.to_dict(),
            "cross_correlation": None if self.cross is None else self.cross.to_dict(),
            "feedback_assumed": self.feedback,
            "spectral_error": None
            if self.spectral is None
            else {
                "low_hz": self.spectral.low,
                "high_hz": self.spectral.high,
                "share": dict(zip(self.fit.model.outputs.names, self.spectral.share)),
            },
            "test": {
                "adapted_on_seconds": self.adapted_on,
                "log_det_innovations": self.log_det_test,
                "rows": [
                    {
                        "record": r.record,
                        "horizon": r.horizon if r.horizon else "free run",
                        "samples": r.samples,
                        "rmse": dict(zip(self.fit.model.outputs.names, r.rmse)),
                        "fit_percent": dict(zip(self.fit.model.outputs.names, r.fit)),
                        "persistence_rmse": dict(zip(self.fit.model.outputs.names, r.persistence)),
                    }
                    for r in self.rows
                ],
            },
        }

    def _hangs_on_starts(self) -> bool:
        """Are one-step errors twice those of training, whose start states were fitted, and may the
        start be why?"""
        if self.adapted_on or self.remembers < RUN_IN / 3:
            return False
        usual = np.sqrt(np.diag(self.fit.model.noise))
        return any(bool((r.rmse > 2 * usual).any()) for r in self.rows if r.horizon == 1)

    def format(self) -> str:
        """Tables for the terminal."""
        names = self.fit.model.outputs.names
        lines = [
            f"{self.fit.model.name}: one-step fit on training data "
            + ", ".join(f"{n} {v:.1f} %" for n, v in zip(names, self.train_fit))
        ]
        for i in self.intervals:
            lines.append(
                f"pole {i.pole:.4f}: {100 * i.level:.0f} % profile interval of its {i.quantity} "
                f"part [{i.lower:.4f}, {i.upper:.4f}]"
            )
        if self.spectral is not None:
            lines.append(
                f"spectral error {self.spectral.low:g}-{self.spectral.high:g} Hz: "
                + ", ".join(f"{n} {100 * v:.2g} %" for n, v in zip(names, self.spectral.share))
            )
        if self.whiteness is not None:
            lines.append(self.whiteness.format())
        for r in self.rows:
            what = f"h = {r.horizon}" if r.horizon else "free run"
            cells = ", ".join(
                f"{n} {rmse:.4g} ({fit:.0f} %, persistence {other:.4g})"
                for n, rmse, fit, other in zip(names, r.rmse, r.fit, r.persistence)
            )
            lines.append(f"test {r.record} {what}: RMSE {cells}")
        if self._hangs_on_starts():
            lines.append(
                "the test errors may be those of unknown start states, which the predictor forgets "
                f"in {3 * self.remembers:.3g} s: --adapt S fits them to the first S seconds"
            )
        return "\n".join(lines)


def validate_linear(
    fit: LinearFit,
    train: Sequence[Record],
    test: Sequence[Record],
    columns: Sequence[int],
    outputs: Sequence[int],
    *,
    horizons: Sequence[int],
    adapt_seconds: float = 0.0,
    feedback: bool = True,
    intervals: Sequence[Interval] = (),
) -> Identified:
    """Residual tests and test rows of `fit`, which uses the given columns of the records' u and y.

    `horizons` are numbers of samples. With `adapt_seconds` the initial state and output offset of
    each test record are fitted on its first seconds, which are then not scored; without, the state
    starts at zero and the first 2 s are run in but not scored. Under `feedback` the verdict of the
    input test uses positive lags only. Raises `DataError` where test records are too short.
    """
    own = [r.part(columns, outputs) for r in train]
    moved = [delayed(r, fit.model.delays) for r in own]
    e = list(fit.innovations)
    rows: list[TestRow] = []
    one_step: list[FloatArray] = []
    for r in test:
        mine = r.part(columns, outputs)
        rows += _test_rows(fit, mine, horizons, adapt_seconds, one_step)
    y = np.vstack([r.y for r in moved])
    share = np.sqrt(np.nanmean(np.vstack(e) ** 2, axis=0) / np.nanvar(y, axis=0))
    return Identified(
        fit=fit,
        whiteness=_whiteness(fit),
        cross=_cross(fit, moved, feedback) if len(fit.model.inputs) else None,
        spectral=_spectral(fit, moved),
        feedback=feedback,
        rows=tuple(rows),
        train_fit=100 * (1 - share),
        log_det_test=_log_det(one_step),
        adapted_on=adapt_seconds,
        remembers=_memory(fit),
        columns=tuple(columns),
        outputs=tuple(outputs),
        intervals=tuple(intervals),
    )


def _memory(fit: LinearFit) -> float:
    """Time constant [s] of the predictor's slowest mode."""
    radius = spectral_radius(fit.model.matrices.predictor)
    if radius >= 1.0:
        return float("inf")
    return fit.model.dt / -np.log(radius) if radius > 0.0 else 0.0


def _whiteness(fit: LinearFit) -> Whiteness | None:
    """None where the innovations do not suffice; so are the other tests."""
    try:
        return whiteness(
            list(fit.innovations),
            names=fit.model.outputs.names,
            max_lag=MAX_LAG,
            fitted=min(2 * fit.order, 20),
            level=LEVEL,
        )
    except GreyboxError:
        return None


def _cross(fit: LinearFit, moved: Sequence[Record], feedback: bool) -> CrossCorrelation | None:
    """Innovations after inputs of the delayed records."""
    try:
        cross = cross_correlation(
            list(fit.innovations),
            [r.u for r in moved],
            names=fit.model.outputs.names,
            input_names=fit.model.inputs.names,
            max_lag=MAX_LAG,
            level=LEVEL,
        )
    except GreyboxError:
        return None
    if feedback:
        return cross
    return replace(cross, note="All lags count: the inputs were declared free of feedback.")


def _spectral(fit: LinearFit, moved: Sequence[Record]) -> SpectralError | None:
    try:
        return spectral_error(list(fit.innovations), [r.y for r in moved], fit.model.dt)
    except GreyboxError:
        return None


def _log_det(errors: Sequence[FloatArray]) -> float:
    """log det of the covariance of one-step errors; NaN without any."""
    if not errors:
        return float("nan")
    total = np.vstack(errors)
    total = total[np.isfinite(total).all(axis=1)]
    return float(np.linalg.slogdet(total.T @ total / len(total))[1])


def _interval(i: Interval) -> dict[str, Json]:
    """Plain values; an open end is None."""
    ends = [float(v) if np.isfinite(v) else None for v in (i.lower, i.upper)]
    return {
        "pole": {"real": i.pole.real, "imag": i.pole.imag},
        "quantity": i.quantity,
        "estimate": i.estimate,
        "lower": ends[0],
        "upper": ends[1],
        "level": i.level,
    }


def _test_rows(
    fit: LinearFit,
    record: Record,
    horizons: Sequence[int],
    seconds: float,
    one_step: list[FloatArray],
) -> list[TestRow]:
    model = fit.model
    known = adapt(model, record, seconds)
    # A horizon of which a short record holds no more than a few is left out, unless it is the only
    # one.
    reached = [h for h in horizons if h <= len(record) // 2] or [min(horizons)]
    first = max(known.samples, min(round(RUN_IN / model.dt), (len(record) - max(reached)) // 3))
    out = []
    for ahead in k_step(model, record, reached, x0=known.x0, offset=known.offset):
        error = (ahead.measured - ahead.predicted)[first:]
        y = ahead.measured[first:]
        source = hold_missing(delayed(record, model.delays).y)[0]
        still = (ahead.measured - source[: len(ahead.measured)])[first:]
        if ahead.horizon == 1:
            one_step.append(error)
        out.append(_row(record.name, ahead.horizon, error, y, still))
    if spectral_radius(model.matrices.a) < 1.0:
        from greybox.linear.prediction import simulate

        moved = delayed(record, model.delays)
        plain = replace(model, delays=(0,) * len(model.inputs))
        y = simulate(plain, moved.u, x0=known.x0) + known.offset - model.output_offset
        still = moved.y - hold_missing(moved.y)[0][first]
        out.append(_row(record.name, 0, (moved.y - y)[first:], moved.y[first:], still[first:]))
    return out


def _row(name: str, horizon: int, error: FloatArray, y: FloatArray, still: FloatArray) -> TestRow:
    rmse = np.sqrt(np.nanmean(error**2, axis=0))
    spread = np.nanstd(y, axis=0)
    return TestRow(
        record=name,
        horizon=horizon,
        rmse=rmse,
        fit=100 * (1 - rmse / np.maximum(spread, 1e-300)),
        persistence=np.sqrt(np.nanmean(still**2, axis=0)),
        samples=len(error),
    )
