"""Own file: a law that a model of the user's own lacks, as a program that builds the model with it.

The program reads the model.json beside it, which holds the equations, and adds the terms, with
coefficients whose null is zero: `greybox fit --model-file proposal_1.py:build` fits them.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from typing import Any

from greybox.errors import ModelError, printable
from greybox.model.own_effect import Terms
from greybox.model.parameter import Parameter
from greybox.residual.laws.effect_file import Law, effect_name, file_name

PLAIN = re.compile(r"[\w .,:;/^|*+()\[\]=<>%·²³-]*")
"""What names, units and terms of a law may hold: a law is run as a program, and a model file that
somebody sent must not become one. Its codes name signals by their places."""


def _demand_plain(texts: Iterable[str]) -> None:
    for text in texts:
        if not PLAIN.fullmatch(text):
            raise ModelError(
                "a name or unit of this model cannot stand in a program",
                expected="letters, digits, blanks and signs",
                got=printable(text),
                fix="rename it",
            )


def own_law_text(law: Law, number: int, taken: Collection[str] = ()) -> str:
    """The program for one state, its effect named otherwise than those `taken`. Raises
    `ModelError` for names and units that could be code."""
    _demand_plain((law.channel, law.unit, *law.terms))
    name, rows = effect_name(law.channel, taken), list(law.terms.items())
    declared = [
        f'    Parameter(name="{name}.c_{i}", unit="{law.unit} / ...", nominal=0.0, null=0.0, '
        f'scale={max(abs(c), 1e-12):.3g}, meaning="{text}"),'
        for i, (text, c) in enumerate(rows, 1)
    ]
    summed = [
        f'    {"value = " if i == 1 else "value += "}p["{name}.c_{i}"] * ({code})'
        for i, code in enumerate(law.codes, 1)
    ]
    return "\n".join(
        [
            f'"""Proposed by greybox discover: a law of {law.channel} [{law.unit}] that the model '
            "does not have.",
            "",
            f"    to the derivative of {law.channel} (discrete: its next value) adds",
            *(f"    {c:+.4g} {text}" for text, c in rows),
            "",
            f"It explains {100 * law.share:.0f} % of what is left, on records that were left out. "
            "Terms are sums that",
            "describe; what the physics is, you may know: keep those that make sense, rename them, "
            "and fit again:",
            f"greybox fit --model-file {file_name(number)}:build --train ...",
            '"""',
            "",
            "from pathlib import Path",
            "",
            "import casadi as ca",
            "",
            "import greybox as gb",
            "from greybox.model.own_effect import with_terms",
            "from greybox.model.parameter import Parameter",
            "",
            "PARAMETERS = (",
            *declared,
            ")",
            "",
            "",
            "def terms(t, x, u, p):",
            *summed,
            f'    return {{"{law.channel}": value}}',
            "",
            "",
            "def build():",
            '    model = gb.load(Path(__file__).parent / "model.json").core',
            "    return with_terms(model, PARAMETERS, terms)",
            "",
        ]
    )


def own_law(text: str) -> tuple[tuple[Parameter, ...], Terms]:
    """Parameters and terms of a program that `own_law_text` wrote."""
    made: dict[str, Any] = {}
    exec(compile(text, "proposal", "exec"), made)
    return made["PARAMETERS"], made["terms"]
