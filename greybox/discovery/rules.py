"""Rules: the few numbers that decide, each with its source; and effort, which decides nothing."""

from __future__ import annotations

from dataclasses import dataclass

from greybox.model.absence import TYPICAL
from greybox.validation.against import TRACE


@dataclass(frozen=True, kw_only=True)
class Rules:
    """Every number on which a verdict rests, besides the user's `alpha`."""

    typical: float = TYPICAL
    """Standard deviation of the prior of a cause in units of its declared typical size."""
    trace: float = TRACE
    """Share of the squared error, ahead or of one reading, below which a name is worth nothing: one
    per cent of the error itself, which no flight controller feels."""
    fastest: float = 0.1
    """Shortest horizon [s] of what a name is worth: a control period of the outer loop."""
    longest: float = 1.0
    """Longest horizon [s]: what a model predictive controller of a multirotor looks ahead."""
    law: float = 0.25
    """Share of the unnamed force or torque, on flights that were left out, that terms must explain
    to be called a law: half of its amplitude. And of the squared error ahead that a fit by errors
    ahead must remove for no likelihood to judge: 79 simulated logs reach .1, a real craft .36."""
    colour: float = 0.02
    """Share of a channel's innovation variance that its own past must tell before its sensor's
    noise is offered colour."""
    stand_in: float = 0.5
    """Share of what the absence of a name costs that others must take over to be its rivals: what
    takes over less is no likelier than doing without any."""
    rivals: int = 3
    """Rivals of a name that are refitted, the nearest first. Calibrated on linear worlds of
    look-alikes (`tests/discovery/test_more_effort_finds_more.py`): with two, 7 of 300 had another
    verdict than with all; with three, one."""

    @property
    def span(self) -> tuple[float, float]:
        """Shortest and longest horizon [s]."""
        return self.fastest, self.longest


RULES = Rules()


@dataclass(frozen=True, kw_only=True)
class Effort:
    """How much is tried: more, or less of `rough`, `stake` and `exact`, finds more or the same."""

    tried: int = 3
    """Causes, and pairs, that are refitted at every step."""
    together: int = 6
    """Causes that one step adds at most: the later ones rest on the earlier ones."""
    iterations: int = 60
    last: int = 300
    """Iterations that the fit of the answer goes on for."""
    opening: int = 6
    """Iterations after which a fit is first held against the best."""
    rough: float = 0.1
    """Where a fit stops that is only compared: a tenth in log evidence."""
    stake: float = 0.05
    """What a rival that is far behind may still gain, as a share of that, where its fit stops."""
    exact: float = 1e-2
    """Where the fit of a structure stops."""
    shares: tuple[float, ...] = (1.0, 0.7, 0.5, 0.3, 0.1)
    """Parts of a first estimate that are tried as starts."""
    behind: float = 30.0
    """Log evidence behind the best beyond which a fit is not carried on."""


EFFORT = Effort()
