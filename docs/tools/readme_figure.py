"""The figure of README.md: error against horizon on flights that the fit never saw, between floor
and ceiling.

make demo
python -m docs.tools.readme_figure demo_out/validate.json docs/images/nanobench.svg
"""

from __future__ import annotations

import argparse
import io
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from greybox.files import read_json, write_atomic

GROUPS = {
    "position": "position [m]",
    "velocity": "velocity [m/s]",
    "rotation": "attitude [deg]",
    "rate": "body rate [rad/s]",
}
ROWS = {
    "persistence": ("last value held", "0.6", "--"),
    "model": ("greybox", "tab:blue", "-"),
    "dead reckoning": ("dead reckoning with the IMU", "0.3", ":"),
}


def main(argv: Sequence[str] | None = None) -> None:
    """Draw the figure from a validation result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("validation")
    parser.add_argument("out")
    arguments = parser.parse_args(argv)
    result = read_json(arguments.validation, schema="greybox.validate/1")
    figure = Figure(figsize=(10, 2.6), layout="constrained")
    axes = figure.subplots(1, len(GROUPS))
    for ax, (group, label) in zip(axes, GROUPS.items(), strict=True):
        for row, (name, colour, style) in ROWS.items():
            curve = result["curves"].get(row, {}).get(group)
            if not curve:
                continue
            factor = 180 / np.pi if group == "rotation" else 1.0
            errors = np.array([np.nan if v is None else v for v in curve], dtype=float) * factor
            seconds = 0.01 * np.arange(1, errors.size + 1)
            ax.plot(seconds, errors, style, color=colour, label=name, linewidth=1.8)
        ax.set_title(label, fontsize=9)
        ax.set_xlabel("seconds ahead", fontsize=8)
        ax.set_ylim(bottom=0)
        ax.tick_params(labelsize=7)
    axes[0].legend(fontsize=7, frameon=False)
    stream = io.StringIO()
    figure.savefig(stream, format="svg", metadata={"Date": None})
    write_atomic(arguments.out, stream.getvalue())


if __name__ == "__main__":
    main()
