"""Matrix: what becomes of every effect in every simulator, on one page.

Rows are effects, columns targets, in blocks that fit a terminal. A cell is the status of a
statement's row, with how far what is left out leads a flight of half a second astray [mm].
"""

from __future__ import annotations

from collections.abc import Sequence

from greybox.simulators.size import FLIGHT_TIME
from greybox.simulators.statement import Row, Statement
from greybox.simulators.words import Status

COLUMNS = 7
"""Targets side by side."""
TOGETHER = "all that is left out"
"""The last row of every block."""

LEGEND = (
    "without a number: counted in another row, of a sensor (sensors.toml), or a push "
    "(pushes.py, --draws)"
)


def matrix(statements: Sequence[Statement]) -> str:
    """The table for people: all effects times all targets. A simulator that has no row for
    something says it: rows are of effects of the model, and of what else a simulator cannot take as
    it is."""
    effects = _in_order([[r.word.effect for r in s.rows] for s in statements])
    width = max([len(e) for e in (*effects, TOGETHER)], default=0) + 2
    lines = [
        f"said, folded or lost, with the mm that a flight of {FLIGHT_TIME:g} s goes astray by it:"
    ]
    for first in range(0, len(statements), COLUMNS):
        block = statements[first : first + COLUMNS]
        rows = [("effect", [s.target for s in block])]
        for effect in effects:
            rows.append((effect, [_cell(s, effect) for s in block]))
        rows.append(
            (TOGETHER, ["" if s.whole is None else _millimetres(s.whole.position) for s in block])
        )
        wide = [
            max(map(len, column)) + 2 for column in zip(*(cells for _, cells in rows), strict=True)
        ]
        for head, cells in rows:
            lines.append(
                (
                    head.ljust(width)
                    + "".join(c.ljust(w) for c, w in zip(cells, wide, strict=True))
                ).rstrip()
            )
        lines.append("")
    return "\n".join([*lines[:-1], LEGEND])


def _cell(statement: Statement, effect: str) -> str:
    row = next((r for r in statement.rows if r.word.effect == effect), None)
    return Status.SAID.value if row is None else _text(row)


def _text(row: Row) -> str:
    size = "" if row.size is None else f" {_millimetres(row.size.position)}"
    return f"{row.word.status.value}{size}"


def _millimetres(metres: float) -> str:
    """Two digits; of a hundred and more, all."""
    value = 1e3 * metres
    return f"{value:.0f}" if value >= 100 else f"{value:.2g}"


def _in_order(lists: Sequence[Sequence[str]]) -> list[str]:
    """All names once, each after those that stand before it in every list."""
    out: list[str] = []
    for names in lists:
        at = 0
        for name in names:
            if name in out:
                at = out.index(name) + 1
            else:
                out.insert(at, name)
                at += 1
    return out
