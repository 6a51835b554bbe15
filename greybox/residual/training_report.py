"""What training a GP did, in numbers: one report per output, the curve over support points, times
and warnings."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypedDict

from greybox.files import Json
from greybox.residual.posterior import GPPosterior
from greybox.residual.selection import Curve


class OutputRow(TypedDict):
    """An `OutputReport` in a result file."""

    name: str
    status: str
    message: str
    log_likelihood: float
    evaluations: int
    at_bound: tuple[str, ...]
    lengthscales: tuple[float, ...]
    signal_std: float
    noise_std: float
    noise_inflation: float
    noise_per_group: bool
    nlpd: float | None
    nlpd_constant: float | None
    gain: float | None
    gain_error: float | None
    rmse: float | None
    rmse_constant: float | None


@dataclass(frozen=True, kw_only=True)
class OutputReport:
    """Training of one output.

    `status` is "converged", "iteration limit", "diverged" or "null" (the held-out samples do not
    prefer the GP to a constant; its mean is zero and its prior variance is the leftover).
    `log_likelihood` is of the exact subset. lengthscales in input units, signal_std and noise_std
    in output units. nlpd and nlpd_constant [nats per sample], their difference `gain` with its
    standard error, and the RMSE of both, are of held-out samples; None without a hold-out.
    """

    name: str
    status: str
    message: str
    log_likelihood: float
    evaluations: int
    at_bound: tuple[str, ...]
    lengthscales: tuple[float, ...]
    signal_std: float
    noise_std: float
    noise_inflation: float
    noise_per_group: bool
    nlpd: float | None = None
    nlpd_constant: float | None = None
    gain: float | None = None
    gain_error: float | None = None
    rmse: float | None = None
    rmse_constant: float | None = None

    def to_dict(self) -> OutputRow:
        """Plain values under the names of the fields."""
        return {
            "name": self.name,
            "status": self.status,
            "message": self.message,
            "log_likelihood": self.log_likelihood,
            "evaluations": self.evaluations,
            "at_bound": self.at_bound,
            "lengthscales": self.lengthscales,
            "signal_std": self.signal_std,
            "noise_std": self.noise_std,
            "noise_inflation": self.noise_inflation,
            "noise_per_group": self.noise_per_group,
            "nlpd": self.nlpd,
            "nlpd_constant": self.nlpd_constant,
            "gain": self.gain,
            "gain_error": self.gain_error,
            "rmse": self.rmse,
            "rmse_constant": self.rmse_constant,
        }


class TrainingDocument(TypedDict, total=False):
    """How something was learned, in result files: a process tells all of the first lines,
    another learner what it chose among; `left_out` per output, where left-out flights judged."""

    candidate: str
    method: str
    kernel: str
    points: int
    subset: int
    rows_used: int
    rows_dropped: int
    groups: int
    held_out: list[str]
    outputs: list[OutputRow]
    curve: dict[str, Json] | None
    seconds: dict[str, float]
    converged: bool
    chosen: str
    candidates: dict[str, float]
    left_out: dict[str, dict[str, float]]
    warnings: list[str]


@dataclass(frozen=True, kw_only=True)
class TrainingReport:
    """Training of all outputs. `seconds` by stage; `held_out` names the groups that judged (or
    "last part")."""

    method: str
    kernel: str
    points: int
    subset: int
    rows_used: int
    rows_dropped: int
    groups: int
    held_out: tuple[str, ...]
    outputs: tuple[OutputReport, ...]
    curve: Curve | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    @property
    def converged(self) -> bool:
        """Whether every output that was trained also converged."""
        return all(o.status in ("converged", "null") for o in self.outputs)

    def to_dict(self) -> TrainingDocument:
        """Plain values."""
        return {
            "method": self.method,
            "kernel": self.kernel,
            "points": self.points,
            "subset": self.subset,
            "rows_used": self.rows_used,
            "rows_dropped": self.rows_dropped,
            "groups": self.groups,
            "held_out": list(self.held_out),
            "outputs": [o.to_dict() for o in self.outputs],
            "curve": None if self.curve is None else self.curve.to_dict(),
            "seconds": dict(self.seconds),
            "warnings": list(self.warnings),
            "converged": self.converged,
        }


@dataclass(frozen=True, kw_only=True)
class TrainedGP:
    """What `train_gp` returns: the posterior to keep, and the report of how it came about."""

    posterior: GPPosterior
    report: TrainingReport
