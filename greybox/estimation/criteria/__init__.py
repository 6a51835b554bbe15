"""Criteria: one file is one member; `CRITERIA` maps names to them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from greybox.estimation.criteria.gaussian import Gaussian

CRITERIA: Mapping[str, Any] = {"gaussian": Gaussian}
