"""The report of `greybox mpc`: from mpc.json (greybox.mpc/1), rows of flights and their traces to
one HTML page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from matplotlib.figure import Figure

from greybox.report import figures, mpc_figures
from greybox.report.html import Cell, Key, Report, script
from greybox.report.mpc_animation import CSS, Animation, look, markup, packed
from greybox.report.mpc_documents import (
    CELL,
    Counted,
    FlightRow,
    FlightTrace,
    MpcDocument,
    PlanTrace,
    Tuning,
)
from greybox.report.mpc_figures import COLOURS
from greybox.report.words import number

if TYPE_CHECKING:
    from greybox.symbolic import FloatArray

Traces: TypeAlias = Mapping[int, Mapping[str, FlightTrace]]
"""{seed: {controller: trace}}"""
AXES = ("c1", "c2", "c3")
"""Colours of x, y and z."""
MARGIN_KEY = (
    Key(text="worst flight", colour="ink"),
    Key(text="median flight", colour="ink", stroke="dash"),
)


def mpc_report(content: MpcDocument, rows: Sequence[FlightRow], traces: Traces) -> str:
    """The page. `content` follows schemas/mpc.json; rows and traces may be few or none (an
    interrupted run)."""
    what, found = content["what"], content["controllers"]
    flown = sum(c["flights"] for c in found.values())
    titles = {
        "demo": "Flying an identified model inside limits",
        "plant": f"Flying {what['model']} against {what['plant']}",
        "model": f"Flying {what['model']}",
    }
    report = Report(
        titles[what["mode"]],
        f"{flown} flights, {len(found)} controllers, at most {100 * content['level']:g} % of "
        "flights may cross a limit",
    )
    report.first_line(content["verdict"], good=_kept(content))
    with report.headline():
        panels = _margin_panels(content, rows, ("tube", content["what"]["plain"]))
        if panels:
            report.figures(panels, key=MARGIN_KEY)
        report.heading("What to do next")
        report.bullets(content["next"])
    for text in content["warnings"]:
        report.warning(text)
    _flight(report, content, rows, traces)
    _table(report, content)
    _what(report, content)
    _margins(report, content, rows)
    _unsure(report, content, traces)
    _limits(report, content, traces)
    _times(report, content, rows)
    _events(report, content)
    _reproduce(report, content)
    return report.html()


def _names(content: MpcDocument) -> list[str]:
    return [n for n, c in content["controllers"].items() if c["flights"]]


def _kept(content: MpcDocument) -> bool:
    """Whether the tube kept the limits as often as was asked for."""
    tube = content["controllers"].get("tube")
    if tube is None or tube["p_value"] is None:  # there are no flights
        return False
    return tube["p_value"] >= 0.05 and not tube["crashed"]


def _flight(
    report: Report, content: MpcDocument, rows: Sequence[FlightRow], traces: Traces
) -> None:
    data = packed(content, rows, traces)
    if not data["flights"]:
        return
    report.section("One flight, and what the tube planned")
    report.paragraph(
        "Every controller flies the same course in the same gusts. The blue tube is the plan of "
        f"the moment: where the vehicle will be over the next {number(data['ahead'], 2)} s, with "
        "ellipses that hold it in 95 of 100 cases. The plan keeps the limits by the half width of "
        "its tube, not by its middle. A cross marks where a controller was deepest beyond a limit."
    )
    report.live(markup(data), script("mpc_animation"), CSS)
    _passages(report, content, data)


def _passages(report: Report, content: MpcDocument, data: Animation) -> None:
    """What the animation shows, for paper: paths past every limit."""
    runs = [
        (name, run["path"])
        for f in data["flights"]
        for name, run in f["runs"].items()
        if not run["crashed"]
    ]
    # The tube is drawn over the others.
    drawn = [(path, *look(name)) for name, path in sorted(runs, key=lambda r: r[0] == "tube")]
    panels = []
    for plane in content["course"]["planes"]:
        figure = mpc_figures.paths(drawn, content["course"]["path"], plane, title=plane["name"])
        panels.append((figure, f"Flown paths near {plane['name']}"))
    count = len(data["flights"])
    report.figures(
        panels,
        key=[
            Key(text=c["name"], colour=c["colour"], stroke=c["stroke"])
            for c in data["controllers"]
            if any(name == c["name"] for name, _ in runs)
        ],
        caption=f"Paths past every limit in {count} flight{'s' * (count != 1)}, crashed ones left "
        "out; the limit is at 0 cm, beyond it is shaded.",
    )


def _counted(hits: Counted) -> str:
    low, high = hits["interval"]
    return f"{100 * low:.0f} .. {100 * high:.0f} %"


def _cost(name: str, content: MpcDocument) -> str | None:
    """Cost beyond that of the tube, in percent, with one standard error."""
    base, other = content["controllers"].get("tube"), content["differences"].get(name)
    if not base or not base["cost"] or not other:
        return None
    scale = 100 / base["cost"]
    if content["controllers"][name]["crashed"]:
        return "crashes"
    spread = f" ± {number(scale * other['error'], 2)}" if other["error"] is not None else ""
    if other["mean"] > 3 * base["cost"]:
        return f"{number(1 + other['mean'] / base['cost'], 2)} times"
    return f"{scale * other['mean']:+.1f}".replace("-", "\N{MINUS SIGN}") + f"{spread} %"


def _table(report: Report, content: MpcDocument) -> None:
    report.section("All flights")
    body: list[list[Cell]] = []
    for name, c in content["controllers"].items():
        if not c["flights"]:
            body.append([name, c["text"], "0 of 0", None, None, None, None, None, None])
            continue
        assert c["rmse"] is not None  # there are flights
        body.append(
            [
                name,
                c["text"],
                f"{c['crossed']['count']} of {c['flights']}",
                _counted(c["crossed"]),
                c["crashed"],
                c["tilted"],
                f"{100 * c['rmse']:.1f}",
                number(c["cost"], 3),
                _cost(name, content),
            ]
        )
    report.table(
        [
            "controller",
            "what it flies with",
            "beyond",
            "95 % interval",
            "crashed",
            "tilted",
            "RMSE [cm]",
            "cost",
            "against tube",
        ],
        body,
        numeric=(2, 3, 4, 5, 6, 7, 8),
        caption="Beyond: the true centre of mass crossed a plane, or the flight crashed. Interval: "
        "exact (Clopper and Pearson). Tilted: further than allowed. Cost: tracking cost per sample "
        "with the controller's own weights, 100 for a crash; against the tube: paired by seed, "
        "with one standard error.",
    )
    _planes(report, content)


def _planes(report: Report, content: MpcDocument) -> None:
    """How near every controller came to every limit."""
    planes = [p["name"] for p in content["course"]["planes"]]
    body: list[list[Cell]] = []
    for name in _names(content):
        c = content["controllers"][name]
        cells: list[Cell] = [name]
        for p in planes:
            margin = c["margins"][p]
            hits = c["crossed_planes"][p]
            nearest = (
                "\N{EN DASH}"
                if margin is None
                else f"{100 * margin:.1f}".replace("-", "\N{MINUS SIGN}")
            )
            cells.append(nearest + (f" ({hits})" if hits else ""))
        body.append(cells)
    with report.details("Which limit, and how far"):
        report.table(
            ["controller", *(f"{p} [cm]" for p in planes)],
            body,
            numeric=range(1, 1 + len(planes)),
            caption="Least distance of all flights to every limit, negative beyond it; in brackets "
            "how many flights crossed it.",
        )


def _what(report: Report, content: MpcDocument) -> None:
    report.section("What was flown")
    what, course, tuning = content["what"], content["course"], content["tuning"]
    plants = {
        "demo": "An independent simulated vehicle with effects that its data sheet does not know "
        "(motor lag, rotor and body drag, blade flapping, a centre of mass beside the middle), "
        "sensor noise and gusts. The models were identified from one flight of it: motor lag, "
        "rotor drag and centre of mass are fitted, body drag and flapping are left to what is "
        "learned.",
        "plant": f"The plant is {what['plant']}, independent of the model; disturbed by "
        f"{what['disturbed_by']}.",
        "model": "The plant is the identified model itself, with parameters drawn from their "
        f"covariance for every flight, disturbed by {what['disturbed_by']}. What the model's "
        "structure misses does not act here.",
    }
    report.paragraph(plants[what["mode"]])
    seeds = content["seeds"]
    rows = [
        ("Model", what["model"]),
        (
            "Learned part",
            ", ".join(what["learned"]) or "none: the tube knows noise and parameter errors alone",
        ),
        ("Identified from", ", ".join(what["trained_on"]) or "not said"),
        (
            "Course",
            f"{number(course['duration'], 3)} s, {len(course['planes'])} planes, tilt up to "
            f"{np.degrees(course['tilt_max']):.0f}°, commands {course['command_min']:g} to "
            f"{course['command_max']:g}",
        ),
        (
            "Pace",
            "as designed"
            if course["pace"] == 1
            else f"{number(course['pace'], 3)} times the time it was designed for",
        ),
        (
            "Controller",
            f"plans every {1e3 * course['plan_time']:.0f} ms over {course['horizon']} stages, one "
            "real-time "
            "iteration a plan; the identified filter estimates the state from measurements",
        ),
        ("Tube", _tightened(tuning)),
        (
            "Constant back-off",
            f"{1e3 * tuning['moved']:.1f} mm, from {tuning['flights']} training flights on this "
            "course",
        ),
        (
            "Gusts",
            f"seeds {seeds['first']} to {seeds['first'] + seeds['count'] - 1}, the same for every "
            "controller; training seeds are others",
        ),
    ]
    report.facts(rows)


def _tightened(tuning: Tuning) -> str:
    """Where the tube's back-off comes from."""
    touched = (
        f"{number(tuning['pairs'], 3)} limits that a flight without tightening touches "
        f"({tuning['flights']} flights)"
    )
    if tuning["risk"] == "boole":
        return (
            f"{number(tuning['kappa'], 3)} standard deviations, by Boole's inequality over "
            f"{touched}"
        )
    tried = ", ".join(
        f"{r['crossed']} of {r['flights']} at {r['kappa']:g}" for r in tuning["rehearsed"]
    )
    return (
        f"{number(tuning['kappa'], 3)} standard deviations, rehearsed on the model itself (beyond "
        f"a limit: {tried}); "
        f"Boole's inequality over {touched} would ask for {number(tuning['boole'], 3)}"
    )


def _margins(report: Report, content: MpcDocument, rows: Sequence[FlightRow]) -> None:
    panels = _margin_panels(content, rows, _names(content))
    if not panels:
        return
    report.section("How near the limits every controller came")
    report.figures(
        panels,
        key=MARGIN_KEY,
        caption="Distance of the true position to the nearest limit; below zero, shaded, is beyond "
        "it. Gaps: no limit near. A crashed flight ends where it left the course.",
    )


def _margin_panels(
    content: MpcDocument, rows: Sequence[FlightRow], names: Sequence[str]
) -> list[tuple[Figure, str]]:
    """Distance to the nearest limit over time of those of the controllers that flew."""
    panels: list[tuple[Figure, str]] = []
    for name in (n for n in names if any(r["controller"] == n for r in rows)):
        mine = [r["nearest"] for r in rows if r["controller"] == name]
        crashes = content["controllers"][name]["crashed"]
        title = f"{name}, {len(mine)} flights" + (f", {crashes} crashed" if crashes else "")
        figure = mpc_figures.margins(
            mine, CELL, content["course"]["duration"], title=title, colour=look(name)[0]
        )
        panels.append((figure, f"Distance to the nearest limit over time, {name}"))
    return panels


def _first(traces: Traces, name: str) -> FlightTrace | None:
    return next((runs[name] for runs in traces.values() if name in runs), None)


def _unsure(report: Report, content: MpcDocument, traces: Traces) -> None:
    tube = _first(traces, "tube")
    if tube is None or len(tube["plans"]) < 2:
        return
    report.section("Where the model was unsure")
    plans = tube["plans"]
    times = np.array([p["time"] for p in plans])
    wide = 100 * np.sqrt([[s[0], s[3], s[5]] for s in (p["spread"][-1] for p in plans)])
    rows = _unsure_rows(plans, content["what"]["learned"], wide)
    figure = figures.time_series(times, rows, title="First flight of the tube")
    place = np.array([p["place"][0] for p in plans])
    above = mpc_figures.sureness(
        place[:, :2],
        np.linalg.norm(wide, axis=1),
        [p["outside"] for p in plans],
        title="From above: the wider, the less sure",
    )
    report.figures(
        [
            (figure, "Uncertainty of the model along the first flight"),
            (above, "Flown path from above, wide where the plan was unsure"),
        ],
        key=[
            Key(text="x", colour="c1"),
            Key(text="y, outside data", colour="c2"),
            Key(text="z", colour="c3"),
        ],
        caption=(
            "Force and torque: standard deviation of the learned part, body axes. "
            if len(rows) > 2
            else ""
        )
        + "Plan's end: standard deviation of the position at the end of every plan, world axes. "
        "Outside data: how far state "
        "and command lie beyond what the training flights covered (0: inside).",
    )
    worst = int(np.argmax(np.asarray(wide).max(axis=1)))
    far = float(np.mean([p["outside"] > 0 for p in plans]))
    report.paragraph(
        f"The plan was least sure {number(float(times[worst]), 3)} s into the flight: "
        f"{number(float(np.max(wide)), 2)} cm at its "
        f"end. {100 * far:.0f} % of the plans began outside what the training flights covered"
        + (
            ", where a learned part fades and only its stated variance is left: fly training data "
            "there."
            if far > 0.2
            else "."
        )
    )


def _unsure_rows(
    plans: Sequence[PlanTrace], learned: Sequence[str], wide: FloatArray
) -> dict[str, Sequence[figures.Line]]:
    """Curves by row: standard deviations of the learned force and torque where a plan begins, those
    of the position at its end, `wide` (n, 3) [cm], and how far outside the data it begins."""
    rows: dict[str, Sequence[figures.Line]] = {}
    for kind, unit, scale in (("force", "N", 1.0), ("torque", "mN m", 1e3)):
        at = [k for k, n in enumerate(learned) if n.startswith(f"{kind}.")]
        sd = scale * np.array([[p["unsure"][k] for k in at] for p in plans])
        if sd.any():
            looks = [COLOURS[AXES["xyz".index(learned[k][-1])]] for k in at]
            rows[f"{kind} [{unit}]"] = [
                figures.Line(values=v, colour=c, width=1.3)
                for v, c in zip(sd.T, looks, strict=True)
                if v.any()
            ]
    rows["plan's end [cm]"] = [
        figures.Line(values=v, colour=COLOURS[c], width=1.3)
        for v, c in zip(wide.T, AXES, strict=True)
    ]
    rows["outside data"] = [
        figures.Line(values=[p["outside"] for p in plans], colour=COLOURS["ink"], width=1.1)
    ]
    return rows


def _limits(report: Report, content: MpcDocument, traces: Traces) -> None:
    plain = content["what"]["plain"]
    names = [n for n in ("tube", plain) if _first(traces, n) is not None]
    if not names:
        return
    report.section("Tilt and commands, with their limits")
    course, panels = content["course"], []
    for name in names:
        trace = _first(traces, name)
        assert trace is not None
        times = np.asarray(trace["time"], dtype=float)
        one = np.ones(len(times))
        tilt = np.degrees(np.asarray(trace["tilt"], dtype=float))
        commands = np.asarray(trace["commands"], dtype=float)
        looks = ("c1", "c2", "c3", "c5", "c4", "muted", "ink", "ink")

        def edge(height: float, one: FloatArray = one) -> figures.Line:
            return figures.Line(values=one * height, colour=COLOURS["ink"], style="--", width=0.8)

        rows: dict[str, Sequence[figures.Line]] = {
            "tilt [°]": [
                figures.Line(values=tilt, colour=COLOURS[look(name)[0]], width=1.4),
                edge(np.degrees(course["tilt_max"])),
            ],
            "commands": [
                *(
                    figures.Line(values=v, colour=COLOURS[c], width=0.9)
                    for v, c in zip(commands.T, looks, strict=False)
                ),
                edge(course["command_min"]),
                edge(course["command_max"]),
            ],
        }
        panels.append(
            (
                figures.time_series(times, rows, title=name),
                f"Tilt and commands of {name} in the first flight",
            )
        )
    report.figures(
        panels,
        caption="First flight. Dashed: the limits; one colour per rotor. Command limits are hard.",
    )


def _times(report: Report, content: MpcDocument, rows: Sequence[FlightRow]) -> None:
    names = [n for n in _names(content) if content["controllers"][n]["solve_ms"]["count"]]
    if not names:
        return
    report.section("Was it fast enough")
    deadline = 1e3 * content["course"]["sample_time"]
    times = {}
    for n in names:
        values = [t for r in rows if r["controller"] == n for t in r["solve_ms"]]
        if values:
            times[n] = (values, *look(n))
    if times:
        report.figure(
            mpc_figures.solve_times(times, deadline),
            key=[Key(text=n, colour=look(n)[0], stroke=look(n)[1]) for n in times],
            caption="One plan in C: linearisation, tube, quadratic programme. The deadline is one "
            "sample of the filter.",
            alt="Distribution of solution times",
        )
    body: list[list[Cell]] = []
    for n in names:
        c = content["controllers"][n]
        t = c["solve_ms"]
        body.append(
            [
                n,
                t["count"],
                f"{t['median']:.1f}",
                f"{t['p99']:.1f}",
                f"{t['worst']:.1f}",
                f"{c['late']['count']} of {c['late']['samples']}",
            ]
        )
    jobs = content["jobs"]
    report.table(
        ["controller", "plans", "median [ms]", "99 % below [ms]", "worst [ms]", "late answers"],
        body,
        numeric=(1, 2, 3, 4, 5),
        caption="Late answers: samples whose command took longer than a sample, filter, transfer "
        "and Python included."
        + (
            f" {jobs} flights ran at a time, which spoils these times a little." if jobs > 1 else ""
        ),
    )


def _events(report: Report, content: MpcDocument) -> None:
    """What was not as usual, and what was done; nothing where nothing happened."""
    found = content["controllers"]
    body: list[list[Cell]] = [
        [n, what, count, f"{found[n].get('descended', 0)} of {found[n]['flights']}"]
        for n in _names(content)
        for what, count in sorted(found[n]["events"].items(), key=lambda item: -item[1])
    ]
    if not body:
        return
    report.section("What went wrong, and what the controller did")
    report.table(
        ["controller", "event", "times", "flights with a declared descent"],
        body,
        numeric=(2, 3),
        caption="No solution: the plan before goes on with the ancillary gain. Not believed, "
        "doubted: a measurement that the filter leaves out, or lets count in part. No measurement, "
        "calls did not come: the filter predicts. Descent declared: the path is given up, straight "
        "down at half a metre a second.",
    )


def _reproduce(report: Report, content: MpcDocument) -> None:
    facts = [("Model file", content["what"]["model_sha256"])]
    report.reproduced_by(content["command"], facts, content["versions"])


def format_table(content: MpcDocument) -> str:
    """The table for a terminal."""
    lines = [
        f"{'controller':10s} {'flights':>7s} {'beyond':>6s} {'95 % interval':>14s} {'crashed':>7s} "
        f"{'tilted':>6s} {'RMSE [cm]':>9s} {'cost':>7s} {'median/99 % [ms]':>16s}"
    ]
    for name, c in content["controllers"].items():
        if not c["flights"]:
            lines.append(f"{name:10s} {0:7d}")
            continue
        t = c["solve_ms"]
        speed = f"{t['median']:.1f}/{t['p99']:.1f}" if t["count"] else "-"
        low, high = c["crossed"]["interval"]
        assert c["rmse"] is not None  # there are flights
        lines.append(
            f"{name:10s} {c['flights']:7d} {c['crossed']['count']:6d} {100 * low:5.0f} "
            f"..{100 * high:4.0f} % {c['crashed']:7d} {c['tilted']:6d} {100 * c['rmse']:9.2f} "
            f"{c['cost']:7.3f} {speed:>16s}"
        )
    return "\n".join(lines)
