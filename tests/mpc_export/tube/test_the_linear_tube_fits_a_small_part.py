"""The linear tube as one C library: its plan solves the condensed problem, limits
hold in flight at any heading, and a Cortex-M4F makes a step at 500 Hz."""

import functools
import subprocess

import numpy as np
import pytest

from benchmarks.tube_on_chip import Circle
from greybox.cli import main
from greybox.errors import ModelError
from greybox.residual.files import save_model
from mpc_export import cortex
from mpc_export.bundle import ExportBundle
from mpc_export.tube.controller import TubeController
from mpc_export.tube.in_process import TubeInC
from mpc_export.tube.library import Still, flight, paths
from mpc_export.tube.linear import linear_tube
from mpc_export.tube.problem import TubeProblem
from mpc_export.tube.target import Planning, write_tube
from mpc_export.tube.target import pilot_of as target_pilot
from tests.mpc_export import cases
from tests.mpc_export.tube.test_no_measurement_moves_a_command_out_of_its_limits import cc

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror")


def pilot_of(model, reference, planes=None):
    return TubeController(
        model=model,
        problem=TubeProblem(dt=0.05, horizon=5, planes=2),
        reference=reference,
        planes=planes,
        kappa=(2.0, 2.0, 2.0),
        kappa_u=1.0,
    )


@functools.cache
def pilot():
    return pilot_of(cases.disturbed(), Circle(0), Circle(0).planes)


def test_responses_and_steady_state_are_those_of_the_model():
    """Of hover to first order: a small change of commands, and a small push that is held."""
    own = pilot()
    f, made, keep = own.functions, linear_tube(own), list(own.solver.stages.keep)
    x, u = (np.array(v) for v in own.solver.stages.steady)
    w = 1e-5 * np.random.default_rng(0).standard_normal((5, 4))
    y = x.copy()
    for command in w:
        y = f["f_d"](y, u + command, f.parameter_values).full().ravel()
    moved = f["boxminus"](y, x).full().ravel()[keep]
    assert np.abs(moved - made.responses[-1] @ w.ravel()).max() < 1e-3 * np.abs(moved).max()
    pushed = np.array(own.solver.stages.free)
    force = 1e-7 * np.arange(1, len(pushed) + 1)
    d = np.zeros(len(f.error_states))
    d[keep] = (made.steady @ force)[: len(keep)]
    held = f["boxplus"](x, d).full().ravel()
    held[pushed] = force
    after = f["f_d"](held, u + (made.steady @ force)[len(keep) :], f.parameter_values)
    drift = f["boxminus"](after, held).full().ravel()
    assert np.abs(drift).max() < 1e-2 * np.abs(d).max()


def flown(own, made, seconds, goal=None):
    """Places (n, 3) and commands (n, 4) of the model itself under the library, from its path's
    beginning, or from there towards another `goal`."""
    f = own.filter
    own.start()
    made.start()
    made.reference = goal or made.reference
    x, u = own.estimate.copy(), own.u.copy()
    place, commands = [], []
    for k in range(round(seconds / made.dt)):
        y = f["h"](x, u, f.parameter_values).full().ravel()
        u_next = made.sample(k * made.dt, dict(zip(f.outputs.names, y)))
        x, u = f["f_d"](x, u, f.parameter_values).full().ravel(), u_next
        place.append(x[:3].copy())
        commands.append(u_next)
    return np.array(place), np.array(commands)


@pytest.mark.slow
@pytest.mark.parametrize("heading", [0.0, 2.5])
def test_it_holds_its_place_at_any_heading(tmp_path, heading):
    own = pilot_of(cases.disturbed(), Still((0.1, -0.2, 1.0, heading)))
    made = TubeInC(own, tmp_path, real="float", linear=True)
    place, _ = flown(own, made, 2.0)
    assert np.abs(place[-20:] - [0.1, -0.2, 1.0]).max() < 5e-3


@pytest.mark.slow
def test_a_path_far_beyond_reach_is_flown_towards_and_said_to_have_no_plan(tmp_path):
    """The method broke down before its first step, and hover's command was called a plan."""
    own = pilot_of(cases.disturbed(), Still((0.0, 0.0, 1.0, 0.0)))
    made = TubeInC(own, tmp_path, real="float", linear=True)
    _, commands = flown(own, made, 0.5, Still((1e6, 0.0, 1.0, 0.0)))
    assert {said & 256 for said in made.said} == {0, 256}  # between plans nothing is said
    assert not any(said & 512 for said in made.said)
    assert np.ptp(commands, axis=0).min() > 0.05
    assert (commands >= own.problem.command_min - 1e-6).all()
    assert (commands <= own.problem.command_max + 1e-6).all()


@pytest.mark.slow
def test_it_keeps_the_wall_and_its_commands_their_limits(tmp_path):
    own, path = pilot(), Circle(0)
    made = TubeInC(own, tmp_path, real="float", linear=True)
    place, commands = flown(own, made, 6.0)
    assert place[100:, 0].max() < 0.8 * path.radius
    assert place[100:, 0].max() > 0.6 * path.radius  # it was needed
    problem = own.problem
    assert (commands >= problem.command_min - 1e-6).all()
    assert (commands <= problem.command_max + 1e-6).all()
    assert np.abs(np.diff(commands, axis=0)).max() <= problem.rate_max + 1e-6
    assert not any(said & 256 for said in made.said)


def test_a_model_that_runs_away_at_hover_is_refused():
    own = pilot_of(cases.hybrid(points=50), Still((0.0, 0.0, 1.0, 0.0)))
    with pytest.raises(ModelError, match="hovers calmly"):
        linear_tube(own)


def test_two_attempts_are_refused():
    functions = pilot().functions
    with pytest.raises(ModelError, match="one attempt"):
        target_pilot(functions, Planning(attempts=2, linear=True))
    assert target_pilot(functions, Planning(linear=True)).problem.horizon == 5
    assert target_pilot(functions, Planning()).problem.horizon == 10


@pytest.mark.slow
def test_the_command_line_exports_a_clean_library_that_passes_its_self_test(tmp_path, capsys):
    save_model(cases.disturbed(), tmp_path / "model.json")
    arguments = ["export", str(tmp_path / "model.json"), "--out", str(tmp_path / "craft")]
    arguments += ["--target", "tube-linear", "--float", "--even-so"]
    assert main(arguments) == 0
    capsys.readouterr()
    said = ExportBundle.load(tmp_path / "craft").manifest["targets_written"]["tube-linear"]
    assert (said["folder"], said["horizon"]) == ("tube_linear", 5)
    folder = tmp_path / "craft" / "tube_linear"
    own = folder / "craft_tube.c"
    subprocess.run(
        [*cc(), *STRICT, "-Wdouble-promotion", "-c", str(own), "-o", str(tmp_path / "own.o")],
        check=True,
    )
    files = sorted(str(p) for p in folder.glob("*.c"))
    out = str(tmp_path / "selftest")
    subprocess.run([*cc(), "-O1", "-w", *files, "-lm", "-o", out], check=True)
    assert subprocess.run([out], check=False).returncode == 0


@pytest.mark.slow
@pytest.mark.skipif(cortex.missing_tool() is not None, reason=f"{cortex.missing_tool()} is missing")
def test_a_step_on_a_cortex_m4f_fits_500_hertz_at_168_megahertz(tmp_path):
    """At most 336 000 instructions and 128 KiB, on a flight along a wall with damaged
    measurements; commands are those in double."""
    own = pilot()
    (tmp_path / "double").mkdir()
    double = TubeInC(own, tmp_path / "double", real="double", linear=True)
    files = write_tube(own, tmp_path, name="craft", real="float", linear=True)
    recorded = flight(own, 80, flown=double)
    given = recorded["measured"], paths(own, 80), cortex.M4F, 0.01
    run = cortex.fly_on_cortex(files[:-1], "craft", *given)
    assert 100_000 < run.instructions.max() <= 336_000
    assert run.ram < 32 * 1024
    assert np.abs(run.commands - recorded["commands"]).max() < 3e-3
