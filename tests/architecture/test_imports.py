"""Imports run one way: plants know nothing of greybox, lower rooms nothing of higher, greybox
nothing of its users."""

from __future__ import annotations

import ast
import functools
import graphlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[2]
BASE = (
    "instructions",
    "symbolic",
    "frames",
    "errors",
    "takes",
    "files",
    "runs",
    "cores",
    "workers",
    "cluster",
    "interrupts",
    "journal",
    "progress",
    "shown",
    "plots",
    "distribution",
)
ROOMS = (
    "statistics",
    "plants",
    "excitation",
    "examples",
    "data",
    "model",
    "estimation",
    "validation",
    "linear",
    "automatic",
    "residual",
    "baselines",
    "simulators",
    "planning",
    "discovery",
    "report",
)
LEVEL = dict.fromkeys(BASE, 0) | {room: 1 + k for k, room in enumerate(ROOMS)}
PLAIN_NUMBERS = "greybox.model.vehicle"
"""Holds only what a vehicle file says, so that the readers in greybox.data may use it."""


class Import(NamedTuple):
    line: int
    module: str
    inside_function: bool
    typing_only: bool


@functools.cache
def imports(path: Path) -> tuple[Import, ...]:
    """Every import of a file: absolute module name, and whether it runs only inside a function or
    only for types."""
    package = list(path.relative_to(ROOT).with_suffix("").parts[:-1])
    modules = known_modules()

    def visit(node: ast.AST, inside: bool, typing_only: bool) -> Iterator[Import]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Import):
                for alias in child.names:
                    yield Import(child.lineno, alias.name, inside, typing_only)
            elif isinstance(child, ast.ImportFrom):
                base = package[: len(package) - child.level + 1] if child.level else []
                stem = ".".join([*base, *([child.module] if child.module else [])])
                for alias in child.names:
                    full = f"{stem}.{alias.name}"
                    yield Import(
                        child.lineno, full if full in modules else stem, inside, typing_only
                    )
            elif isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
                for part in child.body:
                    yield from visit(ast.Module(body=[part], type_ignores=[]), inside, True)
                for part in child.orelse:
                    yield from visit(ast.Module(body=[part], type_ignores=[]), inside, typing_only)
            elif not isinstance(child, ast.expr):  # no import is part of an expression
                function = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef)
                yield from visit(child, inside or function, typing_only)

    return tuple(visit(ast.parse(path.read_text(encoding="utf-8")), False, False))


@functools.cache
def known_modules() -> set[str]:
    """Dotted names of all modules and packages of this repository's packages."""
    names = set()
    for top in ("greybox", "mpc_export", "scenarios"):
        for path in (ROOT / top).rglob("*.py"):
            parts = path.relative_to(ROOT).with_suffix("").parts
            names.add(".".join(parts[:-1] if parts[-1] == "__init__" else parts))
    return names


@functools.cache
def files(folder: str) -> tuple[Path, ...]:
    return tuple(sorted((ROOT / folder).rglob("*.py")))


def within(module: str, package: str) -> bool:
    return module == package or module.startswith(package + ".")


def say(path: Path, found: Import, why: str) -> str:
    return f"{path.relative_to(ROOT)}:{found.line} imports {found.module}: {why}"


PLANTS = ("greybox.plants", "greybox.excitation", "scenarios.plants")
"""Simulated vehicles and what flies them: nothing of them is shared with the models that are fitted
to their flights."""
DEMO = (
    "mpc_export/mission/craft.py",
    "mpc_export/mission/demo.py",
    "mpc_export/rates/craft.py",
    "mpc_export/rates/identify.py",
    "greybox/commands/demo.py",
    "greybox/commands/missing_effect.py",
    "greybox/commands/selftest_checks.py",
)
"""Demos and the selftest, which fly a simulated plant and fit it from outside."""


@pytest.mark.parametrize("folder", ["greybox/plants", "greybox/excitation", "scenarios/plants"])
def test_simulated_plants_are_independent_of_what_is_fitted_to_them(folder):
    wrong = []
    for path in files(folder):
        for found in imports(path):
            top = found.module.split(".")[0]
            if top not in sys.stdlib_module_names | {"numpy", "greybox", "scenarios"}:
                wrong.append(say(path, found, "a plant uses numpy and the standard library only"))
            if top in ("greybox", "scenarios") and not any(within(found.module, p) for p in PLANTS):
                wrong.append(say(path, found, "a plant reaches nothing else"))
    assert not wrong, "\n".join(wrong)


def test_what_is_fitted_knows_nothing_of_the_simulated_plants():
    wrong = [
        say(path, found, "only demos and the selftest fly a simulated plant")
        for top in ("greybox", "mpc_export")
        for path in files(top)
        if not path.relative_to(ROOT)
        .as_posix()
        .startswith(("greybox/plants/", "greybox/excitation/"))
        and path.relative_to(ROOT).as_posix() not in DEMO
        for found in imports(path)
        if any(within(found.module, p) for p in PLANTS)
    ]
    assert not wrong, "\n".join(wrong)


def test_foreign_simulators_share_nothing_with_what_they_judge():
    simulators = {"rotorpy", "mujoco", "drone_models", "pybullet", "casadi", "scipy", "numpy"}
    reached = ("scenarios.foreign", *PLANTS)
    wrong = []
    for path in files("scenarios/foreign"):
        for found in imports(path):
            top = found.module.split(".")[0]
            if top not in sys.stdlib_module_names | simulators | {"greybox", "scenarios"}:
                wrong.append(
                    say(path, found, "a judge uses its simulator and nothing that it judges")
                )
            if top in ("greybox", "scenarios") and not any(
                within(found.module, p) for p in reached
            ):
                wrong.append(say(path, found, "a judge reaches nothing else"))
    assert not wrong, "\n".join(wrong)


def test_greybox_reaches_its_users_only_from_commands_and_inside_functions():
    wrong = []
    for path in files("greybox"):
        name = path.relative_to(ROOT / "greybox").as_posix()
        command = name == "cli.py" or name.startswith("commands/")
        for found in imports(path):
            if within(found.module, "mpc_export"):
                if not command:
                    wrong.append(
                        say(path, found, "only greybox/cli.py and greybox/commands/ may reach it")
                    )
                elif not (found.inside_function or found.typing_only):
                    wrong.append(say(path, found, "only inside a function, or for types"))
    assert not wrong, "\n".join(wrong)


def test_no_command_loads_a_user_of_greybox_before_it_is_run():
    commands = [
        ".".join(p.relative_to(ROOT).with_suffix("").parts) for p in files("greybox/commands")
    ]
    program = f"""
import importlib, sys
for name in {["greybox.cli", *commands]}:
    importlib.import_module(name)
print(*(m for m in sys.modules if m.startswith("mpc_export")))
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert not done.stdout.strip()


def test_what_is_installed_never_imports_scenarios():
    wrong = [
        say(path, found, "it is in the checkout only, what a user needs is in the packages")
        for top in ("greybox", "mpc_export")
        for path in files(top)
        for found in imports(path)
        if within(found.module, "scenarios") or within(found.module, "docs")
    ]
    assert not wrong, "\n".join(wrong)


def test_the_verifier_stands_alone():
    path = ROOT / "mpc_export" / "verify.py"
    if not path.exists():
        pytest.skip("mpc_export.verify is not there yet")
    wrong = [
        say(path, found, "it must run without the packages")
        for found in imports(path)
        if found.module.split(".")[0] in {"greybox", "mpc_export", "scenarios"}
    ]
    assert not wrong, "\n".join(wrong)


def room_of(module: str) -> str | None:
    """The room of a greybox module, or None for the package itself, the command line and what is
    not greybox."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 and parts[0] == "greybox" and parts[1] in LEVEL else None


def test_lower_rooms_do_not_import_higher_ones():
    wrong = []
    for path in files("greybox"):
        own = room_of(".".join(path.relative_to(ROOT).with_suffix("").parts))
        if own is None:
            continue
        for found in imports(path):
            if (
                found.module == "greybox"
                or within(found.module, "greybox.cli")
                or within(found.module, "greybox.commands")
            ):
                wrong.append(say(path, found, "rooms do not import the package's front door"))
            other = room_of(found.module)
            if other is None or LEVEL[other] <= LEVEL[own]:
                continue
            if own == "data" and within(found.module, PLAIN_NUMBERS):
                continue
            wrong.append(say(path, found, f"{own} stands below {other}"))
    assert not wrong, "\n".join(wrong)


def test_no_modules_import_each_other_in_a_circle():
    """Imports inside functions count: they only hide a circle. Those for types alone do not."""
    arrows = {}
    for top in ("greybox", "mpc_export", "scenarios"):
        for path in files(top):
            parts = path.relative_to(ROOT).with_suffix("").parts
            own = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
            found = {i.module for i in imports(path) if not i.typing_only}
            arrows[own] = (found & known_modules()) - {own}
    try:
        graphlib.TopologicalSorter(arrows).prepare()
    except graphlib.CycleError as error:
        pytest.fail(" imports ".join(reversed(error.args[1])))


def test_every_room_of_the_package_has_its_place_in_the_order():
    front = {"__init__", "__main__", "cli", "commands", "schemas"}
    here = {
        p.stem
        for p in (ROOT / "greybox").iterdir()
        if p.suffix == ".py" or (p / "__init__.py").exists()
    }
    assert here - front <= set(LEVEL), "say in this test where the new room stands"


@pytest.mark.parametrize("name", ["vehicle", "vehicle_parts", "vehicle_tables"])
def test_the_vehicle_file_modules_hold_only_plain_numbers(name: str):
    path = ROOT / "greybox" / "model" / f"{name}.py"
    wrong = [
        say(path, found, "it is used by greybox.data and must stay free of the model")
        for found in imports(path)
        if found.module.split(".")[0] == "casadi"
        or (room_of(found.module) not in (None, *BASE, "data", "model"))
    ]
    assert not wrong, "\n".join(wrong)


def test_importing_greybox_loads_neither_torch_nor_matplotlib():
    code = (
        "import sys, greybox; print([m for m in ('torch', 'gpytorch', 'matplotlib') if m in "
        "sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert done.stdout.strip() == "[]"
