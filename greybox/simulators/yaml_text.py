"""Numbers of YAML files: readers of YAML 1.1 take 2e-07 for a text, and 2.0e-07 for a number."""

from __future__ import annotations

from collections.abc import Iterable


def yaml_number(value: float) -> str:
    """All digits, as a number of every YAML reader."""
    text = repr(float(value))
    mantissa, _, exponent = text.partition("e")
    return f"{mantissa}.0e{exponent}" if exponent and "." not in mantissa else text


def yaml_list(values: Iterable[float]) -> str:
    """[a, b, ...]"""
    return f"[{', '.join(yaml_number(v) for v in values)}]"
