"""The reference from the code: every command with every option, every public name with signature
and docstring.

    python -m docs.tools.reference docs

Why not a documentation generator: the page must be the same on every Python that we support, or the
test that it is up to date fails on all but one; argparse and inspect print differently from version
to version.
"""

from __future__ import annotations

import argparse
import importlib
import inspect
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from docs.tools.glossary import table
from greybox import _MOVED
from greybox.files import write_atomic

HEAD = """# Reference

Every command with what it takes; [functions](functions.md) and [types](types.md) of Python have pages of their own. All
three are written by `python -m docs.tools.reference docs` from the code.
How to go about things: [tutorial](tutorial.md), [how-to](howto.md); files and exit codes: [files.md](files.md).
"""
NOTE = (
    "Where no module is named it is `greybox.NAME`, imported when first used. Arrays have time "
    "first; SI units."
)
FUNCTIONS = (
    f"# Functions\n\nWhat Python code calls; what it gets back are [types](types.md). {NOTE}\n"
)
TYPES = f"# Types\n\nWhat [functions](functions.md) take and give back. {NOTE}\n"

RESULTS = {
    "CheckReport": "greybox.data.checks",
    "Covariance": "greybox.estimation.covariance",
    "Discovery": "greybox.discovery.result",
    "FrequencyResponse": "greybox.linear.frf_result",
    "Learned": "greybox.residual.learn",
    "LinearFit": "greybox.linear.fit",
    "Simulated": "greybox.estimation.simulate",
    "Plan": "greybox.planning.result",
    "Profile": "greybox.estimation.profile",
    "Twin": "greybox.simulators.make",
    "Validation": "greybox.validation.result",
}
"""What functions give back."""
CALLED = {"simulate": "greybox.estimation.simulate"}
"""Functions of a notebook that are no public names of the package."""
MODULES = {n: m for n, m in _MOVED.items() if n != "load_model"} | RESULTS | CALLED
"""What else is described: types that public names take and give back, and what a page uses.
`greybox.load` reads all models."""

JOBS = {
    "vehicle and flights": (
        "read_vehicle",
        "read_logs",
        "dataset_from_arrays",
        "check",
        "plan",
        "examples",
    ),
    "fit and judge": ("identify", "fit", "validate", "profile", "build_model"),
    "what the model misses": ("discover", "learn", "from_gpytorch", "compare"),
    "without a vehicle": ("fit_linear", "frf"),
    "use a model": ("load", "export", "twin"),
}
"""Public functions by what they are for."""


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def _option(action: argparse.Action) -> str:
    """Names of an option with what it takes; of a positional argument what stands for it."""
    value = action.metavar or (action.dest.upper() if action.option_strings else action.dest)
    if action.choices is not None and action.metavar is None:
        value = "{" + ",".join(str(c) for c in action.choices) + "}"
    if isinstance(value, tuple):
        value = " ".join(value)
    if action.nargs == 0:
        value = ""
    elif action.nargs in ("+", "*"):
        value = f"{value} ..."
    elif action.nargs == "?":
        value = f"[{value}]"
    return (
        "`"
        + " ".join(
            [*([", ".join(action.option_strings)] if action.option_strings else []), value]
        ).strip()
        + "`"
    )


def _default(action: argparse.Action) -> str:
    if action.required:
        return "required"
    value = action.default
    if isinstance(value, tuple | list):
        value = ",".join(str(v) for v in value)
    return (
        f"`{value}`"
        if isinstance(value, str | int | float) and not isinstance(value, bool) and str(value)
        else ""
    )


def commands(parser: argparse.ArgumentParser) -> Iterator[tuple[str, str, argparse.ArgumentParser]]:
    """(name, summary, parser) of every command; of one with commands of its own also those."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            helps = {a.dest: a.help or "" for a in action._choices_actions}
            for name, child in action.choices.items():
                yield name, helps.get(name, ""), child
                yield from ((f"{name} {inner}", text, p) for inner, text, p in commands(child))


def command_line() -> str:
    """The part about the command line."""
    from greybox.cli import build_parser

    parser = build_parser()
    lines = ["## Command line", "", "    greybox [--version] [--debug] [--quiet] COMMAND ...", ""]
    lines += [
        "`-h` tells the options of every command. Exit codes: [files.md](files.md#exit-codes).",
        "",
    ]
    found = list(commands(parser))
    lines += ["| command | what it does |", "|---|---|"]
    lines += [
        f"| [`{name}`](#greybox-{name.replace(' ', '-')}) | {_cell(text)} |"
        for name, text, _ in found
    ]
    for name, _, child in found:
        lines += ["", f"### greybox {name}", "", _cell(child.description or "")]
        options = [
            a
            for a in child._actions
            if not isinstance(a, argparse._HelpAction | argparse._SubParsersAction)
        ]
        if options:
            lines += ["", "| option | meaning | default |", "|---|---|---|"]
        for action in options:
            meaning = (
                (action.help or "").replace("%(default)s", str(action.default)).replace("%%", "%")
            )
            lines.append(f"| {_cell(_option(action))} | {_cell(meaning)} | {_default(action)} |")
    return "\n".join(lines) + "\n"


def _signature(function: Any) -> str:
    """Names and defaults; types are in the source and in the tips of an editor."""
    out: list[str] = []
    starred = False
    for p in inspect.signature(function).parameters.values():
        if p.kind is p.KEYWORD_ONLY and not starred:
            out.append("*")
            starred = True
        stars = "*" if p.kind is p.VAR_POSITIONAL else "**" if p.kind is p.VAR_KEYWORD else ""
        name = stars + p.name
        plain = isinstance(p.default, str | int | float | tuple | type(None))
        out.append(
            name if p.default is p.empty else f"{name}={p.default!r}" if plain else f"{name}=..."
        )
    return f"({', '.join(n for n in out if n != 'self')})"


def _document(thing: Any) -> str:
    """The docstring; examples in it become blocks (a line that begins with > is a quotation
    otherwise)."""
    text = inspect.getdoc(thing) or ""
    return re.sub(r"^(>>> .*(?:\n.+)*)", r"```text\n\1\n```", text, flags=re.MULTILINE)


def members(thing: Any) -> list[tuple[str, Any]]:
    """Public methods and properties that greybox gives a class, its own before inherited ones;
    functions of a module."""
    if inspect.ismodule(thing):
        own = [
            (n, f)
            for n, f in vars(thing).items()
            if inspect.isfunction(f) and f.__module__ == thing.__name__
        ]
        return [(n, f) for n, f in own if not n.startswith("_")]
    found: dict[str, Any] = {}
    for base in inspect.getmro(thing) if inspect.isclass(thing) else ():
        if not base.__module__.startswith("greybox"):
            continue
        for name, value in vars(base).items():
            function = (
                value.fget if isinstance(value, property) else getattr(value, "__func__", value)
            )
            if not name.startswith("_") and inspect.isfunction(function):
                found.setdefault(name, value)
    return list(found.items())


def _first_paragraph(thing: Any) -> str:
    return _cell((inspect.getdoc(thing) or "").partition("\n\n")[0])


def _first_sentence(thing: Any) -> str:
    return re.split(r"(?<=[.:])\s+(?=[A-Z`])", _first_paragraph(thing))[0]


def public_names() -> dict[str, Any]:
    """Public names of the package and what else is described."""
    import greybox

    public = {name: getattr(greybox, name) for name in greybox.__all__}
    return public | {
        name: getattr(importlib.import_module(module), name) for name, module in MODULES.items()
    }


def _title(name: str, thing: Any) -> str:
    """Titles differ in more than case, so that `Fit` and `fit` have anchors of their own."""
    kind = (inspect.isclass(thing) and "class ") or (inspect.ismodule(thing) and "module ")
    return f"{kind}{name}" if kind else f"{name}()"


def _link(name: str, thing: Any) -> str:
    anchor = _title(name, thing).removesuffix("()").replace(" ", "-").lower()
    return f"[`{name}`](#{anchor})"


def types_page(types: dict[str, Any]) -> str:
    """A table of types, then each."""
    lines = ["| name | what it is |", "|---|---|"]
    for name, thing in types.items():
        module = f" (`{MODULES[name]}`)" if name in MODULES else ""
        lines.append(f"| {_link(name, thing)}{module} | {_first_sentence(thing)} |")
    return "\n".join([*lines, *described(types)]) + "\n"


def functions_page(functions: dict[str, Any]) -> str:
    """Public functions by what they are for, then each; others by where they are."""
    lines = ["| for | functions |", "|---|---|"]
    for job, names in JOBS.items():
        lines.append(f"| {job} | {', '.join(_link(n, functions[n]) for n in names)} |")
    lines += described({n: functions[n] for names in JOBS.values() for n in names})
    lines += ["", "## Others", "", "| function | what it is |", "|---|---|"]
    for name in (n for n in functions if n in MODULES):
        lines.append(f"| `{MODULES[name]}.{name}` | {_first_sentence(functions[name])} |")
    return "\n".join(lines) + "\n"


def described(public: dict[str, Any]) -> list[str]:
    """Each name with signature, docstring and members, in lines."""
    lines = list[str]()
    for name, thing in public.items():
        call = f"greybox.{name}" if inspect.ismodule(thing) else f"{name}{_signature(thing)}"
        if name in MODULES:
            call = f"from {MODULES[name]} import {name}\n{call}"
        lines += ["", f"## {_title(name, thing)}", "", "```text", call, "```", "", _document(thing)]
        inside = members(thing)
        if inside:
            lines += ["", "| member | what it does |", "|---|---|"]
        for member, value in inside:
            function = (
                value.fget if isinstance(value, property) else getattr(value, "__func__", value)
            )
            call = "" if isinstance(value, property) else _signature(function)
            lines.append(f"| `{member}{_cell(call)}` | {_first_paragraph(function)} |")
    return lines


def pages() -> dict[str, str]:
    """The pages by file name."""
    public = public_names()
    types = {name: thing for name, thing in public.items() if inspect.isclass(thing)}
    functions = {name: thing for name, thing in public.items() if name not in types}
    return {
        "reference.md": "\n".join([HEAD, command_line(), table()]),
        "functions.md": "\n".join([FUNCTIONS, functions_page(functions)]),
        "types.md": "\n".join([TYPES, types_page(types)]),
    }


if __name__ == "__main__":
    for file, text in pages().items():
        write_atomic(Path(sys.argv[1]) / file, text)
