"""Predictors: one file is one member; `PREDICTORS` maps names to them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from greybox.estimation.predictors.innovation import Innovation

PREDICTORS: Mapping[str, Any] = {"innovation": Innovation}
