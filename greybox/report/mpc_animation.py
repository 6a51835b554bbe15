"""The animation of `greybox mpc`: flights packed as numbers, and the markup that mpc_animation.js
moves.

Four views (from above and from the side, each whole and close up) and the distance to the nearest
limit over time. The tube is the plan that stands at the moment, with 95 % ellipses of its
covariance and, in the distance, its back-off.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import TypeAlias, TypedDict

from greybox.report.html import Colour, Stroke, embedded_json
from greybox.report.mpc_documents import (
    Crossing,
    FlightRow,
    FlightTrace,
    MpcDocument,
    PlaneRow,
    PlanPath,
    PlanTrace,
)

Look: TypeAlias = tuple[Colour, Stroke]
LOOKS: Mapping[str, Look] = {
    "tube": ("c1", "line"),
    "hybrid": ("c2", "line"),
    "mean": ("c2", "line"),
    "constant": ("c3", "line"),
    "nominal": ("c4", "dash"),
    "pem": ("c5", "dash"),
    "cascade": ("ink", "dots"),
}
"""Colour and stroke of every controller, in all figures of the report."""

CSS = """
.flight { border: 1px solid var(--line); border-radius: 6px; padding: .8rem 1rem 1rem; margin: .8rem 0; }
.flight[hidden] { display: none; }
.flight .controls { display: flex; flex-wrap: wrap; gap: .5rem 1rem; align-items: center; position: sticky; top: 0;
  background: var(--ground); padding: .4rem 0; z-index: 2; }
.flight button, .flight select { font: inherit; color: var(--ink); background: var(--raised); padding: .35rem .9rem;
  border: 1px solid var(--muted); border-radius: 4px; min-height: 2.5rem; }
.flight select { padding: .35rem .4rem; flex: 0 1 auto; min-width: 0; }
.flight button { min-width: 5.5rem; font-weight: 600; }
.flight input[type=range] { flex: 1 1 12rem; min-width: 8rem; height: 2.5rem; accent-color: var(--c1); }
.flight output { font-variant-numeric: tabular-nums; flex: 1 0 100%; }
.flight .who { list-style: none; padding: 0; margin: .4rem 0; max-width: none; display: grid;
  grid-template-columns: repeat(auto-fill, minmax(min(100%, 19rem), 1fr)); gap: .1rem 1.2rem; font-size: .9rem; }
.flight .who label { display: inline-flex; align-items: center; gap: .4rem; min-height: 2rem; }
.flight .who input { accent-color: currentColor; width: 1.05rem; height: 1.05rem; }
.flight .who .stroke { width: 1.5rem; border-top: 3px solid; flex: none; }
.flight .who .dash { border-top-style: dashed; }
.flight .who .dots { border-top-style: dotted; }
.flight .who b { font-weight: 500; color: var(--warn); }
.flight .views { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 27rem), 1fr)); gap: .7rem 1rem; }
.flight .views > div > svg, .flight > svg { border: 1px solid var(--line); border-radius: 4px; }
.flight h4 { margin: .2rem 0 .2rem; font-size: .9rem; font-weight: 600; }
.flight svg { width: 100%; height: auto; display: block; overflow: hidden; }
.flight svg text { font: 13px var(--sans); fill: var(--muted); }
.flight svg polyline, .flight svg path { fill: none; vector-effect: non-scaling-stroke; }
.flight .wanted { stroke: var(--muted); stroke-width: 1; stroke-dasharray: 2 4; opacity: .7; }
.flight .edge { stroke: var(--ink); stroke-width: 2; vector-effect: non-scaling-stroke; }
.flight .beyond { fill: var(--c2); opacity: .22; }
.flight .beyond-text { fill: var(--c2); }
.flight .grid { stroke: var(--line); }
.flight .now { stroke: var(--muted); stroke-dasharray: 4 3; }
.flight .faint { stroke-width: 1; opacity: .4; }
.flight .strong { stroke-width: 2; }
.flight .strong.dash { stroke-dasharray: 6 3; }
.flight .strong.dots { stroke-dasharray: 2 3; }
.flight .tube polygon, .flight .band { fill: var(--c1); fill-opacity: .2; stroke: var(--c1); stroke-width: 1;
  stroke-opacity: .65; vector-effect: non-scaling-stroke; }
.flight .tube .link { stroke: none; fill-opacity: .28; }
.flight .tube polygon:not(.link) { fill-opacity: .06; stroke-opacity: .45; }
.flight .plan { stroke: var(--c1); stroke-width: 1.5; stroke-dasharray: 4 3; }
.flight .dot { stroke: var(--ground); stroke-width: 1.5; }
.flight .cross path { stroke-width: 2.5; }
.flight .bar10 line { stroke: var(--ink); stroke-width: 2; }
@media print { .flight { display: none; } }
"""


class ControllerShown(TypedDict):
    """A controller beside the box that shows or hides it."""

    name: str
    text: str
    colour: Colour
    stroke: Stroke


class RunShown(TypedDict):
    """A flight of one controller: path (n, 3) and distance to the nearest limit (n,) [m]."""

    path: list[list[float]]
    near: list[float | None]
    crossings: list[Crossing]
    crashed: bool


class FlightShown(TypedDict):
    """A flight of every controller, and the plans of the tube."""

    seed: int
    runs: dict[str, RunShown]
    plans: list[PlanPath]


class CourseShown(TypedDict):
    """Limits and the path in equal steps [s]."""

    planes: list[PlaneRow]
    path: list[list[float]]
    step: float


class Animation(TypedDict):
    """What mpc_animation.js reads: seconds between samples, a plan's length and the times of its
    stages [s], the controller without tightening."""

    step: float
    ahead: float
    times: list[float]
    stages: int
    plain: str
    course: CourseShown
    controllers: list[ControllerShown]
    flights: list[FlightShown]


def look(name: str) -> Look:
    """(colour, stroke) of a controller."""
    return LOOKS.get(name, ("c4", "dash"))


def packed(
    content: MpcDocument,
    rows: Sequence[FlightRow],
    traces: Mapping[int, Mapping[str, FlightTrace]],
) -> Animation:
    """Numbers of the animation from mpc.json, rows of flights and {seed: {controller: trace}};
    positions in metres."""
    course = content["course"]
    by_flight = {(r["controller"], r["seed"]): r for r in rows}
    flights: list[FlightShown] = []
    times, step = [0.0], course["plan_time"]
    for seed, runs in traces.items():
        found: dict[str, RunShown] = {}
        plans: list[PlanPath] = []
        for name, trace in runs.items():
            row = by_flight.get((name, seed))
            if row is None or len(trace["time"]) < 2:
                continue
            step = trace["time"][1] - trace["time"][0]
            found[name] = {
                "path": [[round(v, 3) for v in p] for p in trace["path"]],
                "near": trace["nearest"],
                "crossings": row["crossings"],
                "crashed": row["crashed"],
            }
            if name == "tube":
                plans = [_path(p) for p in trace["plans"]]
        if found:
            flights.append({"seed": seed, "runs": found, "plans": plans})
        if plans:
            n = len(plans[0]["place"])
            times = [course["plan_time"] * round(course["horizon"] * i / (n - 1)) for i in range(n)]
    names = [n for n in content["controllers"] if any(n in f["runs"] for f in flights)]
    return {
        "step": step,
        "ahead": course["horizon"] * course["plan_time"],
        "times": times,
        "stages": len(times),
        "plain": content["what"]["plain"],
        "course": {
            "planes": course["planes"],
            "path": course["path"],
            "step": course["duration"] / max(1, len(course["path"]) - 1),
        },
        "controllers": [
            {
                "name": n,
                "text": content["controllers"][n]["text"],
                "colour": look(n)[0],
                "stroke": look(n)[1],
            }
            for n in names
        ],
        "flights": flights,
    }


def _path(plan: PlanTrace) -> PlanPath:
    """The part of a plan that is drawn."""
    return {
        "time": plan["time"],
        "place": plan["place"],
        "spread": plan["spread"],
        "left": plan["left"],
        "backoff": plan["backoff"],
    }


def who_flies(controllers: Sequence[ControllerShown], said: str) -> str:
    """Items of a list: a box, the stroke, and the place `said`-NAME for the words of every
    controller."""
    return "".join(
        f'<li><label><input type="checkbox" checked="checked" value="{escape(c["name"])}"/>'
        f'<span class="stroke {c["stroke"]}" style="color: var(--{c["colour"]})"></span>'
        f"<span>{escape(c['name'])}: {escape(c['text'])} <b "
        f'id="{said}-{escape(c["name"])}"></b></span></label></li>'
        for c in controllers
    )


def which_flight(seeds: Iterable[int]) -> str:
    """Options of a choice, one for the flight of every seed."""
    return "".join(
        f'<option value="{i}">Flight {i + 1} (seed {seed})</option>' for i, seed in enumerate(seeds)
    )


def markup(data: Animation) -> str:
    """The animation's frame with its data; shown by the script alone, so that without one the
    figures below stand for it."""
    text = embedded_json(data)
    who = who_flies(data["controllers"], "said")
    choices = which_flight(f["seed"] for f in data["flights"])
    views = "".join(
        f'<div><h4>{title}</h4><svg id="{name}" role="img" aria-label="{label}"></svg></div>'
        for name, title, label in (
            ("above", "From above", "The course, its limits and the flown paths, from above"),
            (
                "above-close",
                "From above, with the vehicle",
                "Tube and paths near the vehicle, from above",
            ),
            ("side", "From the side", "The course, its limits and the flown paths, from the side"),
            (
                "side-close",
                "From the side, with the vehicle",
                "Tube and paths near the vehicle, from the side",
            ),
        )
    )
    paces = "".join(
        f'<option value="{v}"{" selected=" + chr(34) + "selected" + chr(34) if v == 0.25 else ""}>{t}</option>'
        for v, t in (
            (0.1, "1/10 speed"),
            (0.25, "1/4 speed"),
            (0.5, "half speed"),
            (1, "full speed"),
        )
    )
    return (
        '<div class="flight" id="flight" hidden="hidden"><div class="controls">'
        '<button type="button" id="flight-play" aria-pressed="false">Play</button>'
        '<input type="range" id="flight-time" min="0" max="1" step="0.02" value="0" '
        'aria-label="Time in the flight"/>'
        f'<select id="flight-pace" aria-label="Speed of the animation">{paces}</select>'
        f'<select id="flight-choice" aria-label="Flight">{choices}</select>'
        '<output id="flight-readout" for="flight-time"></output>'
        '<span id="flight-still" hidden="hidden">Your system asks for less motion: move the '
        "slider.</span></div>"
        f'<ul class="who" aria-label="Controllers">{who}</ul><div class="views">{views}</div>'
        "<h4>Distance to the nearest limit [cm]</h4>"
        '<svg id="distance" role="img" aria-label="Distance to the nearest limit over time, and '
        'what the tube plans"></svg>'
        f'</div><script type="application/json" id="flight-data">{text}</script>'
    )
