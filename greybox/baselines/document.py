"""What compare.json (greybox.compare/1) holds, and learn.json of an output residual
(greybox.output_residual/1): written where they are made, read by their pages."""

from __future__ import annotations

from typing import NotRequired, TypedDict

from greybox.baselines.compare_scores import ChannelScores
from greybox.baselines.output_judge import BothJudged
from greybox.baselines.regressors import Point
from greybox.residual.document import LearnedRow
from greybox.residual.training_report import TrainingDocument
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
    """One method in compare.json: an error where it failed or cannot run on these logs, else its
    scores (`StepScores`) and what it cost. `status`: "done", "failed" or "cannot"."""

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


class OutputDocument(TypedDict):
    """learn.json of an output residual; `kernel` of a Gaussian process alone, `validation` once it
    was judged."""

    schema: str
    kind: str
    command: str
    model: str
    features: list[str]
    outputs: list[LearnedRow]
    null: bool
    learner: str
    kernel: str | None
    points: int
    adapt: float | None
    parameters: int
    seconds: float
    seed: int
    samples: int
    training: TrainingDocument
    trained_on: list[str]
    judged_on: list[str]
    data_hash: str
    validation: BothJudged | None
    warnings: list[str]
    versions: dict[str, str]
