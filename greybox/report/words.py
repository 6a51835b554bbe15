"""Numbers and findings as text: estimates with the digits that their spread leaves, p-values,
statements in words."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from greybox.validation.cross_correlation import CrossDocument
    from greybox.validation.whiteness import WhitenessDocument

MINUS = "\N{MINUS SIGN}"
_EXPONENT = re.compile(r"e([+-])0*(\d+)")


def _minus(text: str) -> str:
    """True minus signs, and exponents without leading zeros."""
    return _EXPONENT.sub(lambda m: f"e{m.group(1).replace('+', '')}{m.group(2)}", text).replace(
        "-", MINUS
    )


def number(value: float | None, digits: int = 4) -> str:
    """A number with `digits` significant digits; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return "\N{EN DASH}"
    return _minus(f"{value:.{digits}g}")


def rounded(
    value: float | None, std: float | None, *, like: float | None = None
) -> tuple[str, str]:
    """(value, std) as text, both to the second significant digit of the standard deviation.

    A spread that is missing or zero leaves five significant digits and a dash. Numbers below 0.001
    have an exponent; `like` is the number that decides so (default: the larger of the two).
    """
    if value is None or not math.isfinite(value):
        return "\N{EN DASH}", "\N{EN DASH}"
    if std is None or not math.isfinite(std) or std <= 0:
        return number(value, 5), "\N{EN DASH}"
    place = math.floor(math.log10(std)) - 1
    largest = max(abs(value), std) if like is None else like
    if place >= -6 and 1e-3 <= largest < 1e6:
        digits = max(0, -place)
        return _minus(f"{round(value, -place):.{digits}f}"), f"{round(std, -place):.{digits}f}"
    size = math.floor(math.log10(max(abs(value), std)))
    return _minus(f"{value:.{max(1, size - place)}e}"), _minus(f"{std:.1e}")


def interval(value: float | None, std: float | None) -> str:
    """The 95 % interval value -+ 1.96 std as text."""
    if (
        value is None
        or std is None
        or not math.isfinite(value)
        or not math.isfinite(std)
        or std <= 0
    ):
        return "\N{EN DASH}"
    like = max(abs(value), std)
    low, high = (rounded(value + side * std, std, like=like)[0] for side in (-1.96, 1.96))
    return f"{low} .. {high}"


def p_value(p: float | None) -> str:
    """A probability as text; very small ones only as a bound."""
    if p is None or not math.isfinite(p):
        return "\N{EN DASH}"
    return "< 0.0001" if p < 1e-4 else f"{p:.2g}" if p < 0.01 else f"{p:.2f}"


def strong_correlations(
    names: Sequence[str], matrix: Sequence[Sequence[float | None]], limit: float = 0.9
) -> list[str]:
    """Statements about pairs of parameters that the data can hardly tell apart, strongest first."""
    found = []
    for i, first in enumerate(names):
        for j in range(i):
            r = matrix[i][j]
            if r is not None and math.isfinite(r) and abs(r) >= limit:
                found.append((abs(r), names[j], first, r))
    lines = []
    for _, a, b, r in sorted(found, key=lambda f: (-f[0], f[1], f[2])):
        sense = (
            "the data fix their difference better than either"
            if r > 0
            else "the data fix their sum better than either"
        )
        lines.append(
            f"{a} and {b} are correlated by {number(r, 3)}: in units of their spread, {sense}."
        )
    return lines


def whiteness_verdict(whiteness: WhitenessDocument) -> str:
    """What the whiteness test says, in words with an effect size."""
    channels = whiteness["channels"]
    limit = 0.01 / max(1, len(channels))
    bad = {n: c for n, c in channels.items() if c["p_value"] < limit}
    if not bad:
        return (
            "No innovation channel differs from white noise: the model leaves nothing that its "
            "own past could predict."
        )
    worst = max(bad, key=lambda n: bad[n]["predictable"])
    share = bad[worst]["predictable"]
    text = (
        f"{len(bad)} of {len(channels)} innovation channels {'is' if len(bad) == 1 else 'are'} not "
        f"white ({', '.join(bad)}). Largest: {worst}, of whose variance {100 * share:.0f} % could "
        "be predicted from its own past."
    )
    if share < 0.05:
        return text + " That is small: long records make the test sensitive."
    return (
        text + " Standard errors that assume white innovations are too small; something is still "
        "missing."
    )


def cross_verdict(cross: CrossDocument) -> str:
    """What the test of innovations against inputs says, in words."""
    pairs = cross["pairs"]
    limit = 0.01 / max(1, len(pairs))
    bad = sorted((p for p in pairs if p["p_value"] < limit), key=lambda p: p["p_value"])
    if not bad:
        return "Past inputs explain no innovation: the path from input to output is captured."
    first = ", ".join(f"{p['innovation']} after {p['input']}" for p in bad[:5])
    rest = f" and {len(bad) - 5} more" if len(bad) > 5 else ""
    return (
        f"Past inputs still explain innovations in {len(bad)} of {len(pairs)} pairs: {first}{rest}."
    )
