"""The figure of docs/discovery.md: a search step by step, its certificates, and the gap.

python -m scenarios.foreign.naming --cells single --seeds 61 61 --seconds 8 --out naming
python -m scenarios.studies.discovery_figure naming/logs/single_61/found/discovery.json OUT.svg
"""

from __future__ import annotations

import argparse
import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from greybox.files import read_json, write_atomic

SHOWN = 6
"""Causes that a step shows: those that promise most."""
AHEAD = 0.1
"""Horizon [s] of the gap that is drawn."""


def main(argv: Sequence[str] | None = None) -> None:
    """Draw the figure from a result of `greybox discover`."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("discovery")
    parser.add_argument("out")
    arguments = parser.parse_args(argv)
    content = read_json(arguments.discovery, schema="greybox.discovery/2")
    steps = [s for s in content["steps"] if set(s["added"]) & set(s["predicted"])]
    figure = Figure(figsize=(11, 2.9), layout="constrained")
    axes = figure.subplots(1, len(steps) + 2)
    for k, (ax, step) in enumerate(zip(axes, steps, strict=False), 1):
        promised(ax, step)
        ax.set_title(f"step {k}: what each cause promises", fontsize=8)
    certificates(axes[-2], content)
    gap(axes[-1], content)
    for ax in axes:
        ax.tick_params(labelsize=7)
        ax.spines[["top", "right"]].set_visible(False)
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None})
    write_atomic(arguments.out, text.getvalue())


def promised(ax: Axes, step: Mapping[str, Any]) -> None:
    """Predicted gains of one step; what was added is dark."""
    told = step["predicted"]
    names = sorted(told, key=lambda n: -told[n])[:SHOWN]
    names += [n for n in step["added"] if n in told and n not in names]
    dark = ["tab:blue" if n in step["added"] else "0.75" for n in names]
    ax.barh(names, [told[n] for n in names], color=dark)
    ax.invert_yaxis()
    gained = max(t["gain"] for t in step["tried"])
    ax.set_xlabel(f"log evidence alone; together {gained:.0f}", fontsize=7)


def certificates(ax: Axes, content: Mapping[str, Any]) -> None:
    """The e-value of every name against what a name needs."""
    effects = content["effects"]
    ax.barh([e["name"] for e in effects], [e["log10_e"] for e in effects], color="tab:green")
    ax.axvline(content["bar_log10_e"], color="0.2", linestyle=":")
    ax.invert_yaxis()
    ax.set_xlabel("log10 e; dotted: what a name needs", fontsize=7)
    ax.set_title("on the flight that proposed nothing", fontsize=8)


def gap(ax: Axes, content: Mapping[str, Any]) -> None:
    """Errors ahead before and after, as shares of those before."""
    rows = [r for r in content["gap"] if r["horizon_s"] == AHEAD]
    place = np.arange(len(rows))
    after = [r["after"] / r["before"] for r in rows]
    ax.bar(place, np.ones(len(rows)), color="0.85", label="before")
    ax.bar(place, after, 0.6, color="tab:blue", label="with the names")
    floor = [(r["floor"] or np.nan) / r["before"] for r in rows]
    ax.plot(place, floor, "_", color="0.2", markersize=14, label="dead reckoning")
    ax.set_xticks(place, [r["group"] for r in rows])
    ax.set_title(f"error {AHEAD:g} s ahead", fontsize=8)
    ax.legend(fontsize=6)


if __name__ == "__main__":
    main()
