"""gp_ and network_ functions: the learned part by itself, and what it pushes."""

from __future__ import annotations

from collections.abc import Mapping

from greybox.symbolic import Expr
from mpc_export.model_parts import ModelParts


def add_learned(parts: ModelParts, through: Mapping[str, Expr]) -> None:
    """Nothing without a learned part; `through` are the slopes of x_next in what it pushes, by
    name."""
    if parts.posterior is None:
        return
    parts.features("error")
    parts.features("raw")
    parts.mean()
    parts.mean_jacobian()
    if parts.states_variance:
        parts.learned("variance", ("variance",))
        parts.learned("all", ("mean", "variance", "mean_jacobian", "variance_jacobian"))
        parts.learned("distance", ("distance",))
    for name, expression in through.items():
        parts.add_value(name, name, expression)
