"""Claim: any outputs, in their own units and under any name, have a multi-step table and a verdict.

A model of the user's own is judged over samples of its own clock, output by output, against holding
the last value.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import greybox as gb
from greybox.data import Dataset
from greybox.errors import GreyboxError
from greybox.estimation.fit import Fit
from greybox.model.dynamics import StateSpaceModel
from greybox.symbolic import Layout, Signal
from greybox.validation.comparison import Standard, standard_of
from greybox.validation.groups import GROUPS, groups_of
from greybox.validation.horizons import horizons_of
from tests import motor


@pytest.fixture(scope="module")
def fitted() -> Fit:
    return gb.fit(motor.model(), motor.record())


def renamed(names: dict[str, str], model: StateSpaceModel) -> StateSpaceModel:
    signals = [Signal(name=names[s.name], unit=s.unit) for s in model.outputs]
    sigma = {names[k]: v for k, v in (model.sensor_sigma or {}).items()}
    return StateSpaceModel(**{**vars(model), "outputs": Layout(signals), "sensor_sigma": sigma})


def test_the_table_has_the_outputs_in_their_units(fitted: Fit) -> None:
    seen = gb.validate(fitted.model, motor.record(seed=4, name="other"))
    assert seen.table is not None and seen.verdict is not None
    assert {g: seen.table.kinds[g].unit for g in seen.table.groups} == {
        "current": "A",
        "speed": "rad/s",
    }
    assert seen.horizons == (1, 10, 50, 100)
    assert "speed [rad/s], mean absolute error" in seen.table_text()
    assert seen.verdict.exit_code == 0 and {g.name for g in seen.verdict.groups} == {
        "current",
        "speed",
    }
    cover = seen.table.groups["speed"].coverage
    assert cover is not None and 0.85 < float(np.nanmean(cover[0.95])) <= 1.0


def test_names_of_channel_groups_mean_nothing_special(fitted: Fit) -> None:
    names = {"current": "rotation", "speed": "specific_force"}
    model = renamed(names, motor.model())
    data = motor.record(seed=4, name="other")
    flights = tuple(
        replace(
            f, segments=tuple(s.replace({names[k]: s.column(k) for k in names}) for s in f.segments)
        )
        for f in data
    )
    usual = gb.validate(fitted.model, data)
    other = gb.validate(replace(fitted.model, dynamics=model), Dataset(flights=flights))
    assert usual.table is not None and other.table is not None
    for before, after in names.items():
        assert np.array_equal(usual.table.groups[before].mae, other.table.groups[after].mae)
    assert (
        other.verdict is not None and other.verdict.useful_seconds == usual.verdict.useful_seconds
    )  # type: ignore[union-attr]


def test_a_group_of_a_vehicle_stays_one_where_it_is_whole() -> None:
    columns = [Signal(name=n, unit="m") for n in GROUPS["position"].columns] + [
        Signal(name="speed", unit="rad/s")
    ]
    model = StateSpaceModel(
        **{
            **vars(motor.model()),
            "outputs": Layout(columns),
            "measurement": lambda t, x, u, p: [x[0], x[0], x[1], x[1]],
            "sensor_sigma": None,
        }
    )
    found = groups_of(model)
    assert (
        set(found) == {"position", "speed"}
        and found["position"] is GROUPS["position"]
        and found["speed"].own
    )


def test_a_model_that_is_worse_than_the_last_value_is_not_usable(fitted: Fit) -> None:
    wrong = fitted.model.with_values({"R": 0.05, "J": 6e-6})
    seen = gb.validate(wrong, motor.record(seed=4, name="other"))
    assert seen.verdict is not None and seen.verdict.exit_code == 1
    assert seen.verdict.line.startswith("NOT USABLE")
    assert seen.verdict.anchor == "docs/bad_fit.md#an-output-of-your-own-model"
    assert seen.judged().verdict.line == seen.verdict.line  # type: ignore[union-attr]


def test_the_standard_counts_samples() -> None:
    slow, fast = standard_of(60.0), Standard()
    assert (slow.minimum, slow.look_ahead, slow.longest) == (600.0, 3000.0, 6000.0)
    assert standard_of(0.01).longest == fast.longest


def test_long_horizons_are_allowed_where_the_clock_is_slow(fitted: Fit) -> None:
    assert horizons_of([60.0, 600.0], sample_time=60.0, longest=np.inf).steps == (1, 10)
    with pytest.raises(GreyboxError, match="at most 10"):
        horizons_of([60.0], sample_time=0.01)
