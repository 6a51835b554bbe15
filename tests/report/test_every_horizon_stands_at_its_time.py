"""Ceiling and floor are drawn at the times at which they were computed, whether all horizons are
known or a few."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from greybox.report import figures, validation_sections
from greybox.report.html import Report
from tests.report.synthetic_fit import make_validation


@pytest.mark.parametrize("kept", ["all", "model only"])
def test_every_row_at_its_own_times(kept: str, monkeypatch: pytest.MonkeyPatch) -> None:
    content: dict[str, Any] = make_validation()
    content["curves"] = {
        k.replace("_", " "): v for k, v in content["curves"].items()
    }  # as `validate` writes them
    if kept == "model only":
        content["curves"] = {"model": content["curves"]["model"]}
    drawn: list[tuple[list[float], dict[str, Any]]] = []
    real = figures.error_growth

    def watched(seconds: list[float], curves: dict[str, Any], **rest: Any) -> Any:
        drawn.append((seconds, curves))
        return real(seconds, curves, **rest)

    monkeypatch.setattr(validation_sections.figures, "error_growth", watched)
    validation_sections.horizon_section(Report("x"), content)
    floor = content["dead_reckoning"]
    group = next(iter(floor["horizons"][0]["groups"]))
    seconds, curves = drawn[0]
    values = curves["dead reckoning (floor)"][0]
    assert len(values) == len(seconds)
    for h in floor["horizons"]:
        at = int(np.argmin(np.abs(np.asarray(seconds) - h["seconds"])))
        assert seconds[at] == pytest.approx(h["seconds"])
        assert values[at] == pytest.approx(h["groups"][group]["mae"], rel=1e-6)
