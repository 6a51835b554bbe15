"""The linear tube as one C library: its plan solves the condensed problem, limits
hold in flight at any heading, and a Cortex-M4F makes a step at 500 Hz."""

import ctypes
import functools
import subprocess
from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

from benchmarks import cortex
from benchmarks.tube_on_chip import Circle
from greybox.cli import main
from greybox.errors import ModelError
from greybox.residual.files import save_model
from mpc_export.bundle import ExportBundle
from mpc_export.tube import in_process, linear
from mpc_export.tube.controller import TubeController
from mpc_export.tube.in_process import TubeInC
from mpc_export.tube.library import Still, flight, paths
from mpc_export.tube.linear import inverse_root, linear_tube
from mpc_export.tube.problem import TubeProblem
from mpc_export.tube.target import Planning, write_tube
from mpc_export.tube.target import pilot_of as target_pilot
from mpc_export.tube.trusted import TRUSTED
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


@functools.cache
def tilted():
    """A learned push tilts its hover by 0.066."""
    return pilot_of(cases.hybrid(points=20), Still((0.0, 0.0, 1.0, 0.0)))


INSIDE = """
static void put(double **out, const tube_real *v, int n) {
  for (int i = 0; i < n; i++) *(*out)++ = (double)v[i];
}
int flown_plan(double *out);
int flown_plan(double *out) {
  double *end = out;
  put(&end, c.solver.w[0], ALL), put(&end, c.solver.g, ALL), put(&end, c.solver.c, ROWS);
  put(&end, c.solver.soft[0], ROWS * ALL), put(&end, c.qp.lower[0], ALL), put(&end, c.qp.upper[0], ALL);
  put(&end, c.qp.most[1], ROWS);
  *end++ = c.known.plan_status;
  return (int)(end - out);
}
"""


class Opened(TubeInC):
    """With a look at the QP of the last plan."""

    def __init__(self, own, folder, monkeypatch, **k):
        write, load, made = in_process.write_library, ctypes.CDLL, []

        def written(*a, **k):
            found = write(*a, **k)
            path = folder / "flown_tube.c"
            path.write_text(path.read_text() + INSIDE)
            return found

        with monkeypatch.context() as patch:
            patch.setattr(in_process, "write_library", written)
            patch.setattr(ctypes, "CDLL", lambda path: made.append(load(path)) or made[-1])
            super().__init__(own, folder, linear=True, **k)
        self.library = made[-1]

    def plan(self):
        """w, g, c, T a, lower, upper, most and the status."""
        out = (ctypes.c_double * 1000)()
        n = self.library.flown_plan(out)
        sizes = np.cumsum([20, 20, 15, 300, 20, 20, 15])
        *found, status = np.split(np.array(out[:n]), sizes)
        return *found, int(status[0])


def solved(own, plan):
    """Commands of the same QP by IPOPT, slacks and all."""
    _, g, c, soft, lower, upper, most, _ = plan
    task, hessian = own.problem, linear_tube(own).hessian
    rows = soft.reshape(15, 20) @ np.linalg.inv(inverse_root(hessian)).T
    w, slack = ca.MX.sym("w", 20), ca.MX.sym("slack", 15)
    cost = 0.5 * ca.bilin(ca.DM(hessian), w, w) + ca.dot(g, w)
    cost += task.penalty * ca.sum1(slack) + 0.5 * task.penalty_square * ca.sumsqr(slack)
    limits = ca.vertcat(ca.DM(rows) @ w - slack, w[4:] - w[:-4])
    quiet = {"ipopt.print_level": 0, "print_time": 0, "ipopt.tol": 1e-10, "ipopt.sb": "yes"}
    task_of = {"x": ca.vertcat(w, slack), "f": cost, "g": limits}
    solver = ca.nlpsol("qp", "ipopt", task_of, quiet)
    found = solver(
        lbx=np.concatenate([lower, np.zeros(15)]),
        ubx=np.concatenate([upper, np.full(15, np.inf)]),
        lbg=np.concatenate([np.full(15, -np.inf), np.full(16, -task.rate_max)]),
        ubg=np.concatenate([most - c, np.full(16, task.rate_max)]),
    )
    return found["x"].full().ravel()[:20]


@pytest.mark.slow
def test_its_plan_solves_the_condensed_problem(tmp_path, monkeypatch):
    own = pilot()
    made = Opened(own, tmp_path, monkeypatch, real="float")
    made.start()
    assert made.plan()[-1] == -1  # no plan yet is not a plan
    off = []
    commands = flight(own, 80, 0, Watched(made, own, off))["commands"]
    assert len(off) == 16 and max(off) < 2e-4
    assert np.ptp(commands) > 0.3


class Watched:
    """A library whose plans are compared with `solved`, but those that were cut off."""

    def __init__(self, made, own, off):
        self.made, self.own, self.off = made, own, off

    def start(self):
        self.made.start()

    def sample(self, time, measured):
        """The command."""
        u = self.made.sample(time, measured)
        if self.made.said[-1] & 512 == 0 and len(self.made.said) % 5 == 0:
            plan = self.made.plan()
            assert plan[-1] == 0
            self.off.append(np.abs(plan[0] - solved(self.own, plan)).max())
        return u


@pytest.mark.slow
def test_a_plan_that_is_cut_off_keeps_limits_and_rates_at_every_stage(tmp_path, monkeypatch):
    """Rates of later stages were not looked at."""
    monkeypatch.setattr(linear, "QP_ITERATIONS", 2)
    own, cut = pilot(), 0
    made = Opened(own, tmp_path, monkeypatch, real="double")
    y = flight(own, 60, 0, made)["measured"]
    made.start()
    for k, row in enumerate(y):
        made.sample(k * made.dt, dict(zip(made.columns, row)))
        if made.said[-1] & 512:
            w, _, _, _, lower, upper, _, status = made.plan()
            cut += 1
            assert status == 0
            assert ((w >= lower - 1e-9) & (w <= upper + 1e-9)).all()
            assert np.abs(w[4:] - w[:-4]).max() <= own.problem.rate_max + 1e-9
    assert cut > 2


@pytest.mark.slow
def test_float_flies_as_double(tmp_path, monkeypatch):
    """Plans cut off after five iterations of an interior point method were up to 0.35 apart."""
    own, worst = pilot(), []
    flown = {}
    for real in ("double", "float"):
        (tmp_path / real).mkdir()
        flown[real] = TubeInC(own, tmp_path / real, real=real, linear=True)
    for seed in (1, 5):
        path = Circle(seed)
        for one in (own, *flown.values()):
            monkeypatch.setattr(one, "reference", path)
            monkeypatch.setattr(one, "planes", path.planes)
        double, single = (flight(own, 150, seed, one)["commands"] for one in flown.values())
        worst.append(np.abs(single - double).max())
    assert max(worst) < 5e-4


@pytest.mark.slow
def test_tilt_is_held_from_level_and_not_from_hover(tmp_path, monkeypatch):
    """A craft whose hover is tilted by 0.066 may tilt by as much less to that side."""
    own = tilted()
    made = Opened(own, tmp_path, monkeypatch, real="double")
    level = linear_tube(own).level
    q = own.solver.stages.steady[0][own._rows("attitude")]
    assert np.hypot(*level) == pytest.approx(np.arccos(1 - 2 * (q[1] ** 2 + q[2] ** 2)), abs=1e-6)
    flown(own, made, 1.0)
    tilt = made.plan()[2].reshape(5, 3)[:, 2]  # of the response to hover's command
    assert tilt == pytest.approx(level @ level / (0.3 * own.problem.tilt_max), rel=0.2)


def misses(own, made, d):
    """Of the prediction at hover from there by d: the most, in standard deviations of the tube."""
    f, (x, u) = own.functions, own.solver.stages.steady
    place, tilt = own._rows("position", True), own._rows("attitude", True)[:2]
    y, found = f["boxplus"](x, d), []
    for k in range(1, 6):
        y, d = f["f_d"](y, u, f.parameter_values), made.transition @ d
        off = f["boxminus"](y, x).full().ravel() - d
        for rows, spread in ((place, made.place[k]), (tilt, made.tilt[k])):
            found.append(off[rows] @ np.linalg.solve(spread, off[rows]))
    return float(np.sqrt(max(found)))


def test_it_knows_how_far_from_hover_its_prediction_holds():
    own = pilot()
    made = linear_tube(own)
    tilt, speed, rate = made.trusted
    rows = [own._rows(n, True) for n in ("attitude", "velocity", "rate")]
    rng, inside, outside = np.random.default_rng(7), [], []
    for _ in range(20):
        d = np.zeros(len(own.functions.error_states))
        share = rng.dirichlet(np.ones(3)) ** 0.5
        for of, (at, most) in zip(share, ((rows[0][:2], tilt), (rows[1], speed), (rows[2], rate))):
            way = rng.standard_normal(len(at))
            d[at] = of * most * way / np.linalg.norm(way)
        inside.append(misses(own, made, d))
        outside.append(misses(own, made, 2 * d))
    assert max(inside) < 1.2 * TRUSTED
    assert max(outside) > 2 * TRUSTED


@pytest.mark.slow
def test_it_says_that_it_is_far_from_hover(tmp_path):
    own = pilot_of(cases.disturbed(), Still((0.0, 0.0, 1.0, 0.0)))
    made = TubeInC(own, tmp_path, real="float", linear=True)
    flown(own, made, 0.5)
    assert not any(said & 16384 for said in made.said)
    flown(own, made, 1.0, Still((2.0, 0.0, 1.0, 0.0)))
    assert any(said & 16384 for said in made.said)


@pytest.mark.slow
def test_a_function_that_is_not_finite_is_no_plan_and_no_missing_one(tmp_path, monkeypatch):
    own = pilot_of(cases.disturbed(), Still((0.0, 0.0, 1.0, 0.0)))
    made = Opened(own, tmp_path, monkeypatch, real="float")
    made.start()
    made.reference = Still((np.nan, 0.0, 1.0, 0.0))
    for k in range(5):
        u = made.sample(k * made.dt, {})
    assert made.plan()[-1] == 1
    assert made.said[-1] & 256
    assert u == pytest.approx(own.solver.stages.steady[1], abs=1e-6)


@pytest.mark.slow
def test_a_wall_that_is_no_number_is_no_plan(tmp_path, monkeypatch):
    """It bound nothing, and the plan counted as solved."""
    made = Opened(pilot(), tmp_path, monkeypatch, real="float")
    made.start()
    made.planes = lambda times: np.full((len(np.atleast_1d(times)), 2, 4), np.nan)
    for k in range(5):
        u = made.sample(k * made.dt, {})
    assert made.plan()[-1] != 0
    assert np.isfinite(u).all()


def test_a_hover_that_cannot_be_planned_is_refused(monkeypatch):
    own = pilot()
    failed = own.solver.solve()
    monkeypatch.setattr(own.solver, "solve", lambda: replace(failed, status=1))
    with pytest.raises(ModelError, match="plan at hover"):
        linear_tube(own)


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
def test_a_path_far_beyond_reach_is_flown_towards(tmp_path):
    """The method broke down before its first step, and hover's command was called a plan."""
    own = pilot_of(cases.disturbed(), Still((0.0, 0.0, 1.0, 0.0)))
    made = TubeInC(own, tmp_path, real="float", linear=True)
    place, commands = flown(own, made, 0.5, Still((1e6, 0.0, 1.0, 0.0)))
    assert place[-1, 0] > 0.04
    assert any(said & 16384 for said in made.said)
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


@pytest.mark.slow
def test_a_model_that_runs_away_at_hover_is_refused():
    own = pilot_of(cases.hybrid(points=50), Still((0.0, 0.0, 1.0, 0.0)))
    with pytest.raises(ModelError, match="hovers calmly"):
        linear_tube(own)


def test_two_attempts_are_refused(monkeypatch):
    functions = pilot().functions
    with pytest.raises(ModelError, match="one attempt"):
        target_pilot(functions, Planning(attempts=2, linear=True))
    # no controller is made for how many stages it would have
    monkeypatch.setattr("mpc_export.tube.target.TubeController", SimpleNamespace)
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
