"""The figure of docs/twin.md: how wide a twin's 95 % band is on real flights, beside the box of
+-30 % and what is needed.

greybox twin MODEL.json --out twin --draws 200 --seed 1 --check LOG ...
python -m scenarios.studies.twin_bands twin/twin.json docs/images/twin_bands.png
"""

from __future__ import annotations

import argparse
import io
from collections.abc import Sequence

from matplotlib.figure import Figure

from greybox.files import read_json, write_atomic
from greybox.simulators.coverage import UNITS


def main(argv: Sequence[str] | None = None) -> None:
    """Draw the bands of a flight that was adapted to, or of a new one where none was."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("twin")
    parser.add_argument("out")
    arguments = parser.parse_args(argv)
    rows = read_json(arguments.twin, schema="greybox.twin/1")["coverage"]
    if not rows:
        raise SystemExit(f"{arguments.twin}: no coverage; write it with --draws and --check")
    adapted = any(r["adapted"] for r in rows)
    rows = [r for r in rows if r["adapted"] is adapted]
    figure = Figure(figsize=(9, 2.5), layout="constrained")
    for ax, group in zip(figure.subplots(1, len(UNITS)), UNITS, strict=True):
        own = [r for r in rows if r["group"] == group]
        t = [r["seconds"] for r in own]
        ax.plot(t, [r["box_width"] for r in own], "s:", color="0.6", label="box of 30 %")
        ax.plot(t, [r["width"] for r in own], "o-", color="tab:blue", label="twin")
        ax.plot(
            t, [r["needed"] for r in own], "_", color="k", markersize=12, label="needed for 95 %"
        )
        for r in own:
            ax.annotate(
                f"{100 * r['share']:.0f} %",
                (r["seconds"], r["width"]),
                fontsize=7,
                xytext=(3, -9),
                textcoords="offset points",
                color="tab:blue",
            )
            ax.annotate(
                f"{100 * r['box_share']:.0f} %",
                (r["seconds"], r["box_width"]),
                fontsize=7,
                xytext=(3, 3),
                textcoords="offset points",
                color="0.5",
            )
        ax.set(yscale="log", xlabel="ahead [s]", title=f"{group} [{UNITS[group]}]", xlim=(0, 1.2))
        ax.title.set_fontsize(9)
        ax.tick_params(labelsize=7)
        ax.spines[["top", "right"]].set_visible(False)
    figure.axes[0].legend(fontsize=7, frameon=False)
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=90, metadata={"Software": None})
    write_atomic(arguments.out, data.getvalue())


if __name__ == "__main__":
    main()
