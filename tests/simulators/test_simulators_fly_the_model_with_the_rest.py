"""PyBullet and JSBSim, given the written files, are within 1 % of what their statements say over
half a second; and with the force and moment of rest.py every simulator is within 1 % of the whole
model, what was learned included, whose loss is never silent."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from greybox.model.identified import IdentifiedModel
from greybox.residual.hybrid import HybridModel
from greybox.simulators.craft import Craft
from greybox.simulators.make import twin
from greybox.simulators.size import fly
from greybox.simulators.statement import agreement
from greybox.simulators.words import LEARNED, Status
from scenarios.foreign.plant import MissingSimulator
from scenarios.twins.written import FLYERS, Start
from tests.residual import hybrid_cases
from tests.simulators.identified import AERODYNAMICS, START, Array, identified, manoeuvre

NOT_SAID = {
    **AERODYNAMICS,
    "rotor_drag.k_y": 4e-5,
    "rotational_damping.d_p": 0.02,
    "ground_effect.k": 1.5,
    "constant_force.f_x": 0.2,
}


def flown(target: str, folder: Path, craft: Craft, u: Array, *, rest: bool) -> Array:
    start = Start(rotors=np.full(4, craft.hover_nu), **START)
    before = np.full((5, 4), craft.hover_command)
    try:
        states = FLYERS[target](folder / target, start, u.T, before, 0.01, rest=rest)
    except MissingSimulator as missing:
        pytest.skip(str(missing))
    return states[:, :13].T


@pytest.mark.parametrize("target", ["pybullet", "jsbsim"])
def test_what_it_says_whole_flies_alike(target: str, tmp_path: Path) -> None:
    says = ("motor_lag", "rotor_asymmetry", "center_of", "products", "payload", "command", "thrust")
    said = {k: v for k, v in AERODYNAMICS.items() if k.startswith(says)}
    said |= {"products_of_inertia.Jxy": 2e-3}
    if target == "jsbsim":
        said |= {"rotational_damping.d_p": 0.02}
    model = identified(said, gravity=9.8)
    (statement,) = twin(model, [target], out=tmp_path).statements
    assert {r.word.status for r in statement.rows} == {Status.SAID}
    u = manoeuvre(statement.spoken.hover_nu)
    theirs = flown(target, tmp_path, statement.spoken, u, rest=False)
    apart = agreement(fly(Craft.of(model), START, u, 0.01)[:13], theirs)
    assert max(apart.values()) < 0.01, apart


@pytest.mark.parametrize("target", ["pybullet", "jsbsim"])
def test_what_it_folds_flies_as_the_statement_says(target: str, tmp_path: Path) -> None:
    model = identified(NOT_SAID, gravity=9.8)
    (statement,) = twin(model, [target], out=tmp_path).statements
    u = manoeuvre(statement.spoken.hover_nu)
    theirs = flown(target, tmp_path, statement.spoken, u, rest=False)
    apart = agreement(fly(statement.spoken, START, u, 0.01)[:13], theirs)
    assert max(apart.values()) < 0.01, apart


@pytest.mark.parametrize(
    "target",
    [pytest.param("rotorpy", marks=pytest.mark.slow), "drone-models", "crazyflow", "pybullet"],
)
def test_with_the_rest_every_simulator_flies_the_model(target: str, tmp_path: Path) -> None:
    model = identified(NOT_SAID, gravity=9.80665)
    (statement,) = twin(model, [target], out=tmp_path).statements
    craft = Craft.of(model)
    u = manoeuvre(craft.hover_nu)
    ours = fly(craft, START, u, 0.01)[:13]
    apart = agreement(ours, flown(target, tmp_path, craft, u, rest=True))
    assert max(apart.values()) < 0.01, apart
    without = agreement(ours, fly(statement.spoken, START, u, 0.01)[:13])
    assert without["rate"] > 0.05, "what is left out can be seen"


def learned(*features: str) -> IdentifiedModel:
    """A craft whose physics has motor lag alone, under a push that was learned of `features`."""
    model = identified({"motor_lag.tau": 0.05}, gravity=9.80665)
    push = hybrid_cases.push(model.dynamics, features, ("force.z", "torque.x", "torque.y"))
    scaled = replace(push, output_scale=np.array([1.0, 0.01, 0.02]))
    return replace(model, dynamics=HybridModel(inner=model.dynamics, posterior=scaled))


MOTION = ("body_velocity.x", "gravity.y", "q", "nu1")


@pytest.mark.parametrize("target", ["drone-models", "pybullet"])
def test_what_was_learned_flies_with_the_rest(target: str, tmp_path: Path) -> None:
    (statement,) = twin(learned(*MOTION), [target], out=tmp_path).statements
    craft = Craft.of(learned(*MOTION))
    u = manoeuvre(craft.hover_nu)
    ours = fly(craft, START, u, 0.01, learned=True)[:13]
    apart = agreement(ours, flown(target, tmp_path, craft, u, rest=True))
    assert max(apart.values()) < 0.01, apart
    without = agreement(ours, fly(statement.spoken, START, u, 0.01)[:13])
    assert without["rate"] > 0.05, "what is left out can be seen"


@pytest.mark.parametrize("features", [MOTION, ("body_velocity.x", "u1")])
def test_what_was_learned_is_not_lost_without_a_number(features: tuple[str, ...]) -> None:
    made = twin(learned(*features), ["mujoco", "gazebo", "numpy"])
    *others, own = made.statements
    assert own.whole is None
    for statement in others:
        (row,) = [r for r in statement.rows if r.word.effect == LEARNED]
        assert row.word.status is Status.LOST and row.size is not None
        assert row.size.position > 1e-3 and statement.whole is not None
        assert statement.whole.position == pytest.approx(row.size.position, rel=0.3)
        assert "says everything" not in statement.headline
        assert ("rest.py what was learned" in row.text) is (features is MOTION)
    assert ("mujoco/rest.py" in made.files) is (features is MOTION)


def test_gravity_that_pybullet_fixes_is_a_row() -> None:
    def rows(gravity: float) -> dict[str, tuple[Status, float | None]]:
        (statement,) = twin(identified({}, gravity=gravity), ["pybullet"]).statements
        return {r.word.effect: (r.word.status, r.word.change.gravity) for r in statement.rows}

    assert rows(9.80665)["gravity"] == (Status.FOLDED, 9.8)
    assert "gravity" not in rows(9.8)


def test_nothing_is_left_over_where_everything_is_said(tmp_path: Path) -> None:
    made = twin(identified({"motor_lag.tau": 0.05}), ["rotorpy", "mujoco", "crazyflow"])
    assert not [n for n in made.files if n.endswith("rest.py")]
    with_drag = twin(identified({"rotational_damping.d_p": 0.01}), ["rotorpy", "mujoco"])
    assert [n for n in with_drag.files if n.endswith("rest.py")] == ["rotorpy/rest.py"]
    assert "rest.py" in str(with_drag.files["rotorpy/LOST.txt"])
