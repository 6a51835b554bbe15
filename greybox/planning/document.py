"""What plan.json (greybox.plan/1) holds: written by a plan, read by its page and picture. Standard
errors are null where nothing is known."""

from __future__ import annotations

from typing import NotRequired, TypedDict


class LimitsPart(TypedDict):
    """Room that a plan may use."""

    box_m: list[float]
    floor_m: float
    speed_m_s: float
    tilt_rad: float
    command: list[float]


class UsedPart(TypedDict):
    """The most that flights take of it [m, m/s, rad], and the share of their samples with a command
    outside its range."""

    x: float
    y: float
    lowest: float
    highest: float
    speed: float
    tilt: float
    commands_outside: float


class PieceRow(TypedDict):
    """A manoeuvre of a flight, with its times [s]; `amplitude` is a share of what the limits
    allow."""

    name: str
    text: str
    kind: str
    start: float
    seconds: float
    amplitude: float
    injected: bool


class FlightRow(TypedDict):
    """A flight and the file of its setpoints."""

    file: str
    seconds: float
    manoeuvres: list[PieceRow]


class PlannedRow(TypedDict):
    """A parameter with its standard errors: after the flights, before them, of the flights without
    what was known before, and after flights without a plan."""

    value: float
    unit: str
    scope: str
    wanted: bool
    std: float | None
    std_before: float | None
    std_flights_alone: float | None
    std_naive: float | None


class EfficiencyPart(TypedDict):
    """The plan against flights of the same length without one."""

    against: str
    as_long: float | None
    median_std_ratio: float | None
    not_seen_by_it: list[str]
    text: str


class PairRow(TypedDict):
    """Two effects, and whether the flights tell them apart."""

    effects: list[str]
    overlap: float
    expected_log_likelihood_ratio: float
    separated: bool
    verdict: str


class PlanDocument(TypedDict):
    """plan.json."""

    schema: str
    vehicle: str
    effects: list[str]
    sensors: list[str]
    sample_time: float
    seconds: float
    seed: int
    limits: LimitsPart
    used: UsedPart
    home: list[float]
    flights: list[FlightRow]
    parameters: dict[str, PlannedRow]
    efficiency: EfficiencyPart
    pairs: list[PairRow]
    unidentifiable: list[str]
    cannot_be_flown: list[str]
    warnings: list[str]
    noise: dict[str, float]
    versions: dict[str, str]
    command: NotRequired[str]
