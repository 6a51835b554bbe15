"""Fit: what a fit found, as estimates, diagnostics and provenance."""

from __future__ import annotations

import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from greybox.data.dataset import FlightFacts
from greybox.errors import UnknownNameError
from greybox.estimation.covariance import Covariance
from greybox.estimation.document import FitDocument, FitSettings, HistoryPart, LagPart, ParameterRow
from greybox.estimation.identifiability import Combination
from greybox.estimation.problem import Problem
from greybox.estimation.recipe import Decision, Recipe
from greybox.estimation.status import Status
from greybox.estimation.suspects import suspects
from greybox.files import write_json
from greybox.model.identified import IdentifiedModel, library_versions
from greybox.model.layer import physics_of
from greybox.model.verdict import NOT_JUDGED, Verdict
from greybox.plots import Curve, deviations, panels
from greybox.shown import Cell, Shown
from greybox.statistics.evidence import FELT
from greybox.symbolic import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SCHEMA = "greybox.fit/1"
SAVED = "_saved"
"""Where the provenance of a copy holds its problem."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimate:
    """One estimated parameter. `std` is NaN at an active bound (a two-sided error has no meaning
    there).

    `prior_influence` is the share of the precision that the priors (of all parameters together)
    brought: 0 = the data alone, 1 = the data say nothing. Of a per-flight parameter, `value` is the
    mean over flights and `std` the standard error of that mean (at least what the spread between
    flights says).
    """

    name: str
    value: float
    std: float
    std_fisher: float
    unit: str
    scope: str
    prior: tuple[float, float] | None
    prior_influence: float
    at_bound: bool
    per_flight: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def to_dict(self) -> ParameterRow:
        """As in fit.json."""
        return {
            "value": self.value,
            "std": self.std,
            "std_fisher": self.std_fisher,
            "unit": self.unit,
            "scope": self.scope,
            "prior": None
            if self.prior is None
            else {"value": self.prior[0], "sigma": self.prior[1]},
            "prior_influence": self.prior_influence,
            "at_bound": self.at_bound,
            "per_flight": {k: {"value": v, "std": s} for k, (v, s) in self.per_flight.items()},
        }


class ByName(dict[str, Estimate]):
    """Estimates by name; one that there is not is told with the nearest names."""

    def __missing__(self, name: str) -> Estimate:
        raise UnknownNameError("estimated parameter", name, self)


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimates:
    """The numbers that a fit is made for.

    `derived` and `noise` map names to (value, std) and (level, std, unit); `correlations` (m, m)
    are those of the shared parameters `correlation_names`; `theta` (n,) are all unknowns of the
    problem. `told`: name -> (error by the flights, stated error) of held parameters that flights
    with white innovations know better than they are stated (`greybox.estimation.considered`).
    """

    model: IdentifiedModel
    parameters: Mapping[str, Estimate]
    derived: Mapping[str, tuple[float, float]]
    noise: Mapping[str, tuple[float, float, str]]
    correlation_names: tuple[str, ...]
    correlations: FloatArray
    theta: FloatArray
    told: Mapping[str, tuple[float, float]]

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", ByName(self.parameters))


@dataclass(frozen=True, kw_only=True, eq=False)
class Diagnostics:
    """What says how far the estimates can be trusted.

    `cost` is the negative log posterior, `loglik` the log likelihood without priors. `innovations`
    (flight -> list of (n, n_e)) are NaN where missing; `coloured` says whether they fail the
    whiteness test, in which case `std` of the estimates is the sandwich one.
    """

    status: Status
    cost: float
    loglik: float
    unidentifiable: tuple[Combination, ...]
    innovations: Mapping[str, list[FloatArray]]
    coloured: bool
    covariance: Covariance
    warnings: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Provenance:
    """What the fit was made of: `flights` and `settings` as in fit.json, `n_parameters` with noise
    levels. A fit that was decided automatically holds its `recipe`, with which an explicit fit
    gives the same numbers, and the `decisions`."""

    problem: Problem
    flights: tuple[FlightFacts, ...]
    settings: FitSettings
    data_hash: str
    n_samples: int
    n_parameters: int
    recipe: Recipe | None = None
    decisions: tuple[Decision, ...] = ()

    def __getstate__(self) -> dict[str, object]:
        """With the problem as bytes: few who read a fit in another process ask for it, and its
        engine is built again there."""
        rest = {n: v for n, v in vars(self).items() if n != "problem"}
        return rest if SAVED in rest else {**rest, SAVED: pickle.dumps(self.problem)}

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Problem:
            """The problem of a copy, built when it is asked for."""
            if name != "problem" or SAVED not in vars(self):
                raise AttributeError(name)
            object.__setattr__(self, name, pickle.loads(vars(self)[SAVED]))
            return vars(self)[name]


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Fit(Shown):
    """What a fit found; what the three records hold is there as attributes, too. It can be pickled,
    copied and sent to another process."""

    estimates: Estimates
    diagnostics: Diagnostics
    provenance: Provenance

    def with_history(self, recipe: Recipe, decisions: tuple[Decision, ...]) -> Fit:
        """The same fit with the recipe it was made by and the decisions that led there."""
        return replace(
            self, provenance=replace(self.provenance, recipe=recipe, decisions=decisions)
        )

    @property
    def verdict(self) -> Verdict | None:
        """Whether the model is useful, as flights judged it; None where nobody did."""
        return self.model.verdict

    def of_effect(self, effect: str) -> dict[str, Estimate]:
        """Estimates of the numbers of an effect or a part of the noise, by their whole names."""
        return {n: e for n, e in self.parameters.items() if n.split(".")[0] == effect}

    def feels(self, effect: str) -> bool:
        """Whether a number of an effect is clear of its null by its own error. One at a bound has
        none: it is, unless that bound is its null."""
        return any(
            value != zero and not (np.isfinite(std) and abs(value - zero) <= FELT * std)
            for zero, value, std in self._numbers(effect)
        )

    def tells(self, effect: str) -> bool:
        """Whether the numbers of an effect are clear of their nulls by their errors, alone (see
        `feels`) or together: two that are told as a sum may each be nothing."""
        own = [n for n, e in self.of_effect(effect).items() if np.isfinite(e.std)]
        places = [self.correlation_names.index(n) for n in own if n in self.correlation_names]
        alone = self.feels(effect)
        if alone or not places:
            return alone
        names = [self.correlation_names[i] for i in places]
        null = {d.name: d.null or 0.0 for d in self.model.dynamics.parameters}
        off = np.array([(self[n].value - null[n]) / self[n].std for n in names])
        alike = self.correlations[np.ix_(places, places)]
        return bool(off @ np.linalg.pinv(alike, hermitian=True) @ off > FELT**2)

    def _numbers(self, effect: str) -> list[tuple[float, float, float]]:
        """(null, value, std) of every number of an effect, of every flight that has its own."""
        null = {d.name: d.null or 0.0 for d in self.model.dynamics.parameters}
        return [
            (null[n], value, std)
            for n, e in self.of_effect(effect).items()
            for value, std in e.per_flight.values() or [(e.value, e.std)]
        ]

    def judged(self, verdict: Verdict | None) -> Fit:
        """The same fit with the verdict of a validation (`greybox.validation.validate`)."""
        model = replace(self.model, verdict=verdict)
        return replace(self, estimates=replace(self.estimates, model=model))

    def warned(self, lines: Sequence[str]) -> Fit:
        """The same fit with what is also to be warned of."""
        warnings = (*self.diagnostics.warnings, *lines)
        return replace(self, diagnostics=replace(self.diagnostics, warnings=warnings))

    def _shown_text(self) -> str:
        """The summary: the verdict first."""
        first, _, rest = self.summary().partition("\n")
        what = f"{self.model.name}: {len(self.parameters)} parameters, {len(self.flights)} flights"
        return f"{first}\n{what}\n{rest}"

    def _shown_rows(self) -> list[dict[str, Cell]]:
        """One row per estimated parameter; `t` is the distance from the null in standard errors."""
        null = {d.name: d.null for d in self.model.dynamics.parameters}
        rows: list[dict[str, Cell]] = []
        for name, e in self.parameters.items():
            zero = null.get(name)
            far = None if zero is None or not e.std > 0 else (e.value - zero) / e.std
            prior = e.prior or (None, None)
            rows.append(
                {
                    "parameter": name,
                    "value": e.value,
                    "std": e.std,
                    "unit": e.unit,
                    "scope": e.scope,
                    "t": far,
                    "prior": prior[0],
                    "prior std": prior[1],
                    "at bound": e.at_bound,
                }
            )
        return rows

    def plot(self, ax: Axes | None = None) -> Axes:
        """Estimates that had a prior, as deviations from it in its own standard deviations, with
        the standard error that is left; matplotlib axes. Raises `GreyboxError` without priors."""
        known = [e for e in self.parameters.values() if e.prior and e.prior[1] > 0]
        away = [(e.value - e.prior[0]) / e.prior[1] for e in known if e.prior]
        left = [e.std / e.prior[1] for e in known if e.prior]
        return deviations(
            [e.name for e in known],
            np.array(away),
            np.array(left),
            x="deviation from what the vehicle file says [its standard deviations]",
            ax=ax,
        )

    def plot_residuals(
        self, flight: str | None = None, ax: Sequence[Axes] | None = None
    ) -> list[Axes]:
        """Innovations (one-step errors) of one flight, the first one if none is named, over time;
        one panel per sensor component; matplotlib axes. Raises `UnknownNameError`."""
        chosen = next(iter(self.innovations)) if flight is None else flight
        if chosen not in self.innovations:
            raise UnknownNameError("flight", chosen, self.innovations)
        layout = self.model.dynamics.innovations
        dt = self.model.sample_time
        rows: dict[str, list[Curve]] = {}
        for i, signal in enumerate(layout):
            curves = []
            for j, record in enumerate(self.innovations[chosen]):
                label = "" if j else signal.name
                t = dt * np.arange(len(record), dtype=np.float64)
                curves.append(Curve(label=label, x=t, y=record[:, i]))
            rows[f"{signal.name} [{signal.unit}]"] = curves
        return panels(rows, x="t from the start of the record [s]", ax=ax)

    @property
    def model(self) -> IdentifiedModel:
        """The identified model."""
        return self.estimates.model

    @property
    def parameters(self) -> Mapping[str, Estimate]:
        """Estimates of the model parameters by name."""
        return self.estimates.parameters

    @property
    def derived(self) -> Mapping[str, tuple[float, float]]:
        """Derived parameter -> (value, std)."""
        return self.estimates.derived

    @property
    def noise(self) -> Mapping[str, tuple[float, float, str]]:
        """Estimated noise level -> (level, std, unit)."""
        return self.estimates.noise

    @property
    def correlation_names(self) -> tuple[str, ...]:
        """The shared parameters, in the order of `correlations`."""
        return self.estimates.correlation_names

    @property
    def correlations(self) -> FloatArray:
        """Correlation matrix (m, m) of the shared parameters."""
        return self.estimates.correlations

    @property
    def told(self) -> Mapping[str, tuple[float, float]]:
        """Held parameters that the flights know better than they are stated."""
        return self.estimates.told

    @property
    def theta(self) -> FloatArray:
        """All unknowns (n,), named in `problem.unknowns`; noise levels as natural logarithms."""
        return self.estimates.theta

    @property
    def status(self) -> Status:
        """How the solver ended."""
        return self.diagnostics.status

    @property
    def cost(self) -> float:
        """Negative log posterior."""
        return self.diagnostics.cost

    @property
    def loglik(self) -> float:
        """Log likelihood without priors."""
        return self.diagnostics.loglik

    @property
    def unidentifiable(self) -> tuple[Combination, ...]:
        """Combinations of parameters that the data do not tell."""
        return self.diagnostics.unidentifiable

    @property
    def innovations(self) -> Mapping[str, list[FloatArray]]:
        """Flight -> its records in order of time, a list of innovations (n, n_e) each, NaN where
        missing; columns in the order of `model.dynamics.innovations`."""
        return self.diagnostics.innovations

    @property
    def coloured(self) -> bool:
        """Whether the innovations fail the whiteness test."""
        return self.diagnostics.coloured

    @property
    def covariance(self) -> Covariance:
        """Covariance of all unknowns, in the order of `theta` and `problem.unknowns`; its `matrix`,
        and so `numpy.asarray(fit.covariance)`, is (n, n), noise levels as logarithms. That of the
        model's parameters alone is `model.covariance`."""
        return self.diagnostics.covariance

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the user should know, in words."""
        return self.diagnostics.warnings

    @property
    def recipe(self) -> Recipe | None:
        """What an explicit fit needs to give the same numbers; None where nothing was decided."""
        return self.provenance.recipe

    @property
    def decisions(self) -> tuple[Decision, ...]:
        """What was decided automatically, and why."""
        return self.provenance.decisions

    @property
    def problem(self) -> Problem:
        """The problem that was solved; of a fit from another process it is built when asked for."""
        return self.provenance.problem

    @property
    def flights(self) -> tuple[FlightFacts, ...]:
        """The flights that were fitted, as in fit.json."""
        return self.provenance.flights

    @property
    def settings(self) -> FitSettings:
        """Choices of the fit, as in fit.json."""
        return self.provenance.settings

    @property
    def data_hash(self) -> str:
        """Hash of the data."""
        return self.provenance.data_hash

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return self.provenance.n_samples

    @property
    def n_parameters(self) -> int:
        """Number of parameters and noise levels that were fitted."""
        return self.provenance.n_parameters

    @property
    def converged(self) -> bool:
        """Whether the optimum was reached."""
        return self.status.converged

    def __getitem__(self, name: str) -> Estimate:
        return self.parameters[name]

    @property
    def aic(self) -> float:
        """Akaike's information criterion, -2 log L + 2 k (Akaike 1974)."""
        return -2 * self.loglik + 2 * self.n_parameters

    @property
    def bic(self) -> float:
        """Schwarz' information criterion, -2 log L + k ln N, N the number of samples (Schwarz
        1978)."""
        return -2 * self.loglik + self.n_parameters * float(np.log(max(self.n_samples, 1)))

    def to_dict(self) -> FitDocument:
        """The content of fit.json (schema "greybox.fit/1")."""
        d = self.model.dynamics
        physics = physics_of(d)
        return {
            "schema": SCHEMA,
            "verdict": None if self.verdict is None else self.verdict.to_dict(),
            "model": {
                "name": d.name,
                "effects": list(self.model.effects),
                "states": list(d.states.names),
                "inputs": list(d.inputs.names),
                "outputs": list(d.outputs.names),
                "sample_time": self.model.sample_time,
                "omega_known": physics is None or physics.omega_known,
            },
            "settings": self.settings.copy(),
            "status": self.status.to_dict(),
            "cost": {
                "negative_log_posterior": self.cost,
                "loglik": self.loglik,
                "n_samples": self.n_samples,
                "n_parameters": self.n_parameters,
                "aic": self.aic,
                "bic": self.bic,
            },
            "parameters": {k: v.to_dict() for k, v in self.parameters.items()},
            "derived": {k: {"value": v, "std": s} for k, (v, s) in self.derived.items()},
            **self._lag(),
            "noise": {k: {"value": v, "std": s, "unit": u} for k, (v, s, u) in self.noise.items()},
            "std_kind": "sandwich" if self.coloured and self.covariance.enough else "fisher",
            "correlations": {
                "names": list(self.correlation_names),
                "matrix": self.correlations.tolist(),
            },
            "unidentifiable": [c.text for c in self.unidentifiable],
            "flights": [f.copy() for f in self.flights],
            "warnings": list(self.warnings),
            "data_hash": self.data_hash,
            "versions": library_versions(),
            **self._history(),
        }

    def _lag(self) -> LagPart:
        """Lag and delays as one number, as in fit.json."""
        lag = self.model.effective_lag
        if lag is None:
            return {}
        parts = dict(lag.parts)
        return {
            "effective_lag": {
                "value": lag.value,
                "std": lag.std,
                "parts": parts,
                "line": lag.line,
            }
        }

    def _history(self) -> HistoryPart:
        """Decisions and recipe of an automatic fit, as in fit.json."""
        recipe = self.provenance.recipe
        if recipe is None:
            return {}
        return {
            "decisions": [d.to_dict() for d in self.provenance.decisions],
            "recipe": recipe.to_dict(),
            "explicit": {"options": recipe.arguments(), "python": recipe.to_python()},
        }

    def save(self, folder: str) -> None:
        """Write fit.json and model.json into a folder, each atomically."""
        write_json(f"{folder}/fit.json", self.to_dict())
        self.model.save(f"{folder}/model.json")

    def summary(self) -> str:
        """The estimates as text: the verdict first, then how the solver ended and what doubts every
        error."""
        judged = [NOT_JUDGED] if self.verdict is None else self.verdict.lines()
        lines = [*judged, self.status.advice]
        if (
            self.verdict is None and not self.converged
        ):  # nothing vouches for these numbers: the failure comes first
            lines.reverse()
        doubts = (
            self.covariance.beyond,
            *self.covariance.changed,
            self.covariance.form,
            self.covariance.doubt,
        )
        first = [d for d in doubts if d]
        lines += [f"warning: {d}" for d in first]
        doubted = suspects(self.model, self.parameters)
        width = max((len(n) for n in self.parameters), default=4)
        for n, e in self.parameters.items():
            error = "at bound" if e.at_bound else f"+- {e.std:.2g}"
            extra = (
                f"  (prior decides {100 * e.prior_influence:.0f} %)"
                if e.prior_influence > 0.2
                else ""
            )
            extra += f"  ({doubted[n]})" if n in doubted else ""
            scope = "  per flight" if e.scope == "flight" else ""
            lines.append(f"{n:{width}s}  {e.value:12.6g} {error} {e.unit}{scope}{extra}")
        lag = self.model.effective_lag
        lines += [] if lag is None else [lag.line]
        lines += [f"not identified: {c.text}" for c in self.unidentifiable]
        lines += [f"warning: {w}" for w in self.warnings if w not in first]
        return "\n".join(lines)
