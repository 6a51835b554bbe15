"""Few samples: when there are too few for a fit."""

from __future__ import annotations

from greybox.errors import DataError
from greybox.estimation.problem import Problem


def demand_samples(problem: Problem) -> None:
    """Raise `DataError` where there are fewer samples than unknowns (initial states left out: they are
    read off the data)."""
    samples = sum(int((r.mask != 0).any(axis=1).sum()) for r in problem.records)
    unknowns = sum(u.kind != "initial" for u in problem.unknowns)
    if samples < unknowns:
        raise DataError(
            f"{samples} samples are fewer than the {unknowns} unknowns",
            fix="pass a longer flight, or hold parameters (--fixed) and noise levels (--hold-noise)",
        )
