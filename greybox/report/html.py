"""A small document builder: sections, paragraphs, warnings, tables and figures in one
self-contained HTML file.

The page needs no network and no other file (a content security policy in it says so). Every text is
escaped. The only scripts in it are ours, and run by their hashes alone: page.js where there are
curves to zoom into, and what a report brings (`live`). Without them the page is complete, and
still. The source is well-formed XML as well as HTML, so that tests and other tools can parse it
strictly.
"""

from __future__ import annotations

import base64
import contextlib
import functools
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib import resources
from typing import Literal
from urllib.parse import quote

from matplotlib.figure import Figure

from greybox.errors import DataError
from greybox.report.style import CSS
from greybox.report.svg import to_svg

Colour = Literal["ink", "muted", "c1", "c2", "c3", "c4", "c5"]
Stroke = Literal["line", "dash", "dots"]


@dataclass(frozen=True, kw_only=True)
class Tag:
    """A table cell that asks for attention, e.g. "at bound"."""

    text: str


@dataclass(frozen=True, kw_only=True)
class Share:
    """A table cell that shows a share 0..1 as percent with a small bar."""

    value: float


@dataclass(frozen=True, kw_only=True)
class Key:
    """One entry of a figure's key: a text with the colour and the stroke of its line."""

    text: str
    colour: Colour
    stroke: Stroke = "line"


@dataclass(frozen=True, kw_only=True)
class Span:
    """A table cell that shows an estimate with its interval (low, high) over the interval that its
    prior allowed, on one scale; `text` says it to who cannot see it."""

    low: float
    high: float
    prior: tuple[float, float]
    text: str


WIDE = 9
"""Columns from which a table is set closer, to fit on a desk's screen."""


@functools.cache
def script(name: str) -> str:
    """A program of ours that moves a page, of the file NAME.js beside this one."""
    return (resources.files("greybox.report") / f"{name}.js").read_text(encoding="utf-8").strip()


def embedded_json(data: object) -> str:
    """JSON of `data` as the text of a script element: no sign in it ends the element or starts
    another."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    for sign, code in (("<", "\\u003c"), (">", "\\u003e"), ("&", "\\u0026")):
        text = text.replace(sign, code)
    return text


Cell = str | int | float | None | Tag | Share | Span
"""What a table may hold; None is an empty cell, a float is shown with four significant digits."""


def _cell(value: Cell) -> str:
    if value is None:
        return ""
    if isinstance(value, Tag):
        return f'<span class="tag">{escape(value.text)}</span>'
    if isinstance(value, Share):
        width = 100.0 * min(1.0, max(0.0, value.value))
        return (
            f'{100 * value.value:.0f} %<span class="bar"><i style="width: {width:.0f}%"></i></span>'
        )
    if isinstance(value, Span):
        return _span(value)
    if isinstance(value, float):
        return escape(f"{value:.4g}".replace("-", "\N{MINUS SIGN}"))
    return escape(str(value))


def _span(span: Span) -> str:
    """Two bars, one over the other; the narrowest that is drawn is two hundredths of the scale."""
    low, high = min(span.low, span.prior[0]), max(span.high, span.prior[1])
    width = (high - low) or 1.0

    def bar(kind: str, first: float, last: float) -> str:
        share = max(100 * (last - first) / width, 2.0)
        left = min(100 * (first - low) / width, 100 - share)
        return f'<i class="{kind}" style="left: {left:.1f}%; width: {share:.1f}%"></i>'

    bars = bar("prior", *span.prior) + bar("estimate", span.low, span.high)
    return f'<span class="span" role="img" aria-label="{escape(span.text)}">{bars}</span>'


class Report:
    """Collects the parts of a report in order; `html()` gives the page.

    The first line, then the headline and then the warnings stand first on it, whenever added.
    """

    def __init__(self, title: str, subtitle: str = "") -> None:
        self._title, self._subtitle = title, subtitle
        self._first = ""
        self._head: list[str] = []
        self._warnings: list[str] = []
        self._sections: list[str] = []
        self._parts: list[str] = []
        self._figures = 0
        self._scripts: list[str] = []
        self._css = CSS

    def first_line(self, text: str, why: Sequence[str] = (), *, good: bool) -> None:
        """What the page says first: its result in one line, with the reasons, and whether it is as
        it should be."""
        below = f"<br/>{escape('; '.join(why))}" if why else ""
        kind = "good" if good else "bad"
        self._first = f'<p class="{kind}"><strong>{escape(text)}</strong>{below}</p>'

    @contextlib.contextmanager
    def headline(self) -> Iterator[None]:
        """Everything added inside the `with` block stands right after the first line: what a reader
        sees without scrolling."""
        parts, self._parts = self._parts, self._head
        yield
        self._head, self._parts = self._parts, parts

    def warning(self, text: str) -> None:
        """Add a warning to the box at the top of the page."""
        self._warnings.append(text)

    def section(self, title: str) -> None:
        """Start a section; it appears in the list of contents."""
        self._sections.append(title)
        self._parts.append(f'<h2 id="section-{len(self._sections)}">{escape(title)}</h2>')

    def heading(self, title: str) -> None:
        """A heading inside a section."""
        self._parts.append(f"<h3>{escape(title)}</h3>")

    def paragraph(self, text: str) -> None:
        """A paragraph of plain text."""
        self._parts.append(f"<p>{escape(text)}</p>")

    def note(self, text: str) -> None:
        """A caption by itself, in small letters."""
        self._parts.append(f'<p class="caption">{escape(text)}</p>')

    def verdict(self, text: str) -> None:
        """A paragraph that states a result that is as it should be."""
        self._parts.append(f'<p class="good">{escape(text)}</p>')

    def bullets(self, texts: Sequence[str]) -> None:
        """A list of plain texts; nothing where it is empty."""
        if texts:
            self._parts.append("<ul>" + "".join(f"<li>{escape(t)}</li>" for t in texts) + "</ul>")

    def links(self, places: Sequence[tuple[str, str]]) -> None:
        """Links to files beside the page, (text, path from the page) each; nothing where there are
        none."""
        if places:
            listed = (
                f'<a href="{escape(quote(path))}">{escape(text)}</a>' for text, path in places
            )
            self._parts.append(f"<p>{', '.join(listed)}</p>")

    def code(self, text: str) -> None:
        """Text in a fixed-width font, as a command line."""
        self._parts.append(f'<pre tabindex="0"><code>{escape(text)}</code></pre>')

    @contextlib.contextmanager
    def details(self, summary: str, *, open: bool = False) -> Iterator[None]:
        """Everything added inside the `with` block folds away under `summary`."""
        state = ' open="open"' if open else ""
        self._parts.append(f"<details{state}><summary>{escape(summary)}</summary>")
        yield
        self._parts.append("</details>")

    @contextlib.contextmanager
    def columns(self) -> Iterator[None]:
        """Tables added inside the `with` block stand side by side where the screen is wide."""
        self._parts.append('<div class="columns">')
        yield
        self._parts.append("</div>")

    def facts(self, rows: Sequence[tuple[str, str]]) -> None:
        """A table of name and text."""
        body = "".join(
            f'<tr><th scope="row">{escape(k)}</th><td>{escape(v)}</td></tr>' for k, v in rows
        )
        self._parts.append(
            f'<div class="scroll"><table class="facts"><tbody>{body}</tbody></table></div>'
        )

    def table(
        self,
        headers: Sequence[str],
        rows: Sequence[Sequence[Cell]],
        *,
        caption: str = "",
        numeric: Sequence[int] = (),
    ) -> None:
        """A table; `numeric` are the columns to align to the right, in addition to those that hold
        numbers only.

        The first column names the row. Raises `DataError` for a row of another length than the
        headers.
        """
        for row in rows:
            if len(row) != len(headers):
                raise DataError(
                    f"table row has {len(row)} cells", expected=str(len(headers)), got=repr(row)
                )
        columns = [[r[i] for r in rows] for i in range(len(headers))]
        right = {
            i
            for i, cells in enumerate(columns)
            if i in numeric
            or (cells and all(isinstance(c, (int, float)) or c is None for c in cells))
        }
        mark = [' class="n"' if i in right else "" for i in range(len(headers))]
        head = "".join(f'<th scope="col"{mark[i]}>{escape(h)}</th>' for i, h in enumerate(headers))
        body = []
        for row in rows:
            first = f'<th scope="row"{mark[0]}>{_cell(row[0])}</th>'
            # Long texts may wrap, numbers and names may not.
            long = [
                ' class="t"' if isinstance(c, str) and len(c) > 40 else mark[i]
                for i, c in enumerate(row)
            ]
            body.append(
                f"<tr>{first}{''.join(f'<td{long[i]}>{_cell(c)}</td>' for i, c in enumerate(row) if i)}</tr>"
            )
        # A region that scrolls must be reachable by keyboard.
        region = f'<div class="scroll" tabindex="0" role="region" aria-label="{escape(caption or headers[0])}">'
        kind = ' class="wide"' if len(headers) >= WIDE else ""
        table = f"<table{kind}><thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table>"
        below = f'<p class="caption">{escape(caption)}</p>' if caption else ""
        self._parts.append(f"{region}{table}</div>{below}")

    def figure(
        self, figure: Figure, *, caption: str = "", alt: str, key: Sequence[Key] = ()
    ) -> None:
        """One figure with its caption; `alt` describes it to who cannot see it."""
        self.figures([(figure, alt)], caption=caption, key=key)

    def figures(
        self, panels: Sequence[tuple[Figure, str]], *, caption: str = "", key: Sequence[Key] = ()
    ) -> None:
        """Several panels (figure, alt text) side by side as far as the screen is wide, with one key
        and caption."""
        drawn = []
        for figure, alt in panels:
            self._figures += 1
            drawn.append(to_svg(figure, name=f"f{self._figures}", label=alt))
            if "data-axes" in drawn[-1][:2000]:
                self._run(script("page"))
        entries = "".join(
            f'<li><span class="{k.stroke}" style="color: '
            f'var(--{k.colour})"></span>{escape(k.text)}</li>'
            for k in key
        )
        legend = f'<ul class="key">{entries}</ul>' if entries else ""
        body = f'<div class="panels">{"".join(drawn)}</div>' if len(drawn) > 1 else "".join(drawn)
        below = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
        self._parts.append(f"<figure>{legend}{body}{below}</figure>")

    def live(self, markup: str, script: str, css: str = "") -> None:
        """Markup, the script that moves it and its style, all ours: nothing of a user's may stand
        in them unescaped.

        Script and style stand on the page once, however many parts bring them.
        """
        self._parts.append(markup)
        self._run(script, css)

    def _run(self, script: str, css: str = "") -> None:
        """A script and its style, once however often they are asked for."""
        # Read as HTML the marks are comments, read as XML they keep the script as it is.
        marked = f"//<![CDATA[\n{script}\n//]]>"
        if marked not in self._scripts:
            self._scripts.append(marked)
            self._css += css

    def reproduced_by(
        self, command: str, facts: Sequence[tuple[str, str]], versions: Mapping[str, str]
    ) -> None:
        """The last section: the command, what went in (label, value; empty ones are left out), and
        the versions of what ran."""
        self.section("How to reproduce this")
        if command:
            self.code(command)
        rows = [(label, value) for label, value in facts if value]
        if rows or versions:
            self.facts([*rows, *versions.items()])

    def html(self) -> str:
        """The whole page."""
        title, warnings, contents = escape(self._title), "", ""
        if self._warnings:
            items = "".join(f"<li>{escape(w)}</li>" for w in self._warnings)
            head = "Warning" if len(self._warnings) == 1 else f"{len(self._warnings)} warnings"
            warnings = f'<section class="warnings" aria-label="Warnings"><h2>{head}</h2><ul>{items}</ul></section>'
        if len(self._sections) > 1:
            links = "".join(
                f'<li><a href="#section-{i}">{escape(s)}</a></li>'
                for i, s in enumerate(self._sections, start=1)
            )
            contents = f'<nav aria-label="Contents"><ul>{links}</ul></nav>'
        subtitle = f'<p class="subtitle">{escape(self._subtitle)}</p>' if self._subtitle else ""
        policy = "default-src 'none'; style-src 'unsafe-inline'"
        if self._scripts:
            hashes = (
                base64.b64encode(hashlib.sha256(s.encode()).digest()).decode()
                for s in self._scripts
            )
            policy += "; script-src " + " ".join(f"'sha256-{h}'" for h in hashes)
        scripts = "".join(f"\n<script>{s}</script>" for s in self._scripts)
        return (
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8"/>\n'
            f'<meta http-equiv="Content-Security-Policy" content="{policy}"/>\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1"/>\n'
            f"<title>{title}</title>\n<style>{self._css}</style>\n</head>\n<body>\n"
            '<a class="skip" href="#main">Skip to the report</a>\n'
            f'<main id="main">\n<header><h1>{title}</h1>{subtitle}</header>\n{self._first}\n'
            + "\n".join(self._head)
            + f"\n{warnings}\n{contents}\n"
            + "\n".join(self._parts)
            + f"\n</main>{scripts}\n</body>\n</html>\n"
        )
