"""What flights of several controllers say together: mpc.json (greybox.mpc/1), verdict and advice
included."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from greybox.model.identified import library_versions
from greybox.report.mpc_documents import (
    CourseController,
    CoursePart,
    Difference,
    FlightRow,
    MpcDocument,
    MpcFound,
    Tuning,
    What,
)
from greybox.symbolic import FloatArray
from mpc_export.mission.campaign import Entry
from mpc_export.mission.flight import Mission
from mpc_export.promise import counted, p_value


def crossed(row: FlightRow) -> bool:
    """Whether the flight was beyond a limit of its position, or crashed."""
    return bool(row["crashed"] or row["crossings"])


def summary(
    *,
    what: What,
    task: Mission,
    entries: Sequence[Entry],
    rows: Sequence[FlightRow],
    level: float,
    tuning: Tuning,
    seeds: Sequence[int],
    jobs: int,
    command: str,
    warnings: Sequence[str] = (),
) -> MpcDocument:
    """The content of mpc.json, from rows of flights in any number."""
    per = {e.name: [r for r in rows if r["controller"] == e.name] for e in entries}
    out: MpcFound = {
        "schema": "greybox.mpc/1",
        "command": command,
        "what": what,
        "level": level,
        "tuning": tuning,
        "seeds": {"first": min(seeds), "count": len(seeds)},
        "jobs": jobs,
        "course": _course(task),
        "controllers": {e.name: _controller(e, per[e.name], task, level) for e in entries},
        "differences": _differences(per),
    }
    return {
        **out,
        "verdict": verdict(out),
        "next": advice(out),
        "warnings": list(warnings),
        "versions": library_versions(),
    }


def _course(task: Mission) -> CoursePart:
    course = task.course
    times = np.asarray(np.arange(0.0, course.duration + 1e-9, 0.02 * task.pace))
    return {
        "duration": course.duration,
        "pace": task.pace,
        "lost": course.lost,
        "tilt_max": course.tilt_max,
        "command_min": course.command_min,
        "command_max": course.command_max,
        "sample_time": task.dt,
        "plan_time": task.problem.dt,
        "horizon": task.problem.horizon,
        "planes": [
            {
                "name": p.name,
                "normal": list(p.normal),
                "offset": p.offset,
                "where": {"xyz"[k]: list(v) for k, v in p.where.items()},
            }
            for p in course.planes
        ],
        "path": np.round(course.sample(times).position, 4).tolist(),
    }


def _controller(
    entry: Entry, rows: Sequence[FlightRow], task: Mission, level: float
) -> CourseController:
    n = len(rows)
    hits = sum(map(crossed, rows))
    tilted = sum(bool(r["crashed"] or r["tilt"] > task.course.tilt_max) for r in rows)
    solve = (
        np.concatenate([np.array(r["solve_ms"], dtype=float) for r in rows])
        if rows
        else np.zeros(0)
    )
    samples = sum(r["samples"] for r in rows)
    planes = [p.name for p in task.course.planes]
    events: dict[str, int] = {}
    for r in rows:
        for what, count in (
            r["event_kinds"].items()
            if "event_kinds" in r
            else ((e["what"], 1) for e in r["events"])
        ):
            events[what] = events.get(what, 0) + count
    return {
        "text": entry.text,
        "kind": entry.kind,
        "kappa": entry.kappa,
        "moved": entry.moved,
        "flights": n,
        "crossed": counted(hits, n),
        "p_value": p_value(hits, n, level),
        "crashed": sum(bool(r["crashed"]) for r in rows),
        "tilted": tilted,
        "margins": {
            p: min((r["margins"][p] for r in rows if r["margins"].get(p) is not None), default=None)
            for p in planes
        },
        "crossed_planes": {
            p: sum(any(c["plane"] == p for c in r["crossings"]) for r in rows) for p in planes
        },
        "rmse": _mean([r["rmse"] for r in rows]),
        "cost": _mean([r["cost"] for r in rows]),
        "solve_ms": {
            "count": len(solve),
            "median": _quantile(solve, 0.5),
            "p99": _quantile(solve, 0.99),
            "worst": float(solve.max()) if len(solve) else None,
        },
        "late": {"count": sum(r["late"] for r in rows), "samples": samples},
        "events": events,
        "event_count": sum(r["event_count"] for r in rows),
        "descended": sum(bool(r.get("descended")) for r in rows),
    }


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _quantile(values: FloatArray, share: float) -> float | None:
    return float(np.quantile(values, share)) if len(values) else None


def _differences(per: dict[str, list[FlightRow]]) -> dict[str, Difference]:
    """Cost of every controller minus that of the tube, paired by seed; standard error of the
    mean."""
    base = {r["seed"]: r["cost"] for r in per.get("tube", [])}
    out: dict[str, Difference] = {}
    for name, rows in per.items():
        away = np.array([r["cost"] - base[r["seed"]] for r in rows if r["seed"] in base])
        if name != "tube" and len(away):
            error = float(away.std(ddof=1) / np.sqrt(len(away))) if len(away) > 1 else None
            out[name] = {"mean": float(away.mean()), "error": error, "flights": len(away)}
    return out


def share(found: CourseController) -> str:
    """Crossed flights in words."""
    low, high = found["crossed"]["interval"]
    return (
        f"{found['crossed']['count']} of {found['flights']} ({100 * low:.0f} to {100 * high:.0f} %)"
    )


def verdict(content: MpcFound) -> str:
    """One sentence or two: did the tube keep its promise, and would the same model without it
    have?"""
    tube, plain = (content["controllers"].get(n) for n in ("tube", content["what"]["plain"]))
    level = f"{100 * content['level']:g} %"
    if not tube or not tube["flights"]:
        return "The tube has not flown yet."
    low, high = tube["crossed"]["interval"]
    did = f"{tube['crossed']['count']} of {tube['flights']} did"
    span = f"{100 * low:.0f} to {100 * high:.0f} %"
    assert tube["p_value"] is not None  # there are flights
    if tube["p_value"] < 0.05:
        first = (
            f"The tube broke its promise: at most {level} of flights were to go beyond a "
            f"limit, {did} "
        )
        first += f"(95 % interval {span})."
    elif high <= content["level"]:
        first = (
            f"The tube kept its promise: at most {level} of flights may go beyond a limit, {did} "
        )
        first += f"(95 % interval {span})."
    else:
        first = (
            f"The tube kept its promise so far: at most {level} of flights may go beyond a "
            f"limit, {did}; "
        )
        first += f"so few flights leave {span} open."
    if not plain or not plain["flights"]:
        return first
    return (
        f"{first} The same model without tightening went beyond one in "
        f"{plain['crossed']['count']} of {plain['flights']}."
    )


def advice(content: MpcFound) -> list[str]:
    """What to do next, most important first."""
    found, level = content["controllers"], content["level"]
    tube = found.get("tube")
    out: list[str] = []
    if not tube or not tube["flights"]:
        return ["Fly again: no flight of the tube was finished."]
    n = tube["flights"]
    out += _on_risk(content, tube, level)
    out += _on_cost(content, tube)
    if tube["descended"]:
        out.append(
            f"The tube gave the path up and came down in {tube['descended']} of {n} flights; the "
            "events of these say why: "
            "no steady command within the limits, no measured pose, or too far from the path."
        )
    late = tube["late"]
    if late["samples"] and late["count"] > 0.001 * late["samples"]:
        out.append(
            f"{late['count']} of {late['samples']} answers took longer than a sample, Python's "
            "share included: use a quiet "
            "machine, one --jobs, or a shorter horizon before this flies on hardware."
        )
    if tube["tilted"]:
        out.append(
            f"{tube['tilted']} flights of the tube tilted further than allowed: lower the pace or "
            "the tilt limit."
        )
    if content["what"]["mode"] == "model":
        out.append(
            "The plant here is the identified model: what its structure misses stays unseen. Fly "
            "the real vehicle with "
            "wider limits first, or give an independent simulation with --plant."
        )
    out.append(
        "Take the controller's model to the vehicle with greybox export --with "
        "covariance,filter,target."
    )
    return out


def _on_risk(content: MpcFound, tube: CourseController, level: float) -> list[str]:
    """Whether the tube crosses its limits as often as it was asked to."""
    out: list[str] = []
    n, (low, high) = tube["flights"], tube["crossed"]["interval"]
    assert tube["p_value"] is not None  # there are flights
    if tube["crashed"]:
        out.append(
            "The tube crashed: look at its flights first. A course that is too fast for the model "
            "(--pace), a plant that is "
            "another vehicle, or a model without the effect that matters are the usual reasons."
        )
    elif tube["p_value"] < 0.05:
        out.append(
            f"The limits are crossed more often than the {100 * level:g} % asked for: the model is "
            "surer than it should be. "
            "Fit and learn on flights like these (same speed, same wind), then fly again."
        )
    elif high < level:
        why = (
            "Boole's inequality is careful: --risk rehearsal counts what fails together."
            if content["tuning"]["risk"] == "boole"
            else "The model is less sure than it could be, or the plant kinder than it; a higher "
            "--level flies nearer."
        )
        out.append(f"The tube is more careful than it was asked to be. {why}")
    elif high > 2 * level:
        out.append(
            f"{n} flights leave the share between {100 * low:.0f} and {100 * high:.0f} %: fly more "
            f"of them, for example --flights {max(100, 5 * n)}; the ones that are there are kept."
        )
    return out


def _on_cost(content: MpcFound, tube: CourseController) -> list[str]:
    """What the tube costs beside one constant back-off."""
    out: list[str] = []
    found = content["controllers"]
    other = content["differences"].get("constant")
    if other and other["error"] is not None and tube["cost"] is not None:
        size, error = other["mean"], other["error"]
        if abs(size) < 2 * error:
            out.append(
                "The tube and one constant back-off cost the same within what these flights can "
                "tell apart."
            )
        elif size < 0:
            constant = found["constant"]
            out.append(
                f"One constant back-off of {1e3 * constant['moved']:.1f} mm costs "
                f"{100 * -size / tube['cost']:.0f} % less than the tube, with "
                f"{constant['crossed']['count']} of {constant['flights']} flights beyond a limit. "
                "It was chosen on training flights of this very course in these gusts; where "
                "either changes it must be chosen again."
            )
        else:
            out.append(
                f"The tube costs {100 * size / tube['cost']:.0f} % less than one constant back-off."
            )
    return out
