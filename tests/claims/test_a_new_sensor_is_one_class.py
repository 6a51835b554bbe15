"""A sensor that the house has never heard of is one class, handed to `build_model`: it is fitted,
filtered and saved."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from greybox import build_model, dataset_from_arrays, fit
from greybox.data import Dataset
from greybox.data.logs import read_log
from greybox.errors import ModelError, UnknownNameError
from greybox.estimation.engine import engine_for
from greybox.estimation.filtering import Filter
from greybox.estimation.fit import Fit
from greybox.estimation.record import make_record
from greybox.excitation.injection import rich_excitation
from greybox.excitation.waypoints import RandomWaypoints
from greybox.frames import numeric
from greybox.model.identified import IdentifiedModel
from greybox.model.model import PhysicsModel
from greybox.model.vehicle import Vehicle
from greybox.plants.flight_log import fly
from greybox.plants.presets import controller_for
from greybox.validation.whiteness import whiteness
from scenarios.studies.recovery import plant
from tests.claims.own_sensors import FIELD, Barometer, Magnetometer
from tests.simulated import truth, vehicle

EFFECTS = ["motor_lag", "command_delay", "rotor_drag", "rotational_damping"]
DT, SECONDS = 0.01, 12.0
LEVEL, DRIFT = 0.05, 0.1
"""Noise of the simulated barometer [m] and how its bias walks [m/sqrt(s)]."""
HALF = 0.01
"""Noise of each component of the simulated magnetometer: of the heading 0.01 / 0.5, the level part
of the field."""
TURN = 2.0
"""How far the world of the magnetometer's log is turned [rad]: no start at heading zero is near."""


@functools.cache
def flight() -> tuple[Dataset, dict[str, np.ndarray]]:
    """A flight with the columns of both sensors, in a turned world, and what is true of it: q (n,
    4), bias (n,)."""
    true_plant = plant()
    log = dict(
        fly(
            true_plant,
            controller_for(true_plant),
            RandomWaypoints(),
            rich_excitation(),
            SECONDS,
            DT,
            seed=5,
            warm_up=1.0,
            record=("truth",),
        )
    )
    t, rng = log.pop("t"), np.random.default_rng(1)
    c, s = np.cos(TURN), np.sin(TURN)
    for x, y in (("x", "y"), ("vx", "vy"), ("true.x", "true.y")):
        log[x], log[y] = c * log[x] - s * log[y], s * log[x] + c * log[y]
    turn = np.tile([np.cos(TURN / 2), 0.0, 0.0, np.sin(TURN / 2)], (t.size, 1))
    q = quaternion_product(turn, np.column_stack([log[f"true.q{a}"] for a in "wxyz"]))
    field = np.array([rotation(k).T @ FIELD for k in q]) + HALF * rng.normal(size=(t.size, 3))
    bias = 0.4 + np.cumsum(DRIFT * np.sqrt(DT) * rng.normal(size=t.size))
    own = {f"m{a}": field[:, i] for i, a in enumerate("xyz")}
    own["baro"] = log["true.z"] + bias + LEVEL * rng.normal(size=t.size)
    left_out = ("true.", "omega", "q")  # the attitude of motion capture is not to be had
    kept = {k: v for k, v in log.items() if k == "q" or not k.startswith(left_out)}
    return dataset_from_arrays(t, kept | own, name="run"), {"q": q, "bias": bias}


def quaternion_product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a * b, both (n, 4) as (w, x, y, z)."""
    w = a[:, :1] * b[:, :1] - np.sum(a[:, 1:] * b[:, 1:], axis=1, keepdims=True)
    v = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])
    return np.hstack([w, v])


def rotation(q: np.ndarray) -> np.ndarray:
    """World from body."""
    w, x, y, z = q
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * skew + 2 * skew @ skew


@functools.cache
def fitted() -> Fit:
    """The model of both sensors, fitted without position and attitude: what flies outdoors, with a
    velocity."""
    data, _ = flight()
    columns = [c for c in data.channels if c not in ("x", "y", "z")]
    model = build_model(vehicle(), columns, EFFECTS, sensors=[Barometer(), Magnetometer()])
    assert model.outputs.names[-4:] == ("baro", "mx", "my", "mz")
    return fit(model, data, initialisation="noise")


def test_the_physics_is_recovered_with_sensors_of_the_users_own() -> None:
    found = fitted()
    assert found.converged
    for name, estimate in found.parameters.items():
        assert abs(estimate.value - truth()[name]) < 4.5 * estimate.std, name


def test_a_barometers_drift_is_told_from_its_noise_and_from_the_height() -> None:
    found = fitted()
    level, spread, unit = found.noise["noise.sensor.baro"]
    assert unit == "m"
    assert abs(level - LEVEL) < 3 * spread
    push, spread, unit = found.noise["noise.process.drift.barometer.bias"]
    assert unit == "m/s"
    # Noise that is constant over a sample: after one second the bias has walked push sqrt(dt).
    assert abs(push * np.sqrt(DT) - DRIFT) < 3 * spread * np.sqrt(DT)


def test_its_filter_is_consistent() -> None:
    """The bias lies within its stated error, and innovations of the barometer are white and of the
    stated size."""
    data, true = flight()
    model = fitted().model
    filtered = Filter(model).run(data.segments[0])
    i = model.dynamics.states.names.index("memory.barometer.bias")
    stated = np.sqrt(
        filtered.state_covariance[(d := model.dynamics.error_states["d_memory.barometer.bias"]), d]
    )
    error = (filtered.states[:, i] - true["bias"])[200:]
    assert 0.6 < np.sqrt(np.mean(error**2)) / stated < 1.6
    j = model.dynamics.innovations.names.index("baro")
    e = filtered.innovations[200:, j] / np.sqrt(filtered.covariance[0][j, j])
    assert np.std(e) == pytest.approx(1.0, abs=0.1)
    assert whiteness([e[:, None]], names=["baro"], max_lag=20).channels[0].test.p_value > 0.01


def test_a_magnetometer_makes_the_heading_observable() -> None:
    data, true = flight()
    model = fitted().model
    states = Filter(model).run(data.segments[0]).states
    at = model.dynamics.states["attitude.w"]
    error = numeric("difference", states[:, at : at + 4], true["q"])
    assert abs(error[0, 2]) < 0.6 < TURN
    assert np.sqrt(np.mean(error[-300:, 2] ** 2)) < 0.01
    yaw = model.dynamics.error_states["d_attitude.z"]
    bare = without(model, "magnetometer")
    assert Filter(bare).riccati.P[yaw, yaw] > 100 * Filter(model).riccati.P[yaw, yaw]


def without(model: IdentifiedModel, name: str) -> IdentifiedModel:
    """The same physics and the same noise levels, without one sensor."""
    assert isinstance(model.dynamics, PhysicsModel)
    left = replace(
        model.dynamics, sensors=tuple(s for s in model.dynamics.sensors if s.name != name)
    )
    kept = [model.dynamics.innovations.names.index(n) for n in left.innovations.names]
    return replace(model, dynamics=left, sensor_noise=model.sensor_noise[kept])


def test_a_model_file_is_read_with_the_sensors_that_it_names(tmp_path: Path) -> None:
    model = fitted().model
    path = model.save(tmp_path / "model.json")
    again = IdentifiedModel.load(path, sensors=[Barometer(), Magnetometer()])
    assert again.dynamics.outputs.names == model.dynamics.outputs.names
    np.testing.assert_array_equal(again.process_noise, model.process_noise)
    with pytest.raises(UnknownNameError, match="barometer"):
        IdentifiedModel.load(path)


def test_its_columns_come_out_of_a_log_as_they_are(tmp_path: Path) -> None:
    """A log with columns that greybox does not know: they are kept, and what a sensor of one's own
    reads."""
    data, true = flight()
    segment = data.segments[0]
    names = [n for n in segment.channels if not n.startswith("v")]
    table = np.column_stack([segment.t, *(segment.channels[n] for n in names)])[:200]
    np.savetxt(
        tmp_path / "log.csv",
        table,
        delimiter=",",
        header=",".join(["t", *names]),
        comments="",
        fmt="%.12g",
    )
    log = read_log(tmp_path / "log.csv", vehicle())
    assert not {"baro", "mx"} & set(log.channels)
    model = build_model(vehicle(), log.channels, sensors=[Barometer(), Magnetometer()])
    record = make_record(engine_for(model, ()), log.segments[0])
    np.testing.assert_allclose(
        record.outputs[:, model.outputs["baro"]], table[:, 1 + names.index("baro")], rtol=1e-9
    )
    at = model.states["attitude.w"]
    assert abs(numeric("difference", record.x0[None, at : at + 4], true["q"][:1])[0, 2]) < 0.6


def test_the_vehicle_file_states_its_noise_by_name() -> None:
    known = Vehicle.from_dict(vehicle().to_dict() | {"noise": {"barometer": 0.3, "gyro": 0.01}})
    model = build_model(known, ["p", "q", "r"], sensors=[Barometer()])
    assert model.sensor_scale().tolist() == [0.01] * 3 + [0.3]
    assert build_model(vehicle(), ["p", "q", "r"], sensors=[Barometer()]).sensor_scale()[-1] == 0.2
    for slip in ("gyros", "giro", "accel", "acc", "altitude"):
        with pytest.raises(UnknownNameError, match=slip):
            Vehicle.from_dict(vehicle().to_dict() | {"noise": {slip: 0.3}})


class Late(Barometer):
    """Says the same a tenth of a second later."""

    name = "late"
    delay = 0.1

    def signals(self, vehicle: object) -> tuple:  # type: ignore[override]
        """late."""
        return (replace(super().signals(vehicle)[0], name="late"),)


@pytest.mark.parametrize(
    "effects", [(), ("motor_lag", "sensor_delay", "pose_delay", "command_delay")]
)
def test_a_late_sensor_shows_what_the_same_sensor_showed_before(effects: tuple[str, ...]) -> None:
    """Flown by the model itself with a command that changes, the late reading is the other one ten
    samples ago."""
    columns = ["p", "q", "r", "ax", "ay", "az", "x", "y", "z"]
    model = build_model(vehicle(), columns, effects, sensors=[Barometer(), Late()], sample_time=DT)
    past, future = model.window
    assert past >= 10
    n = len(model.inputs)
    x, window, p = (
        ca.SX.sym("x", len(model.states)),
        ca.SX.sym("U", n, past + 1),
        ca.SX.sym("p", len(model.parameters)),
    )
    assert future == 0
    still = ca.DM.zeros(len(model.noises))
    one = ca.Function(
        "f",
        [x, window, p],
        [model.step(0, x, window, p, still, DT), model.output(0, x, window, p, still, DT)],
    )
    late = {
        "motor_lag.tau": 0.04,
        "sensor_delay.d": 0.01,
        "pose_delay.d": 0.015,
        "command_delay.d": 0.01,
    }
    values = [late.get(d.name, d.nominal) for d in model.parameters]
    commands = 0.5 + 0.1 * np.sin(4 * np.arange(80) * DT)[None, :] * np.ones((n, 1))
    state, seen = model.initial_state({})[0], []
    for k in range(past, 80):
        state, y = one(state, commands[:, k - past : k + 1], values)
        seen.append(np.asarray(y).ravel()[[model.outputs["baro"], model.outputs["late"]]])
    now, before = np.array(seen).T
    moved = np.ptp(now)
    assert moved > 0.1
    np.testing.assert_allclose(before[10:], now[:-10], atol=0.02 * moved)
    assert np.abs(before - now).max() > 0.1 * moved


def test_wrong_sensors_are_refused_in_one_line() -> None:
    class Twice(Barometer):
        name = "gyro"

    class Timeless(Barometer):
        clock = "yesterday"

    class Pushed(Barometer):
        def signals(self, vehicle: object) -> tuple:  # type: ignore[override]
            return (replace(super().signals(vehicle)[0], name="u1"),)

    for wrong, said in (
        (Twice(), "gyro given twice"),
        (Timeless(), "yesterday"),
        (Pushed(), "u1 cannot be input"),
    ):
        with pytest.raises(ModelError, match=said):
            build_model(vehicle(), ["p", "q", "r"], sensors=[wrong])
