"""Promise: at most a share of what runs may go beyond a limit. What ran is held against it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import binomtest

from greybox.report.mpc_documents import Answered, AnswerTimes, Counted, Judged


def exact(hits: int, total: int) -> tuple[float, float]:
    """95 % interval of a share (Clopper and Pearson 1934, Biometrika 26(4)); (0, 1) of none."""
    if not total:
        return 0.0, 1.0
    found = binomtest(hits, total).proportion_ci(method="exact")
    return float(found.low), float(found.high)


def counted(hits: int, total: int) -> Counted:
    """How many went beyond: `count`, `share` (None of none) and its 95 % `interval`."""
    return {
        "count": hits,
        "share": hits / total if total else None,
        "interval": exact(hits, total),
    }


def p_value(hits: int, total: int, level: float) -> float | None:
    """Probability of so many where `level` is the share; None of none."""
    return float(binomtest(hits, total, level, alternative="greater").pvalue) if total else None


def answer_times(rows: Sequence[Answered]) -> AnswerTimes:
    """Median and 99 % [ms] of all answers of some rows; None without any."""
    times = np.concatenate([r["solve_ms"] for r in rows]) if rows else np.zeros(0)
    if not times.size:
        return {"median": None, "p99": None}
    return {"median": float(np.median(times)), "p99": float(np.quantile(times, 0.99))}


def kept(who: str, found: Judged, total: int, level: float, may: str) -> str:
    """Whether `who` kept the promise, in a sentence without its end: `found` has `beyond` (see
    `counted`) and `p_value` of `total` runs, `may` is what at most a `level` of them may do."""
    low, high = (100 * v for v in found["beyond"]["interval"])
    assert found["p_value"] is not None  # there are runs
    broke = found["p_value"] < 0.05
    begin = f"{who} broke its promise" if broke else f"{who} kept its promise"
    begin += "" if broke or high <= 100 * level else " so far"
    return (
        f"{begin}: at most {100 * level:g} % of {may}, {found['beyond']['count']} of {total} did "
        f"(95 % interval {low:.0f} to {high:.0f} %)"
    )


def left_open(found: Judged, level: float) -> bool:
    """Whether so few ran that the share may still be either side of the `level`."""
    low, high = found["beyond"]["interval"]
    return bool(low <= level < high)
