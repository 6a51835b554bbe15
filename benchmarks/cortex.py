"""Runs generated C on an emulated Cortex-M4F and reports what it costs there: flash, RAM and
executed instructions.

The cross compiler is arm-none-eabi-gcc, the machine QEMU's `mps2-an386` (Cortex-M4 with the
single-precision FPU) or `mps2-an500` (Cortex-M7), both Debian packages (gcc-arm-none-eabi, libnewlib-arm-none-eabi,
qemu-system-arm). Instructions are counted, never cycles: with `-icount shift=6` every instruction
takes 64 ns of the machine's time, of which SysTick counts 40 ns each (25 MHz). The program prints
bits of floats over semihosting; nothing of stdio is linked. Flash is text, constants and initial
data of the whole image, with what it takes from the libraries; RAM is data, the functions' work
space and the stack at its deepest.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from greybox.errors import GreyboxError, ModelError
from greybox.symbolic import FloatArray
from mpc_export.c_code import STRICT_FLAGS, CFunction, CSource
from mpc_export.template import filled


@dataclass(frozen=True, kw_only=True)
class Part:
    """A processor: the compiler's flags and QEMU's machine."""

    flags: tuple[str, ...]
    machine: str


M4F = Part(
    flags=("-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard"),
    machine="mps2-an386",
)
M7F = Part(
    flags=("-mcpu=cortex-m7", "-mthumb", "-mfpu=fpv5-sp-d16", "-mfloat-abi=hard"),
    machine="mps2-an500",
)
CPU_FLAGS = M4F.flags
TUNED = (
    "-O2",
    "-ffp-contract=fast",
    "-fno-math-errno",
    "-ffunction-sections",
    "-fdata-sections",
)
FLAGS = (*CPU_FLAGS, *STRICT_FLAGS, *TUNED)
SHIFT = 6
"""An instruction takes 2^SHIFT ns; programs that count longer runs choose less."""
DOUBLE_HELPERS = re.compile(r"__aeabi_(?:d\w+|cd\w+|f2d|[uil]+2d)$|__(?:\w+df\w*)$")
"""Names of library routines that compute with doubles."""
TOOLS = ("arm-none-eabi-gcc", "arm-none-eabi-size", "arm-none-eabi-nm", "qemu-system-arm")


class CortexError(GreyboxError, RuntimeError):
    """The cross compiler or the emulator failed."""


@dataclass(frozen=True, kw_only=True)
class CortexRun:
    """What one image costs: bytes of flash; bytes of RAM, `stack` of which is the stack at its
    deepest in any function; per function the instructions of one call (call and clock taken off)
    and its results, column by column; `loop` is what the count makes of 2001 instructions."""

    flash: int
    ram: int
    stack: int
    instructions: Mapping[str, int]
    results: Mapping[str, Sequence[FloatArray]]
    loop: int


def missing_tool() -> str | None:
    """The first of the tools that is not installed, or None."""
    return next((t for t in TOOLS if shutil.which(t) is None), None)


def double_helpers(source: CSource, folder: Path) -> list[str]:
    """Library routines for doubles that the object file of a float build calls; none is what is
    wanted."""
    out = folder / f"{source.prefix}.o"
    _call(["arm-none-eabi-gcc", *FLAGS, "-c", str(source.source), "-o", str(out)])
    names = _call(["arm-none-eabi-nm", "-u", str(out)]).split()
    return sorted(n for n in names if DOUBLE_HELPERS.fullmatch(n))


def run_on_cortex(
    source: CSource, calls: Mapping[str, Sequence[FloatArray]], folder: Path
) -> CortexRun:
    """Builds an image of `source` (float) and calls each named function once with its arguments
    (dense, any shape).

    Raises `ModelError` for a double build or an unknown function, `CortexError` where a tool fails
    or a call returns something else than 0.
    """
    if source.real != "float":
        raise ModelError(
            "the Cortex-M4F computes in float", got=source.real, fix='write_c(..., real="float")'
        )
    known = {f.name: f for f in source.functions}
    for name in calls:
        if name not in known:
            raise ModelError(f"{source.prefix} has no function {name}", expected=", ".join(known))
    chosen = [known[name] for name in calls]
    harness, image = (folder / f"{source.prefix}_{n}" for n in ("cortex.c", "cortex.elf"))
    harness.write_text(_harness(source, chosen, calls), encoding="utf-8")
    # The harness needs GNU C for its few lines of assembler.
    objects = [
        _compiled(source.source, (*FLAGS, f"-I{source.header.parent}"), folder),
        _compiled(harness, (*OWN, *CPU_FLAGS, f"-I{source.header.parent}"), folder),
    ]
    text, flash, static = _run(objects, image, M4F, SHIFT)
    return _read(text, chosen, flash, static)


OWN = ("-std=gnu99", "-Wall", "-Wextra", "-Werror", "-O2")
"""Flags of harnesses."""


def _compiled(path: Path, flags: Sequence[str], folder: Path) -> str:
    out = str(folder / f"{path.stem}.o")
    _call(["arm-none-eabi-gcc", *flags, "-c", str(path), "-o", out])
    return out


def _run(objects: Sequence[str], image: Path, part: Part, shift: int) -> tuple[str, int, int]:
    """(What the program of these objects printed, bytes of flash, bytes of static RAM)."""
    script = image.with_suffix(".ld")
    script.write_text(filled("cortex/link.ld"), encoding="utf-8")
    link = [
        "-nostartfiles",
        "--specs=nano.specs",
        "--specs=nosys.specs",
        "-Wl,--gc-sections",
        "-T",
        str(script),
    ]
    _call(["arm-none-eabi-gcc", *part.flags, *link, "-o", str(image), *objects, "-lm"])
    sizes = _call(["arm-none-eabi-size", str(image)]).splitlines()[1].split()
    text, data, bss = (int(v) for v in sizes[:3])
    machine = ["qemu-system-arm", "-M", part.machine, "-nographic"]
    machine += ["-monitor", "none", "-serial", "none"]
    machine += ["-semihosting-config", "enable=on,target=native"]
    machine += ["-icount", f"shift={shift}", "-kernel", str(image)]
    return _call(machine, timeout=600), text + data, data + bss


@dataclass(frozen=True, kw_only=True)
class FlightRun:
    """A flight of a tube MPC's C library on a part: bytes of flash (code and constants; the
    recording taken off), static RAM and the stack at its deepest; instructions (samples,) of every
    call, commands (samples, n_u), bits that the calls said (samples,)."""

    flash: int
    ram: int
    stack: int
    instructions: FloatArray
    commands: FloatArray
    said: FloatArray


def fly_on_cortex(
    files: Sequence[Path],
    name: str,
    measured: FloatArray,
    reference: tuple[FloatArray, FloatArray, FloatArray],
    part: Part,
    dt: float,
) -> FlightRun:
    """Flies the library NAME_tube (its C files, in float) through measurements (samples, n_y), NaN
    where nothing is measured, a sample of dt [s] a call.

    reference: place (4,) to start at, paths (samples, stages + 1, 10) as NAME_tube_path has them,
    and planes (stages + 1, planes, 4), the same at every sample. Raises `CortexError` where a tool fails.
    """
    folder, shift = files[0].parent, 1
    place, paths, planes = reference
    harness, image = folder / f"{name}_cortex.c", folder / f"{name}_cortex.elf"
    nan = '__builtin_nanf("")'
    rows = _rows(measured).replace("nanf", nan)
    way = ",\n".join(
        f"{{{', '.join(_point(q) for q in stages)}}}" for stages in np.asarray(paths, dtype=float)
    )
    harness.write_text(
        filled(
            "cortex/tube.c",
            start=filled("cortex/start.c", shift=shift),
            NAME=name,
            UPPER=name.upper(),
            samples=len(measured),
            measured=rows,
            path=way,
            planes=_floats(np.ravel(planes)),
            place=_floats(place),
            dt=f"{dt!r}f",
        ),
        encoding="utf-8",
    )
    strict = (*part.flags, "-std=c99", *TUNED, "-O3")
    objects = [_compiled(path, strict, folder) for path in files]
    objects.append(_compiled(harness, (*OWN, *part.flags, f"-I{folder}"), folder))
    text, flash, static = _run(objects, image, part, shift)
    said: dict[str, list[int]] = {}
    for line in text.splitlines():
        if len(line.split()) == 2:
            said.setdefault(line.split()[0], []).append(int(line.split()[1], 16))
    if len(said.get("instructions", [])) != len(measured):
        raise CortexError("the emulated program did not finish", got=text[-200:])
    stack = said["stack"][0]
    commands = np.array(said["u"], dtype=np.uint32).view(np.float32).reshape(len(measured), -1)
    return FlightRun(
        flash=flash - 4 * (measured.size + paths.size + planes.size),
        ram=static + stack,
        stack=stack,
        instructions=np.array(said["instructions"], dtype=float),
        commands=commands.astype(float),
        said=np.array(said["said"], dtype=float),
    )


def _floats(values: Iterable[float]) -> str:
    return ", ".join(f"{float(np.float32(v))!r}f" for v in values)


def _rows(values: FloatArray) -> str:
    return ",\n".join(f"{{{_floats(row)}}}" for row in values)


def _point(q: FloatArray) -> str:
    """A NAME_tube_path from position, velocity, acceleration and yaw (10,)."""
    blocks = ", ".join(f"{{{_floats(q[i : i + 3])}}}" for i in (0, 3, 6))
    return f"{{{blocks}, {_floats(q[9:])}}}"


def _harness(
    source: CSource, chosen: Sequence[CFunction], calls: Mapping[str, Sequence[FloatArray]]
) -> str:
    data, lines = [], []
    for k, f in enumerate(chosen):
        given = [np.asarray(v, dtype=np.float64).ravel(order="F") for v in calls[f.name]]
        want = [p.nnz for p in f.inputs]
        if [v.size for v in given] != want:
            raise ModelError(
                f"{f.name}: arguments of sizes {[v.size for v in given]}", expected=str(want)
            )
        names = []
        for i, v in enumerate(given):
            names.append(f"in{k}_{i}")
            values = ", ".join(f"{float(np.float32(x))!r}f" for x in v) or "0.0f"
            data.append(f"static const {source.prefix}_real {names[-1]}[] = {{{values}}};")
        data.append(f"static const {source.prefix}_real* inputs{k}[] = {{{', '.join(names)}}};")
        data.append(
            f"static const int sizes{k}[] = {{{', '.join(str(p.nnz) for p in f.outputs)}}};"
        )
        lines.append("  paint();")
        lines.append(f"  run({f.symbol}, inputs{k}, {len(names)}, sizes{k}, {len(f.outputs)});")
        lines.append('  say("stack", deepest());')
    return filled(
        "cortex/harness.c",
        start=filled("cortex/start.c", shift=SHIFT),
        prefix=source.prefix,
        data="\n".join(data),
        calls="\n".join(lines),
        result=max(sum(p.nnz for p in f.outputs) for f in chosen),
        **{k: max(1, *(getattr(f, f"sz_{k}") for f in chosen)) for k in ("w", "iw", "arg", "res")},
    )


def _read(text: str, chosen: Sequence[CFunction], flash: int, static: int) -> CortexRun:
    words = [
        (line.split()[0], int(line.split()[1], 16))
        for line in text.splitlines()
        if len(line.split()) == 2
    ]
    by_name: dict[str, list[int]] = {}
    for name, value in words:
        by_name.setdefault(name, []).append(value)
    if len(by_name.get("stack", [])) != len(chosen) or any(by_name["status"]):
        raise CortexError(
            "the emulated program did not finish",
            got=text[-200:],
            fix="look at the image in a debugger",
        )
    values = np.array(by_name["value"], dtype=np.uint32).view(np.float32)
    results: dict[str, Sequence[FloatArray]] = {}
    at = 0
    for f in chosen:
        found = []
        for port in f.outputs:
            found.append(values[at : at + port.nnz].astype(np.float64))
            at += port.nnz
        results[f.name] = found
    overhead = by_name["empty"][0]
    stack = max(by_name["stack"])
    return CortexRun(
        flash=flash,
        ram=static + stack,
        stack=stack,
        results=results,
        loop=by_name["loop"][0],
        instructions={f.name: n - overhead for f, n in zip(chosen, by_name["instructions"])},
    )


def _call(command: Sequence[str], timeout: float = 300) -> str:
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            check=False,
            timeout=timeout,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise CortexError(f"{command[0]} did not run: {error}") from None
    if done.returncode:
        lines = (done.stderr or done.stdout).strip().splitlines()
        raise CortexError(f"{Path(command[0]).name} failed: {' | '.join(lines[:3])}")
    # Semihosting writes to the emulator's console, which is its standard error.
    return done.stdout + (done.stderr if "qemu" in command[0] else "")
