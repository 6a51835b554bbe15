"""Two derivations, one flight: the CasADi model and the NumPy plant that shares no line with it see
the same half second.

They were written apart from the same statement of the physics. Where they differ, one of them is
wrong.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from craft import CROOKED, flat, function, model_of, state, vector

from greybox.model.effects import CATALOGUE
from greybox.plants.battery import Battery
from greybox.plants.effects import CATALOGUE as PLANT_CATALOGUE
from greybox.plants.quadrotor import Quadrotor

DT = 0.005
N, SECOND = 100, 200
"""Samples of half a second, and of a whole one where an error is held against what it is of."""
PLANT_EFFECTS = {e.name: e for e in PLANT_CATALOGUE}
VALUES = {
    "command_delay": {"d": 4 * DT},
    "thrust_curve": {"f": 0.35},
    "motor_lag": {"tau": 0.03},
    "motor_lag_asymmetry": {"a": 0.4},
    "motor_lag_speed": {"s": 0.25},
    "motor_lag_second": {"b": 0.6},
    "battery_sag": {"c_V": 0.8},
    "rotor_asymmetry": {"delta_1": 0.03, "delta_2": -0.05, "delta_3": 0.04},
    "thrust_level": {"s": -0.04},
    "center_of_mass_offset": {"c_x": 4e-3, "c_y": -3e-3, "c_z": 5e-3},
    "rotor_drag": {"k_x": 3e-5, "k_y": 2e-5},
    "blade_flapping": {"k_flap": 2e-6},
    "rotational_damping": {"d_p": 3e-3, "d_q": 2e-3, "d_r": 1e-3},
    "constant_force": {"f_x": 0.3, "f_y": -0.2, "f_z": 0.1},
    "imu_misalignment": {"theta_x": 0.05, "theta_y": -0.08, "theta_z": 0.6},
    "mocap_misalignment": {"theta_x": -0.05, "theta_y": 0.4, "theta_z": 0.1},
    "accelerometer_bias": {"b_x": 0.1, "b_y": -0.2, "b_z": 0.3},
    "gyro_bias": {"b_x": 0.01, "b_y": -0.02, "b_z": 0.03},
    "command_saturation": {"a_lo": 0.5, "a_hi": 0.49},
    "axial_inflow": {"k_z": 3e-4},
    "translational_lift": {"k_h": 5e-3},
    "ground_effect": {"k": 2.5},
    "products_of_inertia": {"Jxy": 2e-4, "Jxz": -3e-4, "Jyz": 1e-4},
    "payload_mass": {"mu": 0.2},
    "linear_drag": {"d_x": 0.2, "d_y": 0.3, "d_z": 0.1},
    "parasitic_drag": {"c_x": 0.02, "c_y": 0.03, "c_z": 0.04},
    "steady_wind": {"w_x": 3.0, "w_y": -2.0, "w_z": 0.5},
    "rotor_gyroscopic": {"J_r": 5e-5},
    "accelerometer_lever_arm": {"r_x": 0.02, "r_y": -0.03, "r_z": 0.01},
    "pose_lever_arm": {"r_x": -0.02, "r_y": 0.01, "r_z": 0.04},
    "accelerometer_scale": {"s_x": 0.03, "s_y": -0.02, "s_z": 0.05},
    "gyro_scale": {"s_x": -0.03, "s_y": 0.02, "s_z": 0.05},
    "rotor_speed_scale": {"s_1": 0.05, "s_2": -0.03, "s_3": 0.02, "s_4": 0.04},
}
NEEDED = {
    "steady_wind": (
        "rotor_drag",
        "linear_drag",
        "parasitic_drag",
        "axial_inflow",
        "translational_lift",
        "blade_flapping",
    ),
    "motor_lag_asymmetry": ("motor_lag",),
    "motor_lag_speed": ("motor_lag",),
    "motor_lag_second": ("motor_lag",),
}
"""Effects without which another is not felt."""
LOW = {"ground_effect"}
"""Effects that are felt near the ground only."""
LATE_SENSORS = ("pose_delay", "sensor_delay", "rotor_speed_delay")
"""In the plant they show what they saw first until the delay has passed: they have tests of their
own. Of first or second order in the delay in the model, but for the last, which is exact."""
BATTERY = Battery(
    full=12.5, empty=10.2, capacity=60.0, resistance=0.03, idle_current=0.4, full_current=60.0
)


def in_the_plant(name, values):
    """The plant's effect; it lists what each rotor has."""
    if name == "rotor_asymmetry":
        deltas = list(values.values())
        return PLANT_EFFECTS[name](delta=(*deltas, -sum(deltas)))
    if name == "rotor_speed_scale":
        return PLANT_EFFECTS[name](s=tuple(values.values()))
    facts = {
        "battery_sag": {"nominal_voltage": CROOKED.nominal_voltage},
        "ground_effect": {"rotor_radius": CROOKED.rotor_radius},
        "motor_lag_speed": {"hover": CROOKED.hover_speed},
    }
    return PLANT_EFFECTS[name](**values, **facts.get(name, {}))


def commands(n, seed):
    """Hover plus a held random push on every rotor: fast enough to be felt, slow enough to stay in
    the air."""
    rng = np.random.default_rng(seed)
    return (
        CROOKED.hover_speed
        + np.repeat(rng.uniform(-0.03, 0.03, size=(n // 4 + 1, 4)), 4, axis=0)[:n]
    )


@cache
def flown(*names, low=False, rows=N):
    """(rows of the plant's log, rows that the model predicts from the same start, output names)."""
    return fly({n: VALUES[n] for n in names}, low=low, rows=rows)


def settings_of(name):
    """(effects that it needs, whether it is felt near the ground only)."""
    return NEEDED.get(name, ()), name in LOW


def fly(effects, seed=1, substep=DT / 5, low=False, rows=N):
    plant = Quadrotor(
        CROOKED,
        [in_the_plant(n, v) for n, v in effects.items()],
        battery=BATTERY,
        sample_time=DT,
        substep=substep,
    )
    tilt = np.array([0.95, 0.1, -0.2, 0.15])
    start = {
        "position": (0.2, -0.1, 0.2 if low else 5.0),
        "velocity": (2.0, -1.5, 3.0 if low else 0.5),
        "attitude": tuple(tilt / np.linalg.norm(tilt)),
        "rates": (1.0, -0.7, 0.5),
    }
    plant.reset(0, **start)
    model = model_of(CROOKED, *effects, dt=DT)
    p = vector(model, **{f"{n}__{k}": v for n, own in effects.items() for k, v in own.items()})
    u = commands(rows, seed)
    seen, inputs = [], []
    first_rotors = [plant.states()[f"nu{i + 1}"] for i in range(4)]
    for k in range(rows):
        row = plant.measure(u[k])
        seen.append([row[c] for c in model.outputs.names])
        inputs.append([*u[k], row["vbat"]] if "vbat" in model.inputs else u[k])
        plant.step(u[k])
    past = model.window[0]
    held_before = np.array(inputs[0])
    held_before[:4] = CROOKED.hover_speed
    padded = np.vstack([np.tile(held_before, (past, 1)), np.array(inputs)])
    x = state(
        model,
        position=start["position"],
        velocity=start["velocity"],
        attitude=start["attitude"],
        rate=start["rates"],
        rotor=first_rotors,
    )
    step, output = function(model, "step"), function(model, "output")
    predicted = []
    for k in range(rows):
        window = padded[k : k + past + 1].T
        predicted.append(flat(output(x, window, p, np.zeros(6), DT)))
        x = flat(step(x, window, p, np.zeros(6), DT))
    return np.array(seen), np.array(predicted), model.outputs.names


SCALE = {"x": 1, "v": 1, "q": 1, "p": 1, "r": 1, "a": 10, "o": 1000, "y": 1, "z": 1}


def largest_difference(seen, predicted, names):
    """Per column, relative to the size of such a signal (1 m, 1 m/s, 1 rad/s, 10 m/s^2, 1000
    rad/s)."""
    return {
        n: float(np.abs(d).max()) / SCALE[n[0]]
        for n, d in zip(names, (seen - predicted).T, strict=True)
    }


COMPARED = [e.name for e in CATALOGUE if e.name in VALUES]


def test_half_a_second_of_flight_is_the_same():
    difference = largest_difference(*flown())
    assert max(difference.values()) < 1e-6, difference


@pytest.mark.parametrize("name", COMPARED)
def test_half_a_second_of_flight_with_an_effect_is_the_same(name):
    others, low = settings_of(name)
    difference = largest_difference(*flown(name, *others, low=low))
    assert max(difference.values()) < 1e-6, difference


def test_with_the_same_steps_they_differ_by_rounding_alone():
    difference = largest_difference(
        *fly({k: v for k, v in VALUES.items() if k != "motor_lag"}, substep=DT)
    )
    assert max(difference.values()) < 1e-12, difference


@pytest.mark.parametrize("name", COMPARED)
def test_the_effect_was_really_there(name):
    """Without it the same half second looks different by far more than the agreement above."""
    others, low = settings_of(name)
    seen, _, names = flown(name, *others, low=low)
    plain, _, plain_names = flown(*others, low=low)
    assert names == plain_names
    assert max(largest_difference(seen, plain, names).values()) > 1e-3


def test_every_effect_that_a_plant_can_hide_is_compared():
    assert {e.name for e in CATALOGUE} == {*VALUES, *LATE_SENSORS} == set(PLANT_EFFECTS)


def test_all_effects_at_once_agree_too():
    own = {"rotor_gyroscopic", "motor_lag_second"}  # see below
    difference = largest_difference(*fly({k: v for k, v in VALUES.items() if k not in own}))
    assert max(difference.values()) < 1e-6, difference


def test_rotors_that_lag_turn_the_body_by_their_mean_acceleration():
    """Within a step the model takes dOmega/dt at its mean, so that with a lag the two differ a
    little."""
    pair = ("motor_lag", "rotor_gyroscopic")
    seen, predicted, names = flown(*pair, rows=SECOND)
    plain, _, _ = flown("motor_lag", rows=SECOND)
    difference, effect = (
        largest_difference(seen, predicted, names),
        largest_difference(seen, plain, names),
    )
    assert all(difference[c] < 1e-3 * effect[c] for c in "pqr")
    rest = {k: v for k, v in VALUES.items() if k != "motor_lag_second"}
    assert max(largest_difference(*fly(rest)).values()) < 5e-4


@pytest.mark.parametrize("tau", [0.03, 0.8 * DT])
@pytest.mark.parametrize("share", [-0.5, 0.9, 1.2])
def test_a_rotor_that_its_propeller_damps_is_exact_at_every_sample(share, tau):
    """Its mean over a step is exact too; the first moment is that of an exponential."""
    effects = {
        "command_delay": {"d": 2.4 * DT},
        "motor_lag": {"tau": tau},
        "motor_lag_asymmetry": {"a": 0.3},
        "motor_lag_speed": {"s": share},
    }
    difference = largest_difference(*fly(effects))
    assert max(v for k, v in difference.items() if k.startswith("omega")) < 1e-12
    assert max(difference.values()) < 2e-4, difference


@pytest.mark.parametrize("tau", [0.03, 0.8 * DT])
@pytest.mark.parametrize("b", [0.02, 0.2, 0.25, 0.3, 1.0, 3.0])
def test_a_rotor_of_second_order_is_exact_at_every_sample(b, tau):
    """Two lags, equal ones and waves, with commands that switch inside a step; thrust, its square,
    follows the straight line with the rotor's mean and first moment."""
    effects = {
        "command_delay": {"d": 2.4 * DT},
        "motor_lag": {"tau": tau},
        "motor_lag_second": {"b": b},
    }
    difference = largest_difference(*fly(effects))
    assert max(v for k, v in difference.items() if k.startswith("omega")) < 1e-10
    assert max(difference.values()) < 1e-4, difference


@pytest.mark.parametrize(
    ("beside", "close"),
    [
        ({"motor_lag_speed": {"s": 0.5}}, 2e-4),
        ({"motor_lag_asymmetry": {"a": 0.2}}, 2e-3),
        ({"rotor_gyroscopic": {"J_r": 5e-5}}, 2e-3),
    ],
)
def test_second_order_holds_a_lag_that_changes_on_the_way_over_a_step(beside, close):
    difference = largest_difference(
        *fly({"motor_lag": {"tau": 0.03}, "motor_lag_second": {"b": 0.6}} | beside)
    )
    assert max(difference.values()) < close, difference


@pytest.mark.parametrize(
    ("share", "tau", "close"), [(0.25, 0.03, 2e-6), (0.6, 0.03, 2e-6), (0.6, 0.8 * DT, 1e-4)]
)
def test_a_delay_of_a_fraction_of_a_sample_agrees_through_a_lag(share, tau, close):
    """The rotor is exact; thrust, its square, follows the straight line with the rotor's mean and
    first moment."""
    effects = {"command_delay": {"d": (2 + share) * DT}, "motor_lag": {"tau": tau}}
    difference = largest_difference(*fly(effects))
    assert max(v for k, v in difference.items() if k.startswith("omega")) < 1e-12
    assert max(difference.values()) < close, difference


def delayed_errors(effects, name, delays):
    """(largest difference of model and plant, largest change by the delay) per column, for each
    delay [s]."""
    plain, _, names = fly(effects, rows=SECOND)
    out = []
    for d in delays:
        seen, predicted, _ = fly(effects | {name: {"d": d}}, rows=SECOND)
        past = 6  # the plant shows what it saw first until the delay has passed
        out.append(
            tuple(largest_difference(seen[past:], b[past:], names) for b in (predicted, plain))
        )
    return out


FINE = 5
"""Instants per sample at which the plant of `late_imu_errors` is seen."""


def late_imu_errors(effects, parts, without=False):
    """(largest difference of model and plant) per column, with an IMU that is late by parts / FINE
    of a sample.

    The states of the model are those of the instant that the IMU shows: it starts from the plant's
    at that instant."""
    late = {"sensor_delay": {"d": parts * DT / FINE}}
    plant = Quadrotor(
        CROOKED,
        [in_the_plant(n, v) for n, v in (effects | late).items()],
        sample_time=DT / FINE,
        substep=DT / FINE,
    )
    tilt = np.array([0.95, 0.1, -0.2, 0.15])
    plant.reset(
        0,
        position=(0.2, -0.1, 5.0),
        velocity=(2.0, -1.5, 0.5),
        attitude=tuple(tilt / np.linalg.norm(tilt)),
        rates=(1.0, -0.7, 0.5),
    )
    model = model_of(CROOKED, *effects, *([] if without else late), dt=DT)
    p = vector(
        model,
        **{
            f"{n}__{k}": v
            for n, own in (effects | ({} if without else late)).items()
            for k, v in own.items()
        },
    )
    u, seen, truth = commands(SECOND, 1), [], []
    for k in range(SECOND * FINE):
        row = plant.measure(u[k // FINE])
        truth.append(plant.states())
        if k % FINE == 0:
            seen.append([row[c] for c in model.outputs.names])
        plant.step(u[k // FINE])
    first, past = 6, model.window[0]
    at = truth[first * FINE - (0 if without else parts)]
    x = state(
        model,
        position=[at[c] for c in "xyz"],
        velocity=[at[f"v{c}"] for c in "xyz"],
        attitude=[at[f"q{c}"] for c in "wxyz"],
        rate=[at[c] for c in "pqr"],
        rotor=[at[f"nu{i}"] for i in range(1, 5)],
    )
    padded = np.vstack([np.full((past, 4), CROOKED.hover_speed), u])
    step, output = function(model, "step"), function(model, "output")
    predicted = []
    for k in range(first, SECOND):
        window = padded[k : k + past + 1].T
        predicted.append(flat(output(x, window, p, np.zeros(6), DT)))
        x = flat(step(x, window, p, np.zeros(6), DT))
    return largest_difference(np.array(seen[first:]), np.array(predicted), model.outputs.names)


IMU = ("p", "q", "r", "ax", "ay", "az")
POSE = ("x", "y", "z", "vx", "vy", "vz", "qw", "qx", "qy", "qz")


@pytest.mark.parametrize("parts", [1, 3, 5, 8, 10])
def test_states_live_on_the_clock_of_a_late_imu(parts):
    """Commands come to it as much later, the pose is as much ahead."""
    lag = {"motor_lag": {"tau": 0.04}}
    error, change = late_imu_errors(lag, parts), late_imu_errors(lag, parts, without=True)
    assert max(error[c] for c in IMU) < 2e-5, error
    assert all(change[c] > 5e-4 for c in IMU)
    assert max(v for k, v in error.items() if k.startswith("omega")) < 1e-3, error
    assert max(error[c] for c in POSE) < 3e-4, error


@pytest.mark.parametrize("parts", [1, 3, 5, 8, 10])
def test_a_late_imu_on_rotors_without_lag(parts):
    """As exact as late commands are there (below)."""
    error, change = late_imu_errors({}, parts), late_imu_errors({}, parts, without=True)
    for c in IMU:
        assert error[c] < (0.01 if c in ("ax", "ay", "az") else 0.05) * change[c], c
    assert max(error[c] for c in POSE) < 5e-4, error
    if parts % FINE == 0:  # commands of whole samples: which of them came first is known
        assert max(error[c] for c in POSE if c.startswith("q")) < 2e-5, error


def test_delays_of_imu_and_pose_that_are_alike_are_late_commands():
    d = 1.4 * DT
    lag = {"motor_lag": {"tau": 0.04}}
    both = model_of(CROOKED, *lag, "sensor_delay", "pose_delay", dt=DT)
    late = model_of(CROOKED, *lag, "command_delay", dt=DT)
    p = vector(both, motor_lag__tau=0.04, sensor_delay__d=d, pose_delay__d=d)
    q = vector(late, motor_lag__tau=0.04, command_delay__d=d)
    x = state(both, velocity=[2.0, -1.5, 0.5], rate=[1.0, -0.7, 0.5])
    rows, w = commands(40, 3), np.zeros(6)
    for which in ("step", "output"):
        out = [
            flat(function(m, which)(x, rows[30 - m.window[0] : 31].T, v, w, DT))
            for m, v in ((both, p), (late, q))
        ]
        timed = [i for i, n in enumerate(both.outputs.names) if not n.startswith("omega")]
        seen = timed if which == "output" else slice(None)
        np.testing.assert_allclose(out[0][seen], out[1][seen], atol=1e-12)


@pytest.mark.parametrize("tau", [0.004, 0.04])
@pytest.mark.parametrize("late", [0.4, 2.4, 6.0])
def test_late_rotor_speeds_are_exact_however_late_and_however_short_the_lag(late, tau):
    """Also where commands and pose are late themselves."""
    past = 12  # the plant shows what it saw first until the delays have passed
    effects = {"motor_lag": {"tau": tau}, "rotor_speed_delay": {"d": late * DT}}
    for more in ({}, {"command_delay": {"d": 1.4 * DT}, "pose_delay": {"d": DT}}):
        seen, predicted, names = fly(effects | more, substep=DT / 20)
        shown = [i for i, n in enumerate(names) if n.startswith("omega")]
        np.testing.assert_allclose(predicted[past:, shown], seen[past:, shown], atol=0.05)


@pytest.mark.parametrize("late", [0.4, 2.0])
def test_late_speeds_of_rotors_without_lag_are_those_of_the_command_then_in_force(late):
    seen, predicted, names = fly({"rotor_speed_delay": {"d": late * DT}})
    shown = [i for i, n in enumerate(names) if n.startswith("omega")]
    np.testing.assert_allclose(predicted[6:, shown], seen[6:, shown], atol=1e-9)


def test_speeds_cannot_be_shown_before_they_were_commanded():
    """An earlier clock shows the newest command there is, and one that is late by as much as the
    commands shows the rotors of a model without either."""
    early = model_of(CROOKED, "motor_lag", "command_delay", "rotor_speed_delay", dt=DT)
    plain = model_of(CROOKED, "motor_lag", dt=DT)
    rows, w = commands(60, 3), np.zeros(6)
    speeds = [plain.outputs[f"omega{i}"] for i in range(1, 5)]
    for delay, d in ((2 * DT, -2 * DT), (DT, -3 * DT)):
        p = vector(early, motor_lag__tau=0.03, command_delay__d=delay, rotor_speed_delay__d=d)
        q = vector(plain, motor_lag__tau=0.03)
        x, z = state(early), state(plain)
        for k in range(40, 50):
            window = rows[k - early.window[0] : k + 1].T
            x = flat(function(early, "step")(x, window, p, w, DT))
            z = flat(function(plain, "step")(z, rows[k], q, w, DT))
        window = rows[50 - early.window[0] : 51].T
        one = flat(function(early, "output")(x, window, p, w, DT))
        other = flat(function(plain, "output")(z, rows[50], q, w, DT))
        np.testing.assert_allclose(one[speeds], other[speeds], rtol=1e-12)


@pytest.mark.parametrize("share", [0.05, 0.4, 0.9])
def test_a_delay_of_a_fraction_of_a_sample_without_lag(share):
    """Commands change within a step, and an instant shows the one that is in force. Thrust, the
    square of a rotor speed that jumps, follows the straight line with its mean and first moment."""
    ((one, change),) = delayed_errors({}, "command_delay", ((1 + share) * DT,))
    for c in one:
        assert one[c] < (0.01 if c in ("ax", "ay", "az") else 0.05) * change[c] or one[c] < 1e-6, c


@pytest.mark.parametrize(
    "others", [{}, {"motor_lag": {"tau": 0.04}}, {"command_delay": {"d": 1.4 * DT}}]
)
def test_a_late_pose_is_nearly_exact(others):
    """Also on rotors that jump: the pose was pushed by earlier commands, which the record has."""
    for error, change in delayed_errors(others, "pose_delay", (DT / 2, DT, 2 * DT)):
        for c in POSE:  # commands that change within a step run straight through it
            close = 0.02 if "command_delay" in others else 1e-3 if c.startswith("q") else 5e-3
            assert error[c] < close * change[c] or error[c] < 1e-6, c


def test_the_flight_was_worth_comparing():
    seen, _, names = flown()
    at = {n: i for i, n in enumerate(names)}
    assert np.isfinite(seen).all()
    assert np.abs(seen[:, [at[n] for n in "pqr"]]).max() > 2.0
    assert np.ptp(seen[:, at["qz"]]) > 0.1
    assert math.isfinite(seen[-1, at["x"]])
