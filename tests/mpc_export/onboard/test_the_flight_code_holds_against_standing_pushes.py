"""Compiled flight code on a plant with its own equations, whose balance the model has never seen;
and what it says of what it cannot hold."""

from __future__ import annotations

import ctypes
import functools
import math
import shutil
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from greybox.model.identified import IdentifiedModel
from greybox.model.noise import with_disturbance
from greybox.model.parameter import ParameterValues
from greybox.plants.effects import CenterOfMassOffset, MotorLag, RotorAsymmetry
from greybox.plants.noise import SensorNoise
from greybox.plants.presets import X250
from greybox.plants.quadrotor import Quadrotor
from mpc_export.bundle import write_bundle
from mpc_export.functions import model_functions
from mpc_export.standing import DAY, in_flight, unknown
from tests.model.craft import model_of, sensors
from tests.mpc_export import cases

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="C compiler is not installed")
LAG = 0.03
NOISE = SensorNoise(gyro=0.01, accelerometer=0.2, attitude=0.002, position=0.001)
GOAL = (0.5, -0.3, 1.5, 0.0)
WRAPPER = """#include "craft_flight.h"
static craft_flight f;
void start(const double *place) {
  craft_real at[4];
  for (int i = 0; i < 4; ++i) at[i] = (craft_real)place[i];
  craft_flight_start(&f, at);
}
void spoil(void) { f.x[0] = (craft_real)(0.0 / 0.0); }
int sample(const double *y, const double *goal, double *u) {
  craft_real own[CRAFT_N_Y], aim[4];
  unsigned char there[CRAFT_N_Y];
  for (int i = 0; i < CRAFT_N_Y; ++i) own[i] = (craft_real)y[i], there[i] = 1;
  for (int i = 0; i < 4; ++i) aim[i] = (craft_real)goal[i];
  const int code = craft_flight_sample(&f, own, there, aim);
  for (int i = 0; i < CRAFT_N_U; ++i) u[i] = f.u[i];
  return code + 256 * f.said;
}
"""


@functools.cache
def model():
    """Of the nominal craft, as calm flights identify it: its torque hardly wanders."""
    kinds = ("position", "attitude", "gyro", "accelerometer")
    core = model_of(X250, "motor_lag", sensors=sensors(*kinds))
    d = with_disturbance(core, ("force", "torque"), time=0.26)
    levels = dict(zip(d.noises.names, d.noise_scale(0.01), strict=True))
    levels |= {n: 1e-5 * v for n, v in levels.items() if n.startswith("disturbance.torque")}
    seen = {"p": 0.01, "q": 0.01, "r": 0.01, "ax": 0.2, "ay": 0.2, "az": 0.2}
    noise = [seen.get(n, 0.002 if "attitude" in n else 0.001) for n in d.innovations.names]
    hover = np.full(4, math.sqrt(0.5 * X250.gravity / 4 / 4.2))
    return IdentifiedModel(
        dynamics=d,
        values=ParameterValues({p.name: p.nominal for p in d.parameters} | {"motor_lag.tau": LAG}),
        covariance_names=("mass",),
        covariance=np.array([[1e-8]]),
        process_noise=np.array(list(levels.values())),
        sensor_noise=np.array(noise),
        weak=np.full(len(d.error_states), 1e3),
        reference_state=d.reference({"u1": float(hover[0])}),
        reference_inputs=hover,
        sample_time=0.01,
        trained_on=("run0",),
        data_hash="0" * 64,
    )


@functools.cache
def _folder():
    return tempfile.TemporaryDirectory(prefix="standing-")


@functools.cache
def pilot(real):
    """The flight code as a library: (start, sample, its columns, what spoils its estimate)."""
    made = write_bundle(
        model(),
        Path(_folder().name) / real,
        name="craft",
        targets=("ros2",),
        real=real,
        use_cache=False,
    )
    place = made.folder / "c"
    (place / "wrapper.c").write_text(WRAPPER, encoding="utf-8")
    units = [place / f"{n}.c" for n in ("wrapper", "craft", "craft_model", "craft_flight")]
    out = place / "flight.so"
    command = ["gcc", "-std=c99", "-O1", "-shared", "-fPIC", *units, "-lm", "-o", out]
    subprocess.run(command, check=True)
    library = ctypes.CDLL(str(out))
    numbers = ctypes.POINTER(ctypes.c_double)

    def given(v):
        return np.ascontiguousarray(v, dtype=float).ctypes.data_as(numbers)

    def sample(y, goal):
        u = np.zeros(4)
        code = library.sample(given(y), given(goal), u.ctypes.data_as(numbers))
        return u, code % 256, code // 256

    columns = made.functions.outputs.names
    return lambda place: library.start(given(place)), sample, columns, library.spoil


def flown(real, effects, *, mass=1.0, wait=2.0, seconds=6.0):
    """(Distances [m] from the goal after `wait` seconds (n,), codes, bits) of a flight to it."""
    start, sample, columns, _ = pilot(real)
    plant = Quadrotor(
        replace(X250, mass=mass * X250.mass), (MotorLag(tau=LAG), *effects), sensors=NOISE
    )
    plant.reset(1, position=(0.0, 0.0, 1.2))
    start([0.0, 0.0, 1.2, 0.0])
    u, away, codes, bits = np.full(4, plant.airframe.hover_speed), [], set(), set()
    for _ in range(round(seconds / 0.01)):
        seen = plant.measure(u)
        after, code, said = sample([seen[c] for c in columns], GOAL)
        codes.add(code)
        bits.add(said)
        plant.step(u)
        u = after
        state = plant.states()
        away.append(math.dist([state[a] for a in "xyz"], GOAL[:3]))
    return np.array(away[round(wait / 0.01) :]), codes, bits


@pytest.mark.parametrize("real", ["double", pytest.param("float", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("effects", "mass"),
    [
        ((), 1.0),
        ((CenterOfMassOffset(c_x=0.006),), 1.0),
        ((CenterOfMassOffset(c_y=-0.006),), 1.0),
        ((RotorAsymmetry(delta=(-0.15, 0.05, 0.05, 0.05)),), 1.0),
        ((), 1.2),
    ],
    ids=["as identified", "centre of mass x", "centre of mass y", "weak rotor", "payload"],
)
def test_centimetres_are_left_of_a_balance_that_no_flight_has_shown(real, effects, mass):
    away, codes, bits = flown(real, effects, mass=mass)
    assert away.max() < 0.05
    assert codes == {0} and bits == {0}


def test_a_craft_that_is_held_says_that_it_does_not_get_there_and_gives_all_that_it_has():
    start, sample, columns, spoil = pilot("double")
    plant = Quadrotor(X250, (MotorLag(tau=LAG),))
    start([0.0, 0.0, 1.2, 0.0])
    plant.reset(1, position=(0.0, 0.0, 1.2))
    seen = plant.measure(np.full(4, plant.airframe.hover_speed), noise=False)
    said = [sample([seen[c] for c in columns], GOAL)[2] for _ in range(1500)]
    assert said[198:200] == [0, 1], "two seconds farther from the goal than the feedback corrects"
    assert all(bits & 1 for bits in said[200:])
    assert said[-1] == 3, "a command that has stood at its limit"
    spoil()
    after = [sample([seen[c] for c in columns], GOAL)[1:] for _ in range(300)]
    failed = sum(code != 0 for code, _ in after)
    assert failed == 50, "until it starts again"
    assert not any(bits for _, bits in after[: failed + 199]), "a failure ends the row"
    assert after[failed + 199][1] == 1


def test_a_filter_in_flight_walks_as_far_as_the_vehicle_file_leaves_open():
    own, names = model(), model().dynamics.noises.names
    more = in_flight(own).process_noise ** 2 - own.process_noise**2
    sigma = unknown(own)
    for name, value in zip(names, more, strict=True):
        assert value == pytest.approx(0.01 / DAY * sigma.get(name, 0.0) ** 2, rel=1e-6)
    arm, weight = own.physics.vehicle.arm_length, X250.mass * X250.gravity
    # the file calls its numbers exact; of the next craft they are not
    each = 0.2 * weight / 4
    roll = math.hypot(weight * 0.03 * arm, each * 0.088 * 2.0)
    assert sigma["disturbance.torque.x"] == pytest.approx(roll, rel=0.05)
    assert sigma["disturbance.force.z"] == pytest.approx(math.hypot(0.01 * weight, 2 * each), 0.05)
    assert {n for n in sigma if "force" in n} == {"disturbance.force.z"}


def test_the_identified_filter_stays_and_none_follows_without_disturbances():
    assert "follow_step" not in model_functions(cases.physics(), with_=("filter",)).functions
    f = model_functions(model(), with_=("filter",))
    assert "follow_step" in f.functions
