"""What compare.json (greybox.compare/1) holds: written by a comparison, read by its page."""

from __future__ import annotations

from typing import NotRequired, TypedDict

from greybox.baselines.compare_scores import ChannelScores
from greybox.baselines.regressors import Point
from greybox.validation.horizon_table import HorizonDocument


class SeriesRow(TypedDict):
    """Predictions of a channel with their standard deviations."""

    mean: list[float | None]
    std: list[float | None]


class Measured(TypedDict):
    """What `SeriesRow`s are held against: times [s], and values by channel."""

    flight: str
    t: list[float]
    channels: dict[str, list[float | None]]


class MethodRow(TypedDict):
    """One method in compare.json: an error where it failed, else its scores (`StepScores`) and
    what it cost."""

    method: str
    status: str
    error: NotRequired[str]
    channels: NotRequired[dict[str, ChannelScores]]
    mean: NotRequired[dict[str, float]]
    multi_step: NotRequired[HorizonDocument | None]
    curve: NotRequired[dict[str, list[float]] | None]
    parameters: NotRequired[int]
    train_seconds: NotRequired[float]
    microseconds_per_sample: NotRequired[float]
    search: NotRequired[list[Point]]
    settings: NotRequired[Point]
    series: NotRequired[dict[str, SeriesRow]]


class CompareDocument(TypedDict):
    """compare.json; `command` once there is one."""

    schema: str
    vehicle: str
    train: list[str]
    test: list[str]
    sample_time: float
    channels: list[str]
    units: dict[str, str]
    train_std: dict[str, float]
    adapt: float | None
    budget: int
    seed: int
    horizons: list[int]
    origin_spacing: float
    held_back: list[str]
    black_box_inputs: list[str]
    methods: list[MethodRow]
    dead_reckoning: HorizonDocument | None
    dead_reckoning_curve: dict[str, list[float]] | None
    not_run: list[str]
    measured: Measured
    versions: dict[str, str]
    command: NotRequired[str]
