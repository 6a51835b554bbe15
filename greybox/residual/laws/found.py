"""Found: the law of every axis of force and torque, of terms that are chosen by stability
selection.

What a change of a number that the fit had can do is no law: it is taken out from the start, and so
is a steady push on every axis. A force that stands in the world gets what goes with it. How much a
law explains is judged on stretches that were left out.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import TypedDict

import numpy as np

from greybox.residual.laws.axis import by_text
from greybox.residual.laws.normal_equations import solve
from greybox.residual.laws.responses import Library
from greybox.residual.laws.selection import left_out, needed, price_of, select
from greybox.residual.laws.terms import ALONG, Memory, Shaped

TERMS = 6
"""Terms of an axis, at most."""
WORLD = frozenset(itertools.chain.from_iterable(ALONG.values()))
"""Axes of the world, whose components in body axes are signals."""


class AxisLaw(TypedDict, total=False):
    """The law of one axis as `Axis` takes it; empty where it has none."""

    share: float
    terms: dict[str, float]
    codes: tuple[str, ...]
    shapes: tuple[Shaped, ...]
    depends_on: tuple[str, ...]


def is_law(found: AxisLaw, least: float) -> bool:
    """Whether terms were found that explain the `least` share of what is left, or more."""
    return bool(found.get("terms")) and bool(found["share"] >= least)


def laws_of(offered: Library, samples: int, seed: int) -> dict[str, AxisLaw]:
    """Axis -> what its law is made of, for axes that have one."""
    labels = [axis for axis, _ in offered.columns]
    pushes = {axis: len(labels) + j for j, axis in enumerate(offered.smoothed)}
    always = list(range(len(labels), offered.innovations.xy.shape[1]))
    groups = [*labels, *["constant"] * len(always)]
    chosen = select(offered.innovations, always, groups, most=TERMS, samples=samples, seed=seed)
    price = price_of(samples, len(groups))
    kept, always = _completed(offered, always, pushes, _merged(offered, chosen), price)
    total = offered.innovations.xx.sum(0), offered.innovations.xy.sum(0)
    c: dict[int, float] = {}
    if kept:
        c = dict(zip([*always, *kept], solve(*total, [*always, *kept]).tolist(), strict=True))
    out: dict[str, AxisLaw] = {}
    bent = np.array([c.get(i, 0.0) for i in range(len(labels) + len(pushes), len(groups))])
    for j, (axis, whole) in enumerate(offered.smoothed.items()):
        mine = [i for i in kept if labels[i] == axis]
        if not mine:
            continue
        used = [offered.columns[i][1] for i in mine]
        normal = whole.plus(len(labels) + 1 + j * len(bent), bent)
        steady = left_out(normal, [len(labels)])
        more = left_out(normal, [len(labels), *mine]) - steady
        out[axis] = {
            "share": more / max(float(normal.yy.sum()) - steady, 1e-300),
            "terms": by_text([t.text for t in used], [c[i] for i in mine]),
            "codes": tuple(t.code for t in used),
            "shapes": tuple(
                (t.shape, float(np.sqrt(np.mean(t.values**2)))) if t.shape else None for t in used
            ),
            "depends_on": tuple(dict.fromkeys(n for t in used for n in t.uses)),
        }
    return out


def _completed(
    offered: Library,
    always: Sequence[int],
    pushes: Mapping[str, int],
    kept: Sequence[int],
    price: float,
) -> tuple[list[int], list[int]]:
    """With the terms that go with those kept, where they pay, and what is always in then: a force
    that stands in the world has components on all axes of the body, and next to a part that depends
    on the place one that does not, in place of a steady push (lower orders belong to a polynomial:
    Nelder 1977, JRSS A 140(1))."""
    at = {(axis, t.text, t.shape): i for i, (axis, t) in enumerate(offered.columns)}
    judged, out, base = offered.innovations, list(kept), list(always)
    for i in kept:
        axis, term = offered.columns[i]
        side, _, rest = term.text.partition(" ")
        world, _, along = side.partition(".")
        if ALONG.keys().isdisjoint(term.uses) or world not in WORLD or axis != f"force.{along}":
            continue
        for b, part in itertools.product("xyz", ((f" {rest}", term.shape), ("", None))):
            one = at.get((f"force.{b}", f"{world}.{b}{part[0]}", part[1]))
            full = sum(offered.columns[k][0] == f"force.{b}" for k in out) >= TERMS
            if one is None or one in out or full:
                continue
            without = base if part[0] else [k for k in base if k != pushes[f"force.{b}"]]
            more = [*without, *out, one]
            # A push that is fixed in the body stays where it does better.
            worse = left_out(judged, more) < left_out(judged, [*base, *out])
            if not worse and needed(judged, more, one, price):
                out.append(one)
                base = without
    return out, base


def _merged(offered: Library, kept: Sequence[int]) -> list[int]:
    """Of memories of one kind that follow one signal on one axis the first: two of the grid stand
    for one that lies between, and a refit, whose times are free, would find that twice."""
    seen, out = set[tuple[str, str, str]](), list[int]()
    for i in kept:
        axis, term = offered.columns[i]
        if isinstance(term.shape, Memory):
            key = (axis, term.code, term.shape.kind)
            if key in seen:
                continue
            seen.add(key)
        out.append(i)
    return out
