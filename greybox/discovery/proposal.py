"""Proposal: a law of the leftover as an effect file that a user can read, edit and offer again with --effects-file.

The file holds one effect per group of axes (force, torque): a wrench that is linear in its parameters, with the terms
that stability selection kept. The null of every parameter is zero; what the search found stands in the docstring and as
the parameter's scale.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from greybox.discovery.leftover import Leftover
from greybox.model.effect import Effect
from greybox.model.effects_file import load_effects

SLOT = {"force": "force", "torque": "moment"}


def file_name(number: int) -> str:
    """proposal_<n>.py."""
    return f"proposal_{number}.py"


def proposal_text(law: Leftover, number: int) -> str:
    """The file for one axis. The effect is named proposal_<axis>, as proposal_torque_z."""
    kind, axis = law.channel.split(".")
    place = "xyz".index(axis)
    unit = law.unit
    rows = list(zip(law.terms.items(), law.codes, strict=True))
    declared = [
        f'            Parameter(name="c_{i}", unit="{unit} / ...", nominal=0.0, null=0.0, scale={max(abs(c), 1e-12):.3g}, '
        f'meaning="{text}"),'
        for i, ((text, c), _) in enumerate(rows, 1)
    ]
    summed = [
        f'        {"value = " if i == 1 else "value += "}p["c_{i}"] * ({code})' for i, (_, code) in enumerate(rows, 1)
    ]
    parts = ["0.0", "0.0", "0.0"]
    parts[place] = "value"
    formula = " + ".join(f"c_{i} {text}" for i, ((text, _), _) in enumerate(rows, 1))
    needs = ""
    if any("flow.vbat" in code for code in law.codes):
        needs = '\n    needs = Needs(columns=("vbat",))'
    return "\n".join(
        [
            f'"""Proposed by greybox discover: a law of {law.channel} [{unit}] that no effect of the catalogue explains.',
            "",
            f"    {law.channel} = " + " + ".join(f"{c:.4g} {text}" for (text, c), _ in rows),
            "",
            f"It explains {100 * law.share:.0f} % of the smoothed discrepancy on flights that were left out. Terms are",
            "sums that describe; what the physics is, you may know: rename the effect, keep the terms that make sense, and",
            "offer it again with --effects-file.",
            '"""',
            "",
            "import casadi as ca",
            "",
            f"from greybox.model.effect import Effect{', Needs' if needs else ''}",
            "from greybox.model.parameter import Parameter",
            "",
            "",
            f"class Proposal{number}(Effect):",
            f'    name = "proposal_{law.channel.replace(".", "_")}"',
            '    stage = "wrench"',
            f'    summary = "law of {law.channel} found in the leftover"',
            f'    formula = "{law.channel} = {formula}"{needs}',
            "",
            "    def parameters(self, vehicle):",
            "        return (",
            *declared,
            "        )",
            "",
            "    def apply(self, flow, p):",
            *summed,
            f'        return {{"{SLOT[kind]}": ca.vertcat({", ".join(parts)})}}',
            "",
        ]
    )


def proposed(laws: Sequence[Leftover]) -> tuple[Effect, ...]:
    """The effects of the proposals, read back from their files, so that they are what a user would get."""
    out: list[Effect] = []
    with tempfile.TemporaryDirectory() as folder:
        for number, law in enumerate(laws, 1):
            path = Path(folder) / file_name(number)
            path.write_text(proposal_text(law, number), encoding="utf-8")
            out += load_effects(path)
    return tuple(out)
