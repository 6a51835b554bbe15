"""Shown: what an object shows at a prompt and in a notebook, and its table for further work.

A class of the public interface inherits `Shown` and says its text and, where it has one, its table.
It then prints at most `LINES` lines, draws itself as HTML in a notebook and hands its table to
pandas, which is imported only then. A dataclass must say `repr=False`, or its own repr comes first.
"""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from greybox.distribution import install_line
from greybox.errors import MissingExtraError

if TYPE_CHECKING:
    from pandas import DataFrame

LINES = 12
"""Lines of a repr, at most: what fits beside the code that made the object."""
ROWS = 40
"""Rows of a table in a notebook, at most."""
Cell = str | float | int | bool | None
Row = Mapping[str, Cell]


def in_degrees(unit: str) -> tuple[str, float]:
    """(unit as people read it, factor): angles in degrees, all else as it is."""
    return ("deg", math.degrees(1.0)) if unit == "rad" else (unit, 1.0)


_STYLE = "text-align:left;vertical-align:top;padding:0 1em 0 0"


class Shown:
    """Base of objects that show themselves. A member gives `_shown_text` and perhaps
    `_shown_rows`."""

    def _shown_text(self) -> str:
        """The whole text, most important line first."""
        raise NotImplementedError

    def _shown_rows(self) -> Sequence[Row]:
        """The table, a mapping of column to cell per row; empty where there is none."""
        return ()

    def summary(self) -> str:
        """The whole text, of which a prompt shows the first lines."""
        return self._shown_text()

    def __repr__(self) -> str:
        return shortened(self._shown_text())

    def _repr_html_(self) -> str:
        """What a notebook shows: the first line, then the table or the rest of the text."""
        first, _, rest = self._shown_text().partition("\n")
        body = html_table(self._shown_rows())
        if not body and rest:
            body = f"<pre>{html.escape(shortened(rest))}</pre>"
        return f"<div><p><b>{html.escape(first)}</b></p>{body}</div>"

    def to_frame(self) -> DataFrame:
        """The table as a pandas DataFrame. Raises `MissingExtraError` where pandas is not
        installed."""
        try:
            import pandas as pd
        except ImportError:
            raise MissingExtraError(
                "a DataFrame needs pandas, which is not installed", fix=install_line("notebook")
            ) from None
        return pd.DataFrame(columns_of(self._shown_rows()))


def shortened(text: str, lines: int = LINES) -> str:
    """At most `lines` lines of `text`; the last one then says how many are left out."""
    all_lines = text.rstrip("\n").split("\n")
    if len(all_lines) <= lines:
        return "\n".join(all_lines)
    kept = all_lines[: lines - 1]
    return "\n".join([*kept, f"... and {len(all_lines) - len(kept)} more lines"])


def columns_of(rows: Iterable[Row]) -> dict[str, list[Cell]]:
    """The columns of a table of rows; a cell that a row lacks is None."""
    rows = list(rows)
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: [row.get(name) for row in rows] for name in names}


def html_table(rows: Sequence[Row]) -> str:
    """A table as HTML, every cell escaped; "" without rows."""
    if not rows:
        return ""
    columns = columns_of(rows[:ROWS])
    head = "".join(f'<th style="{_STYLE}">{html.escape(name)}</th>' for name in columns)
    lines = [
        "<tr>"
        + "".join(f'<td style="{_STYLE}">{html.escape(_text(c))}</td>' for c in cells)
        + "</tr>"
        for cells in zip(*columns.values(), strict=True)
    ]
    more = f"<p>... and {len(rows) - ROWS} more rows: to_frame()</p>" if len(rows) > ROWS else ""
    return f"<table><tr>{head}</tr>{''.join(lines)}</table>{more}"


def _text(cell: Cell) -> str:
    if cell is None or cell != cell:
        return ""
    return f"{cell:.5g}" if isinstance(cell, float) else str(cell)
