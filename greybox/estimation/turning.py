"""Where one gain cannot serve a whole record: the error of the filter grows somewhere on the way,
though the gain of that place would hold it.

The gain of the innovation form is that of the reference point. In the error state of a vehicle it
hardly depends on the path; of a model of one's own it may turn with the state: a position in the
world beside a heading that no sensor tells corrects the heading with the wrong sign after half a
turn. What is then found, or judged, says nothing of the model.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from greybox.data import Segment
from greybox.errors import FitError
from greybox.estimation.filtering import Filter
from greybox.estimation.gain import linearisation_anywhere, stationary
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import physics_of
from greybox.symbolic import FloatArray

PLACES = 16
"""Samples of a segment that are looked at."""
SHARE = 0.3
"""Share of the largest part of a growing error from which a state is named."""


def turning_states(model: IdentifiedModel, segments: Iterable[Segment]) -> tuple[str, ...]:
    """Names of the error states that the filter's one gain lets grow somewhere on these segments,
    where the gain of that place holds them; none of a vehicle. Sizes of errors are told by the
    spread of a start."""
    if physics_of(model.dynamics) is not None:
        return ()
    found: dict[str, None] = {}
    try:
        runner = Filter(model)
        gain = _gain(runner.riccati.N, runner.riccati.S)
        for segment in segments:
            found |= dict.fromkeys(_of_segment(runner, gain, segment))
    except (FitError, np.linalg.LinAlgError):  # no prediction, no place: a hint costs no result
        return ()
    return tuple(found)


def _of_segment(runner: Filter, gain: FloatArray, segment: Segment) -> list[str]:
    model, run = runner.model, runner.run(segment)
    here, width = linearisation_anywhere(model.dynamics), sum(model.dynamics.window) + 1
    names: list[str] = []
    for k in np.unique(np.linspace(0, len(run.states) - 1, PLACES).astype(int)):
        window = run.record.inputs[k : k + width].T
        values = here.values(run.states[k], window, run.p, model.sample_time)
        if not all(np.isfinite(v).all() for v in values):
            continue
        grown, vectors = np.linalg.eig(values[0] - gain @ values[2])
        if np.abs(grown).max() < 1.0:
            continue
        try:
            own = stationary(values, model.process_noise**2, model.sensor_noise**2, model.weak**2)
        except FitError:
            continue
        if np.abs(np.linalg.eigvals(values[0] - _gain(own.N, own.S) @ values[2])).max() < 1.0:
            size = np.abs(vectors[:, np.argmax(np.abs(grown))]) / model.weak
            states = model.dynamics.error_states.names
            names += [n for n, s in zip(states, size, strict=True) if s >= SHARE * size.max()]
    return names


def _gain(n: FloatArray, s: FloatArray) -> FloatArray:
    """N S^-1."""
    return np.asarray(np.linalg.solve(s, n.T).T)
