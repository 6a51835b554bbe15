"""Adaptation of a model to one flight: per-flight parameters and the start, from the flight's first
seconds.

Maximum a posteriori in innovation form with the model's own filter: shared parameters and noise
levels fixed, the training flights' mean and spread as prior of each per-flight parameter (Ljung
1999, System Identification, sec. 7.4).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypedDict, final

import numpy as np

from greybox.data import Dataset, Flight
from greybox.errors import DataError
from greybox.estimation.criteria.gaussian import Gaussian
from greybox.estimation.filtering import Filter
from greybox.estimation.fit import noise_of
from greybox.estimation.gain import Riccati
from greybox.estimation.predictors.innovation import StationaryGain
from greybox.estimation.problem import Problem, make_problem
from greybox.estimation.settling import RecordGains, held
from greybox.estimation.solvers.levenberg_marquardt import ARRIVED, LevenbergMarquardt
from greybox.estimation.start import Start, vector
from greybox.estimation.status import Status
from greybox.estimation.unknown import Unknown
from greybox.model.identified import IdentifiedModel
from greybox.statistics.evidence import FELT
from greybox.symbolic import FloatArray
from greybox.validation.horizon import REQUIRED

SECONDS = 5.0
"""Seconds [s] at the beginning of a flight that its own values are taken from."""
HALVED = 4
"""Times that the window is halved where the whole of it does not converge."""
LEFT_TO_JUDGE = 3.0
"""Times the seconds of adaptation that a flight lasts at least: two thirds of it judge."""
LEFT_STEPS = 2.0
"""Times the steps ahead that a verdict needs, which must be left after it."""
KNOWN = 1e-3
"""Share of a start's spread that is left where the filter itself knows no more than that."""


class AdaptedRow(TypedDict):
    """A parameter that was fitted to the beginning of a flight."""

    value: float
    std: float
    unit: str


@dataclass(frozen=True, kw_only=True, eq=False)
class Adaptation:
    """What the first `seconds` of a flight said: `values` and `std` of its per-flight parameters,
    its start `x0` (n_x) with the standard errors `x0_sigma` (n_d).

    `x0` belongs to the first segment of the flight. `warnings` say what did not work.
    """

    flight: str
    seconds: float
    values: Mapping[str, float] = field(default_factory=dict)
    std: Mapping[str, float] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    x0: FloatArray | None = None
    x0_sigma: FloatArray | None = None
    warnings: tuple[str, ...] = ()

    def beyond(self, model: IdentifiedModel) -> str:
        """What lies beyond all that the training flights of `model` differ by, the farthest value
        in words; "" where nothing does. Offsets of sensors spoil no model by much."""
        far = {
            n: abs(value - mean) / float(np.hypot(spread, np.nan_to_num(self.std[n])))
            for n, value in self.values.items()
            for mean, spread in [model.flight_spread[n]]
            if spread > 0 and "_bias." not in n
        }
        worst = max(far, key=lambda n: far[n], default=None)
        if worst is None or far[worst] <= FELT:
            return ""
        mean, spread = model.flight_spread[worst]
        unit = "" if self.units[worst] == "-" else f" {self.units[worst]}"
        value = f"{self.values[worst]:.2g}{unit}"
        return f"{self.flight}: {worst} {value}, in training {mean:.2g} +- {spread:.2g}{unit}"

    def to_dict(self) -> dict[str, AdaptedRow]:
        """Name -> value, std, unit."""
        return {
            n: {"value": v, "std": self.std[n], "unit": self.units[n]}
            for n, v in self.values.items()
        }


@final
@dataclass(frozen=True, kw_only=True, eq=False)
class FixedGain(StationaryGain[None]):
    """Innovation form whose gain is given: per-flight parameters do not move it, and noise levels
    are fixed."""

    solution: Riccati
    name: str = "innovation"

    def prepare(self, problem: Problem) -> None:
        """Nothing to prepare."""

    def gains(self, problem: Problem, theta: FloatArray, slopes: bool) -> list[RecordGains]:
        """The given solution for every record."""
        return [held(self.solution, r) for r in problem.records]


def adaptation(
    flights: Iterable[Flight], asked: float | None = None, *, most: float = SECONDS
) -> float:
    """Seconds [s] at the start of `flights` to adapt on: what was `asked`, else `most`, of a shorter
    flight a third; 0 where too little would be left to judge, or there are none.

    Of a short flight the beginning is worth as much as of a long one: judged without it, a flight
    whose gyro has another offset than those that were fitted looks like wrong torques.
    """
    if asked is not None:
        return float(asked)
    shortest = min(flights, key=lambda f: f.duration, default=None)
    if shortest is None:
        return 0.0
    found = min(most, math.floor(10.0 * shortest.duration / LEFT_TO_JUDGE) / 10.0)
    judged = (shortest.duration - found) / shortest.dt
    return found if judged > LEFT_STEPS * REQUIRED else 0.0


def strangers(model: IdentifiedModel, data: Dataset) -> list[Flight]:
    """Flights whose own values `model` does not know, of a model that has such values."""
    varies = any(spread > 0 for _, spread in model.flight_spread.values())
    return [f for f in data if varies and f.name not in model.per_flight]


def adapt_to_flight(
    model: IdentifiedModel,
    flight: Flight,
    seconds: float,
    *,
    riccati: Riccati | None = None,
    use_compiler: bool = True,
    max_iterations: int = 30,
) -> Adaptation:
    """Fit the per-flight parameters of `model` and the initial state on the first `seconds` of
    `flight`.

    `riccati` is that of the model's filter, where it is at hand. Raises `DataError` for a flight
    that has no samples there, or is not sampled at the model's rate.
    """
    declared = {d.name: d for d in model.dynamics.parameters}
    names = [n for n in declared if n in model.flight_spread]
    # A parameter that did not vary between the training flights keeps its mean.
    priors = {
        n: (m, s)
        for n, (m, s) in model.flight_spread.items()
        if n in declared and s > 0 and np.isfinite(s)
    }
    free = [n for n in names if n in priors]
    gain = riccati or Filter(model, use_compiler=use_compiler).riccati

    def on(first: float) -> Problem:
        return _problem(model, _first(flight, first), free, priors, gain, use_compiler)

    problem = on(seconds)
    solver = LevenbergMarquardt(max_iterations=max_iterations)
    theta, status = solver.solve(problem, problem.start)
    if not status.converged:
        theta, status = _grown(on, problem, solver, seconds, (theta, status))
    value = problem.evaluate(theta)
    warnings = []
    if not status.converged:
        warnings.append(f"{flight.name}: adaptation on the first {seconds:g} s: {status.advice}")
    std = np.full(problem.n, np.nan)
    if value.hessian is not None:
        std = np.sqrt(np.maximum(np.diag(np.linalg.pinv(value.hessian, hermitian=True)), 0.0))
    places = {n: problem.place(n, flight.name) for n in free}
    return Adaptation(
        flight=flight.name,
        seconds=seconds,
        values={n: float(theta[i]) for n, i in places.items() if i is not None},
        std={n: float(std[i]) for n, i in places.items() if i is not None},
        units={n: declared[n].unit for n in free},
        x0=problem.initial_state(theta, 0),
        x0_sigma=_spread(problem, std, gain),
        warnings=tuple(warnings),
    )


def _problem(
    model: IdentifiedModel,
    window: Flight,
    free: Sequence[str],
    priors: Mapping[str, tuple[float, float]],
    gain: Riccati,
    use_compiler: bool,
) -> Problem:
    """The fit of a flight's own values and its start to a window."""
    problem = make_problem(
        model.dynamics,
        Dataset(flights=(window,)),
        predictor=FixedGain(solution=gain),
        criterion=Gaussian(),
        free=free,
        per_flight=free,
        values=dict(model.values),
        flight_priors=priors,
        noise=noise_of(model),
        estimate_noise=False,
        use_compiler=use_compiler,
    )
    return _beyond_the_filter(problem, gain)


def _grown(
    on: Callable[[float], Problem],
    problem: Problem,
    solver: LevenbergMarquardt,
    seconds: float,
    found: tuple[FloatArray, Status],
) -> tuple[FloatArray, Status]:
    """What is lowest: `found`, or where a window ends that grew from a start on, each begun where
    the one half as long ended. Of two that are as low the one that converged.

    A filter that hardly corrects lets a rotor that was not settled turn the craft right round: over
    seconds no slope leads back, over tenths of a second all is nearly linear.
    """
    known: Start = {}
    windows = seconds / 2.0 ** np.arange(HALVED, 0, -1)
    # Fewer samples than unknowns are no start.
    for first in windows[windows >= problem.n * problem.dt]:
        shorter = on(float(first))
        at, _ = solver.solve(shorter, vector(shorter, known))
        known = {(u.name, u.flight): float(v) for u, v in zip(shorter.unknowns, at, strict=True)}
    other = solver.solve(problem, vector(problem, known))
    higher = _cost(problem, other[0]) - _cost(problem, found[0])
    return other if higher < (ARRIVED if other[1].converged else 0.0) else found


def _cost(problem: Problem, theta: FloatArray) -> float:
    value = problem.evaluate(theta)
    return value.cost if value.valid else math.inf


def _first(flight: Flight, seconds: float) -> Flight:
    """The first seconds of a flight. Raises `DataError` where it has no samples there."""
    if not seconds > 0:
        raise DataError(f"adaptation on {seconds:g} s", expected="a positive number of seconds")
    begin = float(flight.segments[0].t[0])
    window = flight.between(begin, begin + seconds - 1e-9)
    if window is None or window.segments[0].t[0] > begin:
        raise DataError(f"no samples in the first {seconds:g} s", where=f"flight {flight.name}")
    return window


def _beyond_the_filter(problem: Problem, gain: Riccati) -> Problem:
    """The priors of the start without what innovations of the settled filter have in them already:
    its covariance."""
    names = problem.dynamics.error_states.names
    settled = dict(zip(names, np.diag(gain.P).tolist(), strict=True))

    def beyond(u: Unknown) -> Unknown:
        rest = max(u.sigma**2 - settled[u.name], (KNOWN * u.sigma) ** 2)
        return replace(u, sigma=float(np.sqrt(rest)))

    unknowns = [beyond(u) if u.kind == "initial" else u for u in problem.unknowns]
    return replace(problem, unknowns=tuple(unknowns))


def _spread(problem: Problem, std: FloatArray, gain: Riccati) -> FloatArray:
    """Standard errors (n_d,) of the start, those before the flight where the fit has none: what was
    found beyond the settled filter, and the filter's own."""
    before = problem.start_sigma(0)
    found = np.sqrt(std[problem.initial_columns(0)] ** 2 + np.diag(gain.P))
    return np.where(np.isfinite(found), np.minimum(found, before), before)
