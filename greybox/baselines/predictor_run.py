"""Run: one segment under a predictor in innovation form."""

from __future__ import annotations

from dataclasses import dataclass

from greybox.symbolic import BoolArray, FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """One segment under the predictor: `states` (n, n_x) x(t|t-1), `mean` (n, n_o) y(t|t-1),
    `known` (n,) where both are predictions, `inputs` (n + past + future, n_u), parameters p (a zero
    for a linear model), shift (n_o,) of the outputs."""

    states: FloatArray
    mean: FloatArray
    known: BoolArray
    inputs: FloatArray
    p: FloatArray
    shift: FloatArray
