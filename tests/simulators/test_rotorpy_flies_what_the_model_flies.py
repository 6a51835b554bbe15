"""With the same start and commands RotorPy, given the written file, is within 1 % of our model over
half a second: where it says everything of the model itself, else of what its statement says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from greybox.simulators.craft import Craft
from greybox.simulators.make import twin
from greybox.simulators.size import fly
from greybox.simulators.statement import agreement
from greybox.simulators.words import Status
from scenarios.twins.written import load
from tests.simulators.identified import AERODYNAMICS, START, Array, identified, manoeuvre

multirotor = pytest.importorskip("rotorpy.vehicles.multirotor")


def flown(folder: Path, u: Array, dt: float = 0.01) -> Array:
    """States (13, steps) of RotorPy's craft."""
    commands, vehicle = load(folder, "commands", "vehicle")
    craft = multirotor.Multirotor(
        vehicle.quad_params, vehicle.initial_state(), integrator_kwargs={"rtol": 1e-8, "atol": 1e-9}
    )
    w, x, y, z = START["attitude"]
    state = vehicle.initial_state() | {
        "x": START["position"],
        "v": START["velocity"],
        "q": np.array([x, y, z, w]),
        "w": START["rate"],
    }
    line, rows = commands.DelayLine(np.full(4, commands.HOVER_COMMAND)), []
    for k in range(u.shape[1]):
        for seconds, held in line.pieces(u[:, k], dt):
            state = craft.step(state, {"cmd_motor_speeds": vehicle.motor_speeds(held)}, seconds)
        x, y, z, w = state["q"]
        rows.append([*state["x"], *state["v"], w, x, y, z, *state["w"]])
    return np.array(rows).T


def test_what_it_says_whole_flies_alike(tmp_path: Path) -> None:
    said = {n: v for n, v in AERODYNAMICS.items() if not n.startswith("linear_drag.")}
    model = identified(said)
    made = twin(model, ["rotorpy"], out=tmp_path)
    (statement,) = made.statements
    assert {r.word.status for r in statement.rows} == {Status.SAID}
    craft = Craft.of(model)
    u = manoeuvre(craft.hover_nu)
    ours = fly(craft, START, u, 0.01)[:13]
    apart = agreement(ours, flown(tmp_path / "rotorpy", u))
    assert max(apart.values()) < 0.01, apart


def test_what_it_folds_or_loses_flies_as_the_statement_says(tmp_path: Path) -> None:
    lost = {"rotational_damping.d_p": 0.01, "constant_force.f_x": 0.3, "rotor_drag.k_y": 4e-5}
    model = identified({**AERODYNAMICS, **lost})
    (statement,) = twin(model, ["rotorpy"], out=tmp_path).statements
    status = {r.word.effect: r.word.status for r in statement.rows}
    assert status["rotational_damping"] is status["constant_force"] is Status.LOST
    assert status["rotor_drag"] is status["linear_drag"] is Status.FOLDED
    u = manoeuvre(statement.spoken.hover_nu)
    theirs = flown(tmp_path / "rotorpy", u)
    apart = agreement(fly(statement.spoken, START, u, 0.01)[:13], theirs)
    assert max(apart.values()) < 0.01, apart
    astray = agreement(fly(Craft.of(model), START, u, 0.01)[:13], theirs)
    assert astray["velocity"] > 0.02, "what is lost can be seen"


def test_a_file_of_rotorpy_runs_as_its_first_lines_show(tmp_path: Path) -> None:
    model = identified({"motor_lag.tau": 0.05})
    twin(model, ["rotorpy"], out=tmp_path)
    (vehicle,) = load(tmp_path / "rotorpy", "vehicle")
    craft = multirotor.Multirotor(vehicle.quad_params, vehicle.initial_state())
    hover = np.full(4, Craft.of(model).hover_nu)
    state = vehicle.initial_state()
    for _ in range(20):
        state = craft.step(state, {"cmd_motor_speeds": vehicle.motor_speeds(hover)}, 0.01)
    assert np.abs(state["v"]).max() < 1e-6
