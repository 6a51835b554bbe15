"""A bundle may have any name that C takes, also one that stands in its own templates: what is refused
is said in one line, and everything else compiles."""

from __future__ import annotations

import functools
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest

import mpc_export
from greybox.cli import main
from greybox.errors import ModelError
from greybox.residual.files import save_model
from mpc_export.bundle import write_bundle
from mpc_export.c_names import HEADERS, check_name, renamed
from mpc_export.targets import ONBOARD
from tests.mpc_export import cases

ROOT = Path(mpc_export.__file__).parent
PLAIN = "zq9"
"""A name that stands nowhere else."""
HOSTILE = (
    "tube_model",
    *(pytest.param(n, marks=pytest.mark.slow) for n in ("tube", "filter", "N", "sin")),
)
TARGETS = ("c", "casadi", "tube", "tube-linear", *ONBOARD)
_places = tempfile.TemporaryDirectory(prefix="names-")


@functools.cache
def exported(name: str) -> Path:
    targets = TARGETS if name == name.lower() else ("c", "tube", "tube-linear")
    place = Path(_places.name) / name / "box"
    with_ = ("pilot",)
    write_bundle(
        cases.disturbed(), place, name=name, targets=targets, with_=with_, real="float", horizon=3
    )
    return place


def texts(folder: Path) -> dict[str, str]:
    """What is written by name: C, C++, builds and READMEs."""
    kinds = (".c", ".h", ".cpp", ".hpp", ".txt", ".md", ".xml", ".yaml", ".in", ".cmake", "")
    return {
        p.relative_to(folder).as_posix(): p.read_text()
        for p in folder.rglob("*")
        if p.is_file() and p.suffix in kinds and "LICENSES" not in p.parts
    }


def words(text: str) -> list[str]:
    return re.findall(r"\w+", re.sub(r"\\\n", "", text))


def code(text: str) -> list[str]:
    """Words outside of comments and strings, with those that CasADi's macro puts together."""
    own = re.sub(r"/\*.*?\*/|//[^\n]*|\"(?:\\.|[^\"\\\n])*\"", " ", text, flags=re.DOTALL)
    pasted = [f"{PLAIN}_{w}" for w in re.findall(r"CASADI_PREFIX\((?!ID\b)(\w+)\)", own)]
    return [w for w in [*words(own), *pasted] if w != f"{PLAIN}_"]


def of_name(text: str, name: str) -> str:
    """What was written for PLAIN, as it is for a name; the Class of C++ among it."""
    camel = "".join(part.capitalize() for part in name.split("_"))
    text = text.replace(PLAIN.upper(), name.upper()).replace(PLAIN.capitalize(), camel)
    return text.replace(PLAIN, name)


def identifiers() -> set[str]:
    """Every identifier of the templates, of the controller and of what is generated."""
    sources = [p for p in ROOT.rglob("*") if p.suffix in (".c", ".h", ".cpp", ".hpp", ".txt")]
    found = {w for p in sources for w in words(p.read_text())}
    found |= {w for p in exported(PLAIN).rglob("*.[ch]") for w in words(p.read_text())}
    whole = {w for w in found if re.match("[A-Za-z]", w) and not re.search(PLAIN, w, re.I)}
    return whole | {"_".join(w.split("_")[:k]) for w in whole for k in range(1, w.count("_") + 1)}


def accepted(names: set[str]) -> list[str]:
    out = []
    for name in sorted(names):
        try:
            out.append(check_name(name))
        except ModelError:
            continue
    return out


@functools.cache
def declared() -> set[str]:
    """What the headers that our C includes declare and define; empty without gcc."""
    if shutil.which("gcc") is None:
        return set()
    heads = "".join(f"#include <{h}.h>\n" for h in ("math", "stdio", "stdlib", "string", "stdint"))
    told = ""
    for flags in ((), ("-dM",)):
        command = ["gcc", "-std=gnu17", "-E", "-P", *flags, "-"]
        told += subprocess.run(
            command, input=heads, capture_output=True, text=True, check=True
        ).stdout
    return set(words(told))


def together() -> dict[str, tuple[set[str], set[str]]]:
    """Folder -> words of the name and other words of what may be compiled together: its own files,
    and, on board, the headers of c/."""
    found: dict[str, tuple[set[str], set[str]]] = {}
    there = texts(exported(PLAIN))
    for folder in {path.split("/")[0] for path in there if path.endswith(".c")}:
        own, others = set[str](), set(declared())
        for path, text in there.items():
            at, kind = path.split("/")[0], Path(path).suffix
            included = kind == ".h" and at == "c" and not folder.startswith("tube")
            if included or (at == folder and kind in (".c", ".h", ".cpp", ".hpp")):
                every = set(code(text))
                named = {w for w in every if PLAIN in w.lower()}
                own, others = own | named, others | (every - named)
        found[folder] = own - {PLAIN, PLAIN.upper()}, others
    return found


def test_no_name_makes_two_things_of_an_export_one():
    """Nor one of it and one of the C library."""
    groups = together()
    assert {*groups} == {"c", "tube", "tube_linear", "crazyflie", "px4"}
    candidates = accepted(identifiers() | declared())
    assert len(candidates) > 2000 and {"tube", "filter", "free", "main", "NX"} <= {*candidates}
    for own, others in groups.values():
        every = "\n".join(sorted(own))
        for name in candidates:
            made = {*of_name(every, name).splitlines()}
            assert len(made) == len(own), name
            assert not others & made, name


@pytest.mark.parametrize("name", HOSTILE)
def test_a_name_changes_nothing_but_the_name(name):
    there = texts(exported(name))
    plain = texts(exported(PLAIN))
    plain = {of_name(path, name): text for path, text in plain.items()}
    assert {*there} <= {*plain} and any(path.startswith("tube/") for path in there)
    for path, text in there.items():
        short = len(name) <= 9 or not path.endswith("_app.c")  # a log group has nine letters
        if short and path.endswith((".c", ".h", ".cpp", ".hpp", ".txt")):
            assert words(text) == words(of_name(plain[path], name)), path


@pytest.mark.parametrize("name", HOSTILE)
def test_it_compiles_and_links_without_a_warning(name, tmp_path):
    if shutil.which("gcc") is None:
        pytest.skip("C compiler is not installed")
    folder = exported(name)
    flags = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O0")
    c = [folder / "c" / f"{name}{part}.c" for part in ("", "_model", "_selftest")]
    tubes = [sorted((folder / own).glob("*.c")) for own in ("tube", "tube_linear")]
    for sources in (c, *tubes):
        out = tmp_path / "program"
        command = ["gcc", *flags, *map(str, sources), "-lm", "-o", str(out)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (0, "")
        told = subprocess.run([out], capture_output=True, text=True, check=False)
        assert told.returncode == 0, told.stdout


def test_no_line_of_c_is_too_long():
    for path, text in texts(exported(PLAIN)).items():
        if path.endswith((".c", ".h")):
            assert max(map(len, text.splitlines())) <= 125, path
    for source in [*ROOT.rglob("*.[ch]"), *ROOT.rglob("*.[ch]pp")]:
        assert max(map(len, source.read_text().splitlines())) <= 125, source.name


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("int", "a word of C"),
        ("float", "a word of C"),
        ("xor", "a word of C"),
        ("stdio", "a header of the system"),
        ("Features", "a header of the system"),
        ("debug", "taken in C builds"),
        ("m", "taken in C builds"),
        ("casadi_x", "not a C identifier"),
        ("a b", "not a C identifier"),
        ("größe", "not a C identifier"),
    ],
)
def test_what_c_and_its_builds_take_is_refused_in_one_line(tmp_path, capsys, name, why):
    save_model(cases.physics(), tmp_path / "model.json")
    arguments = [
        "export",
        str(tmp_path / "model.json"),
        "--out",
        str(tmp_path / "box"),
        "--even-so",
    ]
    assert main([*arguments, "--name", name]) == 2
    said = capsys.readouterr().err
    assert why in said and len(said.strip().splitlines()) == 1


@pytest.mark.parametrize("folder", ["export", "test", "math", "mine"])
def test_a_folder_with_a_taken_name_gives_a_free_one(tmp_path, folder):
    written = write_bundle(cases.physics(), tmp_path / folder, targets=("casadi",))
    assert written.name == (folder if folder == "mine" else f"{folder}_model")


def test_no_name_of_a_header_that_the_system_includes_is_taken(tmp_path):
    if shutil.which("gcc") is None:
        pytest.skip("C compiler is not installed")
    used = ("math", "stdio", "stdlib", "string", "stdint", "stdbool", "stddef", "float")
    heads = "".join(f"#include <{h}.h>\n" for h in used)
    told = subprocess.run(
        ["gcc", "-std=gnu17", "-M", "-x", "c", "-"],
        input=heads,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    direct = {
        p.rsplit("/", 1)[1][:-2] for p in told.split() if re.fullmatch(r"\S*/include/\w+\.h", p)
    }
    assert {"math", "features"} <= direct <= HEADERS


def test_what_merely_holds_a_name_is_not_renamed():
    text = "tube_model_int a; craft_tube_model_int b; tube_models; tube_model_; x.tube_model_y"
    assert renamed(text, "tube_model_", "tube_tube_model_") == (
        "tube_tube_model_int a; craft_tube_model_int b; tube_models; tube_model_; "
        "x.tube_tube_model_y"
    )
