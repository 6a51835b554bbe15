"""Statement: what a simulator says, folds and loses, with sizes, as a table and as plain values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from greybox.files import Json
from greybox.simulators.change import Change, changed
from greybox.simulators.craft import Craft
from greybox.simulators.learned import has_learned
from greybox.simulators.size import Size, size_of
from greybox.simulators.target import Target
from greybox.simulators.words import LEARNED, Status, Word
from greybox.symbolic import FloatArray


@dataclass(frozen=True, kw_only=True)
class Row:
    """A word, and how large what it leaves out is; `size` None where nothing is left out, or where
    it is no matter of motion (then `value` has the numbers)."""

    word: Word
    size: Size | None
    value: str = ""

    @property
    def text(self) -> str:
        """One line."""
        what = self.value or ("" if self.size is None else self.size.text)
        tail = f": {what}" if what else ""
        return f"{self.word.effect:24} {self.word.status.value:7} {self.word.how}{tail}"

    def to_dict(self) -> dict[str, Json]:
        """Plain values."""
        return {
            "effect": self.word.effect,
            "status": self.word.status.value,
            "how": self.word.how,
            "size": None if self.size is None else self.size.to_dict(),
            "text": self.value or ("" if self.size is None else self.size.text),
        }


@dataclass(frozen=True, kw_only=True)
class Statement:
    """One target's rows, and the craft that its simulator flies (`spoken`). `whole`: what all that
    is folded or lost does together, None where nothing is."""

    target: str
    simulator: str
    rows: tuple[Row, ...]
    spoken: Craft
    whole: Size | None

    @property
    def text(self) -> str:
        """The table for people."""
        lines = [f"{self.simulator}: {self.headline}"]
        return "\n".join([*lines, *(f"  {row.text}" for row in self.rows)])

    @property
    def headline(self) -> str:
        """One sentence on the whole."""
        if self.whole is None:
            return "says everything that moves this model"
        counts = [
            f"{len(found)} {status.value}"
            for status in Status
            if (found := [r for r in self.rows if r.word.status is status])
        ]
        return f"{', '.join(counts)}; together {self.whole.text}"

    def to_dict(self) -> dict[str, Json]:
        """Plain values."""
        return {
            "target": self.target,
            "simulator": self.simulator,
            "rows": [r.to_dict() for r in self.rows],
            "together": None if self.whole is None else self.whole.to_dict(),
        }


def state(target: Target, craft: Craft) -> Statement:
    """What `target` makes of `craft`. Raises `ModelError` for a rotor layout that it cannot
    express."""
    words = target.words(craft)
    changes = [w.change for w in words]
    spoken = changed(craft, changes)
    moving = [c for c in changes if c and not _of_sensors(craft, c)]
    unlearned = any(_loses_what_was_learned(craft, w) for w in words)
    return Statement(
        target=target.name,
        simulator=target.simulator,
        rows=tuple(_row(craft, w) for w in words),
        spoken=spoken,
        whole=size_of(craft, _together(moving), unlearned=unlearned)
        if moving or unlearned
        else None,
    )


def _of_sensors(craft: Craft, change: Change) -> bool:
    return bool(change.without) and all(
        craft.effects[n].stage == "sensor" for n in change.without if n in craft.effects
    )


def _together(changes: list[Change]) -> Change:
    values: dict[str, float] = {}
    for c in changes:
        values.update(c.values)
    gravity = [c.gravity for c in changes if c.gravity is not None]
    return Change(
        values=values,
        without=tuple(n for c in changes for n in c.without),
        instead=tuple(e for c in changes for e in c.instead),
        gravity=gravity[-1] if gravity else None,
    )


def _loses_what_was_learned(craft: Craft, word: Word) -> bool:
    lost = word.effect == LEARNED and word.status is Status.LOST
    return lost and has_learned(craft)


def _row(craft: Craft, word: Word) -> Row:
    if word.effect == LEARNED:
        if not _loses_what_was_learned(craft, word):
            return Row(word=word, size=None, value=craft.pushes)
        size = size_of(craft, Change(), unlearned=True)
        return Row(word=word, size=size, value=f"{craft.pushes} of {size.text}")
    effect = craft.effects.get(word.effect)
    if effect is not None and effect.stage == "sensor":
        return Row(word=word, size=None, value=_numbers(craft, word.effect))
    return Row(word=word, size=size_of(craft, word.change) if word.change else None)


def _numbers(craft: Craft, effect: str) -> str:
    rows = craft.effects[effect].parameters(craft.physics.vehicle)
    return ", ".join(f"{d.name} {craft.values[f'{effect}.{d.name}']:.3g} {d.unit}" for d in rows)


def agreement(ours: FloatArray, theirs: FloatArray) -> dict[str, float]:
    """How far another simulator's flight is from ours, as shares of how far the craft moved.

    `ours`, `theirs`: states (13, steps) in the order position, velocity, attitude (w, x, y, z),
    rate. Each share is the largest distance over the steps, by the largest change since the first.
    """
    out = {}
    blocks = {"position": slice(0, 3), "velocity": slice(3, 6), "rate": slice(10, 13)}
    for name, rows in blocks.items():
        moved = np.linalg.norm(ours[rows] - ours[rows, :1], axis=0).max()
        apart = np.linalg.norm(ours[rows] - theirs[rows], axis=0).max()
        out[name] = float(apart / moved)

    def angle(a: FloatArray, b: FloatArray) -> FloatArray:
        product = np.abs(np.sum(a * b, axis=0))
        return np.asarray(2.0 * np.arccos(np.minimum(1.0, product)))

    q, r = ours[6:10], theirs[6:10]
    out["attitude"] = float(angle(q, r).max() / angle(q, q[:, :1]).max())
    return out
