"""Errors of a model on flights that judge are computed once, and none where it foretells nothing."""

from __future__ import annotations

import gc
import weakref
from typing import Any, cast

import pytest

import greybox.validation.judges
from greybox.errors import DataError
from greybox.validation.gap import HeldOutErrors
from greybox.validation.judges import Judges
from tests.automatic.craft import flights


class _Model:
    """Any model."""


MODEL: Any = _Model()


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


def test_errors_of_a_model_that_nobody_has_are_not_kept(asked):
    """A race fits a model without every effect: its errors were kept to the end of a search."""
    judges, model = Judges(flights=flights()), cast(Any, _Model())
    errors = weakref.ref(judges.errors(model))
    assert errors() is judges.errors(model)
    del model
    gc.collect()
    assert errors() is None


def test_there_is_no_gap_where_one_of_two_foretells_nothing():
    judges = Judges(flights=flights())
    assert judges.rows(None, MODEL) == []
    assert judges.samples == sum(f.n for f in flights())
