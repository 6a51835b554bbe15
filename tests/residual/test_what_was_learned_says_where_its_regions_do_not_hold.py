"""Regions of what was learned that hold too few errors of test flights are a warning of it."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import pytest

from greybox.residual.before_after import judge_both
from greybox.residual.document import LearnDocument
from tests.residual.hybrid_cases import pendulum_model, swings


@pytest.mark.parametrize(("share", "said"), [(0.1, True), (10.0, False)])
def test_regions_that_do_not_hold_are_warned_of(share: float, said: bool) -> None:
    model = pendulum_model((3e-3, 3e-3))
    after = replace(
        model, process_noise=share * model.process_noise, sensor_noise=share * model.sensor_noise
    )
    content = cast(LearnDocument, {"warnings": [], "null": False})
    judge_both(
        content,
        (model, after),
        swings(2, 5, hidden=0.0, period=4.0, seconds=20.0),
        base="model.json",
        adapt=0.0,
    )
    told = [w for w in content["warnings"] if w.startswith("too narrow: the stated 95 %")]
    assert bool(told) == said, content["warnings"]
