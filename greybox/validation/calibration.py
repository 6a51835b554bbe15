"""Calibration of multi-step uncertainty: how much process noise a prediction without measurements
really collects.

The filter's noise levels are those of one-step errors. Over a horizon the discrepancy is correlated
in time in ways that a first-order disturbance does not catch, and an estimate of its level from one
step ahead is too small (or too large) at half a second. The covariance h samples ahead is affine in
the squared levels,

    Sigma_h = Sigma_h(filter error) + sum_g kappa_g^2 Sigma_h(noise of group g) +
    Sigma_h(open) + Sigma_h(weights) + Sigma_h(parameters)

so that the factors kappa_g of the groups (force, torque, ...) follow from the multi-step errors of
the training flights at little cost: the likeliest, given that they are about one where errors (one
window after the other, sensor by sensor) say nothing. What a learned push leaves open between its
support points is in these errors, and counts. The last two parts are not: parameters and the
weights of what was learned were fitted to the same flights. Counted there, parameters took the
place of the noise, of which a new flight may have more; and the spread of a learned push, scaled to
errors that do not hold it, became two to six times too small for the push itself. It stays as
flights that were left out say (`greybox.residual.open_loop_fit`). The filter keeps its own levels.
Flights differ: one more factor, on the noise, makes the 95 % regions hold on a flight that was not
seen (`greybox.validation.new_flight`).

(Kuleshov, Fenner and Ermon 2018, ICML, recalibrate quantiles after the fact; here the stated
physics of the error growth stays.)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import scipy.optimize

from greybox.data import Dataset
from greybox.errors import DataError, FitError
from greybox.estimation.filtering import Filter, Filtered
from greybox.estimation.propagation import Ahead, Propagator, run_together
from greybox.estimation.result import Fit
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import physics_of
from greybox.statistics.distributions import chi_square_quantile
from greybox.symbolic import FloatArray
from greybox.validation.new_flight import GRID, new_flight_factor
from greybox.validation.predictive import gaussian_nlpd

HORIZONS = (5, 10, 20, 35, 50)
"""Samples at 100 Hz, see `steps_ahead`."""
LIMITS = (0.1, 10.0)
PRIOR = 1.0
"""Standard deviation of the logarithm of a factor where the errors say nothing: about one, as the
filter has it, a factor of e either way."""
LEVEL = 0.95
"""The region that has to hold on a new flight."""
FEW, STRETCHES = 4, 4
"""With fewer flights than this, stretches of a flight (this many) stand for flights."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration:
    """The model with `horizon_noise`, the factor of every noise group, the mean density gained by
    the factors [nat per error]. All factors hold `new_flight`, what a flight that was not seen asks
    for."""

    model: IdentifiedModel
    factors: Mapping[str, float]
    gain: float
    new_flight: float = 1.0


@dataclass(frozen=True, kw_only=True, eq=False)
class _Errors:
    """Errors (N, d) of one channel block with the parts of their covariance: base (N, d, d), by
    group (G, N, d, d)."""

    h: int
    label: str
    e: FloatArray
    base: FloatArray
    parts: FloatArray


def calibrate_horizons(
    model: IdentifiedModel,
    data: Dataset,
    *,
    horizons: Sequence[int] | None = None,
    spacing: float = 0.25,
) -> Calibration:
    """Fit the factors on all flights of `data`, from origins `spacing` seconds apart, `horizons`
    samples ahead (None: half a second of a vehicle, 50 samples of another model).

    Every channel block of the innovation (position, attitude, rate, ...) and every horizon counts
    the same. The accelerometer, whose errors are its own noise, is left out where anything else is
    measured. Raises `DataError` where no flight is long enough.
    """
    work = _Parts(Filter(model), model.process_noise)
    horizons = steps_ahead(model, HORIZONS) if horizons is None else horizons
    flights = _by_flight(work, data, horizons, spacing)
    found = [f for flight in flights for f in flight]
    if not found:
        raise DataError(
            "no flight is long enough to calibrate multi-step uncertainty",
            expected=f"{max(horizons)} samples",
        )
    apart = sum(s.n for f in data for s in f.segments) / max(horizons) * len(work.blocks)

    def cost(log_factors: FloatArray) -> float:
        return float(np.mean([_density(f, np.exp(2 * log_factors)) for f in found]))

    def with_prior(log_factors: FloatArray) -> float:
        return cost(log_factors) + 0.5 * float(np.sum((log_factors / PRIOR) ** 2)) / apart

    factors = _solve(with_prior, len(work.groups))
    gain = cost(np.zeros(factors.size)) - cost(np.log(factors))
    squares = np.exp(2 * GRID)[:, None] * factors**2
    wider = new_flight_factor(
        np.array([np.mean([_inside(f, squares) for f in own], axis=0) for own in flights]), LEVEL
    )
    factors = wider * factors
    return Calibration(
        model=replace(model, horizon_noise=model.process_noise * factors[work.members]),
        factors=dict(zip(work.groups, factors.tolist(), strict=True)),
        gain=gain,
        new_flight=wider,
    )


def _by_flight(
    work: _Parts, data: Dataset, horizons: Sequence[int], spacing: float
) -> list[list[_Errors]]:
    """Errors of every flight that has any, or of its stretches where flights are few."""
    flights: list[list[_Errors]] = []
    pieces = 1 if len(data) >= FEW else STRETCHES
    for flight in data:
        own: list[list[_Errors]] = [[] for _ in range(pieces)]
        for segment in flight.segments:
            step = max(1, round(spacing / segment.dt))
            origins = np.arange(step, segment.n - max(horizons) - 1, step)
            filtered = work.runner.run(segment)
            for stretch, part in zip(own, np.array_split(origins, pieces), strict=True):
                if part.size:
                    stretch += work.errors(filtered, part, horizons)
        flights += [stretch for stretch in own if stretch]
    return flights


def calibrated(found: Fit, data: Dataset) -> Fit:
    """The fit with `horizon_noise`, calibrated on the flights `data` that it was fitted to; as it
    was where none of them is long enough. Its mean predictions stay as they are."""
    try:
        model = calibrate_horizons(found.model, data).model
    except (DataError, FitError):
        return found
    return replace(found, estimates=replace(found.estimates, model=model))


def steps_ahead(model: IdentifiedModel, at_100_hz: Sequence[int]) -> tuple[int, ...]:
    """Samples ahead that are the same times for a vehicle at every rate; of another model, whose
    time scale is its own, as they are."""
    if physics_of(model.dynamics) is None:
        return tuple(at_100_hz)
    return tuple(sorted({max(1, round(0.01 * h / model.sample_time)) for h in at_100_hz}))


class _Parts:
    """Errors ahead of origins with the parts of their covariance, one per group of noise."""

    def __init__(self, runner: Filter, levels: FloatArray) -> None:
        model = runner.model
        heads = [n.removeprefix("disturbance.").split(".")[0] for n in model.dynamics.noises.names]
        self.runner = runner
        self.groups = list(dict.fromkeys(heads))
        self.members = np.array([self.groups.index(h) for h in heads])
        self.blocks = _blocks(model)
        # The filter's error alone, then one group at a time on top of it.
        self.propagators = [
            Propagator(
                runner,
                parameters=False,
                noise=np.where(self.members == g, levels, 0.0),
                weights=False,
            )
            for g in range(-1, len(self.groups))
        ]

    def errors(
        self, filtered: Filtered, origins: npt.NDArray[np.int_], horizons: Sequence[int]
    ) -> list[_Errors]:
        """Per horizon and channel block; nothing where a prediction is not finite."""
        found: list[_Errors] = []
        try:
            for at in run_together(self.propagators, filtered, origins, max(horizons)):
                if at[0].h in horizons:  # the others would fill the memory of a long flight
                    found += self._at(at, filtered, origins)
        except FitError:
            return []
        return found

    def _at(
        self, at: Sequence[Ahead], filtered: Filtered, origins: npt.NDArray[np.int_]
    ) -> list[_Errors]:
        """Per channel block, of one horizon."""
        h, found = at[0].h, []
        e = _errors(self.runner, filtered, at[0].states, origins + h)
        seen = filtered.record.mask[origins + h] != 0
        for label, rows in self.blocks.items():
            keep = seen[:, rows].all(axis=1)
            if keep.any():
                c = np.array([a.innovation_covariance[keep][:, rows][:, :, rows] for a in at])
                found.append(
                    _Errors(h=h, label=label, e=e[keep][:, rows], base=c[0], parts=c[1:] - c[0])
                )
        return found


def _solve(cost: Callable[[FloatArray], float], groups: int) -> FloatArray:
    """Factors (groups,) of least cost within `LIMITS`, from one."""
    best = scipy.optimize.minimize(
        cost, np.zeros(groups), method="L-BFGS-B", bounds=[tuple(np.log(LIMITS))] * groups
    )
    return np.asarray(np.exp(best.x))


def _blocks(model: IdentifiedModel) -> dict[str, list[int]]:
    """Places of the innovation components that are judged together: those of one sensor (one
    channel, where unknown)."""
    names = model.channel_groups
    blocks = {n: [i for i, m in enumerate(names) if m == n] for n in dict.fromkeys(names)}
    if len(blocks) > 1:
        blocks.pop("specific_force", None)
    return blocks


def _errors(
    runner: Filter, filtered: Filtered, states: FloatArray, rows: npt.NDArray[np.int_]
) -> FloatArray:
    """Innovations (m, n_e) of the measurements at `rows` (m,) against predicted states (m, n_x)."""
    record, one = filtered.record, np.ones(len(rows), dtype=np.int32)
    return runner.engine.windows(
        starts=states,
        rows=rows,
        lengths=one,
        tails=one,
        p=filtered.p,
        **record.samples,
    ).innovations


def _density(errors: _Errors, squares: FloatArray) -> float:
    covariance = errors.base + np.einsum("g,gnij->nij", squares, errors.parts)
    return float(gaussian_nlpd(errors.e, covariance).mean())


def _inside(errors: _Errors, squares: FloatArray) -> FloatArray:
    """Share (n,) of the errors inside the region of probability `LEVEL` for each row of squared
    factors (n, G)."""
    edge = chi_square_quantile(LEVEL, errors.e.shape[1])
    shares = []
    for row in squares:
        covariance = errors.base + np.einsum("g,gnij->nij", row, errors.parts)
        distance = np.einsum(
            "ni,ni->n", errors.e, np.linalg.solve(covariance, errors.e[..., None])[..., 0]
        )
        shares.append(float(np.mean(distance <= edge)))
    return np.array(shares)
