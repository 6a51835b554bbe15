"""Parts: what a verdict on all flights together hides, in words.

Errors that are pooled are those of the fast flights and of the axes that move most. Every flight
and every axis is therefore judged alone as well (`greybox.validation.usefulness`), and what denies
the verdict on all of them is said with it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from greybox.model.verdict import Outcome, Part, Verdict

NAMED = 2
"""So many parts of a kind are named in the first line; the others are counted."""


def denies(part: Part, useful: float) -> bool:
    """Whether a part alone is not usable, or not as far ahead as `useful` [s]."""
    early = part.worse_from is not None and part.worse_from <= useful + 1e-9
    return part.outcome is Outcome.NOT_USABLE or early


def reservations(parts: Sequence[Part], useful: float) -> str:
    """In brackets what denies that the model is useful for `useful` [s], and what is too calm to
    judge; "" where nothing is."""
    flights, axes = (
        sorted((p for p in _of(parts, kind) if denies(p, useful)), key=_worst_first)
        for kind in ("flight", "axis")
    )
    said = [_flights(flights), _axes(axes), _calm(parts, useful)]
    text = "; ".join(s for s in said if s)
    return f" ({text})" if text else ""


def denied(parts: Sequence[Part], useful: float) -> bool:
    """Whether any part denies that the model is useful for `useful` [s]."""
    return any(denies(p, useful) for p in parts)


def useful_alone(parts: Sequence[Part]) -> str:
    """A sentence of the flights on which a model is useful that is not usable on all together; ""
    where there is none."""
    good = sorted(
        (p for p in _of(parts, "flight") if p.outcome is Outcome.USABLE),
        key=lambda p: -p.useful_seconds,
    )
    if not good:
        return ""
    return f". Alone it is useful on {_named([f'{p.name} for {_seconds(p)}' for p in good])}"


def in_sentences(verdict: Verdict) -> list[str]:
    """One line of all flights and one of all axes that deny a verdict, with what ends their use."""
    lines = []
    for kind, title in (("flight", "flights alone"), ("axis", "axes alone")):
        bad = [p for p in _of(verdict.parts, kind) if denies(p, verdict.useful_seconds)]
        if bad and not verdict.refused:
            each = "; ".join(_sentence(p) for p in sorted(bad, key=_worst_first))
            lines.append(f"{title}: {each}")
    return lines


def _of(parts: Iterable[Part], kind: str) -> list[Part]:
    return [p for p in parts if p.kind == kind]


def _worst_first(part: Part) -> tuple[bool, float]:
    return part.outcome is not Outcome.NOT_USABLE, part.useful_seconds


def _seconds(part: Part) -> str:
    return f"{part.useful_seconds:.2g} s"


def _flights(bad: Sequence[Part]) -> str:
    """The flights that deny, the worst first."""
    refused = [p for p in bad if p.outcome is Outcome.NOT_USABLE]
    short = [p for p in bad if p not in refused]
    said = [f"not usable on {_named([p.name for p in refused])}"] if refused else []
    said += [f"only {_seconds(p)} on {p.name}" for p in short[:NAMED]]
    left = short[NAMED:]
    if left:
        said.append(f"{_seconds(left[0])} or more on {len(left)} more")
    return ", ".join(said)


def _axes(bad: Sequence[Part]) -> str:
    """The axes that deny, the worst first."""
    return _named(
        [
            f"{p.name} no better than the last value"
            if p.worse_from is None
            else f"{p.name} worse from {p.worse_from:.2g} s"
            for p in bad
        ]
    )


def _calm(parts: Sequence[Part], useful: float) -> str:
    """The flights and axes that move too little to judge."""
    calm = [p.name for p in parts if p.outcome is Outcome.TOO_CALM and not denies(p, useful)]
    return f"too calm to judge {_named(calm)}" if calm else ""


def _named(all_: Sequence[str]) -> str:
    """The first of them by name, and how many more there are."""
    more = len(all_) - NAMED
    named = [*all_[:NAMED], *([f"{more} more"] if more > 0 else [])]
    return " and ".join([", ".join(named[:-1]), named[-1]] if len(named) > 1 else named)


def _sentence(part: Part) -> str:
    """Name, how far, and what ends it."""
    ends = " and ".join(g.replace("_", " ") for g in part.groups if g != part.name)
    if part.worse_from is None:
        return f"{part.name} {ends} no better than the last value".replace("  ", " ")
    refused = "not usable, " if part.outcome is Outcome.NOT_USABLE else ""
    return f"{part.name} {refused}{ends} worse from {part.worse_from:.2g} s".replace("  ", " ")
