"""Check of the motors: order of the commands, spin directions, and the size of the torques.

The torques found by regression are compared with those that position and spin of the vehicle file
promise, in each flight and over those of a craft together. Another order is said only where it
explains far more of them.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from greybox.data.channel import command_names
from greybox.data.checks.finding import Check, Finding, Severity, Unjudged
from greybox.data.checks.rates import shown_by
from greybox.data.checks.relations import CLEAR, LEAST, LEFT, jackknife
from greybox.data.checks.strength import strength_of
from greybox.data.checks.together import alone_and_together
from greybox.data.checks.torque import (
    LEAST as INSTANTS,
)
from greybox.data.checks.torque import (
    Sums,
    Torque,
    directions,
    expected_signs,
    torque_regression,
)
from greybox.data.checks.view import FloatArray, View

AGREE = 0.25
"""Share of what the commands explain from which torques in the promised directions agree with
them."""

MOST_ROTORS = 6
"""Orders are searched up to this many rotors."""

AXES = ("roll", "pitch", "yaw")

SPINS = "spin of the rotors"
PARTS = {
    SPINS: "spins",
    "numbers of the vehicle file": "strength",
    "commands and vehicle file": "strength",
}
"""Where a finding is -> the part of the check that it answers; "" of all others."""

One = TypeVar("One")


@dataclass(frozen=True, kw_only=True, eq=False)
class Verdict:
    """What the torques say, the same for all flights that were judged together; `claim` is the
    same where they say the same."""

    claim: str
    severity: Severity
    where: str
    message: str
    evidence: Mapping[str, float]
    fix: str


def run(views: Sequence[View]) -> Iterator[Finding | Unjudged]:
    """Findings on motor order and spin, in each flight and over those of the craft together: the
    best excited weigh most."""
    found: dict[str, Torque] = {}
    for view in views:
        torque = torque_regression(view) if shown_by(view) and view.drives else None
        if torque is None:
            open_ = view.flight is not None and view.drives
            yield Unjudged(check="motors", flight=view.name, reason=_lacking(view), open=open_)
        elif not torque.seen[:2].all():
            reason = "the commands explain too little of the angular acceleration (share "
            reason += ", ".join(f"{s:.3f}" for s in torque.share) + ")"
            yield Unjudged(check="motors", flight=view.name, reason=reason, open=True)
        else:
            found[view.name] = torque
    if not found:
        return
    first = next(v for v in views if v.name in found)
    promised, names = expected_signs(first), first.drive_names
    said = _told(found, lambda some: _order(_joined(some), promised, names))
    yield from said
    left = {n: t for n, t in found.items() if n not in {f.flight for f in said}}
    if np.any(promised[2]):
        turning = {n: t for n, t in left.items() if t.seen[2]}
        said = _told(turning, lambda some: _spins(some, promised))
        yield from said
        judged = {f.flight for f in said}
        judged |= {n for n, t in turning.items() if _agrees(t.sums, promised)}
        reason = "too little yaw motion to see the spins"
        yield from (
            Unjudged(check="motors", flight=n, reason=reason, part="spins", open=True)
            for n in left
            if n not in judged
        )
    yield from _strong({v.name: (v, left[v.name]) for v in views if v.name in left}, promised)


def _lacking(view: View) -> str:
    """Why the torques of a flight cannot be seen."""
    if view.flight is None:
        return "no airborne stretch"
    shown = shown_by(view)
    if not shown:
        return view.lacks("rate", "gyro")
    if not view.drives:
        return "neither all commands nor all rotor speeds"
    rates = "gyro" if shown == "rate" else "rates by the attitude"
    driven = "commands" if view.commanded else "rotor speeds"
    return (
        f"fewer than {INSTANTS} instants with {rates}, {driven} and specific force all around them: "
        "too short, or too much is missing"
    )


def _strong(
    flights: Mapping[str, tuple[View, Torque]], promised: FloatArray
) -> Iterator[Finding | Unjudged]:
    """Findings on the size of the torques, and the flights that do not show it."""

    def judged(some: Sequence[tuple[View, Torque]]) -> Verdict | None:
        views, torques = zip(*some, strict=True)
        strength = strength_of(views[0].vehicle, _joined(torques), promised)
        wrong = None if strength is None else strength.wrong(views)
        return None if wrong is None else Verdict(severity="blocking", **wrong)

    yield from _told(flights, judged)
    for name, (view, torque) in flights.items():
        strength = strength_of(view.vehicle, torque.sums, promised)
        if strength is not None and not strength.told:
            reason = "the flight does not tell how strongly the commands turn it"
            yield Unjudged(check="motors", flight=name, reason=reason, part="strength", open=True)


def _joined(torques: Sequence[Torque]) -> Sums:
    return Sums.joined([t.sums for t in torques])


def _told(
    flights: Mapping[str, One], judge: Callable[[Sequence[One]], Verdict | None]
) -> list[Finding]:
    """The findings of one question, flights that disagree named."""
    told = alone_and_together(
        flights,
        judge,
        claim=lambda said: said.claim,
        sure=lambda said: said.severity == "blocking",
    )
    return [
        Finding(
            check="motors",
            severity=one.said.severity,
            flight=flight,
            where=one.said.where,
            message=one.said.message + one.against,
            evidence={**one.said.evidence, "flights": len(one.flights)},
            fix=one.said.fix,
        )
        for one in told
        for flight in one.flights
    ]


def _turned(promised: FloatArray, angle: float) -> FloatArray:
    """The directions (3, n) of a layout that is turned by an angle [rad] about z."""
    roll, pitch, yaw = promised
    c, s = np.cos(angle), np.sin(angle)
    return directions(np.stack([c * roll - s * pitch, c * pitch + s * roll, yaw]))


def _best_order(total: Sums, promised: FloatArray) -> tuple[int, ...]:
    """The order of the rotors that agrees best, as given where another is not better."""
    n = promised.shape[1]
    orders = itertools.permutations(range(n)) if n <= MOST_ROTORS else iter([tuple(range(n))])
    weights = np.array([1.0, 1.0, 0.1])

    def score(order: tuple[int, ...]) -> tuple[float, int]:
        agrees = float(weights @ total.agreement(promised[:, order])[:, 0])
        return round(agrees, 9), sum(i == j for i, j in enumerate(order))

    return max(orders, key=score)


def _far_better(sums: Sums, other: FloatArray, given: FloatArray) -> bool:
    """Whether other directions agree, and leave far less than the given ones."""

    def left(part: Sums) -> FloatArray:
        """What the other leaves as a share of what the given one does. Its error is that of the
        share: a logarithm is the less certain, the better the other fits."""
        of, over = (1.0 - part.agreement(p)[:2].mean(axis=0) for p in (other, given))
        return np.asarray((of + LEAST) / (over + LEAST))

    agrees = bool((sums.total.agreement(other)[:2, 0] >= AGREE).all())
    return agrees and float(left(sums.total)[0]) + CLEAR * jackknife(left(sums.left_out)) < LEFT


def _order(sums: Sums, promised: FloatArray, names: Sequence[str]) -> Verdict | None:
    """What is wrong with the order of the commands (or rotor speeds) `names`, or with the layout
    of the rotors; None where the one given agrees or nothing fits far better.

    A layout that is turned by half the angle between two rotors, X for +, agrees by half. A gyro
    that is yawed by as much gives the same torques.
    """
    n, total = promised.shape[1], sums.total
    table = "[columns.command]" if command_names(names) else "[columns.rotor_speed]"
    agreement = total.agreement(promised)[:, 0]
    evidence = {f"agreement_{a}": float(c) for a, c in zip(AXES, agreement, strict=True)}
    says = (
        f"(of what the commands explain, roll {agreement[0]:+.2f}, pitch {agreement[1]:+.2f} "
        "where +1 is right)"
    )
    order = _best_order(total, promised)
    best = total.agreement(promised[:, order])[:2, 0]
    evidence["agreement_other_order"] = float(best.mean())
    where = f"{names[0]}.. against p, q, r"
    turns = [_turned(promised, angle) for angle in (np.pi / n, -np.pi / n)]
    turned = [p[:, _best_order(total, p)] for p in turns]
    layout = max(range(2), key=lambda k: float(total.agreement(turned[k])[:2, 0].sum()))
    if _far_better(sums, turned[layout], promised[:, order]):
        evidence["agreement_turned"] = float(total.agreement(turned[layout])[:2, 0].mean())
        return Verdict(
            claim="turned",
            severity="blocking",
            where=where,
            message="by the torques the rotors stand half way between the places that the file "
            f"states, as in X for + {says}",
            evidence=evidence,
            fix=f"correct the positions of [[rotor]] (turn them by {180 / n:g} deg about z) or the "
            "axes of the gyro or attitude; then see what is said of their order",
        )
    moved = [f"{names[i]} drives rotor {j + 1}" for i, j in enumerate(order) if i != j]
    if moved and _far_better(sums, promised[:, order], promised):
        return Verdict(
            claim=", ".join(moved),
            severity="blocking",
            where=where,
            message=f"the motor order is wrong: {', '.join(moved)} {says}",
            evidence=evidence,
            fix=f"reorder the fields of {table} or the [[rotor]] tables (or correct the "
            "sign of an axis of gyro or attitude)",
        )
    if bool((agreement[:2] >= AGREE).all()):
        return None
    return Verdict(
        claim="poor",
        severity="warning",
        where=where,
        message=f"the torques of the commands fit the rotor positions poorly {says}, and no other "
        "order fits far better",
        evidence=evidence,
        fix=f"compare rotor positions and the fields of {table} with the craft, and the "
        "signs of the axes of gyro or attitude",
    )


def _yaw(sums: Sums, promised: FloatArray) -> tuple[float, float]:
    """Agreement of the yaw torques with the spins, and `CLEAR` times its standard error."""
    yaw = float(sums.total.agreement(promised)[2, 0])
    return yaw, CLEAR * jackknife(sums.left_out.agreement(promised)[2])


def _agrees(sums: Sums, promised: FloatArray) -> bool:
    """Whether a flight shows that the spins are right: as clearly as one shows them wrong."""
    yaw, error = _yaw(sums, promised)
    return yaw > AGREE and yaw - error > 0.0


def _spins(torques: Sequence[Torque], promised: FloatArray) -> Verdict | None:
    """What is wrong with the spins, from the yaw torques."""
    sums, share = _joined(torques), max(t.share[2] for t in torques)
    yaw, error = _yaw(sums, promised)
    high = yaw + error
    evidence = {"agreement_yaw": yaw, "share_yaw": share}
    if yaw < -AGREE and high < 0.0:
        return Verdict(
            claim="opposite",
            severity="blocking",
            where=SPINS,
            message="the yaw torques have the opposite sign: the spins are the wrong way round",
            evidence=evidence,
            fix="change the sign of spin of every rotor (1 = counter-clockwise seen from above)",
        )
    if high >= AGREE:
        return None
    spins, parts = (-directions(s.gains())[2] for s in (sums.total, sums.left_out))
    clear = all(abs(s) > CLEAR * jackknife(p) for s, p in zip(spins[0], parts.T, strict=True))
    signs = np.sign(spins[0]).astype(int).tolist()
    look = f"look like spins {signs}, the vehicle file says otherwise"
    look = look if clear else "fit the spins of the vehicle file poorly"
    return Verdict(
        claim=look,
        severity="warning",
        where=SPINS,
        message=f"the yaw torques {look}",
        evidence=evidence,
        fix="compare spin of each rotor with the craft",
    )


CHECK = Check(
    name="motors",
    question="Does every command drive the rotor that the vehicle file says, with its spin?",
    run=run,
)
