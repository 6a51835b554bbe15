"""simulate runs an identified model from a state under commands, both as plain arrays: the same run
as that of a recorded segment, with the units and the order that it says."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from greybox import build_model, dataset_from_arrays, fit
from greybox.errors import DataError, FitError, UnknownNameError
from greybox.estimation.filtering import Filter
from greybox.estimation.simulate import simulate
from greybox.model.identified import IdentifiedModel
from tests.simulated import flights, vehicle


@pytest.fixture(scope="module")
def model() -> IdentifiedModel:
    data = flights(1, seconds=2.0)
    built = build_model(vehicle(), data.channels, ["motor_lag", "command_delay"], sample_time=0.01)
    return fit(built, data, free=["motor_lag.tau"], estimate_noise=False).model


def test_it_goes_where_the_rollout_of_a_segment_goes(model: IdentifiedModel) -> None:
    (segment,) = flights(1, seconds=2.0).segments
    filter_ = Filter(model)
    filtered = filter_.run(segment)
    record, u = filtered.record, segment.matrix(model.dynamics.inputs.names)
    ours = simulate(model, u, filtered.states[0])
    theirs = filter_.rollout(filtered, np.array([-1]), record.n - 20, starts=filtered.states[:1])[0]
    assert np.allclose(ours.outputs[: record.n - 20], theirs, rtol=0, atol=1e-9)
    assert np.array_equal(ours.states[0], filtered.states[0])
    vm = simulate(model, u, filtered.states[0], use_compiler=False)
    assert np.allclose(vm.states, ours.states, rtol=0, atol=1e-8)


def test_names_are_columns_and_the_reference_stays_where_it_is(model: IdentifiedModel) -> None:
    n, names = 50, model.dynamics.inputs.names
    u = np.repeat(model.reference_inputs[None], n, axis=0)
    still = simulate(model, u)
    assert still.states.shape == (n, len(model.dynamics.states))
    assert still.outputs.shape == (n, len(model.dynamics.outputs))
    assert still.t[1] == model.sample_time
    assert np.array_equal(still.states[0], model.reference_state)
    named = simulate(model, dict(zip(names, u.T, strict=True)), {"position.z": 2.0})
    assert named.states[0, model.dynamics.states.names.index("position.z")] == 2.0
    again = dataset_from_arrays(named.t, named.channels)
    assert set(again.channels) == {*model.dynamics.outputs.names, *names}


@pytest.mark.parametrize(
    ("u", "x0", "error", "words"),
    [
        (np.zeros(4), None, DataError, r"u has shape \(4,\); expected \(n, 4\): u1"),
        (np.zeros((0, 4)), None, DataError, "u has shape"),
        (np.full((9, 4), np.nan), None, DataError, "u has values that are not finite"),
        ({"u1": [0.5]}, None, DataError, "u lacks u2"),
        ({"u5": [0.5]}, None, UnknownNameError, "unknown input 'u5'"),
        (np.zeros((9, 4)), np.zeros(3), DataError, "x0 has shape"),
        (np.zeros((9, 4)), {"position.zz": 1.0}, UnknownNameError, "did you mean position.z"),
        ("hover", None, DataError, "no array of numbers"),
    ],
)
def test_what_does_not_fit_is_said(
    u: Any, x0: Any, error: type[Exception], words: str, model: IdentifiedModel
) -> None:
    with pytest.raises(error, match=words):
        simulate(model, u, x0)


def test_a_flight_that_is_not_there_and_a_run_without_end_are_said(model: IdentifiedModel) -> None:
    with pytest.raises(UnknownNameError, match="unknown flight 'run9'"):
        simulate(model, np.zeros((9, 4)), flight="run9")
    with pytest.raises(FitError, match="stops being finite"):
        simulate(model, np.full((9, 4), 1e200))
