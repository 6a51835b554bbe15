"""Runs generated C on an emulated Cortex-M4F and reports what it costs there: flash, RAM and executed instructions.

The cross compiler is arm-none-eabi-gcc, the machine QEMU's `mps2-an386` (Cortex-M4 with the single-precision FPU), both
Debian packages (gcc-arm-none-eabi, libnewlib-arm-none-eabi, qemu-system-arm). Instructions are counted, never cycles:
with `-icount shift=6` every instruction takes 64 ns of the machine's time, of which SysTick counts 40 ns each (25 MHz).
The program prints bits of floats over semihosting; nothing of stdio is linked. Flash is text, constants and initial
data of the whole image, with what it takes from the libraries; RAM is data, the functions' work space and the stack at
its deepest.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from greybox.errors import GreyboxError, ModelError
from greybox.symbolic import FloatArray
from mpc_export.c_code import STRICT_FLAGS, CFunction, CSource

CPU_FLAGS = ("-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard")
FLAGS = (
    *CPU_FLAGS,
    *STRICT_FLAGS,
    "-O2",
    "-ffp-contract=fast",
    "-fno-math-errno",
    "-ffunction-sections",
    "-fdata-sections",
)
DOUBLE_HELPERS = re.compile(r"__aeabi_(?:d\w+|cd\w+|f2d|[uil]+2d)$|__(?:\w+df\w*)$")
"""Names of library routines that compute with doubles."""
TOOLS = ("arm-none-eabi-gcc", "arm-none-eabi-size", "arm-none-eabi-nm", "qemu-system-arm")

_LINKER = """\
MEMORY { FLASH (rx) : ORIGIN = 0x00000000, LENGTH = 1M  RAM (rwx) : ORIGIN = 0x20000000, LENGTH = 256K }
ENTRY(start)
SECTIONS {
  .text : { KEEP(*(.vectors)) *(.text*) *(.rodata*) *(.ARM.exidx*) } > FLASH
  .data : { data_start = .; *(.data*) data_end = .; } > RAM AT > FLASH
  data_load = LOADADDR(.data);
  .bss : { bss_start = .; *(.bss*) *(COMMON) . = ALIGN(8); bss_end = .; } > RAM
  stack_top = ORIGIN(RAM) + LENGTH(RAM);
}
"""

_HARNESS = """\
#include <stdint.h>
#include "@prefix@.h"

extern uint32_t data_start[], data_end[], data_load[], bss_start[], bss_end[], stack_top[];
int main(void);
void start(void);
void start(void) {
  uint32_t *to = data_start, *from = data_load;
  *(volatile uint32_t*)0xE000ED88 |= 0xFu << 20; /* the FPU on */
  __asm__ volatile ("dsb; isb");
  while (to < data_end) *to++ = *from++;
  for (to = bss_start; to < bss_end; ++to) *to = 0;
  main();
  for (;;) { }
}
static void halt(void) { for (;;) { } }
typedef void (*handler)(void);
__attribute__((section(".vectors"), used)) static const handler vectors[16] = {
  (handler)stack_top, start, halt, halt, halt, halt, halt, 0, 0, 0, 0, halt, halt, 0, halt, halt };

static int host(int operation, const void* argument) {
  register int r0 __asm__("r0") = operation;
  register const void* r1 __asm__("r1") = argument;
  __asm__ volatile ("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
  return r0;
}
static void say(const char* word, uint32_t value) {
  char text[40];
  int n = 0, i;
  while (word[n]) { text[n] = word[n]; ++n; }
  text[n++] = ' ';
  for (i = 28; i >= 0; i -= 4) text[n++] = "0123456789abcdef"[(value >> i) & 15];
  text[n++] = '\\n';
  text[n] = 0;
  host(0x04, text);
}
#define TICK ((volatile uint32_t*)0xE000E010)
static uint32_t ticks(void) { return TICK[2]; }
/* 40 ns a tick, 64 ns an instruction. */
static uint32_t instructions(uint32_t from, uint32_t to) { return (((from - to) & 0xFFFFFFu)*5u + 4u)/8u; }
#define PAINT 0xA5A5A5A5u
static void paint(void) {
  volatile uint32_t *p = bss_end, *here;
  __asm__ volatile ("mov %0, sp" : "=r"(here));
  while (p < here - 16) *p++ = PAINT;
}
static uint32_t deepest(void) {
  volatile uint32_t* p = bss_end;
  while (*p == PAINT) ++p;
  return (uint32_t)((char*)stack_top - (char*)p);
}
typedef int (*function)(const @prefix@_real**, @prefix@_real**, @prefix@_int*, @prefix@_real*, int);
static int nothing(const @prefix@_real** arg, @prefix@_real** res, @prefix@_int* iw, @prefix@_real* w, int mem) {
  (void)arg; (void)res; (void)iw; (void)w;
  return mem;
}
@data@
static @prefix@_real w[@w@];
static @prefix@_int iw[@iw@];
static const @prefix@_real* arg[@arg@];
static @prefix@_real* res[@res@];
static @prefix@_real result[@result@];

static void run(function volatile f, const @prefix@_real** inputs, int n_in, const int* sizes, int n_out) {
  uint32_t from, to;
  union { @prefix@_real real; uint32_t bits; } word;
  int i, k = 0;
  for (i = 0; i < n_in; ++i) arg[i] = inputs[i];
  for (i = 0; i < n_out; ++i) { res[i] = result + k; k += sizes[i]; }
  from = ticks();
  i = f(arg, res, iw, w, 0);
  to = ticks();
  say("status", (uint32_t)i);
  say("instructions", instructions(from, to));
  for (i = 0; i < k; ++i) { word.real = result[i]; say("value", word.bits); }
}

int main(void) {
  uint32_t from, to;
  function volatile empty = nothing;
  static const uint32_t leave[2] = {0x20026, 0};
  TICK[1] = 0xFFFFFFu; TICK[2] = 0; TICK[0] = 5;
  from = ticks();
  __asm__ volatile ("mov r3, #1000\\n1: subs r3, #1\\n bne 1b" ::: "r3", "cc");
  to = ticks();
  say("loop", instructions(from, to)); /* 2001 instructions and those that read the clock */
  from = ticks();
  empty(arg, res, iw, w, 0);
  to = ticks();
  say("empty", instructions(from, to));
@calls@
  host(0x20, leave);
  return 0;
}
"""


class CortexError(GreyboxError, RuntimeError):
    """The cross compiler or the emulator failed."""


@dataclass(frozen=True, kw_only=True)
class CortexRun:
    """What one image costs: bytes of flash; bytes of RAM, `stack` of which is the stack at its deepest in any function;
    per function the instructions of one call (call and clock taken off) and its results, column by column; `loop` is what
    the count makes of 2001 instructions."""

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
    """Library routines for doubles that the object file of a float build calls; none is what is wanted."""
    out = folder / f"{source.prefix}.o"
    _call(["arm-none-eabi-gcc", *FLAGS, "-c", str(source.source), "-o", str(out)])
    names = _call(["arm-none-eabi-nm", "-u", str(out)]).split()
    return sorted(n for n in names if DOUBLE_HELPERS.fullmatch(n))


def run_on_cortex(
    source: CSource, calls: Mapping[str, Sequence[FloatArray]], folder: Path
) -> CortexRun:
    """Builds an image of `source` (float) and calls each named function once with its arguments (dense, any shape).

    Raises `ModelError` for a double build or an unknown function, `CortexError` where a tool fails or a call returns
    something else than 0.
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
    harness, script, image = (
        folder / f"{source.prefix}_{n}" for n in ("cortex.c", "cortex.ld", "cortex.elf")
    )
    harness.write_text(_harness(source, chosen, calls), encoding="utf-8")
    script.write_text(_LINKER, encoding="utf-8")
    link = [
        "-nostartfiles",
        "--specs=nano.specs",
        "--specs=nosys.specs",
        "-Wl,--gc-sections",
        "-T",
        str(script),
    ]
    # The harness needs GNU C for its few lines of assembler.
    objects = []
    for path, flags in (
        (source.source, FLAGS),
        (harness, (*CPU_FLAGS, "-std=gnu99", "-Wall", "-Wextra", "-Werror", "-O2")),
    ):
        objects.append(str(folder / f"{path.stem}.o"))
        _call(
            [
                "arm-none-eabi-gcc",
                *flags,
                f"-I{source.header.parent}",
                "-c",
                str(path),
                "-o",
                objects[-1],
            ]
        )
    _call(["arm-none-eabi-gcc", *CPU_FLAGS, *link, "-o", str(image), *objects, "-lm"])
    sizes = _call(["arm-none-eabi-size", str(image)]).splitlines()[1].split()
    text, data, bss = (int(v) for v in sizes[:3])
    machine = [
        "qemu-system-arm",
        "-M",
        "mps2-an386",
        "-nographic",
        "-monitor",
        "none",
        "-serial",
        "none",
    ]
    machine += [
        "-semihosting-config",
        "enable=on,target=native",
        "-icount",
        "shift=6",
        "-kernel",
        str(image),
    ]
    return _read(_call(machine, timeout=60), chosen, text + data, data + bss)


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
    parts = {
        "prefix": source.prefix,
        "data": "\n".join(data),
        "calls": "\n".join(lines),
        "result": str(max(sum(p.nnz for p in f.outputs) for f in chosen)),
        **{
            k: str(max(1, *(getattr(f, f"sz_{k}") for f in chosen)))
            for k in ("w", "iw", "arg", "res")
        },
    }
    text = _HARNESS
    for key, value in parts.items():
        text = text.replace(f"@{key}@", value)
    return text


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
