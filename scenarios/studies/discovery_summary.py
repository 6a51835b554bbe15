"""Tables and figures of the discovery grid: rates with Wilson intervals, confusion, power,
parameters, gap, times.

Wilson 1927, JASA 22(158): the interval of a binomial share that keeps its level near 0 and 1.
"""

from __future__ import annotations

import io
import itertools
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from greybox.files import write_atomic
from scenarios.studies.rows import wilson

Row = dict[str, Any]
VERDICTS = ("right", "group", "part", "silent", "extra", "wrong", "failed")
FLIGHTS, RATE = 2, 100
"""Training flights of a log, and their samples per second where a row does not say."""
KEPT = "scenarios/results/discovery_grid*.jsonl.gz"
"""Rows behind the documentation."""
POWER = 3.0
"""log10 e of the oracle from which on the flights show an effect: beyond what a name needs of 29
offered at 0.05."""
JUDGING = 1000
"""Seeds from here on judge; those below were used while the code was written."""


def _share(hits: int, total: int) -> str:
    low, high = wilson(hits, total)
    return f"{hits}/{total} = {100 * hits / max(total, 1):.1f} % ({100 * low:.1f}-{100 * high:.1f})"


def _label(row: Row) -> tuple[str, ...]:
    rate = row.get("rate", RATE)
    length = f"{row['seconds']:g} s" + ("" if rate == RATE else f" at {rate:g} Hz")
    return (
        row["kind"],
        row["size"],
        row["vehicle"],
        row["nominal"],
        row["noise"],
        row["columns"],
        length,
    )


def _grouped(rows: Iterable[Row], key: Callable[[Row], Any]) -> dict[Any, list[Row]]:
    out: dict[Any, list[Row]] = defaultdict(list)
    for r in rows:
        out[key(r)].append(r)
    return dict(sorted(out.items(), key=lambda item: str(item[0])))


def false_names(row: Row, alpha: float) -> bool:
    """Whether a clean flight got a name (or a set) at this level; runs are made at 0.05."""
    if row["judged"] in ("right", "silent", "failed"):
        return False
    said = [e for n, e in row["log10_e"].items() if n in row["effects"]]
    # Causes offered over alpha, as the run at 0.05 had it.
    return not said or max(said) >= np.log10(row.get("offered", 29) / alpha)


def rates(rows: Sequence[Row]) -> list[str]:
    """Lines of a table: verdicts per kind of cell."""
    lines = [
        "| cell | " + " | ".join(VERDICTS) + " | right or group (95 %) | false (95 %) |",
        "|---|" + "---|" * (len(VERDICTS) + 2),
    ]
    for label, members in _grouped(rows, _label).items():
        c = Counter(r["judged"] for r in members)
        n = len(members)
        good = c["right"] + (c["silent"] if label[0] == "clean" else c["group"])
        lines.append(
            f"| {' '.join(label)} | "
            + " | ".join(str(c[v]) for v in VERDICTS)
            + f" | {_share(good, n)} | {_share(c['extra'] + c['wrong'], n)} |"
        )
    return lines


def clean_rates(rows: Sequence[Row]) -> list[str]:
    """Lines: false names on clean flights at two levels, unnamed laws there."""
    lines = ["| clean flights | alpha 0.05 | alpha 0.01 | called unnamed |", "|---|---|---|---|"]
    clean = [r for r in rows if r["kind"] == "clean" and r["judged"] != "failed"]
    groups = _grouped(clean, lambda r: _label(r)[2:])
    for label, members in [*groups.items(), (("all",), clean)]:
        n = len(members)
        cells = [_share(sum(false_names(r, a) for r in members), n) for a in (0.05, 0.01)]
        lines.append(
            f"| {' '.join(label)} | {' | '.join(cells)} | "
            f"{_share(sum(bool(r['unnamed']) for r in members), n)} |"
        )
    return lines


def recall(rows: Sequence[Row]) -> list[str]:
    """Lines: recall and precision where several effects hide (members of a group that holds a
    hidden effect count)."""
    lines = []
    for kind in ("pair", "triple", "five"):
        hits = wanted = named = true = 0
        for r in rows:
            if r["kind"] != kind or r["judged"] == "failed":
                continue
            truth = set(r["hidden"])
            groups = [{n for c in a for n in c.split("+")} for a in r["ambiguous"]]
            wanted += len(truth)
            hits += len(truth & (set(r["effects"]).union(*groups)))
            named += len(r["effects"]) + len(groups)
            true += len(truth & set(r["effects"])) + sum(bool(g & truth) for g in groups)
        if wanted:
            lines.append(f"{kind}: recall {_share(hits, wanted)}, precision {_share(true, named)}")
    return lines


def _power(row: Row) -> bool:
    """Whether the oracle certifies every hidden effect."""
    known = row["oracle"].get("log10_e", {})
    return bool(known) and min(known.values()) >= POWER


def against_oracle(rows: Sequence[Row]) -> list[str]:
    """Lines: verdicts where the search could have known (discovery_oracle), and what it closed of
    what can be closed."""
    lines = [
        "| cell | the oracle is certified | of these right | group, tied with the oracle | group, "
        "not tied | silent | no power | of these silent | share of the oracle's gap closed at 0.5 "
        "s: median, worst (logs) |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for label, members in _grouped([r for r in rows if r.get("oracle")], _label).items():
        power = [r for r in members if _power(r)]
        c = Counter(r["judged"] for r in power)
        groups = [r["oracle"]["rivals"].values() for r in power if r["judged"] == "group"]
        # A rival that these columns cannot show at all (sensor_delay without a pose) is the same
        # word for them.
        tied = sum(max(g, default=np.inf) > -POWER * np.log(10) for g in groups)
        weak = [r for r in members if r not in power]
        closed = [
            r["oracle"]["closed"]
            for r in power
            if r["judged"] == "right" and r["oracle"]["closed"] is not None
        ]
        share = f"{np.median(closed):.4f}, {min(closed):.4f} ({len(closed)})" if closed else "-"
        lines.append(
            f"| {' '.join(label)} | {len(power)} | {_share(c['right'], len(power))} | {tied} | "
            f"{len(groups) - tied} | {c['silent']} | {len(weak)} | "
            f"{sum(r['judged'] == 'silent' for r in weak)} | {share} |"
        )
    return lines if len(lines) > 2 else []


def ties(rows: Sequence[Row]) -> list[str]:
    """Lines: the sets that hold the truth, with the log evidence of each rival less the oracle's;
    silences with power."""
    lines = []
    for r in rows:
        if not r.get("oracle"):
            continue
        where = f"{' '.join(_label(r))} {r['seed']} {'+'.join(r['hidden'])}"
        if r["judged"] == "group":
            lines.append(
                f"{where}: group: "
                + ", ".join(f"{n} {v:+.1f}" for n, v in r["oracle"]["rivals"].items())
            )
        elif r["judged"] == "silent" and _power(r):
            known = ", ".join(f"{n} {e:.1f}" for n, e in r["oracle"]["log10_e"].items())
            lines.append(f"{where}: silent: log10 e of the oracle {known}")
    return lines


def parameters(rows: Sequence[Row]) -> list[str]:
    """Lines: relative errors of right names and coverage of their intervals."""
    errors: dict[str, list[float]] = defaultdict(list)
    inside: dict[str, list[bool]] = defaultdict(list)
    for r in rows:
        if r["judged"] != "right":
            continue
        for effect, own in r["effects"].items():
            for name, (value, std) in own.items():
                true = r["truth"].get(f"{effect}.{name}", 0.0)
                if true:
                    errors[r["size"]].append(abs(value - true) / abs(true))
                if std:
                    inside[r["size"]].append(abs(value - true) <= 1.96 * std)
    lines = [
        "| size | values | median error | 90th percentile | 95 % intervals that cover |",
        "|---|---|---|---|---|",
    ]
    for size, e in errors.items():
        lines.append(
            f"| {size} | {len(e)} | {100 * np.median(e):.2g} % | {100 * np.quantile(e, 0.9):.2g} % "
            f"| {_share(sum(inside[size]), len(inside[size]))} |"
        )
    return lines


def gap_and_time(rows: Sequence[Row]) -> list[str]:
    """Lines: share of the gap closed half a second ahead in the most affected group, and
    seconds."""
    lines = []
    for size, members in _grouped(
        [r for r in rows if r["kind"] != "clean"], lambda r: r["size"]
    ).items():
        closed = [r["closed"][1] for r in members if r["judged"] == "right" and r["closed"]]
        if closed:
            lines.append(
                f"gap closed 0.5 s ahead, {size}: median {np.median(closed):.3f}, worst "
                f"{min(closed):.3f} of {len(closed)}"
            )
    for kind, members in _grouped([r for r in rows if "took" in r], lambda r: r["kind"]).items():
        seconds = [r["took"] for r in members]
        lines.append(
            f"seconds, {kind}: median {np.median(seconds):.1f}, longest {max(seconds):.1f}"
        )
    return lines


def confusion(
    rows: Sequence[Row],
) -> tuple[list[str], list[str], np.ndarray[Any, np.dtype[np.int_]]]:
    """(hidden effects, what was said, counts) of single effects."""
    single = [r for r in rows if r["kind"] == "single" and r["judged"] != "failed"]
    hidden = sorted({r["hidden"][0] for r in single})
    said = []
    for r in single:
        truth = r["hidden"][0]
        false = [n for n in r["effects"] if n != truth]
        said.append(
            (truth, false[0] if false else truth if r["judged"] == "right" else f"({r['judged']})")
        )
    columns = [
        *sorted({s for _, s in said if not s.startswith("(")} | set(hidden)),
        "(group)",
        "(silent)",
        "(wrong)",
    ]
    counts = np.zeros((len(hidden), len(columns)), dtype=int)
    for truth, name in said:
        counts[hidden.index(truth), columns.index(name if name in columns else "(wrong)")] += 1
    return hidden, columns, counts


def troubles(rows: Sequence[Row]) -> list[str]:
    """Lines: every case that is neither right nor silent nor a group."""
    return [
        f"{' '.join(_label(r))} {r['seed']} {'+'.join(r['hidden']) or 'clean'}: {r['judged']}: "
        + (", ".join(r.get("effects", ())) or r.get("error", "") or str(r.get("ambiguous")))
        for r in rows
        if r["judged"] in ("wrong", "extra", "failed")
    ]


def summary(rows: Sequence[Row]) -> str:
    """Everything as text."""
    hidden, columns, counts = confusion(rows)
    matrix = [
        f"{h}: " + ", ".join(f"{columns[j]} {counts[i, j]}" for j in np.flatnonzero(counts[i]))
        for i, h in enumerate(hidden)
    ]
    parts = [
        rates(rows),
        clean_rates(rows),
        against_oracle(rows),
        recall(rows),
        parameters(rows),
        gap_and_time(rows),
        matrix,
        ties(rows),
        troubles(rows),
    ]
    return "\n\n".join("\n".join(p) for p in parts if p)


def page(rows: Sequence[Row]) -> str:
    """`discovery_results.md`, from rows of judging seeds."""
    text = [
        "# Discovery: what the grid says",
        "",
        f"Written by `zcat {KEPT} > rows.jsonl` and `python -m scenarios.studies.discovery_grid "
        "--out rows.jsonl --summary",
        f"--docs tables`; {len(rows)} logs with seeds from {JUDGING} on, which nothing was tuned "
        "on, by the versions that",
        "`scenarios/results/README.md` lists. Shares with 95 % Wilson intervals.",
        "",
        *rates(rows),
        "",
        *clean_rates(rows),
        "",
        "The oracle is the structure that is told the hidden effects, on the same flights; where "
        "it is not certified, the",
        "flights hardly show them.",
        "",
        *against_oracle(rows),
        "",
        *(f"- {x}" for x in recall(rows)),
        "",
        *parameters(rows),
        "",
        *(f"- {x}" for x in gap_and_time(rows)),
        "",
        "## Every false name",
        "",
        *([f"- {x}" for x in troubles(rows)] or ["None."]),
        "",
        "## Sets that hold the truth (log evidence of the rival less the oracle's), and silences "
        "with power",
        "",
        *([f"- {x}" for x in ties(rows)] or ["None."]),
        "",
        "![confusion matrix](images/discovery_confusion.svg)",
        "",
        "![power](images/discovery_power.svg)",
        "",
    ]
    return "\n".join(text)


def write_docs(rows: Sequence[Row], folder: Path) -> None:
    """`discovery_results.md` and two figures, from the judging seeds only."""
    rows = [r for r in rows if r["seed"] >= JUDGING]
    write_atomic(folder / "discovery_results.md", page(rows))
    (folder / "images").mkdir(exist_ok=True)
    for name, figure in (("confusion", _confusion_figure(rows)), ("power", _power_figure(rows))):
        stream = io.StringIO()
        figure.savefig(stream, format="svg", metadata={"Date": None})
        write_atomic(folder / "images" / f"discovery_{name}.svg", stream.getvalue())


def _confusion_figure(rows: Sequence[Row]) -> Figure:
    hidden, columns, counts = confusion([r for r in rows if r["size"] != "near"])
    figure = Figure(figsize=(9, 7.5), layout="constrained")
    axes = figure.subplots()
    axes.imshow(
        counts / np.maximum(counts.sum(axis=1, keepdims=True), 1), cmap="Blues", vmin=0, vmax=1
    )
    for i, j in np.argwhere(counts):
        axes.text(j, i, str(counts[i, j]), ha="center", va="center", fontsize=6)
    axes.set_xticks(range(len(columns)), columns, rotation=90, fontsize=6)
    axes.set_yticks(range(len(hidden)), hidden, fontsize=6)
    axes.set_xlabel("said", fontsize=8)
    axes.set_ylabel("hidden (large and medium)", fontsize=8)
    return figure


def _power_figure(rows: Sequence[Row]) -> Figure:
    """Shares of single effects against their size in noise, and against that times the root of the
    number of samples."""
    figure = Figure(figsize=(8, 3), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    single = [
        r for r in rows if r["kind"] == "single" and r["in_noise"] and r["judged"] != "failed"
    ]
    size = np.array([r["in_noise"] for r in single])
    samples = np.array([FLIGHTS * r["seconds"] * r.get("rate", RATE) for r in single])
    _power_axes(left, single, size)
    left.set_xlabel("RMS change of the one-step errors, in their standard deviations", fontsize=8)
    left.set_ylabel("share of logs", fontsize=8)
    _power_axes(right, single, size * np.sqrt(samples))
    right.set_xlabel("the same, times the root of the number of samples", fontsize=8)
    left.legend(fontsize=7, frameon=False)
    return figure


def _power_axes(axes: Axes, single: Sequence[Row], at: npt.NDArray[np.float64]) -> None:
    if single:
        size = np.log10(at)
        edges = np.linspace(
            size.min() - 1e-9, size.max() + 1e-9, min(8, max(2, len(single) // 8)) + 1
        )
        kinds = {
            "right": ("right",),
            "right or group": ("right", "group"),
            "false": ("wrong", "extra"),
        }
        for name, verdicts in kinds.items():
            points = []
            for low, high in itertools.pairwise(edges):
                members = [r for r, v in zip(single, size, strict=True) if low <= v < high]
                if members:
                    points.append(
                        (
                            10 ** (0.5 * (low + high)),
                            np.mean([r["judged"] in verdicts for r in members]),
                        )
                    )
            axes.plot(*zip(*points, strict=True), "o-", label=name, markersize=3, linewidth=1)
    axes.set_xscale("log")
    axes.tick_params(labelsize=7)
