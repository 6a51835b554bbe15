"""Lasting: what pushes the craft for good, without a name, is a part of it that the model has wrong.

Disturbance states hold gusts, and whatever else the model lacks. Of a force along the thrust that
lasts nobody can say whether it is not thrust: it is known no better than that, and with it what is
told by its side, as inertias and drag. The errors hold that. And a push that changes for good within
a flight is no gust: a load, a rotor, a battery. What that moves is no measurement, which the errors
hold as well (`greybox.automatic.shifted`). What is said of both comes with the fit.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
from threadpoolctl import threadpool_limits

from greybox.automatic.changed import changes, lasting_share, said_of_changes, unnamed
from greybox.automatic.shifted import with_shift
from greybox.automatic.widened import HELD, doubted, moved_away, no_measurement, widened
from greybox.data import Dataset
from greybox.errors import GreyboxError
from greybox.estimation.result import Fit
from greybox.model.layer import physics_of


def with_lasting(found: Fit, data: Dataset) -> Fit:
    """The fit to `data` with errors that hold a force along the thrust that lasts and what a change
    for good moves, and with what changed in words. As it was where nothing lasts, where it did not
    converge and where the motion is not measured."""
    physics = physics_of(found.problem.dynamics)
    if physics is None or not found.converged:
        return found
    try:
        with threadpool_limits(limits=1):
            seen = unnamed(found.model, data)
            changed = changes(seen) if seen else ()
    except (GreyboxError, np.linalg.LinAlgError):  # too wild
        return found
    if seen is None:
        return found
    said = said_of_changes(seen, changed)
    before, moved = found, ""
    try:
        with threadpool_limits(limits=1):
            found, moved = with_shift(found, seen, changed)
    except (GreyboxError, np.linalg.LinAlgError):  # a prediction that is not finite
        pass
    # Of what changed the errors then hold what it moves; a force that stays may be thrust as ever.
    share = lasting_share(seen, changed if found is before else ())
    if share > 0:
        found = _with_share(found, share, share * physics.vehicle.gravity)
    if not changed:
        return found
    steps, drifts = list(said.steps), list(said.drifts)
    if moved and steps:
        steps[-1] += f"; {moved}"
    elif moved:  # parts of a flight that drifts are no better
        found, drifts = doubted(found, "; ".join([*drifts, moved])), []
    found = doubted(found, *said.flown)
    old = found.diagnostics
    warnings = (*steps, *drifts, *old.warnings)
    told = replace(old.covariance, changed=tuple(steps))
    return replace(found, diagnostics=replace(old, covariance=told, warnings=warnings))


def _with_share(found: Fit, share: float, lift: float) -> Fit:
    """The fit with errors that hold this share of the weight, `lift` [m/s^2], had it been thrust:
    as far as all estimates go with what the rotors lift. Their Fisher information tells how far;
    a sandwich of few flights ties what is not tied."""
    rows: dict[str, list[int]] = {}
    for i, u in enumerate(found.problem.unknowns):
        if u.kind == "parameter" and not u.name.startswith("disturbance."):
            rows.setdefault(u.name, []).append(i)
    by_name = _lift(found)
    slope = np.zeros(found.problem.n)
    for n, places in rows.items():
        slope[places] = by_name[n] / len(places)
    fisher = found.covariance.fisher
    tied = np.where(np.isfinite(fisher), fisher, 0.0) @ slope
    variance = float(slope @ tied)
    if not variance > 0:
        return found
    moved = tied / variance * lift
    why = (
        f"a lasting force without a name takes {100 * share:.1f} % of the weight, which may be thrust "
        "and would then"
    )
    line = no_measurement(moved_away(found, moved, rows), why, HELD)
    return widened(found, np.outer(moved, moved), rows, line)


def _lift(found: Fit) -> dict[str, float]:
    """How far [m/s^2 per unit] every parameter moves what the rotors lift, level at the mean
    commands."""
    model = found.model
    d = model.dynamics
    p = ca.SX.sym("p", len(d.parameters))
    rate = d.f(0.0, ca.DM(model.reference_state), ca.DM(model.reference_inputs), p)
    up = rate[d.states["velocity.z"]]
    slope = ca.Function("lift", [p], [ca.densify(ca.jacobian(up, p))])(model.parameter_vector())
    names = [q.name for q in d.parameters]
    return dict(zip(names, np.asarray(slope).ravel().tolist(), strict=True))
