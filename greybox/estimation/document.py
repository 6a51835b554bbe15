"""What fit.json (greybox.fit/1) holds: written by a fit, read by its page.

Keys that files of earlier versions, or a fit that was not decided automatically, do not have are
`NotRequired`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NotRequired, TypedDict

from greybox.data.dataset import FlightFacts
from greybox.estimation.status import StatusRow
from greybox.model.verdict import VerdictDocument


class FittedPart(TypedDict):
    """The model's names."""

    name: str
    effects: list[str]
    states: list[str]
    inputs: list[str]
    outputs: list[str]
    sample_time: float
    omega_known: bool


class FitSettings(TypedDict):
    """The choices of a fit."""

    predictor: str
    criterion: str
    solver: str
    initialisation: str
    disturbance: list[str]
    noise_parts: list[str]
    estimate_noise: bool | Literal["process"]
    seed: int
    per_flight: list[str]
    fixed: list[str]
    compiled: bool
    considered: list[str]


class CostPart(TypedDict):
    """The cost at the end and the criteria that follow from it."""

    negative_log_posterior: float
    loglik: float
    n_samples: int
    n_parameters: int
    aic: float
    bic: float


class Normal(TypedDict):
    """A prior."""

    value: float
    sigma: float | None


class Spread(TypedDict):
    """A value with its standard error."""

    value: float
    std: float | None


class ParameterRow(Spread):
    """An estimated parameter; `per_flight`: flight -> value."""

    std_fisher: float | None
    unit: str
    scope: str
    prior: Normal | None
    prior_influence: float | None
    at_bound: bool
    per_flight: dict[str, Spread]


class NoiseRow(Spread):
    """An estimated noise level."""

    unit: str


class LagRow(Spread):
    """Lag and delays as one number [s], its parts by parameter, and all that in words."""

    parts: dict[str, float]
    line: str


class LagPart(TypedDict, total=False):
    """Where the model has a lag."""

    effective_lag: LagRow


class Correlations(TypedDict):
    """Correlation `matrix` (m, m) of the estimates of `names`."""

    names: list[str]
    matrix: list[list[float | None]]


class ExplicitPart(TypedDict):
    """The same fit, said explicitly: options, Python and the command line."""

    options: list[str]
    python: str
    command: NotRequired[str]


class HistoryPart(TypedDict, total=False):
    """How an automatic fit was decided, and the same said explicitly."""

    decisions: list[dict[str, str]]
    recipe: Mapping[str, object]
    explicit: ExplicitPart


class FitDocument(LagPart, HistoryPart):
    """fit.json; `left_out`: the verdict on pieces of the flights, beside that on test flights."""

    schema: str
    verdict: VerdictDocument | None
    model: FittedPart
    settings: FitSettings
    status: StatusRow
    cost: CostPart
    parameters: dict[str, ParameterRow]
    derived: dict[str, Spread]
    noise: dict[str, NoiseRow]
    std_kind: str
    correlations: Correlations
    unidentifiable: list[str]
    flights: list[FlightFacts]
    warnings: list[str]
    data_hash: str
    versions: dict[str, str]
    command: NotRequired[str]
    left_out: NotRequired[VerdictDocument]
