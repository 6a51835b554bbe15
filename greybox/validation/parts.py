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


def in_brackets(parts: Sequence[Part], useful: float) -> str:
    """How many flights and axes deny that the model is useful for `useful` [s], and how far, or are
    too calm to judge, for the first line; "" where none are."""
    against = [p for p in parts if denies(p, useful)]
    refused = [p for p in _of(against, "flight") if p.outcome is Outcome.NOT_USABLE]
    level = [p for p in against if p not in refused and p.worse_from is None]
    said = []
    if refused:
        said.append(f"not usable on {len(refused)} of {_counted(_of(parts, 'flight'))}")
    if level:
        said.append(f"not on {_counted(level)}")
    if less := [p for p in against if p not in refused and p not in level]:
        least = min(less, key=lambda p: p.useful_seconds)
        said.append(f"down to {_seconds(least)} on {_counted(less)}")
    if calm := _calm(parts, useful):
        said.append(f"{_counted(calm)} too calm")
    return f" ({'; '.join(said)})" if said else ""


def reservations(parts: Sequence[Part], useful: float) -> list[str]:
    """What denies that the model is useful for `useful` [s], and what is too calm to judge, by
    name."""
    flights, axes = (
        sorted((p for p in _of(parts, kind) if denies(p, useful)), key=_worst_first)
        for kind in ("flight", "axis")
    )
    calm = _named([p.name for p in _calm(parts, useful)])
    said = [_flights(flights), _axes(axes), f"too calm to judge {calm}" if calm else ""]
    return [s for s in said if s]


def denied(parts: Sequence[Part], useful: float) -> bool:
    """Whether any part denies that the model is useful for `useful` [s]."""
    return any(denies(p, useful) for p in parts)


def useful_on(parts: Iterable[Part]) -> list[Part]:
    """The flights on which a model is useful alone."""
    return [p for p in _of(parts, "flight") if p.outcome is Outcome.USABLE]


def useful_alone(parts: Sequence[Part]) -> list[str]:
    """The flights on which a model is useful that is not usable on all together, in words; nothing
    where there are none."""
    good = sorted(useful_on(parts), key=lambda p: -p.useful_seconds)
    named = _named([f"{p.name} for {_seconds(p)}" for p in good])
    return [f"alone it is useful on {named}"] if good else []


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


def _calm(parts: Sequence[Part], useful: float) -> list[Part]:
    """The flights and axes that move too little to judge."""
    return [p for p in parts if p.outcome is Outcome.TOO_CALM and not denies(p, useful)]


def _counted(parts: Sequence[Part]) -> str:
    """How many flights and axes these are."""
    said = []
    for kind, many in (("flight", "flights"), ("axis", "axes")):
        if n := len(_of(parts, kind)):
            said.append(f"{n} {kind if n == 1 else many}")
    return ", ".join(said)


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
