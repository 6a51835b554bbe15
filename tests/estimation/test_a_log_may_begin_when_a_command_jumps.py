"""Where a log begins with a jump of the commands, rotors are not at their first command: how far they
may be is seen, and a start that bends the readings is an unknown of the fit."""

from __future__ import annotations

import functools

import numpy as np

from greybox.data import Dataset, dataset_from_arrays
from greybox.estimation.ahead import run_ahead
from greybox.estimation.engine import engine_for
from greybox.estimation.fit import fit
from greybox.estimation.problem import make_problem
from greybox.model.model import build_model
from tests.automatic.craft import IMU, flown, vehicle

LAG, DT = 0.05, 0.01
ROTORS = [f"d_rotor.{i}" for i in range(1, 5)]
NOISE = {"p": 0.01, "q": 0.01, "r": 0.01, "ax": 0.08, "ay": 0.08, "az": 0.08}


@functools.cache
def started(jump: float) -> Dataset:
    """Two flights of three seconds whose rotors turn at the usual speed while the first commands
    are off by `jump`, this way and that."""
    model = build_model(vehicle(), IMU, ("motor_lag",), sample_time=DT)
    whole: Dataset | None = None
    for k, columns in enumerate(flown()):
        u = np.column_stack([columns[f"u{i}"] for i in range(1, 5)])[:300]
        usual = u.mean(axis=0)
        fading = np.exp(-np.arange(300) * DT / 0.08)[:, None]
        u = usual + 0.3 * (u - usual) + jump * fading * np.array([1, -1, 1, -1]) * (-1) ** k
        x0 = model.reference({f"u{i}": usual[i - 1] for i in range(1, 5)})
        p = [LAG if d.name == "motor_lag.tau" else d.nominal for d in model.parameters]
        engine = engine_for(model, ())
        run = run_ahead(
            engine,
            starts=x0[None],
            rows=np.zeros(1, dtype=np.int32),
            steps=300,
            inputs=engine.padded_inputs(u),
            p=np.array(p),
            dt=DT,
        ).outputs[0]
        random = np.random.default_rng(k)
        y = {
            n: run[:, i] + NOISE[n] * random.standard_normal(300)
            for i, n in enumerate(model.outputs.names)
        }
        y |= {f"u{i}": u[:, i - 1] for i in range(1, 5)}
        one = dataset_from_arrays(np.arange(300) * DT, y, name=f"run{k}")
        whole = one if whole is None else whole + one
    assert whole is not None
    return whole


def test_the_lag_is_right_although_the_rotors_were_elsewhere():
    data = started(0.4)
    effects = ("motor_lag", "command_delay")
    model = build_model(vehicle(), data.channels, effects, sample_time=DT)
    found = fit(model, data, values={"motor_lag.tau": 0.04})
    for name, true in (("motor_lag.tau", LAG), ("command_delay.d", 0.0)):
        assert abs(found[name].value - true) < 2 * found[name].std
    assert found["motor_lag.tau"].std < 0.01 * LAG


def test_a_start_that_bends_the_readings_is_an_unknown_and_one_of_a_gyro_is_not():
    data = started(0.25)
    model = build_model(vehicle(), data.channels, ("motor_lag",), sample_time=DT)
    names = {u.name for u in make_problem(model, data).unknowns}
    assert set(ROTORS) <= names
    assert "d_rate.x" not in names


def test_how_far_a_rotor_may_be_is_how_far_its_first_command_is_from_the_usual_one():
    data = started(0.25)
    model = build_model(vehicle(), data.channels, ("motor_lag",), sample_time=DT)
    record = make_problem(model, data).records[0]
    at = [model.error_states.names.index(n) for n in ROTORS]
    assert (record.x0_sigma[at] > 0.2).all()
