"""TubeProblem: what the controller is asked to do, in plain numbers. The equations are in stages.py
and controller.c."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from greybox.errors import ModelError
from mpc_export.feedback import Weights


@dataclass(frozen=True, kw_only=True)
class TubeProblem:
    """Horizon, weights and limits of the controller.

    dt [s]: length of a stage; horizon: stages; planes: how many position constraints a stage has
    room for. command_min, command_max and rate_max (change per sample) bound every command and are
    hard; planes and tilt_max [rad] are soft with an exact penalty: `penalty` per metre (or unit of
    cosine) beyond, `penalty_square` on its square. A plane that the craft is beyond, or cannot stop
    before, asks no more than the way back. feedback: whether the ancillary gain acts inside the
    tube; without it the covariance is that of an open loop. ancillary: weights of the LQR that
    gives this gain, default those of the tracking cost; a stiffer one makes the tube narrower in
    place and takes more off the commands. kind: "probabilistic" (covariances, back-off = kappa
    standard deviations) or "worst case" (ellipsoids that hold every disturbance inside its own
    ellipsoid; back-off = their half width). attempts: 2, or 1 for a chip whose time is short: a
    plan that fails is tried again, from its commands flown by the model, at once or in place of the
    next plan; until then the plan before goes on.
    """

    dt: float = 0.02
    horizon: int = 20
    planes: int = 4
    weights: Weights = field(default_factory=Weights)
    ancillary: Weights | None = None
    command_min: float = 0.05
    command_max: float = 0.95
    rate_max: float = 0.25
    tilt_max: float = 0.85
    penalty: float = 400.0
    penalty_square: float = 400.0
    feedback: bool = True
    kind: str = "probabilistic"
    attempts: int = 2

    def __post_init__(self) -> None:
        low, high, most = self.command_min, self.command_max, math.inf
        checks: Mapping[str, bool] = {
            "dt must be positive": math.isfinite(self.dt) and self.dt > 0,
            "the horizon has at least 2 stages": self.horizon >= 2,
            "planes must not be negative": self.planes >= 0,
            "limits of commands must be finite, command_min below command_max": -most
            < low
            < high
            < most,
            "attempts are 1 or 2": self.attempts in (1, 2),
            "rate_max must be positive and finite": 0 < self.rate_max < most,
            "tilt_max lies between 0 and pi": 0 < self.tilt_max < math.pi,
            "penalties must be finite and not negative": 0 <= self.penalty < most
            and 0 <= self.penalty_square < most,
            'kind is "probabilistic" or "worst case"': self.kind in ("probabilistic", "worst case"),
        }
        for text, good in checks.items():
            if not good:
                raise ModelError(f"controller: {text}")
