"""Reader of logs that are tables of text, plain or gzip: header row, numbers, empty cell or nan =
missing. Commas, semicolons (then perhaps with decimal commas), tabs, bars or spaces part the
columns; lines that begin with # may stand before, and the last of them may be the header, as numpy
writes it."""

from __future__ import annotations

import csv
import gzip
import hashlib
import io
import os
import re
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from greybox.data.logs.table import Table
from greybox.data.memory import allowance
from greybox.data.raw import Column
from greybox.errors import DataError

_GZIP_MAGIC = b"\x1f\x8b"
_SPACES = " "
_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}")
_DATE = re.compile(r"(\d{4}-\d\d-\d\d[T ]\d\d:\d\d(?::\d\d(?:[.,]\d{1,9})?)?) ?(Z|[+-]\d\d:?\d\d)?")
_SEPARATORS = (";", "\t", "|")
"""What parts columns, where a header has at least as many of them as cells between commas."""


def read_csv(path: str | os.PathLike[str]) -> Table:
    """Read a CSV file. Raises `DataError`, with file, row and column, where it is not one table of
    a header and rows.

    A file is read as gzip when it begins like one, whatever its name.
    """
    where = str(path)
    content, digest = _content(path, where)
    text = _text(content, where)
    lines = [line.rstrip("\n") for line in io.StringIO(text, newline=None)]
    numbers = [i for i, line in enumerate(lines) if line.strip()]
    if not numbers:
        raise DataError(
            "the file is empty", where=where, fix="export the log again, with a header row"
        )
    filled = [lines[i] for i in numbers]
    first, names, separator = _begins(filled)
    head = numbers[first - 1] + 1
    first, names = _second_row(filled, first, names, separator)
    header = _header(names, where, head)
    body = [lines[i] for i in numbers[first:]]
    if not body:
        raise DataError("a header but no rows", where=where, fix="export the log again")
    if separator != ",":
        body = _with_points(body, separator, where)
    rows = np.array(numbers[first:], dtype=np.int64) + 1
    columns = _numeric(body, header, separator)
    if columns is None:
        columns = _careful(body, header, separator, rows, where)
    return Table(columns=columns, rows=rows, source=Path(path).name, sha256=digest)


def _begins(lines: Sequence[str]) -> tuple[int, list[str], str]:
    """The index of the first row of values, the cells of the header, and what parts the rows. The
    header is the last of the comments where the next line has as many cells and values among them,
    else the first line that is no comment."""
    first = next((i for i, line in enumerate(lines) if not _comment(line)), len(lines))
    if first:
        comment = lines[first - 1].strip().lstrip("#").strip()
        own = _separator(comment)
        names = _split(comment, own)
        if first == len(lines):
            return first, names, own
        for separator in dict.fromkeys((own, _SPACES)):
            row = _split(lines[first], separator)
            if len(row) == len(names) and any(_value(c) for c in row):
                return first, names, separator
    separator = _separator(lines[first])
    return first + 1, _split(lines[first], separator), separator


def _second_row(
    lines: Sequence[str], first: int, names: list[str], separator: str
) -> tuple[int, list[str]]:
    """(index of the first row of values, names) where the header has a second row: text over most
    columns of numbers. It holds names within the groups that a first row with doubles names, as
    pandas writes them, or the units."""
    if first + 1 >= len(lines):
        return first, names
    row, after = (_split(line, separator) for line in lines[first : first + 2])
    numbers = [i for i, cell in enumerate(after) if _is_number(cell)]
    told = sum(bool(row[i]) for i in numbers if i < len(row))
    values = any(c and _value(c) for c in row)
    if len(row) != len(names) or values or 2 * told < max(len(numbers), 1):
        return first, names
    named = [n for n in names if n]
    pairs = list(zip(names, row, strict=True))
    if len(set(named)) < len(named):
        return first + 1, [".".join(filter(None, pair)) for pair in pairs]
    return first + 1, [f"{n} [{u.strip('[]() ')}]" if u else n for n, u in pairs]


def _value(cell: str) -> bool:
    """Whether a cell is none of a header."""
    return not cell or _is_number(cell.replace(",", ".")) or _DATE.fullmatch(cell) is not None


def _with_points(body: list[str], separator: str, where: str) -> list[str]:
    """The rows with points for decimal commas, where no number has a point."""
    spaces = separator == _SPACES
    end, pad = (r"\s", "") if spaces else (rf"{re.escape(separator)}\n", " *")
    number = re.compile(rf"(?<![^{end}])({pad}[-+]?\d*),(\d+(?:[eE][-+]?\d+)?{pad})(?![^{end}])")
    point = re.compile(rf"(?<![^{end}]){pad}[-+]?\d*\.\d*{pad}(?![^{end}])")
    text = "\n".join(body)
    with_comma = {f"{a},{b}".strip() for a, b in number.findall(text)}
    if not with_comma or point.search(text):
        return body
    if all(_THOUSANDS.fullmatch(n) for n in with_comma):
        raise DataError(
            f"{min(with_comma)} may be a number with three decimals, or one of thousands",
            where=where,
            fix="export the log with decimal points and without signs between thousands",
        )
    return number.sub(r"\1.\2", text).split("\n")


def _comment(line: str) -> bool:
    return line.lstrip().startswith("#")


def _separator(header: str) -> str:
    cells = _split(header, ",")
    for separator in _SEPARATORS:
        if header.count(separator) >= max(len(cells), 1):
            return separator
    return _SPACES if len(cells) == 1 and len(cells[0].split()) > 1 else ","


def _split(line: str, separator: str, *, strict: bool = False) -> list[str]:
    """Raises `csv.Error` for a quote that is not closed, if strict."""
    if separator == _SPACES:
        return [c.strip('"') for c in line.split()]
    cells = next(csv.reader([line], delimiter=separator, skipinitialspace=True, strict=strict))
    return [c.strip() for c in cells]


def _content(path: str | os.PathLike[str], where: str) -> tuple[bytes, str]:
    try:
        content = Path(path).read_bytes()
    except FileNotFoundError:
        raise DataError("no such log", where=where, fix="check the path") from None
    except IsADirectoryError:
        raise DataError(
            "a folder, not a log", where=where, fix="name the log files in it"
        ) from None
    except OSError as error:
        raise DataError(
            f"cannot read: {error.strerror or error}", where=where, fix="check the permissions"
        ) from None
    digest = hashlib.sha256(content).hexdigest()
    packed = content.startswith(_GZIP_MAGIC)
    if where.endswith(".gz") and not packed:
        raise DataError(
            "not a gzip file, in spite of its name",
            where=where,
            fix="rename it, or compress it again",
        )
    if packed:
        try:
            most = allowance(path) // 4  # text, numbers and what lies between them
            with gzip.GzipFile(fileobj=io.BytesIO(content)) as stream:
                content = stream.read(most + 1)
            if len(content) > most:
                raise DataError(
                    f"the gzip file unpacks to more than {most / 2**20:.0f} MiB",
                    where=where,
                    fix="cut the log into pieces",
                )
        except (OSError, EOFError, zlib.error) as error:
            raise DataError(
                f"the gzip file is damaged ({error})",
                where=where,
                fix="copy or compress the log again",
            ) from None
    return content, digest


def _text(content: bytes, where: str) -> str:
    try:
        if b"\0" in content:
            raise ValueError
        return content.decode("utf-8-sig")
    except ValueError:
        raise DataError(
            "not a text file",
            where=where,
            expected="a CSV file in UTF-8",
            fix="convert the log to CSV first",
        ) from None


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _header(cells: Sequence[str], where: str, row: int) -> list[str]:
    if all(_is_number(c) for c in cells):
        raise DataError(
            "no header row: the first row holds numbers",
            where=f"{where}, row {row}",
            fix="add the column names",
        )
    header = [c or f"unnamed{i + 1}" for i, c in enumerate(cells)]
    double = sorted({c for c in header if header.count(c) > 1})
    if double:
        raise DataError(
            f"column names given twice: {', '.join(double)}",
            where=f"{where}, row {row}",
            fix="rename or drop one of each",
        )
    return header


def _numeric(body: list[str], header: list[str], separator: str) -> dict[str, Column] | None:
    """The fast path: every cell is a number. None where it is not."""
    try:
        values = np.loadtxt(
            body,
            delimiter=None if separator == _SPACES else separator,
            comments=None,
            quotechar='"',
            ndmin=2,
            dtype=np.float64,
        )
    except ValueError:
        return None
    if values.shape != (len(body), len(header)):
        return None
    return {name: np.ascontiguousarray(values[:, j]) for j, name in enumerate(header)}


def _cells(
    body: list[str], width: int, separator: str, rows: npt.NDArray[np.int64], where: str
) -> Iterator[list[str]]:
    for line, row in zip(body, rows, strict=True):
        try:
            cells = _split(line, separator, strict=True)
        except csv.Error as error:
            raise DataError(
                f"not a CSV row ({error})", where=f"{where}, row {row}", fix="close the quotes"
            ) from None
        if len(cells) != width:
            raise DataError(
                f"{len(cells)} cells",
                where=f"{where}, row {row}",
                expected=f"{width}, as in the header",
                fix="complete or delete that row (a log that was cut off ends so)",
            )
        yield cells


def _careful(
    body: list[str],
    header: list[str],
    separator: str,
    rows: npt.NDArray[np.int64],
    where: str,
) -> dict[str, Column]:
    """The slow path: empty cells become NaN, dates seconds, other text stays text, a ragged row is
    an error."""
    columns = zip(*_cells(body, len(header), separator, rows, where), strict=True)
    out: dict[str, Column] = {}
    for name, cells in zip(header, columns, strict=True):
        try:
            out[name] = np.array([c or "nan" for c in cells], dtype=np.float64)
        except ValueError:
            dates = _dates(cells)
            out[name] = np.array(cells, dtype=np.str_) if dates is None else dates
    return out


def _dates(cells: Sequence[str]) -> npt.NDArray[np.float64] | None:
    """Seconds since 1970 of dates of one time zone, whichever that is, as ISO 8601 writes them;
    None where a cell is no date."""
    read = [_DATE.fullmatch(c) for c in cells if c]
    zones = {match[2] for match in read if match}
    if not read or None in read or len(zones) > 1:
        return None
    text = [
        match[1].replace(" ", "T").replace(",", ".") if (match := _DATE.fullmatch(c)) else "NaT"
        for c in cells
    ]
    try:
        stamps = np.array(text, dtype="datetime64[us]")
    except ValueError:
        return None
    whole = stamps.astype("datetime64[s]")
    seconds = whole.astype(np.float64) + (stamps - whole).astype(np.float64) * 1e-6
    return np.where(np.isnat(stamps), np.nan, seconds)
