"""Written laws: the model refitted with the laws of its leftover as effects, and what that leaves looked at again.

The first look at the leftover sees the largest law of every axis through all the others, at the nearest times of a grid.
Once it is written and fitted, what it hid stands out; terms of a second look join those of the first where BIC prefers it.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

from greybox.data import Dataset
from greybox.discovery.leftover import STRONG, TERMS, Leftover, Promoted, promote
from greybox.discovery.proposal import effect_name, proposed
from greybox.discovery.sensor_noise import plain_model
from greybox.discovery.terms import Memory
from greybox.estimation.fit import Fit, fit, noise_of
from greybox.model.identified import IdentifiedModel
from greybox.statistics.evidence import CLEAR

LOOKS = 2
"""How often the leftover of written laws is looked at again, at most."""


def with_proposals(found: Fit, leftover: Promoted, train: Dataset, known: Fit | None = None) -> Fit | None:
    """`found` refitted with the laws of the leftover as effects, from the estimates of `known` where it has them; None where
    there is no law or the refit fails."""
    effects = proposed(leftover.laws, found.model.effects)
    if not effects:
        return None
    model: Any = found.model.dynamics
    model = model.with_effect(*effects)
    own = [d.name for d in model.parameters if d.name.split(".")[0] in {e.name for e in effects}]
    per_flight = [n for n in found.settings["per_flight"] if n in found.parameters]
    # A time constant is felt only where its coefficient is not zero.
    start = {
        f"{e.name}.c_{i}": c for e, law in zip(effects, leftover.laws, strict=True) if any(law.memories)
        for i, c in enumerate(law.terms.values(), 1)
    }  # fmt: skip
    if known is not None:
        there = {d.name for d in model.parameters}
        start |= {n: float(v) for n, v in known.model.values.items() if n in there}
    result = fit(
        model, train, free=[*found.parameters, *own], values=dict(found.model.values) | start,
        noise=noise_of((known or found).model), per_flight=per_flight, estimate_noise=found.settings["estimate_noise"],
        initialisation="nominal",
    )  # fmt: skip
    return result if result.status.converged else None


@dataclass(frozen=True, kw_only=True, eq=False)
class Looked:
    """`first`: what was left before; `leftover`: the same with the laws that a second look adds to, in the numbers of
    `written`, the fit with them (None as `with_proposals`)."""

    first: Promoted
    leftover: Promoted
    written: Fit | None


def looked_again(found: Fit, leftover: Promoted, train: Dataset, *, seed: int = 0) -> Looked:
    """The laws of a `leftover` of the fit `found`, written, and what that leaves looked at again."""
    first, best = leftover, with_proposals(found, leftover, train)
    for _ in range(LOOKS):
        if best is None:
            break
        left = promote(best, train, seed=seed)
        if left.gain < STRONG or not left.laws:
            break
        more = replace(leftover, axes=tuple(joined(a, left.laws) for a in leftover.axes))
        longer = with_proposals(found, more, train, best)
        if longer is None or longer.bic > best.bic - CLEAR:
            break
        leftover, best = more, longer
    if best is not None:
        leftover = replace(leftover, axes=tuple(fitted(a, best, found.model.effects) for a in leftover.axes))
    return Looked(first=first, leftover=leftover, written=best)


def lawful_model(written: Fit, leftover: Promoted, taken: Collection[str], train: Dataset) -> IdentifiedModel:
    """The model of `written`, the fit with the laws of the `leftover` next to the effects `taken`, its sensors white and its
    laws read from the files that hold its numbers: a model file goes with the files beside it."""
    plain = plain_model(written, train)
    physics: Any = plain.dynamics
    own = [n for n in written.model.effects if n not in taken]
    return replace(plain, dynamics=physics.without_effect(*own).with_effect(*proposed(leftover.laws, taken)))


def fitted(law: Leftover, written: Fit, taken: Collection[str] = ()) -> Leftover:
    """The law of one axis with the numbers of the fit `written` that has it as an effect; unchanged where it has not."""
    name = effect_name(law.channel, taken)
    own = {n.split(".")[1]: e.value for n, e in written.parameters.items() if n.split(".")[0] == name}
    if not own:
        return law
    terms, memories = dict[str, float](), list[tuple[Memory, float] | None]()
    for i, (text, kept) in enumerate(zip(law.terms, law.memories, strict=True), 1):
        now = None
        if kept is not None:
            memory = Memory(time=own[f"time_{i}"], damping=own.get(f"damping_{i}"))
            text, now = f"{text.rsplit(' (', 1)[0]} ({memory})", (memory, kept[1])
        terms[text] = own[f"c_{i}"]
        memories.append(now)
    return replace(law, terms=terms, memories=tuple(memories))


def joined(law: Leftover, others: Sequence[Leftover]) -> Leftover:
    """The law of one axis, if it has one, with the terms of another look that are not there yet: a lag of a signal whose lag
    is known is the same with another time. The second share is of what the first law left."""
    for other in others:
        if other.channel != law.channel:
            continue
        first = law if law.lawful else replace(law, terms={}, codes=(), memories=(), depends_on=(), share=0.0)
        rows = list(zip(first.terms.items(), first.codes, first.memories, strict=True))
        known = {(code, m and m[0].kind) for _, code, m in rows}
        rows += [
            row for row in zip(other.terms.items(), other.codes, other.memories, strict=True)
            if (row[1], row[2] and row[2][0].kind) not in known
        ][: max(TERMS - len(rows), 0)]  # fmt: skip
        return replace(
            law, terms=dict(r[0] for r in rows), codes=tuple(r[1] for r in rows), memories=tuple(r[2] for r in rows),
            share=first.share + (1 - first.share) * other.share,
            depends_on=tuple(dict.fromkeys((*first.depends_on, *other.depends_on))),
        )  # fmt: skip
    return law
