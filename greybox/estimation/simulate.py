"""simulate: where a model goes from a state of one's own under commands of one's own, without noise
and without a log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from greybox.errors import DataError, FitError, UnknownNameError
from greybox.estimation.ahead import run_ahead
from greybox.estimation.engine import engine_for
from greybox.model.identified import IdentifiedModel
from greybox.symbolic import FloatArray, Layout
from greybox.takes import MODEL, Named, takes


@dataclass(frozen=True, kw_only=True, eq=False)
class Simulated:
    """A run of n samples: `t` (n,) [s] from zero, `states` (n, n_x), `outputs` (n, n_y) and
    `inputs` (n, n_u), columns in the order of the model's layouts; `channels` name -> (n,) are
    outputs and inputs, as `greybox.dataset_from_arrays(run.t, run.channels)` takes them."""

    t: FloatArray
    states: FloatArray
    outputs: FloatArray
    inputs: FloatArray
    channels: Mapping[str, FloatArray]


@takes(model=MODEL)
def simulate(
    model: IdentifiedModel,
    u: npt.ArrayLike | Mapping[str, npt.ArrayLike],
    x0: npt.ArrayLike | Mapping[str, float] | None = None,
    *,
    flight: str | None = None,
    use_compiler: bool = True,
) -> Simulated:
    """Run `model` from `x0` under the commands `u`, a row per `model.sample_time`, without noise.

    `u` is (n, n_u) in the order of `model.dynamics.inputs`, or name -> (n,); before its first row
    that row was sent, too. `x0` is (n_x,) in the order of `model.dynamics.states`, or name -> value
    on top of the reference state, which alone holds where it is None (a vehicle: level hover). SI
    units. Numbers with a value per flight are those of the `flight`, else their mean. Outputs of a
    sample are those of its state: the first row is x0. Raises `DataError` for other shapes and
    values that are not finite, `UnknownNameError`, `FitError` where the run stops being finite.
    """
    d = model.dynamics
    inputs = _columns(u, d.inputs, "u")
    start = _start(x0, model)
    p = model.parameter_vector() if flight is None else _of_flight(model, flight)
    engine = engine_for(d, (), use_compiler=use_compiler)
    run = run_ahead(
        engine,
        starts=start[None],
        rows=np.zeros(1, dtype=np.int32),
        steps=len(inputs),
        inputs=engine.padded_inputs(inputs),
        p=p,
        dt=model.sample_time,
        want_states=True,
    )
    assert run.states is not None
    states, outputs = run.states[0], run.outputs[0]
    lost = np.flatnonzero(~np.isfinite(np.column_stack([states, outputs])).all(axis=1))
    if lost.size:
        raise FitError(
            f"the run of {model.name} stops being finite at sample {lost[0]}",
            fix="fewer samples, or commands that the craft can stand",
        )
    return Simulated(
        t=model.sample_time * np.arange(len(inputs), dtype=np.float64),
        states=states,
        outputs=outputs,
        inputs=inputs,
        channels={
            **dict(zip(d.outputs.names, outputs.T, strict=True)),
            **dict(zip(d.inputs.names, inputs.T, strict=True)),
        },
    )


def _finite(values: object, what: str) -> FloatArray:
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise DataError(f"{what} is no array of numbers") from None
    if not np.isfinite(array).all():
        raise DataError(f"{what} has values that are not finite")
    return array


def _columns(
    given: npt.ArrayLike | Mapping[str, npt.ArrayLike], layout: Layout, what: str
) -> FloatArray:
    """(n, columns) of a layout. Raises `DataError`, `UnknownNameError`."""
    if isinstance(given, Named):
        named = dict(given.items())
        for name in named:
            if name not in layout.names:
                raise UnknownNameError("input", str(name), layout.names, where=what)
        if absent := [n for n in layout.names if n not in named]:
            raise DataError(f"{what} lacks {', '.join(absent)}")
        columns = [_finite(named[n], f"{what} of {n}") for n in layout.names]
        if len({c.shape for c in columns}) > 1 or columns[0].ndim != 1:
            raise DataError(f"{what}: not one value per sample for every input")
        array = np.column_stack(columns)
    else:
        array = _finite(given, what)
    if array.ndim != 2 or array.shape[1] != len(layout) or not len(array):
        raise DataError(
            f"{what} has shape {array.shape}",
            expected=f"(n, {len(layout)}): {', '.join(layout.names)}",
        )
    return array


def _start(given: npt.ArrayLike | Mapping[str, float] | None, model: IdentifiedModel) -> FloatArray:
    """x0 (n_x,). Raises `DataError`, `UnknownNameError`."""
    names = model.dynamics.states.names
    start = np.array(model.reference_state, dtype=np.float64)
    if isinstance(given, Named):
        for name, value in given.items():
            if name not in names:
                raise UnknownNameError("state", str(name), names, where="x0")
            start[names.index(name)] = float(_finite(value, f"x0 of {name}"))
        return start
    if given is None:
        return start
    array = _finite(given, "x0")
    if array.shape != (len(names),):
        raise DataError(
            f"x0 has shape {array.shape}", expected=f"({len(names)},): {', '.join(names)}"
        )
    return array


def _of_flight(model: IdentifiedModel, flight: str) -> FloatArray:
    if flight not in model.per_flight:
        raise UnknownNameError("flight", flight, model.per_flight or model.trained_on)
    return model.flight_vector(flight)
