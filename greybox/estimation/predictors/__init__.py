"""Predictors: one file is one member; `PREDICTORS` maps names to them."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from greybox.estimation.predictor import Predictor
from greybox.estimation.predictors.innovation import Innovation
from greybox.estimation.predictors.k_step import KStep
from greybox.estimation.predictors.kalman import Kalman
from greybox.estimation.predictors.multi_step import MultiStep
from greybox.estimation.predictors.multiple_shooting import MultipleShooting
from greybox.estimation.predictors.simulation import Simulation

PREDICTORS: Mapping[str, Callable[..., Predictor[object]]] = {
    "innovation": Innovation,
    "kalman": Kalman,
    "k-step": KStep,
    "multi-step": MultiStep,
    "multiple-shooting": MultipleShooting,
    "simulation": Simulation,
}
