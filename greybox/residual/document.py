"""What learn.json (greybox.learn/1) holds: written where something is learned and judged, read by
its page."""

from __future__ import annotations

from typing import Literal, NotRequired, TypedDict

from greybox.model.verdict import VerdictDocument
from greybox.residual.training_report import TrainingDocument
from greybox.validation.against import AgainstDocument
from greybox.validation.result import ValidationDocument


class CandidateRow(TypedDict):
    """A set of features, and the share of the held-out cost that it saves; `features_saw`: with
    features that saw the flights which judge it, for a better candidate stood without."""

    name: str
    held_out_gain: float
    features_saw: NotRequired[bool]


class LearnedRow(TypedDict):
    """An output of the learned part, and whether anything was learned of it."""

    name: str
    unit: str
    learned: bool


class MovedRow(TypedDict):
    """A parameter of the physics before and after it was refitted beside the learned part."""

    name: str
    unit: str
    before: float
    after: float
    std_before: float
    std_after: float | None


class OpenLoopPart(TypedDict):
    """The fit by errors ahead; `strengths`: output -> strength of its prior, None where nothing was
    learned."""

    status: str
    iterations: int
    cost_before: float
    cost_after: float
    held_out_gain: float
    strengths: dict[str, float | None]


class CalibrationPart(TypedDict):
    """What the growth of the uncertainty was scaled by, as `Calibration` explains it; `learned`,
    a factor on the spread of the learned part, in older files."""

    factors: dict[str, float]
    learned: NotRequired[float]
    gain: float
    new_flight: float


Half = Literal["before", "after"]
HALVES: tuple[Half, ...] = ("before", "after")
"""What is compared: the model without and with what was learned."""


class BeforeAfter(TypedDict, total=False):
    """Their validations, as far as there are any."""

    before: ValidationDocument
    after: ValidationDocument


class LearnDocument(TypedDict):
    """learn.json, without its last three keys before it is judged; its schema says more."""

    schema: str
    model: str
    kind: str
    learner: str
    null: bool
    candidates: list[CandidateRow]
    chosen: str
    features: list[str]
    outputs: list[LearnedRow]
    points: int
    fit: OpenLoopPart
    refit: NotRequired[list[MovedRow]]
    calibration: CalibrationPart
    training: list[TrainingDocument]
    trained_on: list[str]
    data_hash: str
    seconds: float
    warnings: list[str]
    versions: dict[str, str]
    command: NotRequired[str]
    validation: NotRequired[BeforeAfter]
    verdict: NotRequired[VerdictDocument | None]
    against_physics: NotRequired[AgainstDocument]
