"""Order and intervals on random systems, and the bias of open-loop subspace methods under feedback:
small versions.

The long versions are scenarios/studies/linear_recovery.py and linear_feedback_bias.py.
"""

import numpy as np
import pytest

from scenarios.studies import linear_feedback_bias, linear_recovery


def test_order_and_coverage_on_a_few_systems():
    rows = [
        linear_recovery.one_run(100 + n, n, size, closed, count=1500)
        for n, size, closed in ((1, 1, False), (2, 2, True), (3, 1, True))
    ]
    judged = [r for r in rows if r["ratio"] > 40]
    assert judged
    assert all(r["chosen"] == r["n"] for r in judged)
    hits = [
        h for r in rows for kind in ("poles", "ln_gain", "phase", "steady_gain") for h in r[kind]
    ]
    assert np.mean(hits) > 0.8


def test_closed_loop_subspace_and_pem_are_closer_to_the_truth_than_open_loop_subspace():
    table = linear_feedback_bias.errors(6, 2000)
    size = {k: float(np.abs(e.mean(axis=0)).max()) for k, e in table.items()}
    for consistent in ("ssarx", "pbsid", "pem"):
        assert size[consistent] < 0.6 * size["cva"]


@pytest.mark.slow
def test_pooled_coverage_and_order():
    rows = [
        linear_recovery.one_run(seed, n, size, closed)
        for seed in range(4)
        for n in range(1, 9)
        for size in (1, 2)
        for closed in (False, True)
    ]
    judged = [r for r in rows if r["ratio"] > 40]
    assert np.mean([r["chosen"] == r["n"] for r in judged]) >= 0.95
    hits = [
        h for r in judged for kind in ("poles", "ln_gain", "phase", "steady_gain") for h in r[kind]
    ]
    assert 0.93 <= np.mean(hits) <= 0.97


@pytest.mark.slow
def test_open_loop_subspace_is_biased_under_feedback():
    table = linear_feedback_bias.errors(30, 3000)
    for name, e in table.items():
        score = np.abs(e.mean(axis=0) / (e.std(axis=0, ddof=1) / np.sqrt(len(e)))).max()
        assert (score > 4) == (name in ("n4sid", "moesp", "cva")), (name, score)
