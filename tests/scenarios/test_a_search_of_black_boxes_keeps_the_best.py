"""Searches of the study of a paper keep the candidate that predicts validation flights best."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.data import Dataset, dataset_from_arrays
from greybox.errors import DataError

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


def flight(seed: int, n: int = 400) -> Dataset:
    """A stable second-order system, y1 and y2, driven by u, with a little noise."""
    rng = np.random.default_rng(seed)
    u = np.convolve(rng.standard_normal(n + 9), np.ones(10) / 10, "valid")
    y = np.zeros((n, 2))
    for k in range(1, n):
        y[k, 0] = 0.9 * y[k - 1, 0] + 0.1 * y[k - 1, 1]
        y[k, 1] = 0.8 * y[k - 1, 1] - 0.2 * y[k - 1, 0] + np.tanh(2.0 * u[k - 1])
    y += 0.01 * rng.standard_normal(y.shape)
    return dataset_from_arrays(0.01 * np.arange(n), {"y1": y[:, 0], "y2": y[:, 1], "u": u})


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
