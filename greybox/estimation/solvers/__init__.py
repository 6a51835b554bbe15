"""Solvers: one file is one member; `SOLVERS` maps names to them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt

SOLVERS: Mapping[str, Any] = {"levenberg-marquardt": LevenbergMarquardt}
