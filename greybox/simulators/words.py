"""Words: what a simulator says, folds into something else, or loses, effect by effect."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field, replace
from typing import Self

from greybox.model.effect import Effect
from greybox.simulators.change import Change, changed
from greybox.simulators.craft import Craft
from greybox.simulators.learned import has_learned, is_of_motion
from greybox.symbolic import FloatArray

THRUST_MAP, TORQUE_MAP, GRAVITY = "thrust map", "torque map", "gravity"
CENTRE, GYROSCOPIC = "centre of mass", "gyroscopic moment"
LEARNED = "learned and unexplained pushes"
"""What stands in the table beside the effects."""


class Status(enum.Enum):
    """What becomes of an effect. The value is what files hold."""

    SAID = "said"
    FOLDED = "folded"
    LOST = "lost"


@dataclass(frozen=True, kw_only=True)
class Word:
    """One row of the table: `how` says in a few words where the effect went, `change` what that
    makes of our model (nothing where the simulator has the same law)."""

    effect: str
    status: Status
    how: str
    change: Change = field(default_factory=Change)


@dataclass
class Wording:
    """Collects the rows of one target for `craft`. Effects that the model does not have make no
    row. Where an effect `becomes` others, rows after it are of the craft that has these."""

    craft: Craft
    simulator: str
    rows: list[Word] = field(default_factory=list)
    first: tuple[str, ...] = ()
    host: Word | None = None

    def __post_init__(self) -> None:
        self.first = tuple(self.craft.effects)

    def becomes(self, effect: str, how: str, change: Change) -> Self:
        """Other effects take the place of one, by their parameters in `change`."""
        self.host = Word(effect=effect, status=Status.FOLDED, how=how, change=change)
        self.craft = changed(self.craft, [change])
        return self

    def said(self, effect: str, how: str) -> Self:
        """The simulator has the same law."""
        return self._row(effect, Status.SAID, how, Change())

    def folded(self, effect: str, how: str, change: Change) -> Self:
        """The simulator has another law that comes near."""
        return self._row(effect, Status.FOLDED, how, change)

    def lost(self, effect: str, why: str) -> Self:
        """The simulator has nothing for it."""
        return self._row(effect, Status.LOST, why, Change(without=(effect,)))

    def folded_lag_mean(self) -> Self:
        """The row of rotors that rise and fall at different rates, in a simulator with one lag."""
        mean = 1e3 * self.craft.get("motor_lag.tau")
        how = f"one lag of {mean:.3g} ms, the mean of both"
        change = Change(without=("motor_lag_asymmetry",))
        return self.folded("motor_lag_asymmetry", how, change)

    def _row(self, effect: str, status: Status, how: str, change: Change) -> Self:
        if effect in self.craft.effects:
            self.rows.append(Word(effect=effect, status=status, how=how, change=change))
        return self

    def add(self, row: Word) -> Self:
        """A row that is not an effect's."""
        self.rows.append(row)
        return self

    def finish(self) -> tuple[Word, ...]:
        """All rows, in the order of the model's effects; what nobody spoke of is lost."""
        have = {w.effect for w in self.rows}
        for name, effect in self.craft.effects.items():
            if name not in have:
                self.lost(name, _no_term(effect, self.simulator))
        if self.host is not None:
            self.rows = _in_one_row(self.host, self.rows, self.first)
        effects = dict.fromkeys((*self.first, *self.craft.effects))
        order = [THRUST_MAP, TORQUE_MAP, GRAVITY, CENTRE, GYROSCOPIC, *effects, LEARNED]
        if self.craft.pushes and LEARNED not in {w.effect for w in self.rows}:
            self.add(
                Word(
                    effect=LEARNED,
                    status=Status.LOST,
                    how=f"{self.simulator} has no place for them; pushes.py, beside commands.py, "
                    f"and --draws give {_given(self.craft)}",
                )
            )
        return tuple(sorted(self.rows, key=lambda w: order.index(w.effect)))


def _in_one_row(host: Word, rows: list[Word], first: tuple[str, ...]) -> list[Word]:
    """The rows with all that befalls what an effect became in the row of that effect: apart, one
    would undo the other. Effects that the model did not have at `first` make no row."""
    became = {n.split(".")[0] for n in host.change.values}
    change, hows, kept = host.change, [], []
    for w in rows:
        touched = {n.split(".")[0] for n in w.change.values} | set(w.change.without)
        moved = bool(became & touched)
        change = change.then(w.change) if moved else change
        if w.effect in became and w.effect not in first:
            if moved or w.status is Status.SAID:
                hows.append(f"{w.effect}: {w.how}")
        elif moved:
            kept.append(replace(w, how=f"{w.how}, in the row of {host.effect}", change=Change()))
        else:
            kept.append(w)
    how = host.how + (f" ({'; '.join(hows)})" if hows else "")
    return [*kept, replace(host, how=how, change=change)]


def _given(craft: Craft) -> str:
    """What is given of learned and unexplained pushes beside a simulator's files."""
    if not has_learned(craft):
        return "them"
    if is_of_motion(craft):
        return "what is unexplained, rest.py what was learned"
    return "what is unexplained; only NumPy and JAX have what was learned, as it looks at commands"


def _no_term(effect: Effect, simulator: str) -> str:
    if effect.stage == "sensor":
        return f"{simulator} flies the body; it stands in sensors.toml"
    return f"{simulator} has no such term"


def quadratic_maps(wording: Wording, *, thrust: str, torque: str) -> None:
    """Rows of the thrust and torque maps for a simulator that knows c2 Omega^2 only.

    Maps with other powers become the c2 that agrees at hover (thrust), and the ratio that torque
    and thrust have there.
    """
    craft = wording.craft
    nu = craft.hover_nu
    for name, c, key, how in (
        (THRUST_MAP, craft.thrust, "thrust", thrust),
        (TORQUE_MAP, craft.torque, "torque", torque),
    ):
        if not any(c[:2]):
            wording.add(Word(effect=name, status=Status.SAID, how=how))
            continue
        fitted = square_at_hover(c, nu)
        values = {f"{key}.c0": 0.0, f"{key}.c1": 0.0, f"{key}.c2": fitted}
        text = f"{how}; only the square of the speed: equal at hover, nu = {nu:.3f}"
        wording.add(Word(effect=name, status=Status.FOLDED, how=text, change=Change(values=values)))


def square_at_hover(c: FloatArray, nu: float) -> float:
    """The coefficient of nu^2 alone that equals c0 + c1 nu + c2 nu^2 at nu."""
    return float(c[2] + (c[0] + nu * c[1]) / nu**2)


def fixed_gravity(wording: Wording, gravity: float) -> None:
    """A row for a simulator whose gravity [m/s^2] is fixed, where the model's differs."""
    if wording.craft.gravity != gravity:
        how = f"{gravity:g} m/s^2 fixed in {wording.simulator}, {wording.craft.gravity:g} here"
        row = Word(effect=GRAVITY, status=Status.FOLDED, how=how, change=Change(gravity=gravity))
        wording.add(row)


def symmetric_arms(wording: Wording, key: str) -> None:
    """A row for a simulator with arms symmetric about the centre of mass, where they are not."""
    craft = wording.craft
    aside = craft.arms.mean(axis=0)[:2]
    if "center_of_mass_offset" in craft.effects:
        wording.folded("center_of_mass_offset", f"{key}: see {CENTRE}", Change())
    if not aside.any():
        return
    values = {
        f"center_of_mass.{a}": craft.get(f"center_of_mass.{a}") + float(v)
        for a, v in zip("xy", aside, strict=True)
    }
    how = f"{key} are symmetric; it lies {1e3 * aside[0]:.2g}, {1e3 * aside[1]:.2g} mm aside"
    wording.add(Word(effect=CENTRE, status=Status.LOST, how=how, change=Change(values=values)))
