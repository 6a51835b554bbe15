"""A name whose estimates ran to a bound, and of which no other is clear of none, stands in for something else."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from greybox.discovery.name import Addition
from greybox.discovery.search import without_bent

NULL = {"accelerometer_scale.s_x": 0.0, "accelerometer_scale.s_z": 0.0, "command_saturation.a_lo": 0.0, "gyro_bias.b_x": 0.0}


def estimate(value: float, std: float | None = None) -> Any:
    """An estimate, at a bound where it has no standard error."""
    return SimpleNamespace(value=value, std=float("nan") if std is None else std, at_bound=std is None)


def fitted(effects: Sequence[str], **parameters: Any) -> Any:
    """A fit with these effects and estimates."""
    return SimpleNamespace(
        effects=tuple(effects), fit=SimpleNamespace(parameters={k.replace("__", "."): v for k, v in parameters.items()})
    )


def added(*effects: str) -> Addition:
    """A step that added them."""
    at: Any = None
    return Addition(
        effects=effects, p_value=0.001, delta_bic=100.0, delta_bic_rival=50.0, rivals={}, before=at, after=at, scores=()
    )


NEST: Any = SimpleNamespace(
    candidates=SimpleNamespace(null=NULL), refit=lambda effects, start: fitted(effects)
)


@pytest.mark.parametrize(
    ("s_x", "s_z", "gone"),
    [
        (estimate(-0.5), estimate(0.0012, 0.0008), True),
        (estimate(-0.5), estimate(-0.5), True),
        (estimate(-0.5), estimate(0.03, 0.001), False),
        (estimate(0.001, 0.001), estimate(0.0012, 0.0008), False),  # no bound: BIC has judged it
        (estimate(0.0), estimate(0.03, 0.001), False),
    ],
)
def test_bent_and_not_seen_is_out(s_x: Any, s_z: Any, gone: bool):
    at = fitted(
        ("gyro_bias", "accelerometer_scale"), gyro_bias__b_x=estimate(0.03, 0.001), accelerometer_scale__s_x=s_x,
        accelerometer_scale__s_z=s_z,
    )  # fmt: skip
    both = [added("gyro_bias"), added("accelerometer_scale")]
    last, kept, off = without_bent(NEST, at, both)
    assert ("accelerometer_scale" not in last.effects) == gone
    assert [a.effects for a in kept] == [("gyro_bias",)] + ([] if gone else [("accelerometer_scale",)])
    assert [w.effects for w in off] == ([("accelerometer_scale",)] if gone else [])
    assert (last is at) == (not gone)


def test_a_bound_that_is_the_null_says_nothing():
    at = fitted(("command_saturation",), command_saturation__a_lo=estimate(0.0))
    assert without_bent(NEST, at, [added("command_saturation")])[2] == []
