"""What is left of the commands at hover: said before a vehicle flies that cannot hold what pushes it.

For every push (a steady force and torque) the steady command that holds place and heading is solved
for. Beyond its limits the heading gives way first (mpc_export/tube/heading.py); where that is not
enough, the vehicle sinks or drifts, and the controller declares a descent after half a second.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from greybox.errors import ModelError
from greybox.model.identified import IdentifiedModel
from greybox.symbolic import FloatArray
from mpc_export.feedback import hover
from mpc_export.functions import ModelFunctions
from mpc_export.tube.heading import turning, within

DRAWS, NEWTON = 200, 4
"""Pushes that are looked at, and Newton steps for each, from the push before."""
REMEDY = "a fuller battery, less weight, or a course that allows more command (--course)"


@dataclass(frozen=True, kw_only=True)
class Headroom:
    """hover: the largest command of a rotor at hover, limit: what is allowed. Shares of pushes under
    which no steady command within the limits holds the place, or place and heading."""

    hover: float
    limit: float
    place_lost: float
    heading_lost: float

    @property
    def words(self) -> str:
        """One sentence for who is about to fly; empty where pushes are held."""
        place, heading = (round(100 * v) for v in (self.place_lost, self.heading_lost))
        if not place and not heading:
            return ""
        return (
            f"It hovers at {self.hover:.2f} of {self.limit:.2f}: under {place} % of the pushes to come "
            f"no command holds the place, under {heading} % none the heading, which gives way. What "
            f"leaves room: {REMEDY}."
        )


def headroom(
    functions: ModelFunctions, pushes: FloatArray | None, low: float, high: float
) -> Headroom:
    """Of a model with target_step under `pushes` (n, k) [N, N m], in the order of its disturbance
    states; None: draws of what was identified. Raises `ModelError` where it cannot even hover."""
    f = functions
    assert isinstance(f.model, IdentifiedModel)
    rotors = f.model.physics.vehicle.rotors
    way = turning(
        np.array([r.position for r in rotors], dtype=float),
        np.array([float(r.spin) for r in rotors]),
    )
    x, u = hover(f.functions, f.states, f.reference, f.parameter_values, len(f.targets))
    if within(u, way, low, high) is None:
        raise ModelError(
            "the vehicle cannot hover within the commands of the course",
            expected=f"{low:g} to {high:g}",
            got=", ".join(f"{v:.2f}" for v in u),
            fix=REMEDY,
        )
    rows = [i for i, n in enumerate(f.states.names) if n.startswith("disturbance.")]
    if pushes is None:
        pushes = _drawn(f, (x, u))
    place = heading = 0
    at, command = x.copy(), u
    chosen = pushes[:: max(1, len(pushes) // DRAWS)]
    for push in chosen:
        at[rows] = push
        for _ in range(NEWTON):
            at, command, _ = (
                v.full().ravel()
                for v in f["target_step"](at, command, f.parameter_values, np.zeros(len(f.targets)))
            )
        if not np.isfinite(command).all():
            at, command, held = x.copy(), u, None
        else:
            held = within(command, way, low, high)
        place += held is None
        heading += held is None or held[1] != 0.0
    n = max(len(chosen), 1)
    return Headroom(
        hover=float(u.max()), limit=high, place_lost=place / n, heading_lost=heading / n
    )


def _drawn(f: ModelFunctions, point: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Pushes (DRAWS, k) of the identified process in its stationary state; seeded."""
    rows = [i for i, n in enumerate(f.error_states.names) if n.startswith("d_disturbance.")]
    kept = np.diag(f["f_d_jac"](*point, f.parameter_values)[1].full())[rows]
    fresh = np.diag(f.noise.process)[rows]
    spread = np.sqrt(fresh / np.maximum(1.0 - kept**2, 1e-6))
    return np.asarray(np.random.default_rng(0).standard_normal((DRAWS, len(rows))) * spread)
