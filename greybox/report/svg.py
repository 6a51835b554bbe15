"""Turn a matplotlib Figure into inline SVG that follows the page: its colours are CSS variables,
its font the page's.

Figures are drawn with the stand-in colours below; `to_svg` replaces each by a CSS variable, so that
one drawing reads well on light and on dark ground. Nothing of pyplot is touched, and a figure
leaves no global state behind.
"""

from __future__ import annotations

import io
import json
import re
import warnings
from html import escape

import matplotlib
import numpy as np
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

INK, MUTED, GRID, GROUND = "#0b0101", "#0b0202", "#0b0303", "#0b0404"
SERIES = ("#0b1001", "#0b1002", "#0b1003", "#0b1004", "#0b1005")
"""Stand-in colours of data: 1 the model, 2 the second prediction, 3 the floor, 4 the ceiling, 5
spare."""

_VARIABLES = {
    INK: "--ink",
    MUTED: "--muted",
    GRID: "--line",
    GROUND: "--ground",
    **{c: f"--c{i + 1}" for i, c in enumerate(SERIES)},
}
_NUMBER = re.compile(r"-?\d+\.\d{3,}")
_TAG = re.compile(r"<[^>]*>")
_PATH = re.compile(r' d="([^"]*)"')


def _short(match: re.Match[str]) -> str:
    text = f"{float(match.group()):.2f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def to_svg(figure: Figure, *, name: str, label: str) -> str:
    """Inline `<svg>` of a figure. `name` prefixes all ids (unique in the page), `label` is read to
    who cannot see it.

    The result is well-formed XML without namespaces, scripts, style sheets or links.
    """
    canvas = FigureCanvasSVG(figure)
    stream = io.StringIO()
    settings = {
        "svg.fonttype": "none",
        "svg.hashsalt": name,
        "path.simplify": True,
        "axes.unicode_minus": True,
    }
    with matplotlib.rc_context(settings), warnings.catch_warnings():
        # Text is drawn with the page's fonts; that matplotlib's own lacks a letter of a flight's
        # name is no matter.
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        canvas.print_svg(stream, metadata={"Date": None})
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.S)
    # The style sheet inside would leak into the page; the page has the same rule for its figures.
    text = re.sub(r"<style.*?</style>", "", text, flags=re.S)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.S)
    head = text[: text.index(">") + 1]
    box = re.search(r'viewBox="([^"]*)"', head)
    assert box is not None
    body = text[len(head) :]
    for colour, variable in _VARIABLES.items():
        body = body.replace(colour, f"var({variable})")
    for name_, kind in _MARKED:
        body = re.sub(rf'<g id="{name_}\d+"', f'<g class="{kind}"', body)
    body = re.sub(r'<g id="[^"]*"', "<g", body)
    body = re.sub(r'\bid="([^"]*)"', rf'id="{name}-\1"', body)
    body = re.sub(r'(?:xlink:)?href="#([^"]*)"', rf'href="#{name}-\1"', body)
    body = re.sub(r"url\(#([^)]*)\)", rf"url(#{name}-\1)", body)
    body = re.sub(r"font: ([^;\"]*?)(\d[\d.]*px) [^;\"]*", r"font: \1\2 var(--sans)", body)
    body = re.sub(r"font-family: [^;\"]*;? ?", "", body)
    body = _PATH.sub(lambda m: ' d="' + " ".join(m.group(1).split()) + '"', body)
    # Coordinates stand in tags; the text between tags (axis labels) is left as it is.
    body = _TAG.sub(lambda m: _NUMBER.sub(_short, m.group()), body)
    body = re.sub(r"\n\s*", "\n", body)
    width = float(box.group(1).split()[2])
    # Points of the drawing, times 1.36, are CSS pixels at the largest size that a figure is shown
    # at.
    style = f"max-width: {1.36 * width:.0f}px"
    live = f' data-axes="{escape(json.dumps(found))}"' if (found := _zoomable(figure)) else ""
    return f'<svg viewBox="{box.group(1)}" role="img" aria-label="{escape(label)}"{live} style="{style}">{body}'.strip()


_MARKED = (
    ("axes_", "axes"),
    ("xtick_", "tx"),
    ("ytick_", "ty"),
    ("line2d_", "curve"),
    ("PolyCollection_", "band"),
    ("FillBetweenPolyCollection_", "band"),
)
"""Groups of matplotlib's SVG that page.js looks for, by the beginning of their id, with their
class."""


def _zoomable(figure: Figure) -> list[dict[str, object]]:
    """For page.js, of every axes: its box (left, top, right, bottom) on the drawing, its ranges and
    scales, what its axes are called. Empty where anything but curves and bands is drawn: such a
    figure stays as it is."""
    width, height = (72.0 * float(v) for v in figure.get_size_inches())
    found: list[dict[str, object]] = []
    for axes in figure.axes:
        bands = all(isinstance(c, PolyCollection) for c in axes.collections)
        if (
            not any(np.size(line.get_xdata()) > 2 for line in axes.lines)
            or not bands
            or axes.patches
        ):
            return []
        place = axes.get_position()
        box = (place.x0 * width, (1 - place.y1) * height, place.x1 * width, (1 - place.y0) * height)
        x, y = axes.get_xlim(), axes.get_ylim()
        if not (x[1] > x[0] and y[1] > y[0]):
            return []
        found.append(
            {
                "box": [round(float(v), 2) for v in box],
                "x": [float(v) for v in x],
                "y": [float(v) for v in y],
                "logx": axes.get_xscale() == "log",
                "logy": axes.get_yscale() == "log",
                "name": axes.get_ylabel() or axes.get_title(loc="left"),
            }
        )
    title = next((a.get_xlabel() for a in reversed(figure.axes) if a.get_xlabel()), "")
    return [{**a, "title": title} for a in found]
