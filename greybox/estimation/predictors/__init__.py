"""Predictors: one file is one member; `PREDICTORS` maps names to them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from greybox.estimation.predictors.innovation import Innovation
from greybox.estimation.predictors.k_step import KStep
from greybox.estimation.predictors.simulation import Simulation

PREDICTORS: Mapping[str, Any] = {"innovation": Innovation, "simulation": Simulation, "k-step": KStep}
