"""What runs on an autopilot is pilot_step: a recording through each target gives Python's commands
and predictions."""

from __future__ import annotations

import functools
import math
import runpy
import shutil
import subprocess
import sys
import tempfile
import types
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from greybox.errors import ModelError
from greybox.frames import GRAVITY, numeric
from greybox.residual.files import save_model
from mpc_export.bundle import write_bundle
from mpc_export.functions import model_functions
from mpc_export.targets import ONBOARD, write_target
from mpc_export.tube.controller import TubeController
from mpc_export.tube.problem import TubeProblem
from tests.mpc_export import cases
from tests.residual import hybrid_cases

HERE = Path(__file__).parent
NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FRD = np.diag([1.0, -1.0, -1.0])
WARNINGS = ("-Wall", "-Wextra", "-Werror")
pytestmark = pytest.mark.skipif(
    shutil.which("gcc") is None or shutil.which("g++") is None, reason="C compiler is not installed"
)


@functools.cache
def _folder():
    return tempfile.TemporaryDirectory(prefix="onboard-")


@functools.cache
def exported(real):
    place = Path(_folder().name) / real
    targets = tuple(t for t in ONBOARD if real == "float" or t != "crazyflie-app")
    return write_bundle(
        cases.disturbed(), place, name="craft", targets=targets, real=real, use_cache=False
    )


def functions():
    return exported("double").functions


def bundle(real="double"):
    return exported(real).folder


def built(folder, real, sources, *flags, out):
    """A program of the bundle's C and these sources; what is there is not built again."""
    objects = []
    for unit in ("craft", "craft_model", "craft_flight"):
        objects.append(folder / f"{unit}.o")
        if not objects[-1].exists():
            single = ["-Wdouble-promotion"] if real == "float" else []
            command = [
                "gcc",
                "-std=c99",
                *WARNINGS,
                *single,
                "-O0",
                "-c",
                folder / "c" / f"{unit}.c",
                "-o",
                objects[-1],
            ]
            subprocess.run(command, check=True)
    program = folder / out
    if program.exists():
        return program
    c = sources[0].suffix == ".c"
    standard = (
        ["gcc", "-std=gnu11"]
        if c
        else ["g++", "-std=c++17", *(("-Wdouble-promotion",) if real == "float" else ())]
    )
    subprocess.run(
        [*standard, *WARNINGS, *flags, *sources, *objects, "-lm", "-o", program], check=True
    )
    return program


def ran(program, rows, *arguments, code=0):
    """Numbers of every line that a program says of these rows, which ends with that code."""
    text = "\n".join(" ".join(repr(float(v)) for v in row) for row in rows) + "\n"
    done = subprocess.run(
        [program, *arguments], input=text, capture_output=True, text=True, check=False
    )
    assert done.returncode == code, done.stderr
    return [np.array(line.split(), dtype=float) for line in done.stdout.splitlines()]


@functools.cache
def recording(samples=60):
    """(y (n, n_y) as floats, goal (n, 4)) of a flight with noise, turned and moving from the
    start."""
    f, rng = functions(), np.random.default_rng(4)
    x, u = f.pilot.x.copy(), f.pilot.u.copy()
    truth = placed(x, (0.5, -0.3, 1.2, 0.4))
    x, rows = truth.copy(), []
    goal = np.array([0.0, 0.2, 1.0, -0.6])
    for _ in range(samples):
        y = f["h"](truth, u, f.parameter_values).full().ravel()
        y += 0.01 * rng.standard_normal(y.size)
        rows.append(y)
        truth = f["f_d"](truth, u, f.parameter_values).full().ravel()
        x, u, _ = step(x, u, y, np.ones(y.size, dtype=bool), goal)
    return np.array(rows), goal


def placed(x, place):
    """A state moved to (x, y, z, heading)."""
    names, out = functions().states, x.copy()
    out[[names[f"position.{a}"] for a in "xyz"]] = place[:3]
    out[[names[f"attitude.{a}"] for a in "wxyz"]] = [
        math.cos(place[3] / 2),
        0.0,
        0.0,
        math.sin(place[3] / 2),
    ]
    return out


def step(x, u, y, given, goal):
    """x, u, y_hat one sample on."""
    f = functions()
    there = [
        float(all(given[f.outputs[c]] for c in own)) for own in f.model.dynamics.innovation_columns
    ]
    x, u, _, y_hat = f["pilot_step"](x, u, f.parameter_values, np.where(given, y, 0.0), there, goal)
    return x.full().ravel(), u.full().ravel(), y_hat.full().ravel()


def expected(y, given, goal, place, flies=None, others=None, least=0.0):
    """(Command in force, the next one, predictions) per sample, as Python has them; no command in
    force is below `least`."""
    f = functions()
    x, u, rows = placed(f.pilot.x, place), f.pilot.u.copy(), []
    for k in range(len(y)):
        own = flies is None or flies[k]
        u = np.maximum(u, least) if own else others[k]
        x, after, y_hat = step(x, u, y[k], given[k], goal)
        rows.append((u, after, y_hat))
        u = after if own else u
    return [np.array(v) for v in zip(*rows)]


def close(got, want, limit=1e-6):
    scale = np.maximum(np.abs(want).max(axis=0), 1e-3)
    np.testing.assert_array_less(np.abs(got - want) / scale, limit)


@pytest.mark.parametrize(
    ("real", "limit"), [("double", 1e-9), pytest.param("float", 3e-3, marks=pytest.mark.slow)]
)
def test_a_recording_through_the_bench_gives_pythons_commands(real, limit):
    folder = bundle(real)
    program = built(folder, real, [folder / "c" / "craft_bench.c"], out="bench")
    y, goal = recording()
    given = np.ones(y.shape, dtype=bool)
    given[20:30, :7], given[40:45] = False, False  # no pose, then nothing
    rows = [[*np.where(g, row, np.nan), *goal] for row, g in zip(y, given)]
    out = ran(program, rows, "pilot")
    _, after, y_hat = expected(y, given, goal, goal)
    assert all(line[0] == 0 for line in out)
    close(np.array([line[1:5] for line in out]), after, limit)
    close(np.array([line[5:] for line in out]), y_hat, limit)


def test_no_recording_gives_a_command_beyond_its_limits():
    folder = bundle()
    program = built(folder, "double", [folder / "c" / "craft_bench.c"], out="bench")
    rng = np.random.default_rng(1)
    y, goal = recording()
    wild = (
        y * 10.0 ** rng.uniform(-3, 300, y.shape) * np.where(rng.random(y.shape) < 0.1, 1.0, 0.0)
        + y
    )
    wild[rng.random(y.shape) < 0.05] = np.inf
    out = np.array(ran(program, [[*row, *goal] for row in [*wild, *y]], "pilot"))[:, 1:5]
    assert np.isfinite(out).all() and out.min() >= 0.0 and out.max() <= 1.0


def bench_of(rows):
    folder = bundle()
    program = built(folder, "double", [folder / "c" / "craft_bench.c"], out="bench")
    return np.array(ran(program, rows, "pilot"))


@functools.cache
def watched(samples=400):
    """(y, u) of a flight that another pilot flies: the model's own, with noise as it states."""
    f, rng = functions(), np.random.default_rng(6)
    x, u, rows, given = placed(f.pilot.x, (0.5, -0.3, 1.2, 0.4)), f.pilot.u, [], []
    truth, aim = x.copy(), np.array([0.0, 0.2, 1.0, -0.6])
    size = np.repeat([1e-3, 2e-3, 0.02, 0.1], [3, 4, 3, 3])
    for k in range(samples):
        y = f["h"](truth, u, f.parameter_values).full().ravel()
        y += size * rng.standard_normal(y.size)
        flown = np.clip(u + 0.1 * np.sin(k * np.array([0.1, 0.47, 0.23, 0.71])), 0, 1)
        rows.append(y)
        given.append(flown)
        truth = f["f_d"](truth, flown, f.parameter_values).full().ravel()
        x, u, _ = step(x, flown, y, np.ones(y.size, dtype=bool), aim)
    return np.array(rows), np.array(given)


def checked(rows, *arguments):
    """(predictions, what is said per innovation: times what the model states, return code)."""
    folder = bundle()
    program = built(folder, "double", [folder / "c" / "craft_bench.c"], out="bench")
    text = "\n".join(",".join(repr(float(v)) for v in row) for row in rows)
    done = subprocess.run(
        [program, *arguments], input=text, capture_output=True, text=True, check=False
    )
    out = [np.array(line.split(), dtype=float) for line in done.stdout.splitlines()]
    said = [line.split() for line in done.stderr.splitlines() if "states" in line]
    return np.array(out), {line[0]: float(line[-2]) for line in said}, done.returncode


def test_the_check_before_a_flight_takes_the_commands_that_were_flown():
    y, u = watched()
    out, times, code = checked(np.column_stack([y, u]))
    f = functions()
    x, wanted = f.pilot.x.copy(), []
    for place, column in (("xyz", "position.{}"), ("wxyz", "attitude.{}")):
        for a in place:
            x[f.states[column.format(a)]] = y[0, f.outputs[a if len(place) == 3 else f"q{a}"]]
    for a, c in zip("xyz", "pqr"):
        x[f.states[f"rate.{a}"]] = y[0, f.outputs[c]]
    for row, flown in zip(y, u):
        x, _, y_hat = step(x, flown, row, np.ones(row.size, dtype=bool), (0, 0, 1, 0))
        wanted.append(y_hat)
    close(out[:, 1:], np.array(wanted), 1e-9)
    assert code == 0 and (out[:, 0] == 0).all()
    others = checked(np.column_stack([y, u[:, [1, 0, 2, 3]]]))[1]
    assert set(times) == set(f.innovations.names)
    assert max(times.values()) < 3.0
    assert all(others[n] > 3 * times[n] for n in "qr"), "motors in another order must show"


def test_a_check_says_where_a_flight_does_not_tell_the_commands():
    y, u = watched()
    calm = np.tile(hovering(), (400, 1)) + 1e-3 * np.random.default_rng(1).standard_normal(y.shape)
    held = np.tile(functions().pilot.u, (400, 1))
    assert checked(np.column_stack([calm, held]))[2] == 2
    assert checked(np.column_stack([y, u[:, [1, 0, 2, 3]]]))[2] == 2, "exchanged back it is better"
    still = u.copy()
    still[:, 3] = still[:, 3].mean()
    assert checked(np.column_stack([y, still]))[2] == 2


def test_a_check_counts_no_refused_measurement_as_a_perfect_one():
    y, u = watched()
    attitude = [functions().outputs[f"q{a}"] for a in "wxyz"]
    half, never = y.copy(), y.copy()
    half[::2, attitude], never[1:, attitude] = 0.0, 0.0
    lost = half.copy()
    lost[::2, attitude] = math.nan
    assert checked(np.column_stack([half, u]))[1:] == checked(np.column_stack([lost, u]))[1:]
    _, times, code = checked(np.column_stack([never, u]))
    assert code == 2 and len(times) == len(functions().innovations) - 3, "no attitude was judged"


def test_a_check_without_the_commands_is_refused():
    y, u = watched()
    assert checked(y)[2] == 2
    assert checked(np.column_stack([y, u]), "watch")[2] == 2
    for nowhere in (np.nan, np.inf):
        holed = u.copy()
        holed[300, 2] = nowhere
        assert checked(np.column_stack([y, holed]))[2] == 2, "a command is not told"
    unmeasured = np.column_stack([np.full_like(y, np.nan), u])
    assert checked(unmeasured)[2] == 2, "nothing was measured"


@functools.cache
def hovering():
    """What is measured at hover 1 m above the origin."""
    f = functions()
    x = placed(f.pilot.x, (0.0, 0.0, 1.0, 0.0))
    return f["h"](x, f.pilot.u, f.parameter_values).full().ravel()


def at_hover(*, x=0.0, goal=(0.0, 0.0, 1.0, 0.0)):
    """A row of the bench: hover at (x, 0, 1)."""
    y = hovering().copy()
    y[0] = x
    return [*y, *goal]


def test_a_goal_that_is_no_number_leaves_the_last_one_and_the_filter_goes_on():
    nowhere = (0.0, 0.0, math.nan, 0.0)
    moves = [0.005 * k for k in range(60)]
    asked = bench_of([at_hover()] * 5 + [at_hover(x=x, goal=nowhere) for x in moves])
    held = bench_of([at_hover()] * 5 + [at_hover(x=x) for x in moves])
    np.testing.assert_array_equal(asked, held)
    assert (asked[:, 0] == 0).all() and abs(asked[-1, 5] - moves[-1]) < 0.05


@pytest.mark.parametrize("wrong", [1e6, 1e300])
def test_one_absurd_measurement_is_as_good_as_none(wrong):
    rows = [at_hover() for _ in range(40)]
    absurd, missing = [list(r) for r in rows], [list(r) for r in rows]
    absurd[20][0], missing[20][0] = wrong, math.nan
    np.testing.assert_array_equal(bench_of(absurd), bench_of(missing))


@pytest.mark.parametrize("length", [0.0, 0.3, 5.0])
def test_a_quaternion_of_no_length_is_as_good_as_none(length):
    rows = [at_hover() for _ in range(40)]
    absurd, missing = [list(r) for r in rows], [list(r) for r in rows]
    for k in range(20, 30):
        for i in range(3, 7):
            absurd[k][i], missing[k][i] = rows[k][i] * length, math.nan
    np.testing.assert_array_equal(bench_of(absurd), bench_of(missing))
    never = [[v * length if 3 <= i < 7 else v for i, v in enumerate(r)] for r in rows]
    for r in never:
        r[-1] = math.nan  # a goal that is none: the start waits for a pose
    assert (bench_of(never)[:, 0] > 1).all(), "there is no attitude to start from"


def test_zeros_of_a_lost_tracker_do_not_start_a_healthy_filter_again():
    y, u = watched()
    lost, zeros = y.copy(), y.copy()
    attitude = [functions().outputs[f"q{a}"] for a in "wxyz"]
    lost[100:200, attitude], zeros[100:200, attitude] = math.nan, 0.0
    want, got = (checked(np.column_stack([v, u]))[0] for v in (lost, zeros))
    np.testing.assert_array_equal(got, want)


def test_a_filter_that_is_lost_starts_again_from_a_pose():
    rows = [at_hover()] * 5 + [at_hover(x=500.0, goal=(500.0, 0.0, 1.0, 0.0))] * 60
    out = bench_of(rows)
    assert abs(out[5 + 49, 5]) < 5.0, "50 samples are refused"
    np.testing.assert_allclose(out[5 + 50 :, 5], 500.0, atol=1e-3)
    # as one that begins there, under the command that is in force
    place = np.array([500.0, 0.0, 1.0, 0.0])
    x, u, y = placed(functions().pilot.x, place), out[5 + 49, 1:5], np.array(rows[-1][:-4])
    for line in out[5 + 50 :]:
        x, u, _ = step(x, u, y, np.ones(y.size, dtype=bool), place)
        np.testing.assert_allclose(line[1:5], u, atol=1e-9)


def test_a_start_that_is_no_number_waits_for_a_pose():
    first = at_hover(goal=(math.nan, 0.0, 1.0, 0.0))
    blind = [math.nan if i < 7 else v for i, v in enumerate(first)]
    out = bench_of([blind, blind, *[at_hover(x=3.0, goal=(3.0, 0.0, 1.0, 0.0))] * 20])
    np.testing.assert_allclose(out[:2, 1:5], np.tile(functions().pilot.u, (2, 1)))
    assert (out[:2, 0] > 1).all() and (out[2:, 0] == 0).all()
    np.testing.assert_allclose(out[2:, 5], 3.0, atol=1e-3)


def floats(*parts):
    """Numbers as the firmware's floats hold them, and as doubles again."""
    return [np.asarray(p, dtype=np.float32).astype(float) for p in parts]


def quaternion(rotation):
    """(w, x, y, z) of a rotation matrix."""
    w = math.sqrt(max(1.0 + np.trace(rotation), 1e-12)) / 2.0
    v = np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    return np.array([w, *(v / (4.0 * w))])


def rotation(q):
    w, r = q[0], q[1:]
    cross = np.array([[0.0, -r[2], r[1]], [r[2], 0.0, -r[0]], [-r[1], r[0], 0.0]])
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross


def crazyflie(rows):
    folder = bundle("float")
    stubs = HERE / "stubs" / "crazyflie"
    program = built(
        folder,
        "float",
        [folder / "crazyflie" / "src" / "craft_app.c", HERE / "bench_crazyflie.c"],
        f"-I{stubs}",
        "-DCALLS=10",
        out="crazyflie_bench",
    )
    return np.array(ran(program, rows))


@pytest.mark.slow
def test_the_crazyflie_app_flies_in_its_own_units():
    y, goal = recording()
    place, q, gyro, acc = floats(y[:, :3], y[:, 3:7], np.degrees(y[:, 7:10]), y[:, 10:13] / GRAVITY)
    aim, here = floats([*goal[:3], math.degrees(goal[3])], [math.degrees(0.4)])
    start = np.array([*place[0], np.radians(here[0])])
    seen = np.column_stack([place, q, np.radians(gyro), GRAVITY * acc])

    def rows(yaw, quaternion, mode=1.0):
        said = [mode, here[0], yaw != 0, quaternion, aim[3]]
        wanted = [*aim[:3], 77.0 if quaternion else yaw, *said]
        return [
            [*place[k], 0, 0, 0, *q[k, 1:], q[k, 0], *gyro[k], *acc[k], *wanted]
            for k in range(len(y))
        ]

    for name, own, heading in (
        ("an absolute yaw", rows(aim[3], 0), aim[3]),
        ("a quaternion before a yaw", rows(aim[3], 1), aim[3]),
        ("neither: the heading stays", rows(0.0, 0), here[0]),
    ):
        out = crazyflie([*own, rows(aim[3], 0, 0.0)[0]])
        target = np.array([*aim[:3], np.radians(heading)])
        force, _, y_hat = expected(seen, np.ones(y.shape, dtype=bool), target, start)
        assert (out[:, 0] == 1).all(), "the control mode is that of forces"
        close(out[:-1, 1:5], force, 3e-3)
        close(out[:-1, 5:], y_hat, 3e-3)
        assert not out[-1, 1:5].any(), f"{name}: a setpoint without a position stops the motors"


def px4(rows, form="-UCRAFT_MODULE_TEMPLATE", *arguments):
    folder = bundle()
    program = built(
        folder,
        "double",
        [folder / "px4" / "src" / "modules" / "craft" / "CraftModule.cpp", HERE / "bench_px4.cpp"],
        f"-I{HERE / 'stubs' / 'px4'}",
        '-DMODULE_NAME="craft"',
        "-DOUTPUTS=13",
        form,
        out=f"px4_bench{form}",
    )
    return np.array(ran(program, rows, *arguments))


def px4_row(*, north=0.0, flies=1.0):
    """At rest 1 m above the origin, with a setpoint there, `north` of it, or none (infinity)."""
    level = [*quaternion(NED @ FRD)]
    return [
        *(0.0, 0.0, -1.0, 0.0, 0.0, 0.0, *level, 0.0, 0.0, 0.0, 0.0, 0.0, -GRAVITY),
        *(north, 0.0, -1.0, math.pi / 2, 1.0, 1.0, 1.0, flies, 0.7, 0.7, 0.7, 0.7),
    ]


@pytest.mark.parametrize("lost", [math.nan, math.inf])
def test_the_px4_module_holds_the_last_goal_and_stops_the_motors_when_it_ends(lost):
    given = [px4_row(flies=0.0)] * 2 + [px4_row(north=0.2)] * 5
    kept = px4([*given, *[px4_row(north=0.2)] * 80])
    held = px4([*given, *[px4_row(north=lost)] * 80], "-UCRAFT_MODULE_TEMPLATE", "stop")
    np.testing.assert_array_equal(held[:-1], kept)
    assert (held[2:-1, 1:5] >= 0.0).all(), "it should command in every sample"
    assert np.isnan(held[-1, 1:5]).all()


def test_the_px4_module_takes_over_with_a_fresh_setpoint_alone():
    old = [px4_row(flies=0.0)] + [px4_row(flies=0.0, north=math.inf)] * 60
    out = px4([*old, *[px4_row(north=math.inf)] * 5, *[px4_row()] * 5])[61:, 1:5]
    assert (out[:5] == -1.0).all() and (out[5:] >= 0.0).all()


def px4_recording(idle=0.0):
    """(rows, command in force, predictions): a flight watched, then flown, with motors that idle."""
    y, goal = recording()
    n, rng = len(y), np.random.default_rng(2)
    flies = np.arange(n) >= 20
    pose, imu, rate = np.arange(n) % 3 != 1, np.arange(n) % 5 != 4, np.arange(n) % 10 != 9
    pose[0] = True
    turned = np.array([quaternion(NED @ rotation(q / np.linalg.norm(q)) @ FRD) for q in y[:, 3:7]])
    place, q, gyro, acc, others = floats(
        y[:, :3] @ NED, turned, y[:, 7:10] @ FRD, y[:, 10:13] @ FRD, rng.uniform(0.6, 0.8, (n, 4))
    )
    acted = idle + (1.0 - idle) * others
    (aim,) = floats([*(NED @ goal[:3]), math.pi / 2 - goal[3]])
    rows = [
        [
            *place[k],
            0,
            0,
            0,
            *q[k],
            *gyro[k],
            *acc[k],
            *aim,
            pose[k],
            imu[k],
            rate[k],
            flies[k],
            *others[k],
        ]
        for k in range(n)
    ]
    back = np.array([quaternion(NED @ rotation(v) @ FRD) for v in q])
    seen = np.column_stack([place @ NED, back, gyro @ FRD, acc @ FRD])
    given = np.zeros(y.shape, dtype=bool)
    given[:, :7], given[:, 7:10], given[:, 10:] = pose[:, None], (imu | rate)[:, None], imu[:, None]
    heading = math.pi / 2 - aim[3]
    target = np.array([*(NED @ aim[:3]), heading])
    force, _, y_hat = expected(
        seen, given, target, np.array([*(NED @ place[0]), heading]), flies, acted, idle
    )
    return rows, force, y_hat


@pytest.mark.parametrize("form", ["-UCRAFT_MODULE_TEMPLATE", "-DCRAFT_MODULE_TEMPLATE"])
def test_the_px4_module_turns_frames_and_watches_before_it_flies(form):
    rows, force, y_hat = px4_recording()
    out = px4(rows, form)
    assert (out[:, 0] == 0).all()
    close(out[:, 1:5], force)
    close(out[:, 5:], y_hat)


@pytest.mark.parametrize("idle", [0.15, 0.75])
def test_controls_of_px4_begin_at_the_idle_of_the_commands(idle):
    rows, force, y_hat = px4_recording(idle)
    out = px4(rows, f"-DCRAFT_IDLE={idle}f")
    close(idle + (1.0 - idle) * out[:, 1:5], force)
    close(out[:, 5:], y_hat)
    assert (out[20:, 1:5] == 0.0).any() == (idle == 0.75), "its limit should be met"


def test_the_idle_of_px4_is_named_where_it_is_to_be_set():
    said = (bundle() / "px4" / "README.md").read_text(encoding="utf-8")
    assert all(f"`{own}`" in said for own in ("CRAFT_IDLE", "DSHOT_MIN"))
    assert "CRAFT_IDLE" in (bundle() / "manifest.json").read_text(encoding="utf-8")


def ros(rows, *arguments):
    folder = bundle()
    program = built(
        folder,
        "double",
        [folder / "ros2" / "src" / "craft_node.cpp"],
        f"-I{HERE / 'stubs' / 'ros2'}",
        out="ros_bench",
    )
    return ran(program, rows, *arguments)


def test_the_ros_node_stops_without_odometry_until_a_new_goal():
    y = hovering()
    rows = [
        [*y[:7], 0, 0, 0, *y[7:13], *(0, 0, 1, 0), pose, 1, goal, *[0.7] * 4]
        for pose, goal, count in ((1, 1, 10), (0, 0, 80), (1, 0, 10), (1, 1, 5))
        for _ in range(count)
    ]
    commands = np.array([line[1:5] for line in ros(rows, "fly")])
    assert (commands[:60] > 0.5).all(), "half a second is flown without odometry"
    assert not commands[62:100].any(), "odometry alone does not start motors"
    assert (commands[102:] > 0.0).all()


def test_a_ros_imu_without_force_measures_rates_alone():
    y, goal = recording()
    rows = [[*r[:7], 0, 0, 0, *r[7:13], *goal, 1, 2, 0, *[0.7] * 4] for r in y]
    given = np.ones(y.shape, dtype=bool)
    given[:, 10:] = False
    start = np.array([*y[0, :3], float(numeric("euler", y[0, 3:7])[0][2])])
    held = np.full((len(y), 4), 0.7)
    _, _, y_hat = expected(y, given, goal, start, np.zeros(len(y), dtype=bool), held)
    close(np.array([line[-13:] for line in ros(rows)]), y_hat)


@pytest.mark.parametrize("fly", [True, False])
def test_the_ros_node_flies_and_watches(fly):
    y, goal = recording()
    n, others = len(y), np.random.default_rng(3).uniform(0.6, 0.8, (len(y), 4))
    pose, imu = np.arange(n) % 3 != 1, np.arange(n) % 5 != 4
    rows = [
        [*y[k, :7], 0, 0, 0, *y[k, 7:13], *goal, pose[k], imu[k], k == 10, *others[k]]
        for k in range(n)
    ]
    out = ros(rows, *(["fly"] if fly else []))
    given = np.zeros(y.shape, dtype=bool)
    given[:, :7], given[:, 7:] = pose[:, None], imu[:, None]
    heading = float(numeric("euler", y[0, 3:7])[0][2])
    flies = (np.arange(n) >= 10) & fly
    force, _, y_hat = expected(y, given, goal, np.array([*y[0, :3], heading]), flies, others)
    close(np.array([line[-13:] for line in out]), y_hat)
    assert [line.size for line in out] == [18 if f else 14 for f in flies]
    if fly:
        close(np.array([line[1:5] for line in out[10:]]), force[10:])


@pytest.mark.parametrize(
    ("target", "changes", "said"),
    [
        ("crazyflie-app", {"bounds": (np.zeros(4), np.full(4, 2500.0))}, "commands from 0 to 1"),
        ("px4-module", {"bounds": (np.zeros(4), np.full(4, 2500.0))}, "commands from 0 to 1"),
        ("crazyflie-app", {"dt": 0.0125}, "whole milliseconds"),
    ],
)
def test_what_an_autopilot_cannot_fly_is_refused(target, changes, said, tmp_path):
    with pytest.raises(ModelError, match=said):
        write_target(target, replace(functions(), **changes), tmp_path, "craft", "float")


def test_a_crazyflie_refuses_double(tmp_path):
    with pytest.raises(ModelError, match=r"single precision[\s\S]*--float"):
        write_target("crazyflie-app", functions(), tmp_path, "craft", "double")


def test_a_model_that_does_not_fly_or_a_name_that_ros_refuses(tmp_path):
    with pytest.raises(ModelError, match="needs a model with position"):
        write_bundle(cases.linear(), tmp_path / "b", targets=("px4-module",), use_cache=False)
    with pytest.raises(ModelError, match="small letters"):
        write_target("ros2", functions(), tmp_path, "Craft")
    assert not (tmp_path / "b").exists()


@pytest.mark.parametrize(
    ("target", "part", "real"),
    [
        ("px4-module", "px4", "double"),
        ("ros2", "ros2", "double"),
        pytest.param("crazyflie-app", "crazyflie", "float", marks=pytest.mark.slow),
    ],
)
def test_a_bundle_says_what_is_still_to_do(target, part, real):
    folder = bundle(real)
    text = (folder / part / "README.md").read_text(encoding="utf-8")
    assert "Before it flies, you must" in text
    assert "@" not in text.replace("nobody@example.com", ""), "a word was not filled in"
    assert "2 where for as long a command stood at a limit" in text
    assert "./bench < flight.csv" in text and "x y z qw qx qy qz p q r ax ay az, then u1" in text
    assert "battery" not in text.replace("battery compensation", ""), "the model has none"
    assert f"For {target}: `{part}/README.md`" in (folder / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(("target", "name"), [("ros2", "node"), ("px4-module", "module_base")])
def test_names_that_an_autopilot_uses_itself_build(target, name, tmp_path):
    write_target(target, functions(), tmp_path, name)
    for end in (".h", "_model.h"):
        text = (bundle() / "c" / f"craft{end}").read_text(encoding="utf-8")
        text = text.replace("craft", name).replace("CRAFT", name.upper())
        (tmp_path / "c" / f"{name}{end}").write_text(text, encoding="utf-8")
    (source,) = tmp_path.glob("*/**/*.cpp")
    stubs = HERE / "stubs" / source.relative_to(tmp_path).parts[0]
    command = ["g++", "-std=c++17", *WARNINGS, f"-I{stubs}", f'-DMODULE_NAME="{name}"']
    subprocess.run([*command, "-fsyntax-only", source], check=True)


def test_only_a_model_with_disturbances_is_said_to_lean(tmp_path):
    plain = model_functions(cases.physics(), with_=("pilot",))
    for own, f in (("plain", plain), ("disturbed", functions())):
        write_target("px4-module", f, tmp_path / own, "craft")
        text = (tmp_path / own / "px4" / "README.md").read_text(encoding="utf-8")
        assert ("leans against the force" in text) == (own == "disturbed")


VOLTS = """#include <stdio.h>
#include "c/craft_flight.h"
static craft_flight flight;
int main(void) {
  const craft_real place[4] = {0, 0, 1, 0};
  double volts;
  craft_flight_start(&flight, place);
  while (scanf("%lf", &volts) == 1) {
    craft_flight_parameter(&flight, CRAFT_P_VBAT, (craft_real)volts);
    printf("%.17g\\n", (double)flight.p[CRAFT_P_VBAT]);
  }
  return 0;
}
"""


@pytest.mark.slow
def test_every_target_takes_voltages_that_are_some_and_keeps_the_last(tmp_path):
    craft = cases.identified(
        hybrid_cases.craft(("motor_lag", "battery_sag")), **{"battery_sag.c_V": 1.0}
    )
    model = replace(craft, reference_inputs=np.array([0.7, 0.7, 0.7, 0.7, 3.8]))
    targets = ("px4-module", "ros2")
    made = write_bundle(model, tmp_path / "b", name="craft", targets=targets, use_cache=False)
    write_target("crazyflie-app", made.functions, made.folder, "craft", "float")
    for source in (
        "crazyflie/src/craft_app.c",
        "px4/src/modules/craft/CraftModule.cpp",
        "ros2/src/craft_node.cpp",
    ):
        assert "craft_flight_parameter(&" in (made.folder / source).read_text(encoding="utf-8")
    for place, topic in (("px4", "| battery_status |"), ("ros2", "| battery |")):
        said = (made.folder / place / "README.md").read_text(encoding="utf-8")
        assert topic in said and "mean of the training flights, 3.8 V" in said
    (made.folder / "volts.c").write_text(VOLTS, encoding="utf-8")
    write_target("ros2", made.functions, made.folder, "craft", "double")
    program = built(made.folder, "double", [made.folder / "volts.c"], out="volts")
    got = ran(program, [[v] for v in (3.5, math.nan, 0.0, -3.0, math.inf, 3.4)])
    assert [v[0] for v in got] == [3.5] * 5 + [3.4]
    # the check before a flight takes the voltage that acted, too, and none as the one before
    program = built(made.folder, "double", [made.folder / "c" / "craft_bench.c"], out="bench")
    f, rows = made.functions, []
    y = f["h"](f.pilot.x, f.pilot.u, f.parameter_values).full().ravel()
    for low in (3.8, 3.2, math.nan):
        rows.append([[*y, *f.pilot.u, volts] for volts in [3.8] * 5 + [low] * 250])
    # commands that never change tell nothing
    full, empty, none = (ran(program, own, code=2) for own in rows)
    az = 1 + f.outputs["az"]
    assert empty[8][az] < full[8][az] - 0.5 and none[8][az] == full[8][az]
    assert ran(program, [row[:-1] for row in rows[0]], code=2) == []
    for untold in (math.nan, 0.0, -3.0):
        assert ran(program, [[*row[:-1], untold] for row in rows[0]], code=2) == []


class Anything:
    """A message of ROS: what is asked of it is there."""

    def __init__(self, **given):
        self.__dict__.update(given)

    def __getattr__(self, name):
        made = Anything()
        setattr(self, name, made)
        return made


class Node:
    """What a Python node sees of rclpy."""

    given: ClassVar = {}

    def __init__(self, name):
        self.heard, self.said = {}, []

    def declare_parameter(self, name, value):
        return Anything(value=self.given.get(name, value))

    def create_subscription(self, kind, topic, call, qos):
        self.heard[topic] = call

    def create_publisher(self, kind, topic, qos):
        return Anything(publish=lambda message: self.said.append(message.data))

    def create_timer(self, period, call):
        self.period, self.tick = period, call


@pytest.mark.slow
def test_the_tube_node_flies_the_tube_controller(monkeypatch, tmp_path):
    for name in (
        "rclpy",
        "rclpy.node",
        "rclpy.qos",
        "geometry_msgs.msg",
        "nav_msgs.msg",
        "sensor_msgs.msg",
        "std_msgs.msg",
    ):
        made = types.ModuleType(name)
        made.Node, made.qos_profile_sensor_data = Node, 5
        made.PoseStamped = made.Odometry = made.Imu = Anything
        made.BatteryState = made.Float64MultiArray = Anything
        monkeypatch.setitem(sys.modules, name, made)
    monkeypatch.setattr(
        Node, "given", {"model": str(save_model(cases.disturbed(), tmp_path / "model.json"))}
    )
    script = runpy.run_path(str(bundle() / "ros2" / "scripts" / "tube_node.py"), run_name="tube")
    node = script["TubeNode"]()
    path = script["Still"]()
    model = cases.disturbed()
    pilot = TubeController(
        model=model,
        problem=TubeProblem(dt=node.pilot.problem.dt, planes=0),
        reference=path,
        kappa=(2.0,),
        kappa_u=1.0,
    )
    y, goal = recording()
    here = [*y[0, :3], float(numeric("euler", y[0, 3:7])[0][2])]
    wanted, time = [], 0.0
    for k in range(30):
        at = dict(zip(functions().outputs.names, y[k]))
        odometry, imu, aim = Anything(), Anything(), Anything()
        odometry.pose.pose.position = Anything(**{a: at[a] for a in "xyz"})
        odometry.pose.pose.orientation = Anything(**{a: at[f"q{a}"] for a in "wxyz"})
        odometry.twist.twist.linear = Anything(x=0.0, y=0.0, z=0.0)
        imu.angular_velocity = Anything(x=at["p"], y=at["q"], z=at["r"])
        imu.linear_acceleration = Anything(x=at["ax"], y=at["ay"], z=at["az"])
        node.heard["odometry"](odometry)
        node.heard["imu"](imu)
        node.heard["battery"](Anything(voltage=3.8))
        assert node.seen["vbat"] == 3.8
        if k == 0:
            path.aims(here, here, 0.0)
            pilot.start()
        if k == 5:
            aim.pose.position = Anything(x=goal[0], y=goal[1], z=goal[2])
            aim.pose.orientation = Anything(
                w=math.cos(goal[3] / 2), x=0.0, y=0.0, z=math.sin(goal[3] / 2)
            )
            node.heard["goal"](aim)
            path.aims(here, goal, time)
        node.tick()
        if k >= 5:
            wanted.append(pilot.u.copy())
        pilot.sample(time, at)
        time += node.period
    assert node.period == model.sample_time
    np.testing.assert_allclose(np.array(node.said), wanted, atol=1e-12)
    assert np.ptp(wanted, axis=0).max() > 0.01, "it should have to steer"
