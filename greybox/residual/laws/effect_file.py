"""Effect file: a law of the leftover as a file that a user can read, edit and offer again with
--effects-file.

The file holds one effect per group of axes (force, torque): a wrench that is linear in its
parameters, with the terms that stability selection kept. The null of every coefficient is zero;
what the search found stands in the docstring and as the coefficient's scale. A term with a memory
is a state of the effect, whose time constant is a parameter too.
"""

from __future__ import annotations

import math
import re
import tempfile
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Protocol

from greybox.model.effect import Effect
from greybox.model.effects_file import load_effects
from greybox.residual.laws.terms import Memory

REACH = 10.0
"""Factor by which a refit may move time and damping of a memory, either way."""
SHORTEST = 0.02
"""Time constant [s] below which no refit goes: it is the present, and steps of integration must
stay shorter than it."""
ROUND = 1e-3
LAW_FILE = re.compile(r"proposal_\d+\.py")
SLOT = {"force": "force", "torque": "moment"}


class Law(Protocol):
    """What is written: one axis as a sum of terms."""

    @property
    def channel(self) -> str:
        """force.x, ..., torque.z."""

    @property
    def unit(self) -> str:
        """Of the axis."""

    @property
    def share(self) -> float:
        """Of the variance, on flights that were left out."""

    @property
    def terms(self) -> Mapping[str, float]:
        """Text -> coefficient."""

    @property
    def codes(self) -> tuple[str, ...]:
        """The terms as lines of an effect."""

    @property
    def memories(self) -> tuple[tuple[Memory, float] | None, ...]:
        """How a term follows with a memory, and the RMS of what follows; None without one."""


def file_name(number: int) -> str:
    """proposal_<n>.py, as `LAW_FILE` has it."""
    return f"proposal_{number}.py"


def effect_name(channel: str, taken: Collection[str] = ()) -> str:
    """proposal_<axis>, as proposal_torque_z; further_proposal_<axis> where that is `taken`, and so
    on."""
    name = f"proposal_{channel.replace('.', '_')}"
    while name in taken:
        name = f"further_{name}"
    return name


def proposal_text(law: Law, number: int, taken: Collection[str] = ()) -> str:
    """The file for one axis, its effect named otherwise than those `taken`."""
    kind, axis = law.channel.split(".")
    place = "xyz".index(axis)
    unit = law.unit
    rows = list(zip(law.terms.items(), law.codes, strict=True))
    places, shapes, past = _past(law)
    declared = [
        f'            Parameter(name="c_{i}", unit="{unit} / ...", nominal=0.0, null=0.0, '
        f"scale={max(abs(c), 1e-12):.3g}, "
        f'meaning="{text}"),'
        for i, ((text, c), _) in enumerate(rows, 1)
    ]
    summed = [
        f'        {"value = " if i == 1 else "value += "}p["c_{i}"] * '
        + (f"flow.memory[{places[i]}]" if i in places else f"({code})")
        for i, (_, code) in enumerate(rows, 1)
    ]
    parts = ["0.0", "0.0", "0.0"]
    parts[place] = "value"
    formula = " + ".join(f"c_{i} {text}" for i, ((text, _), _) in enumerate(rows, 1))
    needs = ""
    if any("flow.vbat" in code for code in law.codes):
        needs = '\n    needs = Needs(columns=("vbat",))'
    imports = ["Effect", *(["Needs"] if needs else []), *(["Remembered"] if past else [])]
    return "\n".join(
        [
            *_head(law),
            "import casadi as ca",
            "",
            f"from greybox.model.effect import {', '.join(imports)}",
            "from greybox.model.parameter import Parameter",
            "",
            "",
            f"class Proposal{number}(Effect):",
            f'    name = "{effect_name(law.channel, taken)}"',
            '    stage = "wrench"',
            f'    summary = "law of {law.channel} found in the leftover"',
            f'    formula = "{law.channel} = {formula}"{needs}',
            "",
            "    def parameters(self, vehicle):",
            "        return (",
            *declared,
            *shapes,
            "        )",
            *past,
            "",
            "    def apply(self, flow, p):",
            *summed,
            f'        return {{"{SLOT[kind]}": ca.vertcat({", ".join(parts)})}}',
            "",
        ]
    )


def _head(law: Law) -> list[str]:
    """The docstring of the file."""
    return [
        f'"""Proposed by greybox discover: a law of {law.channel} [{law.unit}] that no effect of '
        "the catalogue explains.",
        "",
        f"    {law.channel} = " + " + ".join(f"{c:.4g} {text}" for text, c in law.terms.items()),
        "",
        f"It explains {100 * law.share:.0f} % of the smoothed discrepancy on flights that were "
        "left out. Terms are",
        "sums that describe; what the physics is, you may know: copy this file, rename the "
        "effect, keep the terms that",
        "make sense, and offer it with --effects-file.",
        '"""',
        "",
    ]


def _past(law: Law) -> tuple[dict[int, int], list[str], list[str]]:
    """Of the terms with a memory: number of the term -> place of what it follows in `flow.memory`,
    the declarations of times and dampings, and the two methods of an effect that remembers (none
    where no term does)."""
    places, remembered, changes, shapes = dict[int, int](), list[str](), list[str](), list[str]()
    for i, (code, kept) in enumerate(zip(law.codes, law.memories, strict=False), 1):
        if kept is None:
            continue
        memory, size = kept
        j = places[i] = len(remembered)
        remembered.append(f'            Remembered(name="term_{i}", unit="...", size={size:.3g}),')
        shapes.append(
            _positive(f"time_{i}", "s", memory.time, f"memory of term {i}", lower=SHORTEST)
        )
        if memory.damping is None:
            changes.append(f'            ({code} - flow.memory[{j}]) / p["time_{i}"],')
            continue
        shapes.append(
            _positive(f"damping_{i}", "-", memory.damping, f"damping ratio of term {i}", upper=1.0)
        )
        remembered.append(
            f'            Remembered(name="term_{i}_rate", unit="... / s", '
            f"size={size / memory.time:.3g}),"
        )
        changes.append(f"            flow.memory[{j + 1}],")
        changes.append(
            f'            ({code} - flow.memory[{j}]) / p["time_{i}"] ** 2'
            f' - 2 * p["damping_{i}"] * flow.memory[{j + 1}] / p["time_{i}"],'
        )
    if not places:
        return places, shapes, []
    methods = ["", "    def memory(self, vehicle):", "        return (", *remembered, "        )"]
    methods += [
        "",
        "    def remember(self, flow, p):",
        "        return ca.vertcat(",
        *changes,
        "        )",
    ]
    return places, shapes, methods


def _positive(
    name: str, unit: str, value: float, meaning: str, lower: float = 0.0, upper: float = math.inf
) -> str:
    """The declaration of a shape parameter: felt only where its term is, and then within reach of
    the proposed value."""
    low, high = min(max(value / REACH, lower), value), max(min(value * REACH, upper), value)
    # Rounding must not leave the value outside.
    bounds = f"lower={low * (1 - ROUND):.4g}, upper={high * (1 + ROUND):.4g}, scale={value / 3:.3g}"
    return (
        f'            Parameter(name="{name}", unit="{unit}", nominal={value:.4g}, '
        f"null={value:.4g}, {bounds}, "
        f'meaning="{meaning}"),'
    )


def proposed(laws: Sequence[Law], taken: Collection[str] = ()) -> tuple[Effect, ...]:
    """The effects of the proposals, read back from their files, so that they are what a user would
    get."""
    out: list[Effect] = []
    with tempfile.TemporaryDirectory() as folder:
        for number, law in enumerate(laws, 1):
            path = Path(folder) / file_name(number)
            path.write_text(proposal_text(law, number, taken), encoding="utf-8")
            out += load_effects(path)
    return tuple(out)
