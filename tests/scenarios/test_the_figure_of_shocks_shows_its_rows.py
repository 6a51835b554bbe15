"""The figure of shocks shows what the rows say."""

from __future__ import annotations

import numpy as np

from scenarios.studies.shocks import WINDOW, WINDOWS
from scenarios.studies.shocks_figure import main, share_beyond


def test_a_line_is_the_mean_of_its_flights():
    rows = [
        {"before": 0.0, "after": [1.0, *[0.0] * (WINDOWS - 1)]},
        {"before": 0.1, "after": [0.5, *[0.0] * (WINDOWS - 1)]},
    ]
    times, share = share_beyond(rows)
    np.testing.assert_allclose(share, [0.05, 0.75, *[0.0] * (WINDOWS - 1)])
    assert times[0] < 0.0 < times[1] and times[-1] == WINDOW * (WINDOWS - 0.5)


def test_the_kept_rows_make_the_same_figure_twice(tmp_path):
    kept = "scenarios/results/shocks_1001.jsonl.gz"
    for name in ("a.svg", "b.svg"):
        main([kept, str(tmp_path / name)])
    text = (tmp_path / "a.svg").read_text()
    assert text == (tmp_path / "b.svg").read_text()
    assert len(text) < 150_000
