"""python -m mpc_export.verify DIR: does a bundle still compute what it was exported from?

Checks that the files are whole; compiles c/ strictly, runs the self-test, and calls every function
from a shared library at every golden point; builds the libraries of tubes and runs their self-tests;
builds the flight code and flies it without measurements; replays python/ (rebuild) and casadi/ where
casadi is installed. Prints the largest differences, in units of each output's scale, and which parts
it verified. Exit code 0: all agree; 1: something does not, or nothing could be compared; 2: not a
bundle.

Stands alone: the standard library, and casadi and numpy for the rebuild. It imports neither greybox
nor this package. It runs the bundle's C and its rebuild.py: checksums find damage, not malice, so
verify what comes from a source you trust.
"""

from __future__ import annotations

import argparse
import csv
import ctypes
import hashlib
import importlib.util
import json
import os
import re
import shutil
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import casadi as ca

Manifest = Mapping[str, Any]
"""The manifest of a bundle, or the part of it that belongs to one function: what a stranger wrote
(greybox/schemas/manifest.json)."""
Functions = Mapping[str, "ca.Function"]
SCHEMA = "greybox.bundle/1"
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror")
C_LIMIT = {"double": 1e-10, "float": 1e-4}
"""Largest difference between C and golden vectors, in units of the output's scale: a bundle may ask
for less."""
REBUILD_LIMIT = 1e-11
"""Other versions of CasADi order sums differently."""
LARGEST_MANIFEST, LARGEST, MOST_FILES = 2**27, 500 * 2**20, 5000
"""Bytes of the manifest and of all files together, and how many of them, at most."""
SECONDS = 900.0
"""So long a compiler or a self-test may take."""
WARNED = "-Wno-unused-parameter"
"""Of generated C that older versions wrote."""
BLIND = 50
"""Samples that the flight code flies without measurements."""
OTHERS = {
    "acados": "run examples/acados_hover.py",
    "do-mpc": "run examples/do_mpc_hover.py",
    "rockit": "run examples/rockit_hover.py",
    "l4acados": "run examples/l4acados_hover.py",
    "fmu": "run examples/fmu_simulate.py",
    "crazyflie-app": "the firmware's build does that",
    "px4-module": "PX4's build does that",
    "ros2": "colcon does that",
}
"""Targets that need more than a C compiler, and what tries them."""
Point = tuple[list[list[float]], list[list[float]]]


class VerifyError(Exception):
    """Something that makes verification impossible or wrong, in one line."""


def say(text: str, *, error: bool = False) -> None:
    """Print with escapes for what a terminal would act on: names come from the bundle."""
    shown = "".join(
        c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text
    )
    print(shown, file=sys.stderr if error else sys.stdout)


def read_manifest(folder: Path) -> Manifest:
    """The manifest, checked by schema. Raises `VerifyError`."""
    try:
        path = folder / "manifest.json"
        size(path, LARGEST_MANIFEST)
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise VerifyError(f"{folder}: not a bundle ({error})") from None
    if not isinstance(manifest, dict) or manifest.get("schema") != SCHEMA:
        raise VerifyError(f"{folder}: not a bundle of this version, expected schema {SCHEMA}")
    return manifest


def size(path: Path, limit: int = LARGEST) -> int:
    """Bytes of a regular file: reading a pipe or a device may never end. Raises `VerifyError`."""
    state = path.lstat()
    if not stat.S_ISREG(state.st_mode):
        raise VerifyError(f"{path}: not a regular file")
    if state.st_size > limit:
        raise VerifyError(f"{path}: {state.st_size} bytes, at most {limit}")
    return state.st_size


def check_files(folder: Path, manifest: Manifest) -> list[str]:
    """Files of the folder that the manifest does not list. Raises `VerifyError` for what is no
    regular file (a link, a pipe), too many and too large ones."""
    there, total = [], 0
    for path in folder.rglob("*"):
        if path.is_dir() and not path.is_symlink():
            continue
        total += size(path)
        there.append(path.relative_to(folder).as_posix())
        if total > LARGEST or len(there) > MOST_FILES:
            raise VerifyError(f"{folder}: more than {LARGEST} bytes or {MOST_FILES} files")
    own = {*there} - {*manifest["files"], "manifest.json"}
    return sorted(n for n in own if not made_on_the_way(n))


def made_on_the_way(name: str) -> bool:
    """Whether a file of a bundle comes of building or running it, by its name."""
    return bool({"build", "__pycache__"} & {*PurePosixPath(name).parts[:-1]})


def check_names(manifest: Manifest) -> None:
    """Names that become paths and symbols lead nowhere else. Raises `VerifyError`."""
    for name in (manifest["name"], *(f["name"] for f in manifest["functions"])):
        if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z]\w*", name, re.ASCII):
            raise VerifyError(
                f"manifest.json: {name!r} is not the name of a bundle or of a function"
            )
    for name in manifest["files"]:
        path = PurePosixPath(name)
        if path.is_absolute() or ".." in path.parts or "\\" in name:
            raise VerifyError(f"manifest.json: {name!r} is not a file of the bundle")


def seal(manifest: Manifest) -> str:
    """Checksum of a manifest: SHA-256 of its canonical JSON without the checksum. Raises
    `ValueError` for NaN."""
    rest = {k: v for k, v in manifest.items() if k != "checksum"}
    return hashlib.sha256(
        json.dumps(rest, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
    ).hexdigest()


def changed_files(folder: Path, manifest: Manifest) -> list[str]:
    """Files that are missing or not as they were written."""
    out = [] if manifest.get("checksum") == seal(manifest) else ["manifest.json"]
    for name, digest in manifest["files"].items():
        path = folder / name
        if not path.is_file() or hashlib.sha256(path.read_bytes()).hexdigest() != digest:
            out.append(name)
    return out


def golden(folder: Path, function: Manifest) -> Iterator[Point]:
    """(arguments, results) of every golden point, each a list of columns of numbers."""
    with open(
        folder / "golden" / f"{function['name']}.csv", newline="", encoding="utf-8"
    ) as stream:
        rows = csv.reader(stream)
        next(rows)
        for row in rows:
            numbers, at = [float(v) for v in row], 0
            parts: list[list[list[float]]] = []
            for ports in (function["arguments"], function["results"]):
                parts.append([])
                for port in ports:
                    size = port["rows"] * port["columns"]
                    parts[-1].append(numbers[at : at + size])
                    at += size
            yield parts[0], parts[1]


def gap(
    function: Manifest, got: Sequence[Sequence[float]], want: Sequence[Sequence[float]]
) -> float:
    """Largest difference over the results of one call, in units of each output's scale; infinite
    where one is NaN."""
    worst = 0.0
    for port, ours, theirs in zip(function["results"], got, want, strict=True):
        for a, b in zip(ours, theirs, strict=True):
            difference = abs(a - b)
            worst = (
                max(worst, difference / port["scale"]) if difference == difference else float("inf")
            )
    return worst


def check_scales(folder: Path, manifest: Manifest) -> None:
    """The scales by which differences are judged are those of the golden results. Raises
    `VerifyError`."""
    for function in manifest["functions"]:
        largest = [1e-30] * len(function["results"])
        for _, results in golden(folder, function):
            largest = [
                max(m, *map(abs, r)) if r else m for m, r in zip(largest, results, strict=True)
            ]
        for port, own in zip(function["results"], largest, strict=True):
            if not 0 < port["scale"] <= own * (1 + 1e-9):
                raise VerifyError(
                    f"{function['name']}: damaged: scale {port['scale']:g} of {port['name']}, the "
                    f"results have {own:g}"
                )


# ---------------------------------------------------------------------------------------------- C


def find_compiler(asked: str | None) -> list[str]:
    """The one asked for, or else $CC, cc, gcc or clang, or that of the wheel `ziglang`. Raises
    `VerifyError`."""
    if asked and not shutil.which(asked):
        raise VerifyError(f"no compiler {asked}")
    for name in (asked, os.environ.get("CC"), "cc", "gcc", "clang"):
        if name and (found := shutil.which(name)):
            return [found]
    if importlib.util.find_spec("ziglang") is not None:
        return [sys.executable, "-P", "-m", "ziglang", "cc", "-fno-sanitize=undefined"]
    raise VerifyError("no C compiler: install gcc or clang, or pip install ziglang, or pass --no-c")


def run(command: Sequence[str], given: str = "") -> str:
    """Standard output of a command that is given this input. Raises `VerifyError` with its first
    complaint."""
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            check=False,
            timeout=SECONDS,
            input=given,
        )
    except subprocess.TimeoutExpired:
        raise VerifyError(f"{command[0]} did not end within {SECONDS:g} s") from None
    if done.returncode:
        said = (done.stderr or done.stdout).strip().splitlines()
        first = next((line for line in said if "error:" in line), said[0] if said else "")
        raise VerifyError(f"{Path(command[0]).name} failed with code {done.returncode}: {first}")
    return done.stdout


def build(folder: Path, manifest: Manifest, compiler: Sequence[str], work: Path) -> Path:
    """Strictly compiled shared library in `work`, after the self-test has passed. Raises
    `VerifyError`."""
    name, source = manifest["name"], folder / "c"
    objects = []
    for stem, extra in (
        (name, [WARNED]),
        (f"{name}_model", []),
        (f"{name}_selftest", []),
    ):
        objects.append(str(work / f"{stem}.o"))
        run(
            [
                *compiler,
                *STRICT,
                *extra,
                "-O1",
                "-fPIC",
                "-c",
                str(source / f"{stem}.c"),
                "-o",
                objects[-1],
            ]
        )
    program = work / "selftest"
    run([*compiler, *objects, "-o", str(program), "-lm"])
    say(f"  {run([str(program)]).strip()}")
    library = work / "model.so"
    run([*compiler, "-shared", *objects[:2], "-o", str(library), "-lm"])
    return library


class CLibrary:
    """Functions of a compiled bundle, called through their own calling convention."""

    def __init__(self, path: Path, manifest: Manifest) -> None:
        self.library = ctypes.CDLL(str(path))
        self.manifest = manifest
        self.real: type[ctypes.c_double | ctypes.c_float] = (
            ctypes.c_double if manifest["c"]["real"] == "double" else ctypes.c_float
        )
        self.integer: type[ctypes.c_longlong | ctypes.c_int] = (
            ctypes.c_longlong if manifest["c"]["integer"].startswith("long") else ctypes.c_int
        )
        abi = getattr(self.library, f"{manifest['name']}_abi")
        abi.restype = ctypes.c_uint
        if abi() != manifest["abi"]:
            raise VerifyError("the compiled library has another layout than the manifest")

    def call(self, function: Manifest, arguments: Sequence[Sequence[float]]) -> list[list[float]]:
        """Results as columns of numbers. Raises `VerifyError` where the function fails."""
        sizes = self.manifest["c"]["functions"][function["name"]]
        pointer = ctypes.POINTER(self.real)
        given = [(self.real * max(len(a), 1))(*a) for a in arguments]
        lengths = [p["rows"] * p["columns"] for p in function["results"]]
        results = [(self.real * max(n, 1))() for n in lengths]
        arg = (pointer * max(sizes["sz_arg"], 1))(*(ctypes.cast(a, pointer) for a in given))
        res = (pointer * max(sizes["sz_res"], 1))(*(ctypes.cast(r, pointer) for r in results))
        iw, w = (self.integer * max(sizes["sz_iw"], 1))(), (self.real * max(sizes["sz_w"], 1))()
        code = getattr(self.library, f"{self.manifest['name']}_{function['name']}")(
            arg, res, iw, w, 0
        )
        if code:
            raise VerifyError(f"{function['name']} returned {code}")
        return [list(r)[:n] for r, n in zip(results, lengths, strict=True)]


def verify_c(folder: Path, manifest: Manifest, compiler: Sequence[str]) -> dict[str, float]:
    """Function -> largest difference between C and golden vectors."""
    with tempfile.TemporaryDirectory(prefix="verify-") as work:
        library = CLibrary(build(folder, manifest, compiler, Path(work)), manifest)
        return {
            f["name"]: max(
                gap(f, library.call(f, given), want) for given, want in golden(folder, f)
            )
            for f in manifest["functions"]
        }


def verify_tube(folder: Path, manifest: Manifest, target: str, compiler: Sequence[str]) -> str:
    """What the self-test of a tube's library prints. Raises `VerifyError` where it does not compile
    or fails."""
    own = PurePosixPath(manifest["targets_written"][target]["folder"])
    listed = [n for n in manifest["files"] if PurePosixPath(n).parent == own and n.endswith(".c")]
    if not listed:
        raise VerifyError(f"{own}/ has no C")
    with tempfile.TemporaryDirectory(prefix="verify-") as work:
        program = str(Path(work) / "selftest")
        sources = [str(folder / n) for n in sorted(listed)]
        run([*compiler, *STRICT, WARNED, "-O1", "-o", program, *sources, "-lm"])
        return run([program])


def verify_flight(folder: Path, manifest: Manifest, compiler: Sequence[str]) -> str:
    """Builds the flight code with its bench, which flies a while without measurements. Raises
    `VerifyError` where a command is not finite or beyond its limits."""
    name, inputs, n_y = manifest["name"], manifest["inputs"], manifest["sizes"]["n_y"]
    sources = [str(folder / "c" / f"{name}{s}.c") for s in ("", "_model", "_flight", "_bench")]
    with tempfile.TemporaryDirectory(prefix="verify-") as work:
        program = str(Path(work) / "bench")
        run([*compiler, *STRICT, WARNED, "-O1", "-o", program, *sources, "-lm"])
        said = run([program, "pilot"], f"{'nan ' * n_y}0 0 1 0\n" * BLIND)
    rows = [[float(v) for v in line.split()] for line in said.splitlines()]
    if len(rows) != BLIND or any(len(row) != 1 + len(inputs) + n_y for row in rows):
        raise VerifyError(f"{len(rows)} samples, of {BLIND}")
    for row in rows:
        for port, u in zip(inputs, row[1:], strict=False):
            low, high = port.get("lower"), port.get("upper")
            if not (low is None or u >= low - 1e-6) or not (high is None or u <= high + 1e-6):
                raise VerifyError(f"command {u:g} of {port['name']} is beyond its limits")
        if not all(abs(v) < float("inf") for v in row):
            raise VerifyError("a number is not finite")
    return f"{BLIND} samples without measurements, every command within its limits"


def verify_programs(
    folder: Path, manifest: Manifest, compiler: Sequence[str]
) -> dict[str, tuple[bool, str]]:
    """Part -> whether its program passed, and what it said: tubes and the flight code."""
    found: dict[str, tuple[bool, str]] = {}
    for part in programs(manifest):
        try:
            if part == "flight code":
                said = verify_flight(folder, manifest, compiler)
            else:
                said = verify_tube(folder, manifest, part, compiler)
            found[part] = True, said.strip()
        except VerifyError as error:
            found[part] = False, str(error)
    return found


def programs(manifest: Manifest) -> list[str]:
    """Parts whose own program judges them."""
    tubes = [t for t, said in manifest["targets_written"].items() if "selftest" in said]
    return [
        *tubes,
        *(["flight code"] if f"c/{manifest['name']}_flight.c" in manifest["files"] else []),
    ]


# ----------------------------------------------------------------------------------------- casadi


def _columns(function: ca.Function, arguments: Sequence[Sequence[float]]) -> list[list[float]]:
    import casadi as ca

    given = [
        ca.reshape(ca.DM(a), *function.size_in(i)) if a else ca.DM(*function.size_in(i))
        for i, a in enumerate(arguments)
    ]
    return [[float(v) for v in ca.densify(r).nonzeros()] for r in function.call(given)]


def verify_functions(folder: Path, manifest: Manifest, functions: Functions) -> dict[str, float]:
    """Function -> largest difference between CasADi functions and golden vectors."""
    return {
        f["name"]: max(
            gap(f, _columns(functions[f["name"]], given), want) for given, want in golden(folder, f)
        )
        for f in manifest["functions"]
    }


def load_rebuild(folder: Path) -> dict[str, ca.Function]:
    """The functions of python/, with the bundle's own interpreter. Raises `VerifyError` where that
    cannot be read."""
    path = folder / "python" / "rebuild.py"
    # The source itself: what Python may have cached beside it is no part of the bundle.
    try:
        code = compile(path.read_bytes(), str(path), "exec")
    except (OSError, SyntaxError, ValueError) as error:
        raise VerifyError(
            f"{folder}: python/rebuild.py cannot be read ({type(error).__name__})"
        ) from None
    names: dict[str, Any] = {"__name__": "bundle_rebuild", "__file__": str(path)}
    exec(code, names)
    return dict(names["load"](folder / "python"))


def verify_casadi(folder: Path, manifest: Manifest) -> dict[str, dict[str, float]]:
    """Differences of the rebuild, and of the .casadi files where this CasADi wrote them; empty
    without casadi."""
    try:
        import casadi as ca
    except ImportError:
        print("  rebuild: not checked, casadi is not installed")
        return {}
    out = {"rebuild": verify_functions(folder, manifest, load_rebuild(folder))}
    if not (folder / "casadi").is_dir():
        return out
    if manifest["versions"]["casadi"] != ca.CasadiMeta.version():
        say(
            f"  casadi/: not checked, written by {manifest['versions']['casadi']}, here is "
            f"{ca.CasadiMeta.version()}"
        )
        return out
    files = {
        f["name"]: ca.Function.load(str(folder / "casadi" / f"{f['name']}.casadi"))
        for f in manifest["functions"]
    }
    return {**out, "casadi files": verify_functions(folder, manifest, files)}


# ------------------------------------------------------------------------------------------- main


def verify(folder: Path, compiler: str | None = None, *, with_c: bool = True) -> bool:
    """Verify a bundle and print what was found. Raises `VerifyError` where that cannot be done."""
    manifest = read_manifest(folder)
    check_names(manifest)
    say(f"{folder}: {manifest['name']}, {manifest['model']['name']}")
    unknown = check_files(folder, manifest)
    if unknown:
        say(f"  not of the export: {', '.join(unknown[:20])}")
    changed = changed_files(folder, manifest)
    check_scales(folder, manifest)
    if changed:
        say(f"  changed since the export: {', '.join(changed[:20])}")
    found: dict[str, tuple[dict[str, float], float]] = {}
    programs_found: dict[str, tuple[bool, str]] = {}
    if with_c and (manifest["c"] or programs(manifest)):
        cc = find_compiler(compiler)
        if manifest["c"]:
            limit = min(manifest["tolerance"], C_LIMIT[manifest["c"]["real"]])
            found["C"] = (verify_c(folder, manifest, cc), limit)
        programs_found = verify_programs(folder, manifest, cc)
    found |= {k: (v, REBUILD_LIMIT) for k, v in verify_casadi(folder, manifest).items()}
    parts: dict[str, bool] = {}
    for what, (gaps, limit) in found.items():
        name = max(gaps, key=lambda n: gaps[n])
        parts[what] = gaps[name] <= limit
        say(
            f"  {what}: largest difference {gaps[name]:.2g} of the output's scale, in {name} "
            f"(limit {limit:g}): {'passed' if parts[what] else 'FAILED'}"
        )
    for what, (passed, told) in programs_found.items():
        parts[what] = passed
        shown = told.replace("\n", "\n    ")
        say(f"  {what}: {'passed' if passed else 'FAILED'}: {shown}")
    summary(folder, manifest, parts, with_c=with_c)
    if changed or unknown:
        say("  FAILED: files were changed or added since the export")
    return not changed and not unknown and bool(parts) and all(parts.values())


def summary(folder: Path, manifest: Manifest, parts: Mapping[str, bool], *, with_c: bool) -> None:
    """Say which parts were verified, which failed, and which were not compared and why."""
    if not parts:
        say("  nothing was compared: it needs a C compiler or casadi")
    for word, passed in (("verified", True), ("FAILED", False)):
        if named := [what for what, as_wanted in parts.items() if as_wanted is passed]:
            say(f"  {word}: {', '.join(named)}")
    own = [*(["C"] if manifest["c"] else []), *programs(manifest)]
    left = {} if with_c else dict.fromkeys(own, "--no-c")
    left["rebuild"] = "casadi is not installed"
    if (folder / "casadi").is_dir():
        left["casadi files"] = "they are for another CasADi, or it is not installed"
    left |= {t: OTHERS[t] for t in manifest["targets_written"] if t in OTHERS}
    for part, why in left.items():
        if part not in parts:
            say(f"  not verified: {part} ({why})")


def main(argv: Sequence[str] | None = None) -> int:
    """Command line. Returns the exit code."""
    asked = "Does a bundle still compute what it was exported from?"
    parser = argparse.ArgumentParser(prog="python -m mpc_export.verify", description=asked)
    parser.add_argument(
        "folder", metavar="DIR", type=Path, help="bundle that `greybox export` wrote"
    )
    parser.add_argument(
        "--cc",
        metavar="COMPILER",
        help="C compiler (default: $CC, cc, gcc, clang, the wheel ziglang)",
    )
    parser.add_argument(
        "--no-c", action="store_true", help="check the rebuild only, without a C compiler"
    )
    arguments = parser.parse_args(argv)
    try:
        read_manifest(arguments.folder)
    except VerifyError as error:
        say(f"verify: {error}", error=True)
        return 2
    try:
        return 0 if verify(arguments.folder, arguments.cc, with_c=not arguments.no_c) else 1
    except VerifyError as error:
        say(f"verify: {error}", error=True)
    except Exception as error:  # damage shows wherever the bundle is read
        say(f"verify: {arguments.folder}: damaged ({type(error).__name__}: {error})", error=True)
    return 1


if __name__ == "__main__":
    sys.exit(main())
