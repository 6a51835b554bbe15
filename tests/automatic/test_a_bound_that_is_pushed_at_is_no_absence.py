"""Flights that push a parameter beyond the bound where its effect is nothing do not say that there is
no such effect: a clock or the model is wrong. That comes before every number, and what it moves is no
measurement."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from greybox.automatic.wanted import with_rivals
from greybox.commands.fit_said import next_step
from greybox.data import Dataset
from greybox.estimation.fit import fit
from greybox.estimation.result import Fit
from greybox.model.model import build_model
from tests.automatic.craft import RATES, flight, flown, vehicle

COMMANDS = ("u1", "u2", "u3", "u4")
TRUE = {"motor_lag.tau": 0.05}
WITH = ("motor_lag", "command_delay", "gyro_bias")
NAMES, LATER = ("command_delay.d",), {"command_delay.d": 0.02}


def late(columns: Mapping[str, np.ndarray], rows: int) -> dict[str, np.ndarray]:
    """The log whose row k holds the command of row k - rows."""
    kept = {n: v[rows:] for n, v in columns.items()}
    return {**kept, **{n: columns[n][: len(columns[n]) - rows] for n in COMMANDS}}


def fitted(rows: int, effects: tuple[str, ...], **choices: object) -> Fit:
    """A fit to flights whose commands are logged so many rows of 10 ms late; they act 12 ms after."""
    logs = [flight(late(c, rows), f"run{i}") for i, c in enumerate(flown())]
    data = Dataset(flights=tuple(d.flights[0] for d in logs))
    model = build_model(vehicle(), data.channels, effects, sample_time=data.flights[0].dt)
    return with_rivals(fit(model, data, disturbance=("torque",), **choices), data)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("effects", "choices"),
    [
        pytest.param(WITH, {}, id="where the search ended"),
        pytest.param(WITH, {"fixed": NAMES}, id="held at nothing", marks=pytest.mark.slow),
        pytest.param(WITH, {"values": LATER}, id="begun elsewhere", marks=pytest.mark.slow),
        pytest.param(("motor_lag", "gyro_bias"), {}, id="not in the model"),
    ],
)
def test_commands_that_are_logged_late_are_said_first(effects, choices):
    found = fitted(2, effects, **choices)
    said = found.covariance.beyond
    assert said.startswith("command_delay.d would be ")
    assert "standard errors beyond its bound 0: commands are logged about " in said
    assert "or physics that the model lacks looks like that (greybox discover)" in said
    assert 0.004 < float(said.split(", add ")[1].split()[0]) < 0.012  # 8 ms
    assert found.warnings[0] == said
    assert found.summary().splitlines()[2] == f"warning: {said}"
    assert next_step(None, found, ["a push"])[0] == f"next: {said}"  # type: ignore[arg-type]
    assert "motor_lag.tau" in found.covariance.form
    away = {n: abs(found[n].value - v) / found[n].std for n, v in TRUE.items()}
    assert max(away.values()) < 3


@pytest.mark.parametrize("rows", [1, pytest.param(0, marks=pytest.mark.slow)])
def test_commands_on_time_push_at_nothing(rows):
    for effects in (("motor_lag", "command_delay", "gyro_bias"), ("motor_lag", "gyro_bias")):
        assert not fitted(rows, effects).covariance.beyond  # with 1: 2 ms late in all


def test_an_effect_that_is_nothing_is_not_pushed_at():
    logs = Dataset(flights=tuple(flight(c, f"run{i}").flights[0] for i, c in enumerate(flown())))
    effects = ("motor_lag", "command_delay", "gyro_bias", "rotational_damping")
    model = build_model(vehicle(), RATES + COMMANDS, effects, sample_time=logs.flights[0].dt)
    found = with_rivals(fit(model, logs, disturbance=("torque",)), logs)
    assert not found.covariance.beyond
