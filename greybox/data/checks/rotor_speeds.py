"""Check of the rotor speeds: beside commands, does each follow the command of its own rotor? In
place of commands, does the vehicle file say what a full one is?

What all rotors do together is taken out, so that only what tells them apart is compared, at the lag
at which speeds follow commands.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from greybox.data.airframe import TopSpeed
from greybox.data.checks.block_sums import BLOCKS, BlockSums
from greybox.data.checks.finding import Check, Finding, Unjudged
from greybox.data.checks.relations import CLEAR, LEAST, LEFT, SEEN, jackknife
from greybox.data.checks.signals import bridged, peak, products, shifted, smoothed
from greybox.data.checks.together import alone_and_together
from greybox.data.checks.view import FloatArray, View
from greybox.data.drive import full_drive

HALF_WINDOW = 0.02
"""Commands and speeds are compared as means over twice this time [s], ..."""
SLOW = 1.0
"""... less those over twice this time: a rotor that is weaker than the others is none of them."""
LAGS = (-0.05, 0.2)
"""Lags from command to speed that are looked for [s]."""
FEWEST = 200
"""Fewer samples judge nothing."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sums(BlockSums):
    """Sums over blocks of time of speeds times commands `xy` (B, n, n), and of the squares of
    speeds `xx` and commands `yy` (B, n)."""

    xy: FloatArray
    xx: FloatArray
    yy: FloatArray
    block_axis: ClassVar[int] = 0

    def left(self, order: Sequence[int]) -> FloatArray:
        """Log of what is left of the speeds (B,) that follow the commands in this order, by one
        gain."""
        own = self.xy[:, np.arange(len(order)), list(order)].sum(axis=1)
        size = self.xx.sum(axis=1) * self.yy.sum(axis=1)
        share = np.maximum(own, 0.0) ** 2 / np.maximum(size, 1e-300)
        return np.log(1.0 - share + LEAST)


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Which speed follows which other command."""

    message: str
    evidence: Mapping[str, float]


def run(views: Sequence[View]) -> Iterator[Finding | Unjudged]:
    """Findings on the scale of rotor speeds that drive the craft, and on the order of those beside
    commands, in each flight and over those of the craft."""
    yield from (_unscaled(v) for v in views if v.drives and not v.commanded and _lacks_scale(v))
    found = {v.name: s for v in views if v.measured and (s := _sums(v)) is not None}
    told = alone_and_together(
        found,
        lambda some: _verdict(Sums.joined(some)),
        claim=lambda said: said.message,
    )
    for one in told:
        for flight in one.flights:
            yield Finding(
                check=CHECK.name,
                severity="blocking",
                flight=flight,
                where="omega1.. against u1..",
                message=one.said.message + one.against,
                evidence={**one.said.evidence, "flights": len(one.flights)},
                fix="reorder the fields of [columns.rotor_speed]; or those of [columns.command], "
                "where the motors are in a wrong order too",
            )


def _lacks_scale(view: View) -> bool:
    actuator = view.vehicle.actuator
    return isinstance(actuator, TopSpeed) and actuator.speed_max is None


def _unscaled(view: View) -> Finding:
    highest = full_drive(view.drive_names, view.vehicle, view.joined(view.drive_names))
    return Finding(
        check=CHECK.name,
        severity="blocking",
        flight=view.name,
        where="omega1..",
        message="rotor speeds drive the craft, and the vehicle file has no actuator.speed_max: "
        "thrust per rotor speed is unknown",
        evidence={"highest_rad_s": highest},
        fix="write speed_max [rad/s] into [actuator], the rotor speed at which the thrust map "
        f"ends, above the {highest:.4g} rad/s seen here; thrust of k N per (rad/s)^2 is "
        "thrust = [0, 0, k speed_max^2]",
    )


def _sums(view: View) -> Sums | None:
    """The sums of a flight; None where too little is known."""
    dt = view.dt
    half, slow = max(1, round(HALF_WINDOW / dt)), max(2, round(SLOW / dt))

    def own(values: FloatArray) -> FloatArray:
        """What is quick and not common to all rotors."""
        values = bridged(values, half)
        quick = smoothed(values, half) - smoothed(values, slow)
        return np.asarray(quick - quick.mean(axis=1, keepdims=True))

    speeds, commands = own(view.group("rotor_speed")), own(view.drive)
    lags = np.arange(round(LAGS[0] / dt), round(LAGS[1] / dt) + 1)
    # In whatever order they are: the size of all correlations.
    size = np.linalg.norm(products(speeds, commands, lags), axis=(1, 2))
    lag = round(peak(size, lags)[0])
    commands = shifted(commands, lag)
    rows = np.flatnonzero(np.isfinite(np.hstack([speeds, commands])).all(axis=1))
    if rows.size < FEWEST:
        return None
    blocks = np.array_split(rows, BLOCKS)
    return Sums(
        xy=np.array([speeds[b].T @ commands[b] for b in blocks]),
        xx=np.array([(speeds[b] ** 2).sum(axis=0) for b in blocks]),
        yy=np.array([(commands[b] ** 2).sum(axis=0) for b in blocks]),
    )


def _verdict(sums: Sums) -> Verdict | None:
    """Which speeds follow other commands than their own; None where that does not tell far more."""
    total, left_out = sums.total, sums.left_out
    size = np.sqrt(np.maximum(np.outer(total.xx[0], total.yy[0]), 1e-300))
    order = np.argmax(total.xy[0] / size, axis=1).tolist()
    given = list(range(len(order)))
    if sorted(order) != given or order == given:
        return None
    other, own = (float(total.left(o)[0]) for o in (order, given))
    error = jackknife(left_out.left(order) - left_out.left(given))
    if other - own + CLEAR * error > math.log(LEFT) or math.exp(other) > 1.0 - SEEN:
        return None
    moved = [f"omega{i + 1} follows u{j + 1}" for i, j in enumerate(order) if i != j]
    return Verdict(
        message=f"the rotor speeds are in another order than the commands: {', '.join(moved)}",
        evidence={
            "explained": 1.0 - math.exp(own),
            "explained_other_order": 1.0 - math.exp(other),
        },
    )


CHECK = Check(
    name="rotor_speeds",
    question="Have rotor speeds a scale, and does each follow the command of its rotor?",
    run=run,
)
