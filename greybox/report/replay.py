"""The replay of a flight in three dimensions: what was measured, and as a ghost what the model said
before."""

from __future__ import annotations

import base64
from dataclasses import dataclass

import numpy as np

from greybox.report.html import Report, embedded_json, script
from greybox.symbolic import FloatArray

CSS = """
.replay { border: 1px solid var(--line); border-radius: 6px; padding: .6rem .8rem; margin: .8rem 0; }
.replay[hidden] { display: none; }
.replay canvas { display: block; width: 100%; height: clamp(15rem, 46vw, 30rem); touch-action: none; cursor: grab; }
.replay .controls { display: flex; flex-wrap: wrap; gap: .3rem .9rem; align-items: center; }
.replay button, .replay select { font: inherit; color: var(--ink); background: var(--raised); padding: .3rem .8rem;
  border: 1px solid var(--muted); border-radius: 4px; min-height: 2.4rem; }
.replay label { display: inline-flex; flex: 1 1 14rem; align-items: center; gap: .5rem; min-width: 0; }
.replay input { flex: 1 1 8rem; min-width: 6rem; height: 2.4rem; accent-color: var(--c1); }
.replay label + label input { accent-color: var(--c2); }
.replay output, .replay .ahead { font-variant-numeric: tabular-nums; }
.replay .ahead { flex: none; }
@media print { .replay { display: none; } }
"""
SECONDS = 1.0
"""Longest horizon [s]: as far as a verdict looks."""
STEP = 0.05
"""Time between poses [s]: no craft turns by more than the eye follows in it."""
ORIGINS = 600
"""Most moments from which a prediction is kept, some 250 kB."""


@dataclass(frozen=True, kw_only=True)
class Replay:
    """Poses: position (x, y, z) [m] in the world, attitude (qw, qx, qy, qz), z up.

    `measured` (n, 7) every `step` s from `begin` [s]; `predicted` (m, k + 1, 7) from moments
    `stride` s apart, the first at `begin`, at 0, 1, .. k steps after each. `arm` [m] is the length
    of the arms that are drawn.
    """

    begin: float
    step: float
    stride: float
    measured: FloatArray
    predicted: FloatArray
    arm: float = 0.1


def replay(report: Report, name: str, flight: Replay) -> None:
    """Add the replay to a page; without its script nothing of it is seen."""
    position = flight.measured[:, :3]
    middle = 0.5 * (position.min(axis=0) + position.max(axis=0))
    # A ghost that flew away is drawn at the edge of four times the room.
    size = 2.0 * max(float(np.ptp(position, axis=0).max()), 1.0)
    data = {
        "begin": round(flight.begin, 4),
        "step": flight.step,
        "stride": flight.stride,
        "arm": flight.arm,
        "steps": flight.predicted.shape[1] - 1,
        "origins": len(flight.predicted),
        "middle": middle.tolist(),
        "size": size,
        "measured": _packed(flight.measured, middle, size),
        "predicted": _packed(flight.predicted, middle, size),
    }
    report.live(
        '<div class="replay" hidden="hidden">'
        '<canvas tabindex="0" role="img" aria-label="The flight in three dimensions and the '
        "prediction of the model as a "
        'ghost; arrow keys turn the view"></canvas><div class="controls"><button '
        'type="button">Play</button>'
        '<select aria-label="Speed of the replay"><option value="0.25">1/4 speed</option>'
        '<option value="1" selected="selected">full speed</option><option value="4">4 '
        "times</option></select>"
        '<button type="button">Close up</button>'
        '<label>time <input type="range" min="0" max="1" step="0.01" value="0"/></label>'
        '<label>ghost <input type="range" min="0.05" max="1" step="0.05" value="0.5"/><span '
        'class="ahead"></span></label>'
        f"</div><output></output>"
        f'<script type="application/json">{embedded_json(data)}</script></div>',
        script("replay"),
        CSS,
    )
    report.note(
        f"{name}: dark, the craft as it was measured, with its last two seconds; orange, dashed, "
        "where the model said "
        "before that it would be, from the commands alone. Drag to turn the view."
    )


def _packed(poses: FloatArray, middle: FloatArray, size: float) -> str:
    """Poses (..., 7) as whole numbers of 16 bit in base64: positions as shares of `size` about
    `middle`."""
    scaled = np.array(poses, dtype=np.float64)
    scaled[..., :3] = (scaled[..., :3] - middle) / size
    whole = np.clip(np.rint(32767 * np.nan_to_num(scaled)), -32767, 32767).astype("<i2")
    return base64.b64encode(whole.tobytes()).decode()
