"""The tube MPC as one C library: clean C, the commands of Python's controller, limits whatever is
measured, and what it costs on a Cortex-M7."""

import functools
import math
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import pytest

from benchmarks import cortex
from benchmarks.tube_on_chip import Circle
from greybox.cli import main
from greybox.errors import ModelError
from greybox.residual.files import save_model
from mpc_export.bundle import ExportBundle
from mpc_export.tube.controller import TubeController
from mpc_export.tube.in_process import TubeInC
from mpc_export.tube.library import Still, flight, paths
from mpc_export.tube.problem import TubeProblem
from mpc_export.tube.target import write_tube
from tests.mpc_export import cases
from tests.mpc_export.tube.test_controller_flies_and_survives import pilot
from tests.mpc_export.tube.test_no_measurement_moves_a_command_out_of_its_limits import (
    SANITIZED,
    cc,
)
from tests.mpc_export.tube.wild import damaged

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror")
PARTS = ("tube", "tube_model", "tube_filter", "tube_selftest")
PLACE = (0.1, -0.2, 1.0, 0.3)


@functools.cache
def in_c(real):
    folder = Path(tempfile.mkdtemp())
    return TubeInC(pilot(), folder, real=real)


def selftest(folder, real, flags):
    """Builds the self-test: our own C strictly, generated C as it is."""
    write_tube(pilot(), folder, name="craft", real=real)
    objects = []
    for part in PARTS:
        own = part in ("tube", "tube_selftest")
        objects.append(str(folder / f"{part}.o"))
        warnings = (*STRICT, *(["-Wdouble-promotion"] if own and real == "float" else []))
        command = [*cc(), *flags, *(warnings if own else ("-std=c99", "-w"))]
        source = str(folder / f"craft_{part}.c")
        if part == "tube_selftest":
            command.append("-Wno-double-promotion")
        subprocess.run([*command, "-c", source, "-o", objects[-1]], check=True)
    out = str(folder / "selftest")
    subprocess.run([*cc(), *flags, *objects, "-lm", "-o", out], check=True)
    return subprocess.run([out], capture_output=True, text=True, check=False, timeout=600)


@pytest.mark.parametrize("real", [pytest.param("double", marks=pytest.mark.slow), "float"])
def test_our_c_is_clean_and_its_self_test_passes(tmp_path, real):
    done = selftest(tmp_path, real, ("-O0",))
    assert done.returncode == 0, done.stdout + done.stderr
    first, *said = done.stdout.splitlines()
    assert first.startswith("craft_tube: 60 samples") and first.endswith(": passed")
    # the recording has a gap and a spike
    assert any("4 samples  NO_MEASUREMENT: " in line for line in said)
    assert any("1 samples  NOT_BELIEVED: " in line for line in said)


@pytest.mark.slow
def test_sanitizers_find_nothing_in_it(tmp_path):
    done = selftest(tmp_path, "double", SANITIZED)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.slow
def test_a_self_test_that_is_tampered_with_fails(tmp_path):
    write_tube(pilot(), tmp_path, name="craft", real="double")
    path = tmp_path / "craft_tube.c"
    text = path.read_text()
    assert "command_max = 0.95," in text
    path.write_text(text.replace("command_max = 0.95,", "command_max = 0.6,"))
    files = [str(tmp_path / f"craft_{part}.c") for part in PARTS]
    out = str(tmp_path / "selftest")
    subprocess.run([*cc(), "-std=c99", "-O0", "-w", *files, "-lm", "-o", out], check=True)
    done = subprocess.run([out], capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 1


def followed(flown, y):
    """Commands of a library along measurements (samples, n_y)."""
    flown.start()
    return np.array(
        [flown.sample(k * flown.dt, dict(zip(flown.columns, row))) for k, row in enumerate(y)]
    )


@functools.cache
def tilted():
    """A learned push tilts its hover."""
    return TubeController(
        model=cases.hybrid(points=8),
        problem=TubeProblem(dt=0.02, horizon=6, planes=2),
        reference=Still(PLACE),
        kappa=(2.0, 2.0, 2.0),
        kappa_u=1.0,
    )


@functools.cache
def hard():
    """A circle that a wall cuts: slack, and limits that come and go."""
    path = Circle(1)
    return TubeController(
        model=cases.disturbed(),
        problem=TubeProblem(dt=0.02, horizon=10, planes=2),
        reference=path,
        planes=path.planes,
        kappa=(2.0, 2.0, 2.0),
        kappa_u=1.0,
    )


@functools.cache
def short_of_command():
    """It hovers at 0.731 of 0.735: tightening gives way."""
    return TubeController(
        model=cases.disturbed(),
        problem=TubeProblem(dt=0.02, horizon=10, planes=2, command_max=0.735),
        reference=Still((0.1, -0.2, 1.0, 2.0)),
        kappa=(2.0, 2.0, 2.0),
        kappa_u=3.0,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("of", "samples", "double", "single"),
    [
        (pilot, 120, 1e-6, 1e-5),
        (tilted, 120, 1e-6, 1e-5),
        (hard, 240, 1e-4, 1e-3),
        (short_of_command, 120, 1e-4, 1e-3),
    ],
)
def test_commands_are_those_of_the_controller_in_python(tmp_path, of, samples, double, single):
    """From the first plan on, whatever the pilot flew before it was written."""
    recorded = flight(of(), samples, seed=3)
    for real, most in (("double", double), ("float", single)):
        (tmp_path / real).mkdir()
        of().u[:] = 0.4  # a command in force is none of the library's
        flown = TubeInC(of(), tmp_path / real, real=real)
        off = np.abs(followed(flown, recorded["measured"]) - recorded["commands"]).max()
        assert off < most
    assert np.ptp(recorded["commands"], axis=0).min() > 1e-3  # there was something to do


@pytest.mark.slow
def test_its_heading_gives_way_as_that_of_the_controller_in_python_does(tmp_path):
    own = short_of_command()
    f, names = own.filter, own.filter.states.names
    own.start()
    x, u, rows, commands, adrift = own.estimate.copy(), own.u.copy(), [], [], 0
    for k in range(80):
        x[names.index("disturbance.torque.z")] = 8e-5 * (k > 10)
        y = f["h"](x, u, f.parameter_values).full().ravel().astype(np.float32).astype(float)
        rows.append(y)
        commands.append(
            own.sample(k * own.model.sample_time, dict(zip(own.estimator.columns, y))).copy()
        )
        adrift += own._adrift
        x, u = f["f_d"](x, u, f.parameter_values).full().ravel(), commands[-1]
    assert 20 < adrift < 80
    flown = TubeInC(own, tmp_path, real="double")
    assert np.abs(followed(flown, np.array(rows)) - commands).max() < 1e-4


@pytest.mark.slow
def test_an_estimate_that_takes_over_is_that_of_python(tmp_path):
    """Twice: from hover, and among commands that move."""
    own = pilot()
    f, flown = own.filter, TubeInC(own, tmp_path, real="double")
    own.start()
    x, u, off, taken = own.estimate.copy(), own.u.copy(), [], []
    for k in range(60):
        y = f["h"](x, u, f.parameter_values).full().ravel()
        measured = dict(zip(own.estimator.columns, y)) | {"x": y[0] + 0.4 * (30 <= k < 36)}
        u_next = own.sample(0.01 * k, measured).copy()
        flown.sample(0.01 * k, measured)
        off.append(np.abs(flown.estimate - own.estimate).max())
        taken.append(bool(flown.said[-1] & 32))
        x, u = f["f_d"](x, u, f.parameter_values).full().ravel(), u_next
    assert sum(taken) == sum(e.what == "the filter starts anew" for e in own.events) == 2
    assert max(off[:34]) < 1e-10
    assert max(off) < 1e-4  # commands agree no better while they are at their limits


@pytest.mark.slow
def test_no_measurement_moves_a_command_of_the_library_out_of_its_limits():
    flown, problem = in_c("float"), pilot().problem
    rng, f = np.random.default_rng(1), pilot().filter
    flown.start()
    x, u = pilot().estimate.copy(), pilot().u.copy()
    before, solved, said = None, 0, 0
    for k in range(1500):
        y = f["h"](x, u, f.parameter_values).full().ravel()
        measured = dict(zip(f.outputs.names, y.tolist()))
        if k % 60 >= 20:
            measured = damaged(measured, "mixed", 0.3, 0.5, rng)
        clock = 0.01 * k if k % 7 else float(rng.choice([math.nan, -1.0, 1e9, 0.01 * k]))
        command = flown.sample(clock, measured)
        assert (
            (command >= problem.command_min - 1e-7) & (command <= problem.command_max + 1e-7)
        ).all()
        if before is not None:
            assert np.abs(command - before).max() <= problem.rate_max + 1e-6
        before = command
        said |= flown.said[-1]
        solved += not flown.said[-1] & 256
    assert said & 8 and said & 128 and solved > 1000


def test_what_has_no_library_is_refused(tmp_path):
    with pytest.raises(ModelError, match="calibrates or adapts"):
        write_tube(pilot(True), tmp_path, name="craft")


@pytest.mark.slow
def test_the_command_line_exports_a_library_that_passes_its_self_test(tmp_path, capsys):
    save_model(cases.disturbed(), tmp_path / "model.json")
    arguments = ["export", str(tmp_path / "model.json"), "--out", str(tmp_path / "craft")]
    assert main([*arguments, "--target", "tube", "--horizon", "6", "--float", "--even-so"]) == 0
    bundle = ExportBundle.load(tmp_path / "craft")
    assert bundle.manifest["targets_written"]["tube"]["horizon"] == 6
    folder = tmp_path / "craft" / "tube"
    files = sorted(str(p) for p in folder.glob("*.c"))
    out = str(tmp_path / "selftest")
    subprocess.run([*cc(), "-O1", *files, "-lm", "-o", out], check=True)
    assert subprocess.run([out], check=False).returncode == 0
    capsys.readouterr()
    assert main([*arguments, "--target", "tube", "--horizon", "1"]) == 2


@pytest.mark.slow
@pytest.mark.skipif(cortex.missing_tool() is not None, reason=f"{cortex.missing_tool()} is missing")
def test_a_step_with_fifty_points_fits_a_cortex_m7(tmp_path):
    """At 100 Hz and 600 MHz, with one attempt a step; commands are Python's and keep their limits
    there, too."""
    flown = TubeController(
        model=cases.hybrid(points=50),
        problem=TubeProblem(dt=0.02, horizon=10, planes=2, attempts=1),
        reference=Circle(0),
        planes=Circle(0).planes,
        kappa=(2.0, 2.0, 2.0),
        kappa_u=1.0,
    )
    files = write_tube(flown, tmp_path, name="craft", real="float")
    recorded = flight(flown, 40)
    run = cortex.fly_on_cortex(
        files[:-1], "craft", recorded["measured"], paths(flown, 40), cortex.M7F, 0.01
    )
    assert ((run.commands >= 0.05 - 1e-6) & (run.commands <= 0.95 + 1e-6)).all()
    assert np.abs(run.commands - recorded["commands"]).max() < 1e-3
    assert 1_000_000 < run.instructions.max() <= 6_000_000
    assert 100_000 < run.ram < 512 * 1024
