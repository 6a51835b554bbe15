"""No measurement, however wild, moves a command out of its limits, stops a pilot or keeps it lost.

GREYBOX_FUZZ=1000000 python -m pytest -m slow THIS_FILE -s   # a million plans, a million samples

Long runs go in parts of 50 000, each from a seed of its own, and print the sum so far: a run that
is cut tells what it has seen.
"""

from __future__ import annotations

import math
import os
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from greybox.errors import ModelError
from greybox.estimation.build import compiler
from mpc_export.c_code import FAST_FLAGS
from mpc_export.tube.problem import TubeProblem
from mpc_export.tube.solver import _compiled, hpipm, link_flags, sources
from tests.mpc_export.tube.test_controller_flies_and_survives import fly, pilot
from tests.mpc_export.tube.test_tube_solver_agrees_with_ipopt import pair
from tests.mpc_export.tube.wild import fuzzed

HERE = Path(__file__).parent
MANY = int(os.environ.get("GREYBOX_FUZZ", "20000"))
PART = 50_000
SANITIZED = ("-std=c99", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=undefined")
STRICT = ("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror")


def cc() -> tuple[str, ...]:
    return compiler() or ()


def program(folder: Path, flags: tuple[str, ...], *, own_model: bool = False) -> list[str]:
    """Command line of fuzz.c behind controller.c, with the stage functions of the compiled solver
    or, for sanitizers, compiled with it."""
    solver, _ = pair()
    texts = sources(solver.sizes, solver.stages, ())
    fuzz = folder / "fuzz.c"
    own = (HERE.parent / "fuzz_random.c", HERE / "fuzz.c")
    fuzz.write_text("".join([texts["controller.c"], *(f.read_text() for f in own)]))
    include = f"-isystem{hpipm()[0]}"
    made = [*cc(), *flags, *STRICT, include, "-c", str(fuzz), "-o", str(folder / "fuzz.o")]
    subprocess.run(made, check=True)
    model = str(_compiled(texts))
    if own_model:
        (folder / "model.c").write_text(texts["tube_model.c"])
        model = str(folder / "model.o")
        subprocess.run(
            [*cc(), *flags, "-w", "-c", str(folder / "model.c"), "-o", model], check=True
        )
    out = str(folder / "fuzz")
    subprocess.run(
        [*cc(), *flags, str(folder / "fuzz.o"), model, "-o", out, *link_flags(), "-lm"], check=True
    )
    solver.reset()
    solver.data["kappa"][:], solver.data["kappa_u"][()] = 2.0, 1.0
    (folder / "hover.bin").write_bytes(solver._buffer.tobytes())
    return [out, str(folder / "hover.bin")]


def in_float(folder: Path, flags: tuple[str, ...]) -> list[str]:
    """The same in single precision: the controller's own text with HPIPM's other half."""
    solver, _ = pair()
    solver.reset()
    d = solver.data
    d["kappa"][:], d["kappa_u"][()] = 2.0, 1.0
    d["qp_tolerance"][()], d["primal_tolerance"][()] = 1e-4, 1e-3
    (folder / "hover.bin").write_bytes(solver._buffer.astype(np.float32).tobytes())
    texts = sources(solver.sizes, solver.stages, (), real="float")

    def single(text: str) -> str:
        text = re.sub(r"\bdouble\b", "float", text).replace("blasfeo_d_", "blasfeo_s_")
        return re.sub(r"\b(hpipm_|struct )?d_ocp_qp", r"\1s_ocp_qp", text).replace(
            "1e-12)", "1e-6)"
        )

    random = (HERE.parent / "fuzz_random.c").read_text()
    texts["fuzz.c"] = single(texts["controller.c"]) + random + single((HERE / "fuzz.c").read_text())
    for name in ("tube_model.c", "fuzz.c"):
        (folder / name).write_text(texts[name])
    made = [
        *cc(),
        *flags,
        "-w",
        f"-isystem{hpipm()[0]}",
        *(str(folder / n) for n in ("fuzz.c", "tube_model.c")),
    ]
    subprocess.run([*made, "-o", str(folder / "fuzz"), *link_flags(), "-lm"], check=True)
    return [str(folder / "fuzz"), str(folder / "hover.bin")]


def judged(command: list[str], steps: int, seed: int) -> None:
    done = subprocess.run(
        [*command, str(steps), str(seed)], capture_output=True, text=True, check=False, timeout=7200
    )  # a hang ends in TimeoutExpired
    print(done.stdout)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = [line.split() for line in done.stdout.splitlines()]
    counts = {name: [int(n) for n in numbers] for name, *numbers in rows[:-2]}
    assert len(counts) == 11
    assert sum(row[0] for row in counts.values()) == steps
    # outside its limits, not finite, written to though refused
    assert [sum(row[i] for row in counts.values()) for i in (4, 5, 6)] == [0, 0, 0]
    assert all(row[0] == row[1] + row[2] + row[3] for row in counts.values())
    # it does refuse, it does solve, and what is wild leaves nothing behind
    assert counts["nan"][3] > 0 < counts["near"][1]
    _, back, _, of = rows[-1]
    assert back == of


@pytest.mark.slow
def test_plans_in_c_keep_their_limits(tmp_path):
    judged(program(tmp_path, ("-std=c99", "-O0")), 1500, 1)


@pytest.mark.slow
def test_plans_in_single_precision_keep_their_limits_too(tmp_path):
    judged(in_float(tmp_path, ("-std=c99", "-O1")), 1500, 1)


def flown(steps: int, seed: int) -> None:
    tally = fuzzed(pilot(), steps, seed)
    print(tally)
    assert tally.raised == []
    assert tally.outside == 0
    assert tally.back == tally.rests > 0
    assert tally.lost == 0 < tally.home


def test_commands_of_a_pilot_keep_their_limits():
    flown(700, 1)


def test_a_qp_that_is_cut_off_is_no_solution_unless_it_keeps_its_limits():
    """From one iteration on to as many as it asks for: what is taken over has met dynamics and
    limits."""
    solver, _ = pair()
    names = solver.model.states.names
    statuses = set()
    for most in range(1, 30):
        solver.reset()
        d = solver.data
        d["x0"][names.index("velocity.x")], d["qp_iterations_max"][()] = 3.0, most
        kept = d["x"].copy(), d["u"].copy()
        outcome = solver.solve()
        statuses.add((outcome.status, outcome.qp_status))
        assert (outcome.status == 0) == (outcome.qp_residual <= d["primal_tolerance"])
        if outcome.status:
            np.testing.assert_array_equal(d["x"], kept[0])
            np.testing.assert_array_equal(d["u"], kept[1])
        changes = np.diff(np.vstack([d["u_before"], d["u"]]), axis=0)
        assert np.abs(changes).max() <= solver.problem.rate_max + 1e-12
    assert {(2, 1), (0, 0)} <= statuses


def test_cut_off_qps_are_told_by_events():
    controller = pilot()

    def seen(k, y):
        controller.solver.data["qp_iterations_max"][()] = 2 if 100 <= k < 120 else 40
        return y

    _, commands = fly(controller, 200, force=0.02, seen=seen)
    kinds = {e.what for e in controller.events}
    assert kinds <= {
        "no solution (status 2, QP 1)",
        "a plan within its limits, but not the best (QP 1)",
    }
    assert kinds
    assert np.abs(np.diff(commands, axis=0)).max() <= controller.problem.rate_max + 1e-12


@pytest.mark.parametrize(
    "command", [[9.0] * 4, [-9.0, 0.5, 9.0, 0.5], [math.nan] * 4, [math.inf] * 4]
)
def test_whoever_decides_it_a_command_is_within_its_limits_and_it_is_told(monkeypatch, command):
    controller = pilot()
    controller.start()
    monkeypatch.setattr(controller, "_decide", lambda begin: np.array(command))
    before = controller.u
    for k in range(40):
        u = controller.sample(0.01 * k, {})
        assert (u >= controller.problem.command_min).all()
        assert (u <= controller.problem.command_max).all()
        assert np.abs(u - before).max() <= controller.problem.rate_max + 1e-12
        before = u
    told = [e.what for e in controller.events if e.what.startswith("the command is")]
    assert len(told) == 20


def test_the_caller_cannot_change_the_command_in_force():
    controller = pilot()
    controller.start()
    controller.sample(0.0, {})[:] = 77.0
    assert controller.u.max() <= controller.problem.command_max


def test_a_start_that_is_not_finite_and_limits_that_are_none_are_refused():
    with pytest.raises(ModelError, match="finite"):
        pilot().start(np.full(len(pilot().estimate), math.nan))
    for wrong in ({"command_max": math.inf}, {"rate_max": math.nan}, {"penalty": math.inf}):
        with pytest.raises(ModelError, match="controller"):
            TubeProblem(**wrong)


def in_parts(steps: int, first_seed: int) -> Iterator[tuple[int, int]]:
    """(steps, seed) of every part; prints how many steps were judged when a part is done."""
    for done in range(0, steps, PART):
        part = min(PART, steps - done)
        yield part, first_seed + done // PART
        print(f"{done + part} of {steps} steps", flush=True)


@pytest.mark.slow
def test_many_plans_in_c_keep_their_limits(tmp_path):
    command = program(tmp_path, FAST_FLAGS)
    for steps, seed in in_parts(MANY, 100):
        judged(command, steps, seed)


@pytest.mark.slow
@pytest.mark.parametrize("real", ["double", "float"])
def test_plans_in_c_stay_inside_their_memory(tmp_path, real):
    made = (
        program(tmp_path, SANITIZED, own_model=True)
        if real == "double"
        else in_float(tmp_path, SANITIZED)
    )
    judged(made, min(MANY, 20000), 3)


@pytest.mark.slow
def test_many_commands_of_a_pilot_keep_their_limits():
    for steps, seed in in_parts(MANY, 200):
        flown(steps, seed)
