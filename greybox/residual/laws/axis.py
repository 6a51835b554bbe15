"""Law: what one axis of the unnamed force and torque holds, and the terms that it follows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import NotRequired, TypedDict

from greybox.residual.laws.terms import Shaped


class AxisRow(TypedDict):
    """An axis as in discovery.json; `proposal`: its law in words. Files of earlier versions have no
    `lasts_s`."""

    channel: str
    depends_on: list[str]
    share: float
    rms: float
    unit: str
    proposal: str | None
    gain: float
    lasts_s: NotRequired[float]


def by_text(texts: Iterable[str], values: Iterable[float]) -> dict[str, float]:
    """Text of a term -> its coefficient; of terms that read alike the later ones get a number."""
    out: dict[str, float] = {}
    for text, value in zip(texts, values, strict=True):
        alike = sum(known.partition(" [")[0] == text for known in out)
        out[f"{text} [{alike + 1}]" if alike else text] = value
    return out


@dataclass(frozen=True, kw_only=True, eq=False)
class Axis:
    """One axis: `channel` (force.x, ...), `rms` of its smoothed discrepancy [unit], `gain`: log
    evidence that its state brings, `lasts`: its correlation time [s]. Of its law, if it has one:
    `share` of the variance that `terms` (text -> coefficient, SI) explain on flights that were left
    out, the signals they look at, `codes` as lines of an effect file, and their `shapes`.
    `needed`: whether the flights clearly need the state,
    `lawful`: whether the law explains enough of it."""

    channel: str
    unit: str
    rms: float
    gain: float
    lasts: float
    needed: bool
    share: float = 0.0
    terms: Mapping[str, float] = None  # type: ignore[assignment]
    depends_on: tuple[str, ...] = ()
    codes: tuple[str, ...] = ()
    shapes: tuple[Shaped, ...] = ()
    lawful: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "terms", dict(self.terms or {}))

    def refitted(self, name: str, values: Mapping[str, float]) -> Axis:
        """The law with the numbers `values` of a fit that has it as the effect `name`."""
        texts, shapes = list[str](), list[Shaped]()
        for i, (text, kept) in enumerate(zip(self.terms, self.shapes, strict=True), 1):
            now = None
            if kept is not None:
                numbers = {n: values[f"{name}.{n}_{i}"] for n in kept[0].numbers}
                now = kept[0].moved(numbers), kept[1]
                text = f"{text.rsplit(' (', 1)[0]} ({now[0]})"
            texts.append(text)
            shapes.append(now)
        coefficients = [values[f"{name}.c_{i}"] for i in range(1, len(texts) + 1)]
        return replace(self, terms=by_text(texts, coefficients), shapes=tuple(shapes))

    def to_dict(self) -> AxisRow:
        """As in discovery.json."""
        law = " + ".join(f"{c:.4g} {t}" for t, c in self.terms.items()) if self.lawful else ""
        return {
            "channel": self.channel,
            "depends_on": list(self.depends_on) if law else [],
            "share": self.share,
            "rms": self.rms,
            "unit": self.unit,
            "proposal": f"{self.channel} = {law}" if law else None,
            "gain": self.gain,
            "lasts_s": self.lasts,
        }
