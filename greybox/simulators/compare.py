"""Compare: what has changed between two identifications of a craft, and what it does to a flight.

Every change is one of our own model, so that it is computed and flown like what a simulator loses.
A change counts where it is beyond what both fits together leave open (two standard errors of the
difference, each flight's own spread included).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from greybox.errors import ModelError
from greybox.files import Json
from greybox.model.identified import IdentifiedModel
from greybox.simulators.change import Change
from greybox.simulators.craft import Craft
from greybox.simulators.size import Size, size_of

SCHEMA = "greybox.twin_comparison/1"
CLEAR = 2.0
"""Standard errors of the difference from which on a change is more than the fits leave open."""


@dataclass(frozen=True, kw_only=True)
class Changed:
    """One parameter: its values, the standard error of their difference (None where neither fit
    states one), and what the change does."""

    name: str
    unit: str
    old: float
    new: float
    error: float | None
    size: Size

    @property
    def clear(self) -> bool:
        """Whether the change is more than the fits leave open."""
        return self.error is None or abs(self.new - self.old) > CLEAR * self.error

    @property
    def text(self) -> str:
        """One line."""
        share = f" ({100 * (self.new / self.old - 1):+.1f} %)" if self.old else ""
        sure = "" if self.error is None else f", {abs(self.new - self.old) / self.error:.1f} sigma"
        doubt = "" if self.clear else " within what the fits leave open"
        return (
            f"{self.name:28} {self.old:.4g} -> {self.new:.4g} {self.unit}{share}{sure}{doubt}: "
            f"{self.size.text}"
        )


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """`changes` of parameters, largest first; `added` and `gone` effects; `whole`: all together;
    `weight` is the mean force of the whole change [N] and as a share of the weight."""

    old: str
    new: str
    changes: tuple[Changed, ...]
    added: tuple[str, ...]
    gone: tuple[str, ...]
    whole: Size
    force: float
    share: float

    def summary(self) -> str:
        """For people."""
        clear = [c for c in self.changes if c.clear]
        head = (
            f"{len(clear)} of {len(self.changes)} changes are more than the fits leave open"
            if self.changes
            else "no parameter has changed"
        )
        lines = [
            f"{self.old} -> {self.new}: {head}",
            f"together {self.force:.3g} N ({100 * self.share:.2g} % of the weight): "
            f"{self.whole.text}",
        ]
        lines += [f"  + {n}" for n in self.added] + [f"  - {n}" for n in self.gone]
        return "\n".join([*lines, *(f"  {c.text}" for c in self.changes)])

    def to_dict(self) -> dict[str, Json]:
        """Plain values (schema "greybox.twin_comparison/1")."""
        return {
            "schema": SCHEMA,
            "old": self.old,
            "new": self.new,
            "added": list(self.added),
            "gone": list(self.gone),
            "force": self.force,
            "share_of_weight": self.share,
            "together": self.whole.to_dict(),
            "changes": [
                {
                    "name": c.name,
                    "unit": c.unit,
                    "old": c.old,
                    "new": c.new,
                    "standard_error": c.error,
                    "clear": c.clear,
                    "size": c.size.to_dict(),
                    "text": c.size.text,
                }
                for c in self.changes
            ],
        }


def compare(old: IdentifiedModel, new: IdentifiedModel) -> Comparison:
    """Raises `ModelError` for models of craft with different rotors, or of another kind."""
    a, b = Craft.of(old), Craft.of(new)
    if a.count != b.count:
        raise ModelError(
            "the models are of different craft",
            expected=f"{a.count} rotors",
            got=f"{b.count} rotors",
        )
    units = {d.name: d.unit for d in (*b.physics.parameters, *a.physics.parameters)}
    gone = tuple(n for n in a.effects if n not in b.effects)
    added = tuple(n for n in b.effects if n not in a.effects)
    # Effects of the new craft that the old one lacks come in switched off.
    missing = tuple(e for n, e in b.effects.items() if n in added)
    there = {e.name for e in a.physics.effects}
    bring = Change(instead=tuple(e for e in missing if e.name not in there))
    base = _with(a, bring)
    changes = []
    for name, value in {**base.values}.items():
        after = b.values.get(name)
        if after is None:
            after = _null(base, name)
        if after is None or after == value:
            continue
        changes.append(
            Changed(
                name=name,
                unit=units.get(name, ""),
                old=value,
                new=float(after),
                error=_error(old, new, name),
                size=size_of(base, Change(values={name: float(after)})),
            )
        )
    changes.sort(key=lambda c: (-c.size.force - c.size.turning, -c.size.position, c.name))
    everything = Change(values={c.name: c.new for c in changes})
    whole = size_of(base, everything)
    force = whole.force * a.mass
    return Comparison(
        old=old.name,
        new=new.name,
        changes=tuple(changes),
        added=added,
        gone=gone,
        whole=whole,
        force=force,
        share=force / (a.mass * a.gravity),
    )


def _with(craft: Craft, change: Change) -> Craft:
    """The craft with further effects at the values that switch them off."""
    from greybox.simulators.change import changed

    if not change:
        return craft
    nulls = {
        f"{e.name}.{d.name}": float(d.null if d.null is not None else d.nominal)
        for e in change.instead
        for d in e.parameters(craft.physics.vehicle)
    }
    return changed(craft, [Change(instead=change.instead, values=nulls)])


def _null(craft: Craft, name: str) -> float | None:
    """The value that switches a parameter of an effect off; None of a core parameter."""
    for d in craft.physics.parameters:
        if d.name == name and "." in name and d.null is not None:
            return float(d.null)
    return None


def _error(old: IdentifiedModel, new: IdentifiedModel, name: str) -> float | None:
    """Standard error of the difference."""
    total, known = 0.0, False
    for model in (old, new):
        if name in model.covariance_names:
            total += model.standard_errors[name] ** 2
            known = True
        if name in model.flight_spread and math.isfinite(model.flight_spread[name][1]):
            flights = max(1, len(model.per_flight))
            total += model.flight_spread[name][1] ** 2 / flights
            known = True
    return math.sqrt(total) if known and total > 0 else None
