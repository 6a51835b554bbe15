"""What is done to all C of an export before it is written: no warning of a parameter that a function
does not use or of a number that decides as a truth, and no line that is too long to be read."""

from __future__ import annotations

import re

LONGEST = 125
"""Characters of a line."""
_DEFINITION = re.compile(
    r"^(?:(?:static|CASADI_SYMBOL_EXPORT) )[^;{}#\n]*\b\w+\((?P<given>[^;{}()]*)\) \{\n(?P<body>.*?)^\}",
    re.MULTILINE | re.DOTALL,
)
_NUMBER = r"([aw]\d+|\(\*cr\+\+\))"
_DECIDES = (
    (re.compile(rf"\({_NUMBER}\?"), r"((\1!=0)?"),
    (re.compile(rf"\(! ?{_NUMBER} ?\)"), r"(\1==0)"),
    (re.compile(rf"\({_NUMBER} ?(&&|\|\|) ?{_NUMBER}\)"), r"((\1!=0)\2(\3!=0))"),
)
"""Numbers of CasADi as conditions, and the same compared with zero (NaN is true both ways)."""
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


def compared(text: str) -> str:
    """C of CasADi in which no number is taken as a truth, of which clang warns (-Wconversion)."""
    for pattern, clear in _DECIDES:
        text = pattern.sub(clear, text)
    return text


def broken(text: str) -> str:
    """C without a line longer than LONGEST where spaces outside of strings allow it. Comments of C++
    (//) stay."""
    lines: list[str] = []
    macro = False
    for line in text.split("\n"):
        macro = line.lstrip().startswith("#") or (macro and lines[-1].endswith("\\"))
        lines += [line] if len(line) <= LONGEST or "//" in line else _parts(line, macro)
    return "\n".join(lines)


def _parts(line: str, macro: bool) -> list[str]:
    """A line in parts, each broken at a space, after a comma where there is one in its second half;
    those of a macro end with a backslash."""
    end = " \\" if macro or line.endswith("\\") else ""
    indent = f"{line[: len(line) - len(line.lstrip())]}    "
    done: list[str] = []
    part, neat = "", 0
    for word in _WORD.findall(line):
        if part.strip() and not word.isspace() and len(part) + len(word) + len(end) > LONGEST:
            at = neat if neat > LONGEST / 2 else len(part)
            done.append(part[:at].rstrip() + end)
            part, neat = indent + part[at:].lstrip(), 0
        if word.isspace() and part.endswith((",", ";")):
            neat = len(part)
        part += word
    return [*done, part]
