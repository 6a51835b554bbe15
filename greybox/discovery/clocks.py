"""Clocks: late commands are a late IMU and a pose that is as late, and no log tells the two apart.

Commands that act c later, an IMU that is i late and a pose that is p late give the same log as c - t, i + t and p + t, to
the last digit: only two of the three can be told, and what can be said with one of them can be said with two others.
Where one name says it, one name is given; where it takes two, there are two ways with no delay below zero, and both are
said.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from greybox.discovery.candidates import IN_OTHER_WORDS
from greybox.discovery.nested import Nest, NestedFit, Refit

if TYPE_CHECKING:
    from greybox.discovery.name import Addition

((COMMAND, (IMU, POSE)),) = IN_OTHER_WORDS.items()
THREE = frozenset({COMMAND, IMU, POSE})
SHORT = 0.25
"""Part of a sample below which lag and delay of the command are not told apart: all that is seen is which command a sample
still felt, and that is as much a matter of how the log was written."""
TIED = 1.0
"""BIC within which two ways to say the same are the same."""


def in_other_words(at: NestedFit, best: Sequence[str]) -> set[str]:
    """What says the same as `best` next to what `at` has: next to one of the three each of the others says what the other
    does."""
    same = set(THREE - set(at.effects) - set(best))
    return same if len(THREE & set(at.effects)) == 1 and set(best) < THREE else set()


def said_shorter(nest: Nest, at: NestedFit, found: Refit) -> Refit | None:
    """A fit that `found` two of the three, said with less:

    a late IMU and a pose that is no earlier are late commands, and what the pose is later than these;
    late commands and a pose that is early by no more are a late IMU, and what the commands are later than that.

    None where `found` says something else. What is left with nothing to say goes when names are left out again.
    """
    if not set(found.effects) | set(nest.candidates.parameters) >= THREE:
        return None
    late = {n: found.theta.get((f"{n}.d", None), 0.0) for n in THREE}
    brief = SHORT * nest.candidates.physics.sample_time
    had = THREE & set(found.effects)
    if had == {IMU, POSE} and late[IMU] >= brief and late[POSE] >= late[IMU] - brief:
        gone, new, kept, shift = IMU, COMMAND, POSE, -late[IMU]
    elif had == {COMMAND, POSE} and late[POSE] <= -brief and late[COMMAND] + late[POSE] >= -brief:
        gone, new, kept, shift = POSE, IMU, COMMAND, late[POSE]
    else:
        return None
    said = dict(found.theta) | {(f"{new}.d", None): -shift, (f"{kept}.d", None): max(late[kept] + shift, 0.0)}
    task = replace(nest.task((*(e for e in found.effects if e != gone), new), start=at), starts=(said,))
    shorter = nest.contest([task], found.bic)[0]
    return shorter if shorter.comparable and shorter.bic < found.bic + TIED else None


def said_two_ways(nest: Nest, at: NestedFit, additions: Sequence[Addition]) -> tuple[list[Addition], list[str]]:
    """`additions` with two names for what takes two of the three to say, and a sentence on what the third then is.

    Of a late IMU and a later pose the IMU may as well be punctual and the commands late; of a pose that is less late the
    pose. No manoeuvre tells which, only somebody who knows one of the three.
    """
    had = THREE & set(at.effects)
    late = {n: at.fit.parameters[f"{n}.d"].value for n in had if f"{n}.d" in at.fit.parameters}
    if len(late) != 2 or not set(nest.candidates.parameters) >= THREE:
        return list(additions), []
    shift = late.get(COMMAND, 0.0)
    imu, pose = late.get(IMU, 0.0) + shift, late.get(POSE, 0.0) + shift
    kept, other, size = (POSE, IMU, imu) if pose >= imu else (IMU, POSE, pose)
    if kept not in had or min(imu, pose) <= 0:
        return list(additions), []
    (one,) = had - {kept}
    new = other if one == COMMAND else COMMAND
    would = {new: size, kept: max(imu, pose) - (size if new == COMMAND else 0.0)}
    uppers = {d.name: d.upper for d in nest.candidates.model.parameters}
    if any(v > uppers[f"{n}.d"] for n, v in would.items()):
        return list(additions), []
    out: list[Addition] = []
    for a in additions:
        if one in a.effects and not a.rivals:
            rest = tuple(e for e in a.effects if e != one)
            out += [replace(a, effects=rest)] if rest else []
            out.append(replace(a, effects=(one,), rivals={one: 0.5, new: 0.5}))
        else:
            out.append(a)
    note = (
        f"{one} next to {kept} is the same thing as {new} of {1e3 * would[new]:.3g} ms next to a {kept} of "
        f"{1e3 * would[kept]:.3g} ms: no log tells these apart"
    )
    return out, [note]


def never_separated(at: NestedFit, rivals: Collection[str]) -> bool:
    """Whether no manoeuvre tells `rivals` apart in a model that has two of the three."""
    return set(rivals) <= THREE and len(THREE & set(at.effects)) == 2
