"""Status of a fit: an enum whose members are advice."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Any, TypedDict


class Code(enum.Enum):
    """How a solver ended. The value is what to tell the user."""

    CONVERGED = (
        "Converged: the gradient vanishes to far below one standard error of every estimate."
    )
    MAX_ITERATIONS = (
        "NOT converged: the iteration limit was reached. Allow more iterations, give better start "
        "values, or fix parameters that the data cannot identify."
    )
    NO_PROGRESS = (
        "NOT converged: no step lowers the cost by what matters, yet the gradient is not zero. The "
        "model may be discontinuous here or the data contain outliers: look at the innovations, "
        "try the robust criterion or other start values."
    )
    BEHIND = (
        "NOT converged: ended early, as no more was needed: it could not catch up with the fit "
        "that it was held against."
    )
    INVALID_START = (
        "NOT converged: the model gives no finite prediction at the start values. "
        "Check units and the vehicle file."
    )
    INTERRUPTED = "NOT converged: interrupted; the values are the best so far."
    SOLVER_FAILED = (
        "NOT converged: the solver gave up. Try levenberg-marquardt, or other start values."
    )


class Interrupted(KeyboardInterrupt):
    """A solver or a fit was interrupted from the keyboard.

    Nobody goes on with half a fit by mistake, because it is an exception; nothing is lost, because
    `kept` is what was there: of a solver the best unknowns and their `Status`, of `fit` the `Fit`
    with them.
    """

    def __init__(self, kept: Any) -> None:
        super().__init__("interrupted")
        self.kept = kept


class StatusRow(TypedDict):
    """A `Status` in a result file; `code` by its name."""

    converged: bool
    code: str
    advice: str
    iterations: int
    evaluations: int
    decrement: float
    seconds: float


@dataclass(frozen=True, kw_only=True)
class Status:
    """How a fit ended. `decrement` is the decrease of the cost that one more full step promises."""

    code: Code
    iterations: int
    evaluations: int
    decrement: float
    seconds: float = 0.0
    detail: str = ""

    @property
    def converged(self) -> bool:
        """Whether the optimum was reached."""
        return self.code is Code.CONVERGED

    @property
    def advice(self) -> str:
        """One or two sentences for the user."""
        return self.code.value + (f" ({self.detail})" if self.detail else "")

    def to_dict(self) -> StatusRow:
        """Plain values for fit.json."""
        return {
            "converged": self.converged,
            "code": self.code.name.lower(),
            "advice": self.advice,
            "iterations": self.iterations,
            "evaluations": self.evaluations,
            "decrement": self.decrement,
            "seconds": self.seconds,
        }
