"""Fenced blocks of the pages, and how each kind is executed.

python    run top to bottom, one namespace and one folder per page
console   lines that begin with "$ " (and lines after a trailing backslash) are commands: one bash with `set -eo pipefail`
          runs them in the page's folder, the commands of this Python first in PATH. All other lines
          are output that must come, in this order: blanks count as one, numbers agree within 5 % or
          one in their last decimal, "..." stands for anything
toml      parsed; one with the schema of vehicle files is read as one
json      parsed
c         a file that compiles (where there is a compiler), with the headers of the bundles that the page exported before
text      a sketch, never checked
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

from greybox.model.vehicle import Vehicle

ROOT = Path(__file__).resolve().parents[2]
LANGUAGES = ("python", "console", "toml", "json", "c", "text")
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


def name_of(page: Path) -> str:
    """Where a page stands in the repository, "docs/fit.md"."""
    return page.relative_to(ROOT).as_posix()


_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?")


@dataclass(frozen=True)
class Block:
    """One fenced block: its language ("" where none is said), its text and the line of the page on
    which the text begins."""

    language: str
    text: str
    line: int


def blocks(page: str) -> list[Block]:
    """The fenced blocks of a page in order. Raises `ValueError` for a fence that is not closed."""
    found: list[Block] = []
    language: str | None = None
    start, body = 0, []
    for number, line in enumerate(page.splitlines(), start=1):
        if not line.startswith("```"):
            body.append(line)
        elif language is None:
            language, start, body = line[3:].strip(), number + 1, []
        else:
            found.append(Block(language, "".join(f"{text}\n" for text in body), start))
            language = None
    if language is not None:
        raise ValueError(f"the fence before line {start} is never closed")
    return found


def commands_and_output(text: str) -> tuple[str, list[str]]:
    """The script of a console block and the lines of output that it shows."""
    script, shown, continued = [], [], False
    for line in text.splitlines():
        if line.startswith("$ ") or continued:
            command = line.removeprefix("$ ")
            script.append(command)
            continued = command.endswith("\\")
        elif line.strip():
            shown.append(line)
    return "\n".join(script), shown


def _same_word(shown: str, came: str) -> bool:
    numbers = _NUMBER.findall(shown)
    others = _NUMBER.findall(came)
    if _NUMBER.sub("#", shown) != _NUMBER.sub("#", came) or len(numbers) != len(others):
        return False
    for a, b in zip(numbers, others):
        mantissa, _, exponent = a.partition("e")
        # A whole number is a count: it has no last digit to be off by.
        last_digit = (
            10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
            if a.strip("+-0123456789")
            else 0.0
        )
        if abs(float(a) - float(b)) > max(0.05 * abs(float(a)), 1.001 * last_digit):
            return False
    return True


def same_line(shown: str, came: str) -> bool:
    """Whether a line of output is the one shown: blanks count as one, numbers within 5 %, "..." for
    any words."""
    words, others = shown.split(), came.split()

    def match(i: int, j: int) -> bool:
        if i == len(words):
            return j == len(others)
        if words[i] == "...":
            return any(match(i + 1, k) for k in range(j, len(others) + 1))
        return j < len(others) and _same_word(words[i], others[j]) and match(i + 1, j + 1)

    return match(0, 0)


def first_missing(shown: list[str], came: list[str]) -> str | None:
    """The first line shown that does not come after the one before it; None where all come."""
    rest = iter(came)
    for line in shown:
        if line.strip() != "..." and not any(same_line(line, other) for other in rest):
            return line
    return None


def run_console(text: str, folder: Path) -> None:
    """Run a console block in `folder` and compare what it shows. Raises `AssertionError` with the
    output."""
    script, shown = commands_and_output(text)
    environment = {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "COLUMNS": "120",
    }
    environment["PYTHONPATH"] = os.pathsep.join(
        [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    )
    done = subprocess.run(
        ["bash", "-c", f"set -eo pipefail\n{script}"],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, f"exit code {done.returncode}:\n{script}\n{done.stdout}"
    missing = first_missing(shown, done.stdout.splitlines())
    assert missing is None, f"not in the output: {missing!r}\n{script}\n{done.stdout}"


def run_c(text: str, folder: Path) -> None:
    """Compile a C file strictly, without linking. Raises `AssertionError` with the compiler's
    messages."""
    if shutil.which("cc") is None:
        return
    includes = [f"-I{p}" for p in folder.glob("*/c")]
    done = subprocess.run(
        [
            "cc",
            "-std=c99",
            "-Wall",
            "-Wextra",
            "-Werror",
            "-fsyntax-only",
            *includes,
            "-x",
            "c",
            "-",
        ],
        input=text,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr


def run_page(path: Path, folder: Path) -> int:
    """Execute every block of a page in `folder`, which is the current directory; returns how many
    were executed."""
    namespace: dict[str, object] = {}
    executed = 0
    for block in blocks(path.read_text()):
        executed += block.language != "text"
        if block.language == "python":
            exec(compile("\n" * (block.line - 1) + block.text, str(path), "exec"), namespace)
        elif block.language == "console":
            run_console(block.text, folder)
        elif block.language == "toml":
            content = tomllib.loads(block.text)
            if str(content.get("schema", "")).startswith("greybox.vehicle/"):
                Vehicle.from_dict(content)
        elif block.language == "json":
            json.loads(block.text)
        elif block.language == "c":
            run_c(block.text, folder)
    return executed
