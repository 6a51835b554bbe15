"""Errors of a model on flights that judge are computed once, and none where it foretells nothing."""

from __future__ import annotations

from typing import Any

import pytest

import greybox.validation.judges
from greybox.errors import DataError
from greybox.validation.gap import HeldOutErrors
from greybox.validation.judges import Judges
from tests.automatic.craft import flights

MODEL: Any = object()


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[float, bool]]:
    calls: list[tuple[float, bool]] = []

    def predicted(_model: Any, _data: Any, *, adapt: float, unnamed: bool) -> HeldOutErrors:
        calls.append((adapt, unnamed))
        if unnamed:
            raise DataError("no flight is long enough for multi-step errors")
        return HeldOutErrors(own={}, floor={})

    monkeypatch.setattr(greybox.validation.judges, "predict_ahead", predicted)
    return calls


@pytest.mark.parametrize(("adapt", "seconds"), [(None, 0.0), (5.0, 5.0)])
def test_once_with_what_has_no_name_and_once_without(asked, adapt, seconds):
    judges = Judges(flights=flights(), adapt=adapt)
    assert judges.errors(MODEL) is judges.errors(MODEL) is not None
    assert judges.errors(MODEL, unnamed=True) is judges.errors(MODEL, unnamed=True) is None
    assert asked == [(seconds, False), (seconds, True)]


def test_there_is_no_gap_where_one_of_two_foretells_nothing():
    judges = Judges(flights=flights())
    assert judges.rows(None, MODEL) == []
    assert judges.samples == sum(f.n for f in flights())
