"""What discovery.json (greybox.discovery/2) holds: written by a search, read by its page and by a
search that goes on.

Keys that files of earlier versions, or of a search without files, do not have are `NotRequired`.
"""

from __future__ import annotations

from typing import NotRequired, TypedDict

from greybox.discovery.options import DiscoverOptions
from greybox.estimation.noise_table import SensorRow
from greybox.model.verdict import VerdictDocument
from greybox.planning.experiment import Manoeuvres
from greybox.residual.laws.axis import AxisRow
from greybox.validation.gap import GapDocument


class WorthRow(TypedDict):
    """Share of the squared error that a name removes, where, and its e-value on so many seconds."""

    share: float
    group: str
    horizon_s: float
    log10_e: float
    seconds: int


class UnlikelyRow(TypedDict):
    """A rival that the certificate does not refute and all flights do."""

    name: str
    log10_odds: float
    log10_e: float


class Grounds(TypedDict):
    """What is said of every name; `further`: the part of `log10_e` that later flights brought."""

    name: str
    status: str
    log10_e: float
    against: str
    unlikely: NotRequired[list[UnlikelyRow]]
    worth: WorthRow | None
    further: NotRequired[float]


class Estimate(TypedDict):
    """A number of the final fit; `std` is None at a bound."""

    value: float
    std: float | None
    unit: str


class NamedRow(Grounds):
    """A certified or supported effect, where it acts, and its parameters."""

    stage: str
    parameters: dict[str, Estimate]


class UnnamedRow(Grounds):
    """What was asked and has no name, and why; `in_model`: it is in the model all the same."""

    reason: str
    in_model: NotRequired[bool]


class Candidate(TypedDict):
    """One of a set, the probability that it is the one if one of them is, and the numbers that
    would then be others (parameter to value)."""

    name: str
    weight: float
    elsewhere: NotRequired[dict[str, float]]


class AmbiguousRow(TypedDict):
    """Causes that the flights cannot tell apart, and what would; the evidence of the set."""

    candidates: list[Candidate]
    separating_manoeuvre: Manoeuvres | None
    log10_e: float
    parameters: dict[str, Estimate]


class LeftRow(AxisRow):
    """An axis that holds something without a name; `file`: where its law is written."""

    file: str | None


class LocationRow(AxisRow):
    """An axis before the names, and its RMS after them."""

    rms_after: float | None


class TriedRow(TypedDict):
    """What was added in a fit, and what that gained in log evidence."""

    added: list[str]
    gain: float


class StepRow(TypedDict):
    """A step of the search: where it stood, what every absent cause promised, what was fitted."""

    structure: list[str]
    log_evidence: float
    predicted: dict[str, float]
    tried: list[TriedRow]
    added: list[str]


class BaseRow(TypedDict):
    """A cause that every model of the search has."""

    name: str
    parameters: dict[str, Estimate]


class SearchSettings(TypedDict, total=False):
    """Choices of a search (`DiscoverOptions`); a search that is refused tells the first two."""

    alpha: float
    seed: int
    max_effects: int
    adapt: float | None
    kinematic_noise: bool | None
    hold_sensor_noise: bool
    trace: bool
    per_flight: list[str]
    fixed: list[str]
    since: str | None
    sample_time: float


class DiscoveryDocument(TypedDict):
    """discovery.json."""

    schema: str
    verdict: str
    line: str
    model_verdict: NotRequired[VerdictDocument | None]
    bar_log10_e: float
    alone_log10_e: NotRequired[float]
    effects: list[NamedRow]
    traces: list[UnnamedRow]
    omega_known: bool
    ambiguous: list[AmbiguousRow]
    unnamed: list[LeftRow]
    not_certified: list[UnnamedRow]
    model_with_laws: NotRequired[str | None]
    base: NotRequired[list[BaseRow]]
    sensors: NotRequired[list[SensorRow]]
    locations: list[LocationRow]
    steps: list[StepRow]
    gap: list[GapDocument]
    gap_on: str
    minimum_detectable: dict[str, dict[str, float]]
    not_judged: dict[str, str]
    denied: NotRequired[list[str]]
    faults: list[str]
    by_errors_ahead: NotRequired[bool]
    warnings: list[str]
    settings: SearchSettings
    trained_on: list[str]
    tested_on: list[str]
    data_hash: str | None
    seconds: float
    versions: dict[str, str]
    command: NotRequired[str]
    effects_files: NotRequired[list[str]]


def settings_of(options: DiscoverOptions) -> SearchSettings:
    """What a search was asked for."""
    return {
        "alpha": options.alpha,
        "seed": options.seed,
        "max_effects": options.max_effects,
        "adapt": options.adapt,
        "kinematic_noise": options.kinematic_noise,
        "hold_sensor_noise": options.hold_sensor_noise,
        "trace": options.trace,
        "per_flight": list(options.per_flight),
        "fixed": sorted(options.fixed),
        "since": None if options.since is None else options.since.data_hash,
    }
