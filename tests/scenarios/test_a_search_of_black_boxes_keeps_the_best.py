"""Searches of the study of a paper keep the candidate that predicts validation flights best."""

from __future__ import annotations

import pytest

from greybox.errors import DataError
from tests.baselines.second_order import flight

pytest.importorskip("gpytorch")
from scenarios.studies import paper_search

OUTPUTS, INPUTS = ("y1", "y2"), ("u",)
SPACES = {
    "search_narx": (
        "NARX_SPACE",
        {"lags": (1, 2), "kernel": ("se",), "increments": (False,), "points": (20,)},
        {},
    ),
    "search_lstm": (
        "LSTM_SPACE",
        {
            "hidden": (4, 8),
            "learning_rate": (1e-2,),
            "window": (2,),
            "dropout": (0.0,),
            "increments": (False,),
        },
        {"epochs": 4},
    ),
}


@pytest.mark.parametrize("name", SPACES)
def test_it_keeps_the_best_candidate_and_lists_all(name, monkeypatch):
    space, small, options = SPACES[name]
    monkeypatch.setattr(paper_search, space, small)
    search = getattr(paper_search, name)
    best = search(flight(0), flight(1), outputs=OUTPUTS, inputs=INPUTS, budget=2, **options)
    tried = best.report["search"]
    varied = next(k for k, values in small.items() if len(values) > 1)
    assert {c[varied] for c in tried} == set(small[varied])
    chosen = min(tried, key=lambda c: c["validation"])
    own = best.lags.n_a if varied == "lags" else best.report["settings"][varied]
    assert own == chosen[varied]
    with pytest.raises(DataError, match="at least 1"):
        search(flight(0), flight(1), outputs=OUTPUTS, inputs=INPUTS, budget=0)
