"""What is done to all C of an export before it is written: no warning of a parameter that a function
does not use, and no line that is too long to be read."""

from __future__ import annotations

import re

LONGEST = 125
"""Characters of a line."""
_DEFINITION = re.compile(
    r"^(?:(?:static|CASADI_SYMBOL_EXPORT) )[^;{}#\n]*\b\w+\((?P<given>[^;{}()]*)\) \{\n(?P<body>.*?)^\}",
    re.MULTILINE | re.DOTALL,
)
_WORD = re.compile(r"(?:\"(?:\\.|[^\"\\])*\"|\S)+|\s+")


def all_used(text: str) -> str:
    """C whose functions name every parameter that they do not use: (void)mem."""

    def named(found: re.Match[str]) -> str:
        parameters = [p.split("[")[0].split() for p in found["given"].split(",")]
        names = [p[-1].lstrip("*") for p in parameters if len(p) > 1]
        own = set(re.findall(r"\w+", found["body"]))
        idle = "".join(f"  (void){n};\n" for n in names if n not in own)
        start = found.start("body") - found.start()
        return f"{found[0][:start]}{idle}{found[0][start:]}"

    return _DEFINITION.sub(named, text)


def broken(text: str) -> str:
    """C without a line longer than LONGEST where spaces outside of strings allow it. Comments of C++
    (//) stay."""
    lines = []
    for line in text.split("\n"):
        lines += [line] if len(line) <= LONGEST or "//" in line else _parts(line)
    return "\n".join(lines)


def _parts(line: str) -> list[str]:
    """A line in parts; those of a macro end with a backslash."""
    end = " \\" if line.lstrip().startswith("#") or line.endswith("\\") else ""
    indent = f"{line[: len(line) - len(line.lstrip())]}    "
    done: list[str] = []
    while len(line) > LONGEST and (at := _space(line, len(indent), LONGEST - len(end))):
        done.append(f"{line[:at]}{end}")
        line = indent + line[at:].lstrip()
    return [*done, line]


def _space(line: str, first: int, last: int) -> int:
    """Where a line is broken: the last space within its room, one after a comma before others. The
    first space beyond where there is none, 0 where there is none at all."""
    fits: list[int] = []
    for word in _WORD.finditer(line):
        at = word.start()
        if not word[0].isspace() or at <= first:
            continue
        if at > last:
            fits = fits or [at]
            break
        fits.append(at)
    neat = [at for at in fits if line[at - 1] in ",;" and at > last / 2]
    return (neat or fits or [0])[-1]
