"""What fit.json of linear models (greybox.linear_fit/1) holds."""

from __future__ import annotations

from typing import TypedDict

from greybox.files import Json
from greybox.validation.cross_correlation import CrossDocument
from greybox.validation.whiteness import WhitenessDocument


class ChannelRow(TypedDict):
    """An input or output, and the columns of the log that it is the weighted sum of."""

    name: str
    unit: str
    terms: list[list[str | float]]


class LogRow(TypedDict):
    """A log that was read."""

    name: str
    sha256: str


class TrainPart(TypedDict):
    """By output."""

    one_step_fit_percent: dict[str, float]


class SpectralPart(TypedDict):
    """Share of the spectrum between two frequencies that the model misses, by output."""

    low_hz: float
    high_hz: float
    share: dict[str, float]


class TestDocument(TypedDict):
    """One test record at one horizon [samples], or in a free run; errors by output."""

    record: str
    horizon: int | str
    samples: int
    rmse: dict[str, float]
    fit_percent: dict[str, float]
    persistence_rmse: dict[str, float]


class TestPart(TypedDict):
    """Records that the fit never saw."""

    adapted_on_seconds: float
    log_det_innovations: float
    rows: list[TestDocument]


class JudgedModel(TypedDict):
    """A fitted model and how it was judged."""

    name: str
    fit: dict[str, Json]
    model: dict[str, Json]
    profile_intervals: list[dict[str, Json]]
    train: TrainPart
    whiteness: WhitenessDocument | None
    cross_correlation: CrossDocument | None
    feedback_assumed: bool
    spectral_error: SpectralPart | None
    test: TestPart


class LinearDocument(TypedDict):
    """fit.json of `greybox linear`; `siso`: one model for every output and its input."""

    schema: str
    command: str
    sample_time: float
    inputs: list[ChannelRow]
    outputs: list[ChannelRow]
    train: list[LogRow]
    test: list[LogRow]
    siso: bool
    models: list[JudgedModel]
    warnings: list[str]
    notes: list[str]
