"""Faults of the robustness study break what they name, for as long as they say, and its table
counts outcomes."""

import math

import numpy as np
import pytest

from mpc_export.mission import OBSTACLE_COURSE
from mpc_export.mission.craft import vehicle
from scenarios.studies.tube_robustness import ALL, FAULTS, broken_vehicle, table

CLEAN = dict.fromkeys(ALL, 1.0)


def arrived(name, count, seed=3):
    """Measurements that arrive in the samples from the fault's begin on; None where the controller
    is not called."""
    rng = np.random.default_rng([seed, 77])
    return [FAULTS[name].seen(dict(CLEAN), k, rng) for k in range(count)]


def test_rotors_grow_weak_when_and_as_much_as_said():
    whole, weak = vehicle(), broken_vehicle(FAULTS["rotor-30"], 0.0501, 2)
    u = np.full(4, float(np.mean(whole.airframe.hover_speed)))
    for plant in (whole, weak):
        plant.reset(5)
    for k in range(6):
        same = whole.states() == weak.states()
        assert same == (0.01 * k <= 0.05)
        for plant in (whole, weak):
            plant.step(u, 0.01)
    lost = 0.3 * whole.airframe.thrust[2] * u[0] ** 2 / whole.airframe.mass
    fall = (whole.states()["vz"] - weak.states()["vz"]) / 0.01
    assert fall == pytest.approx(lost, rel=0.15)
    battery = broken_vehicle(FAULTS["battery"], 0.0, 1).effects[-1]
    assert battery.factors == (0.85,) * 4


def test_measurements_break_for_as_long_as_they_say():
    for name, samples in (("drop-1", 1), ("drop-10", 10), ("nan-all", 10)):
        broken = [all(math.isnan(v) for v in y.values()) for y in arrived(name, 30)]
        assert broken == [True] * samples + [False] * (30 - samples)
    one = arrived("inf-one", 60)
    assert [sum(math.isinf(v) for v in y.values()) for y in one] == [1] * 50 + [0] * 10
    assert len({next(c for c, v in y.items() if math.isinf(v)) for y in one[:50]}) == 1
    assert (
        len({str(arrived("inf-one", 1, seed)) for seed in range(10)}) > 3
    )  # another channel in another flight
    assert [y is None for y in arrived("late-10", 12)] == [True] * 10 + [False] * 2
    many = arrived("spikes", 4000)
    off = [k for k, y in enumerate(many) if y != CLEAN]
    assert 20 <= len(off) <= 60
    assert {abs(many[k][c] - 1.0) for k in off for c in "xyz"} == {0.0, 0.5}


def test_the_table_counts_outcomes_and_depths():
    def row(seed, outcome, crossed):
        return {
            "fault": "rotor-75",
            "seed": seed,
            "outcome": outcome,
            "broken_count": seed,
            "crossed": crossed,
            "rmse": 0.05,
            "tilt": 0.5,
            "events": {"doubted: p": 2},
        }

    rows = [
        row(0, "landed", {}),
        row(1, "crashed", {"wall": 0.012}),
        row(0, "in the air", {}),
        row(0, "course", {}),
    ]
    line = table(rows).splitlines()[1].split()
    assert line[:9] == ["rotor-75", "4", "1", "1", "2", "1", "1", "12.0", "mm"]
    assert "doubted: p: 2" in table(rows)
    assert OBSTACLE_COURSE.duration > 4.0  # the last fault begins before the end
