"""`greybox mpc --mcap F.mcap`: the watched flights of every controller beside each other, with
their plans.

One channel per flight, controller and kind, /flight_SEED/CONTROLLER/KIND; all flights begin at
zero, so that controllers fly side by side.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from greybox.commands.mcap_out import WARNING, WORLD, Recording, pose_of, recording, rows_of
from greybox.report.mpc_documents import FlightRow, FlightTrace

_LEVEL = [1.0, 0.0, 0.0, 0.0]
"""Attitude of the places of a plan, which has none of its own here."""
MARGIN = "greybox.Margin"


def write_mpc_mcap(
    path: str | Path,
    rows: Sequence[FlightRow],
    traces: Mapping[int, Mapping[str, FlightTrace]],
) -> None:
    """`rows` of flights and {seed: {controller: trace}}, as the campaign keeps them."""
    by_flight = {(r["controller"], r["seed"]): r for r in rows}
    with recording(path) as out:
        out.declare(rows_of(MARGIN, ("value",), ("nearest", "tilt")))
        for seed, runs in traces.items():
            for name, trace in runs.items():
                _flight(out, f"/flight_{seed}/{name}", trace, by_flight.get((name, seed)))


def _flight(out: Recording, root: str, trace: FlightTrace, row: FlightRow | None) -> None:
    # Traces of earlier versions have no attitude.
    attitude = trace.get("attitude") or [_LEVEL] * len(trace["path"])
    poses = [pose_of((*p, *q)) for p, q in zip(trace["path"], attitude, strict=True)]
    for t, pose, nearest, tilt in zip(
        trace["time"], poses, trace["nearest"], trace["tilt"], strict=True
    ):
        out.pose(root, t, pose, craft=root.replace("/", " ").strip())
        far = math.inf if nearest is None else nearest
        out.message(f"{root}/margin", MARGIN, t, {"value": {"nearest": far, "tilt": tilt}})
    out.message(
        f"{root}/path",
        "foxglove.PosesInFrame",
        trace["time"][0],
        {"frame_id": WORLD, "poses": poses},
    )
    for plan in trace["plans"]:
        places = [pose_of((*p, *_LEVEL)) for p in plan["place"]]
        out.message(
            f"{root}/plan",
            "foxglove.PosesInFrame",
            plan["time"],
            {"frame_id": WORLD, "poses": places},
        )
    if row is None:
        return
    for event in row["events"]:
        out.log(f"{root}/events", event["time"], event["what"])
    for crossing in row["crossings"]:
        text = f"{1e3 * crossing['depth']:.0f} mm beyond {crossing['plane']}"
        out.log(f"{root}/crossings", crossing["time"], text, level=WARNING)
