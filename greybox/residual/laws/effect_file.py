"""Effect file: a law of the leftover as a file that a user can read, edit and offer again with
--effects-file.

The file holds one effect per group of axes (force, torque): a wrench that is linear in its
parameters, with the terms that stability selection kept. The null of every coefficient is zero;
what the search found stands in the docstring and as the coefficient's scale. A term with a memory
is a state of the effect. Its time constant, and place and width of a bump, are parameters too.
"""

from __future__ import annotations

import math
import re
import tempfile
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import Protocol

from greybox.files import set_aside
from greybox.model.effect import Effect
from greybox.model.effects_file import load_effects
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import with_physics
from greybox.residual.laws.terms import Memory, Shaped

REACH, WIDER, ASIDE = 10.0, 3.0, 2.0
"""Factors by which a refit may move time and damping of a memory and the width of a bump, either
way, and how many widths it may move its place."""
SHORTEST = 0.02
"""Time constant [s] below which no refit goes: it is the present, and steps of integration must
stay shorter than it."""
ROUND = 1e-3
LAW_FILE = re.compile(r"proposal_\d+\.py")
WITH_LAWS = "model_with_laws.json"
"""File of the model that has the laws of the leftover as well."""
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
        """The terms as lines of an effect, see `Term`."""

    @property
    def shapes(self) -> tuple[Shaped, ...]:
        """How a term follows its signal, or where it acts; see `Shaped`."""


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
    rows = list(zip(law.terms.items(), _felt(law), strict=True))
    places, past = _past(law)
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
            *_shapes(law),
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


def _felt(law: Law) -> list[str]:
    """The codes of the terms, numbers of a bump as parameters."""
    return [
        code.format(**{n: f"p['{n}_{i}']" for n in kept[0].numbers}) if kept else code
        for i, (code, kept) in enumerate(zip_longest(law.codes, law.shapes), 1)
    ]


def _shapes(law: Law) -> list[str]:
    """The declarations of what a refit frees besides coefficients."""
    out = list[str]()
    for i, kept in enumerate(law.shapes, 1):
        shape = kept[0] if kept else None
        if isinstance(shape, Memory):
            of = f"memory of term {i}"
            out.append(_positive(f"time_{i}", "s", shape.time, of, REACH, lower=SHORTEST))
            if shape.damping is not None:
                of = f"damping ratio of term {i}"
                out.append(_positive(f"damping_{i}", "-", shape.damping, of, REACH, upper=1.0))
        elif shape is not None:
            at, far, of = shape.place, ASIDE * shape.width, f"{shape.signal} where term {i} acts"
            out.append(_shape(f"place_{i}", "...", at, of, at - far, at + far, shape.width / 3))
            out.append(_positive(f"width_{i}", "...", shape.width, f"width of term {i}", WIDER))
    return out


def _past(law: Law) -> tuple[dict[int, int], list[str]]:
    """Of the terms with a memory: number of the term -> place of what it follows in `flow.memory`,
    and the two methods of an effect that remembers (none where no term does)."""
    places, remembered, changes = dict[int, int](), list[str](), list[str]()
    for i, (code, kept) in enumerate(zip(law.codes, law.shapes, strict=False), 1):
        if kept is None or not isinstance(memory := kept[0], Memory):
            continue
        size = kept[1]
        j = places[i] = len(remembered)
        remembered.append(f'            Remembered(name="term_{i}", unit="...", size={size:.3g}),')
        if memory.damping is None:
            changes.append(f'            ({code} - flow.memory[{j}]) / p["time_{i}"],')
            continue
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
        return places, []
    methods = ["", "    def memory(self, vehicle):", "        return (", *remembered, "        )"]
    methods += [
        "",
        "    def remember(self, flow, p):",
        "        return ca.vertcat(",
        *changes,
        "        )",
    ]
    return places, methods


def _positive(
    name: str,
    unit: str,
    value: float,
    meaning: str,
    reach: float,
    lower: float = 0.0,
    upper: float = math.inf,
) -> str:
    """The declaration of a positive shape parameter, within a factor `reach` of the proposed
    value."""
    low, high = min(max(value / reach, lower), value), max(min(value * reach, upper), value)
    # Rounding must not leave the value outside.
    low, high = low * (1 - ROUND), high * (1 + ROUND)
    return _shape(name, unit, value, meaning, low, high, value / 3)


def _shape(
    name: str, unit: str, value: float, meaning: str, low: float, high: float, scale: float
) -> str:
    """The declaration of a shape parameter: felt only where its term is."""
    return (
        f'            Parameter(name="{name}", unit="{unit}", nominal={value:.4g}, '
        f"null={value:.4g}, lower={low:.4g}, upper={high:.4g}, scale={scale:.3g}, "
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


def with_laws(model: IdentifiedModel, laws: Sequence[Effect]) -> IdentifiedModel:
    """The model with `laws` in place of those of the same names that it has."""
    own = [e.name for e in laws]
    dynamics = with_physics(model.dynamics, lambda m: m.without_effect(*own).with_effect(*laws))
    return replace(model, dynamics=dynamics)


def set_aside_laws(out: Path, laws: Mapping[str, str]) -> None:
    """Set laws of an earlier search aside, but for those that are the same now (`laws`: file name
    -> text)."""
    for old in out.glob("proposal_*.py"):
        if LAW_FILE.fullmatch(old.name) and old.read_bytes() != laws.get(old.name, "").encode():
            set_aside(old)
