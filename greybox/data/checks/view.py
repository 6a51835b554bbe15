"""View: one flight as the checks see it: the raw rows, and its airborne part on a uniform clock of
at most 250 Hz."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from greybox.data.airframe import Airframe
from greybox.data.channel import command_names, group_names
from greybox.data.clock import Clock, no_flight_log, read_clock
from greybox.data.column_guess import guess_columns
from greybox.data.conditioning import MAX_GAP, condition
from greybox.data.dataset import Flight
from greybox.data.drive import drive_names, full_drive
from greybox.data.impossible import without_impossible
from greybox.data.raw import RawLog
from greybox.data.repeats import without_repeats
from greybox.errors import DataError

FloatArray = npt.NDArray[np.float64]

TOP_RATE = 250.0
"""The signal checks work at this rate [Hz] at most."""

PAD = 1.0
"""Missing samples [s] put between segments, so that no lag or derivative reaches across."""


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """One flight under check. Rows with a bad time are left out of everything but `raw`.

    `asked_again`: it will be judged beside other flights, too, and `found` keeps what it shows by
    itself; else it is forgotten with the question.
    """

    raw: RawLog
    vehicle: Airframe
    asked_again: bool = False
    found: dict[object, object] = field(init=False, default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the flight."""
        return self.raw.flight

    def keep(self, question: object, answer: object) -> None:
        """What it shows by itself, for `found`."""
        if self.asked_again:
            self.found[question] = answer

    @functools.cached_property
    def possible(self) -> RawLog:
        """The log without the repeats of slow streams and the samples that no craft can have made,
        as every command reads it."""
        return without_impossible(self._once, self.vehicle)

    @functools.cached_property
    def _once(self) -> RawLog:
        return without_repeats(self.raw)

    @functools.cached_property
    def increasing(self) -> RawLog:
        """The possible samples without the rows whose time is not later than all times before."""
        return _increasing(self.possible)

    @functools.cached_property
    def as_logged(self) -> RawLog:
        """The same with what slow streams repeat."""
        if self._once is self.raw:  # nothing repeats
            return self.increasing
        return _increasing(without_impossible(self.raw, self.vehicle))

    @functools.cached_property
    def clock(self) -> Clock | None:
        """The clock of the increasing rows; None where fewer than two are left."""
        return read_clock(self.increasing.t, max_gap=MAX_GAP) if self.increasing.n >= 2 else None

    @property
    def rate(self) -> float:
        """Sample rate of the log [Hz] (0 where there is none)."""
        return 1.0 / self.clock.dt if self.clock else 0.0

    @property
    def usable_clock(self) -> bool:
        """Whether the clock is good enough to look at signals over time."""
        return no_flight_log(self.rate) is None

    @functools.cached_property
    def flight(self) -> Flight | None:
        """The airborne part on a uniform clock; None where there is none."""
        if not self.usable_clock:
            return None
        rate = TOP_RATE if self.rate > 1.2 * TOP_RATE else None
        try:
            return condition(self.increasing, self.vehicle, rate=rate)
        except DataError:
            return None

    @functools.cached_property
    def _segments(self) -> FloatArray:
        """(S, 2): first and last time [s] of the airborne segments."""
        ends = [(s.t[0], s.t[-1]) for s in self.flight.segments] if self.flight else []
        return np.array(ends, dtype=np.float64).reshape(-1, 2)

    def in_flight(self, t: float) -> bool:
        """Whether the log time `t` [s] lies in the airborne part."""
        k = int(np.searchsorted(self._segments[:, 0], t, side="right")) - 1
        return k >= 0 and bool(t <= self._segments[k, 1])

    @property
    def dt(self) -> float:
        """Sample time of `joined` [s]."""
        return self.flight.dt if self.flight else float("nan")

    def has(self, *groups: str) -> bool:
        """Whether every channel of these groups is in the log."""
        names = [n for g in groups for n in group_names(g, len(self.vehicle.rotors))]
        return self.flight is not None and all(n in self.flight.channels for n in names)

    def lacks(self, group: str, word: str) -> str:
        """That a group is missing, in words, and which columns nobody was told of look like it."""
        extra = self.raw.extra.items()
        numbers = {n: c.astype(np.float64) for n, c in extra if c.dtype.kind == "f"}
        like = next((g for g in guess_columns(numbers) if g.group == group), None)
        if like is None:
            return f"no {word}"
        return (
            f"no {word}, but {', '.join(like.fields)} look like one: say so in [columns.{group}] "
            "(greybox inspect --draft)"
        )

    @property
    def commanded(self) -> bool:
        """Whether commands drive the rotors; else measured rotor speeds stand in their place."""
        return self.flight is None or bool(command_names(self.drive_names))

    @property
    def drive_names(self) -> tuple[str, ...]:
        """The channels that drive the rotors, in their order."""
        return drive_names(self.flight.channels if self.flight else (), len(self.vehicle.rotors))

    @property
    def drives(self) -> bool:
        """Whether the log has what drives every rotor."""
        return len(self.drive_names) == len(self.vehicle.rotors)

    @functools.cached_property
    def measured(self) -> View | None:
        """The flight as the rotor speeds drive it that the log has beside its commands; None where
        it has not both."""
        if not (self.commanded and self.drives and self.has("rotor_speed")):
            return None
        others = {n: v for n, v in self.raw.channels.items() if n not in self.drive_names}
        return replace(self, raw=replace(self.raw, channels=others))

    @functools.cached_property
    def drive(self) -> FloatArray:
        """The airborne commands, or rotor speeds as shares of the highest, (N, n), see `joined`."""
        values = self.joined(self.drive_names)
        return values / full_drive(self.drive_names, self.vehicle, values)

    def group(self, group: str) -> FloatArray:
        """The airborne samples of a group, (N, k), see `joined`."""
        return self.joined(group_names(group, len(self.vehicle.rotors)))

    @property
    def time(self) -> FloatArray:
        """Log time of the rows of `joined` (N,) [s], NaN between segments."""
        return self._stack([s.t[:, None] for s in self.flight.segments] if self.flight else [])[
            :, 0
        ]

    def joined(self, names: Sequence[str]) -> FloatArray:
        """The airborne samples (N, len(names)) of all segments, with stretches of NaN between
        them."""
        return self._stack([s.matrix(names) for s in self.flight.segments] if self.flight else [])

    def _stack(self, parts: Sequence[FloatArray]) -> FloatArray:
        if not parts:
            raise DataError("no airborne samples", where=f"flight {self.name}")
        pad = np.full((int(np.ceil(PAD / self.dt)), parts[0].shape[1]), np.nan)
        out = [parts[0]]
        for part in parts[1:]:
            out += [pad, part]
        return np.vstack(out)


def _increasing(raw: RawLog) -> RawLog:
    """The rows whose time is later than all times before."""
    t = raw.t
    good = np.concatenate([[True], t[1:] > np.maximum.accumulate(t)[:-1]])
    return replace(
        raw,
        t=t[good],
        channels={k: v[good] for k, v in raw.channels.items()},
        extra={},
        rows=raw.rows[good],
    )
