"""`greybox cite MODEL.json`: what to cite for a model: the method, the sources of its effects, its
data, the software."""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from greybox.commands.command_line import Subcommands
from greybox.commands.console import Console, printed_json_option

if TYPE_CHECKING:
    from greybox.files import Parsed

SCHEMA = "greybox.cite/1"

PREDICTION_ERROR = (
    "Ljung 1999, System Identification: Theory for the User, 2nd edition, Prentice Hall"
)
HYBRID = (
    "Ghoul, Bousserhane and Boufeldja 2026, A Hybrid PEM-GP Framework for Uncertainty-Aware System "
    "Identification of Quadcopters, International Journal of Control, Automation and Systems 24(8)"
)
DISTURBANCE = (
    "Kristensen, Madsen and Jorgensen 2004, A method for systematic improvement of stochastic "
    "grey-box models, Computers & Chemical Engineering 28(8)"
)
CASADI = (
    "Andersson, Gillis, Horn, Rawlings and Diehl 2019, CasADi: a software framework for nonlinear "
    "optimization and optimal control, Mathematical Programming Computation 11(1)"
)
DATA_SETS: Mapping[str, tuple[str, str]] = {
    "nanobench": (
        "NanoBench",
        "Ullah and Baca 2026, NanoBench: A Multi-Task Benchmark Dataset for Nano-Quadrotor System "
        "Identification, Control, and State Estimation, arXiv:2603.09908",
    ),
    "arpl": (
        "ARPL Crazyflie logs",
        "Eschmann, Albani and Loianno 2024, Data-Driven System Identification of Quadrotors "
        "Subject to Motor Delays",
    ),
}
"""Data sets by a word that the name of their vehicle, or an entry of the model's `data_sets`,
contains."""


@dataclass(frozen=True, kw_only=True)
class Work:
    """One work to cite and what for."""

    reason: str
    text: str


def add(subparsers: Subcommands) -> None:
    """Declare the command."""
    p = subparsers.add_parser(
        "cite",
        help="what to cite for a model",
        description="List what to cite for a model file: method, sources of its effects, data "
        "sets, software.",
    )
    p.add_argument("model", metavar="MODEL.json", help="a model file")
    printed_json_option(p)
    p.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print the list. Returns 0. Raises `FileFormatError` for a file that is not a model."""
    from greybox.files import read_json

    model = read_json(arguments.model)
    found = works(model, where=arguments.model)
    result = {
        "schema": SCHEMA,
        "model": {"file": str(arguments.model), "name": str(model.get("name", ""))},
        "works": [{"for": w.reason, "text": w.text} for w in found],
    }
    Console.of(arguments).result(result, text(found))
    return 0


def works(model: Parsed, *, where: str = "model") -> tuple[Work, ...]:
    """What to cite for the values of a model file; a work with several reasons comes once, with all
    of them.

    Raises `FileFormatError` where the values are not those of a model, `UnknownNameError` for an
    unknown effect.
    """
    from greybox.errors import FileFormatError
    from greybox.model.effects import effect_by_name

    schema = model.get("schema")
    if not (isinstance(schema, str) and schema.startswith("greybox.") and "model" in schema):
        raise FileFormatError(
            "not a model file",
            where=where,
            expected="greybox.model/1",
            got=repr(schema),
            fix="pass the model.json that greybox fit wrote",
        )
    effects = model.get("effects", [])
    if not (isinstance(effects, list) and all(isinstance(e, str) for e in effects)):
        raise FileFormatError(
            "effects is not a list of names", where=where, fix="write the file again"
        )
    found = [
        Work(reason="prediction error method", text=PREDICTION_ERROR),
        Work(reason="framework", text=HYBRID),
    ]
    parts = model.get("noise_parts", [])
    if model.get("disturbance") or any(p.get("kind") in ("disturbance", "gust") for p in parts):
        found.append(Work(reason="disturbance states", text=DISTURBANCE))
    own = model.get("own_effects", {})
    for e in effects:
        references = own[e]["references"] if e in own else effect_by_name(e).references
        found += [Work(reason=f"effect {e}", text=r) for r in references]
    found += [
        Work(reason=f"data set {name}", text=reference) for name, reference in data_sets(model)
    ]
    found.append(Work(reason="symbolic framework", text=CASADI))
    reasons: dict[str, list[str]] = {}
    for work in found:
        reasons.setdefault(work.text, []).append(work.reason)
    return tuple(Work(reason=", ".join(r), text=t) for t, r in reasons.items())


def data_sets(model: Parsed) -> tuple[tuple[str, str], ...]:
    """(name, reference) of the data sets that the model names in `data_sets` or by its vehicle.

    An entry of `data_sets` that is no known name is itself taken as the reference.
    """
    stated = model.get("data_sets") or []
    vehicle = model.get("vehicle")
    name = vehicle.get("name") if isinstance(vehicle, Mapping) else None
    out: dict[str, tuple[str, str]] = {}
    for entry, is_reference in [*((s, True) for s in stated), *([(name, False)] if name else [])]:
        known = [v for k, v in DATA_SETS.items() if k in str(entry).lower()]
        for row in known or ([(str(entry), str(entry))] if is_reference else []):
            out.setdefault(row[1], row)
    return tuple(out.values())


def text(found: tuple[Work, ...]) -> str:
    """The list for a terminal."""
    lines = ["If you publish results of this model, please cite:", ""]
    for work in found:
        lines += textwrap.wrap(work.text, 100, initial_indent="- ", subsequent_indent="  ")
        lines.append(f"  ({work.reason})")
    return "\n".join(lines)
