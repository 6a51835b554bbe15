"""Every prediction in open loop is one function; what changes states on the way, and the end of a
record, change nothing else."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from greybox.errors import FitError
from greybox.estimation.ahead import run_ahead
from greybox.estimation.filtering import Filter
from tests import simulated
from tests.residual.hybrid_cases import craft, craft_model

ROOT = Path(__file__).parents[2]
CALLERS = {
    "greybox/estimation/ahead.py",
    # One sample, the point about which it linearises.
    "greybox/estimation/smoothing.py",
    # In closed loop: a pilot chooses every command.
    "greybox/planning/manoeuvres.py",
}
STEPS = 20


@pytest.fixture(scope="module")
def flown():
    model = craft_model(craft(("motor_lag", "command_delay")))
    runner = Filter(model)
    return runner, runner.run(simulated.flights(1, 2.0).segments[0])


def ahead(flown, rows, steps=STEPS, **more):
    runner, run = flown
    return run_ahead(
        runner.engine,
        starts=run.states[rows],
        rows=np.asarray(rows),
        steps=steps,
        inputs=run.record.inputs,
        p=run.p,
        dt=run.record.dt,
        want_states=True,
        **more,
    )


def test_nobody_else_asks_the_engine():
    files = [p for f in ("greybox", "mpc_export", "scenarios") for p in (ROOT / f).rglob("*.py")]
    found = {p.relative_to(ROOT).as_posix() for p in files if _asks(p.read_text())}
    assert found == CALLERS


def _asks(text: str) -> bool:
    return re.search(r"\bengine\.rollout\(", text) is not None


def test_states_left_alone_on_the_way_are_those_of_one_run(flown):
    whole, stepped = (
        ahead(flown, [30, 60]),
        ahead(flown, [30, 60], between=lambda h, x, after: after),
    )
    for name in ("outputs", "states", "commands"):
        assert np.array_equal(getattr(whole, name), getattr(stepped, name))


def test_states_changed_on_the_way_are_what_the_next_sample_starts_from(flown):
    def reset(h, x, after):
        return x if h == 2 else after

    told = ahead(flown, [30], between=reset)
    assert np.array_equal(told.states[:, 3], told.states[:, 2])
    assert np.array_equal(told.states[:, :3], ahead(flown, [30]).states[:, :3])


def test_the_first_sample_left_out_is_the_same_run_later(flown):
    whole, later = ahead(flown, [30]), ahead(flown, [30]).without_first()
    for name in ("outputs", "states", "commands"):
        assert np.array_equal(getattr(later, name), getattr(whole, name)[:, 1:])


def test_past_the_end_the_last_command_is_held(flown):
    _, run = flown
    (last,) = ahead(flown, [run.record.n - 2]).commands
    assert np.array_equal(last[1:], np.repeat(last[1:2], STEPS - 1, axis=0))


def test_a_start_behind_the_record_is_refused(flown):
    runner, run = flown
    with pytest.raises(FitError, match="outside its record"):
        run_ahead(
            runner.engine,
            starts=run.states[:1],
            rows=np.array([run.record.n + 2]),
            steps=STEPS,
            inputs=run.record.inputs,
            p=run.p,
            dt=run.record.dt,
        )
