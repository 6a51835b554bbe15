"""The figure of unannounced shocks: share of time beyond a limit through each of them.

python -m scenarios.studies.shocks_figure scenarios/results/shocks_1001.jsonl.gz docs/images/shocks.svg
"""

from __future__ import annotations

import argparse
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from greybox.files import write_atomic
from scenarios.studies.rows import read_rows
from scenarios.studies.shocks import BACK, LEVEL, SHOCKS, WINDOW, WINDOWS

LINES = {
    "aware": ("tube that calibrates and learns", "tab:blue", "-", 2.2),
    "tube": ("tube", "tab:cyan", "-", 1.4),
    "zoro": ("zoRO on acados", "tab:orange", "-", 1.4),
    "nominal": ("no tightening", "0.45", "--", 1.2),
    "pid": ("PID that knows the craft", "0.65", ":", 1.4),
}
TITLES = {
    "none": "no shock",
    "payload": "payload +20 %",
    "rotor": "one rotor -15 %",
    "wind": "wind 5 m/s",
    "battery": "voltage 85 %",
    "delay": "delay +10 ms",
    "mocap": "no pose for 0.5 s",
    "gusts": "gusts +2 m/s",
}


def share_beyond(rows: Sequence[Mapping[str, Any]]) -> tuple[np.ndarray, np.ndarray]:
    """(times [s] from the shock on, mean share of time beyond a limit): one point before the shock,
    then one in the middle of each window."""
    before = np.mean([r["before"] for r in rows])
    after = np.mean([r["after"][:WINDOWS] for r in rows], axis=0)
    times = WINDOW * np.concatenate([[-0.5], np.arange(len(after)) + 0.5])
    return times, np.concatenate([[before], after])


def panel(ax: Axes, shock: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """One shock: a line per controller, the level, and the time by which it should be back."""
    ax.axvspan(0.0, BACK, color="0.93", linewidth=0)
    ax.axhline(100 * LEVEL, color="tab:red", linewidth=0.8, linestyle=":")
    for name, (label, colour, style, width) in LINES.items():
        mine = [r for r in rows if r["shock"] == shock and r["controller"] == name]
        if mine:
            times, share = share_beyond(mine)
            ax.plot(times, 100 * share, style, color=colour, linewidth=width, label=label)
    ax.set_title(TITLES[shock], fontsize=8)
    ax.set_ylim(-3.0, 103.0)
    ax.tick_params(labelsize=7)
    ax.spines[["top", "right"]].set_visible(False)


def main(argv: Sequence[str] | None = None) -> None:
    """Draw the figure from kept rows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("rows", type=Path, nargs="+")
    parser.add_argument("out")
    arguments = parser.parse_args(argv)
    rows = [row for path in arguments.rows for row in read_rows(path)]
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    axes = figure.subplots(2, len(SHOCKS) // 2, sharex=True, sharey=True)
    for ax, shock in zip(axes.flat, SHOCKS, strict=True):
        panel(ax, shock, rows)
    for ax in axes[-1]:
        ax.set_xlabel("seconds after the shock", fontsize=8)
    for ax in axes[:, 0]:
        ax.set_ylabel("beyond a limit [% of time]", fontsize=8)
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=7, frameon=False, loc="outside lower center", ncols=5)
    stream = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "shocks", "svg.fonttype": "none"}):
        figure.savefig(stream, format="svg", metadata={"Date": None})
    write_atomic(arguments.out, stream.getvalue())


if __name__ == "__main__":
    main()
