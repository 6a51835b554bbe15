"""With the same start and commands MuJoCo, given the written model and its callback, is within 1 %
of our own model over half a second; without the callback it still hovers."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from greybox.simulators.craft import Craft
from greybox.simulators.make import twin
from greybox.simulators.size import fly
from greybox.simulators.statement import agreement
from greybox.simulators.words import Status
from scenarios.twins.written import load
from tests.simulators.identified import AERODYNAMICS, START, Array, identified, manoeuvre

mujoco = pytest.importorskip("mujoco")

EVERYTHING = {
    **AERODYNAMICS,
    "ground_effect.k": 1.5,
    "rotational_damping.d_p": 0.01,
    "rotor_gyroscopic.J_r": 1e-5,
    "constant_force.f_x": 0.2,
}


def rotation(q: Array) -> Array:
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def flown(folder: Path, com: Array, u: Array, dt: float = 0.01) -> Array:
    """States (13, steps) of the centre of mass in MuJoCo."""
    commands, callback = load(folder, "commands", "callback")
    model = mujoco.MjModel.from_xml_path(str(folder / "model.xml"))
    data = mujoco.MjData(model)
    turn = rotation(START["attitude"])
    data.qpos[:3] = START["position"] - turn @ com
    data.qpos[3:7] = START["attitude"]
    data.qvel[:3] = START["velocity"] - turn @ np.cross(START["rate"], com)
    data.qvel[3:6] = START["rate"]
    callback.attach()
    try:
        callback.hover(model, data)
        line, rows = commands.DelayLine(np.full(4, commands.HOVER_COMMAND)), []
        for k in range(u.shape[1]):
            for seconds, held in line.pieces(u[:, k], dt):
                count = int(np.ceil(seconds / 0.002))
                model.opt.timestep = seconds / count
                data.ctrl[:] = commands.normalised_speed(held)
                for _ in range(count):
                    mujoco.mj_step(model, data)
            q, rate = data.qpos[3:7].copy(), data.qvel[3:6].copy()
            turn = rotation(q)
            position = data.qpos[:3] + turn @ com
            velocity = data.qvel[:3] + turn @ np.cross(rate, com)
            rows.append(np.concatenate([position, velocity, q, rate]))
        return np.array(rows).T
    finally:
        callback.detach()


def test_what_moves_the_body_is_said_whole_and_flies_alike(tmp_path: Path) -> None:
    model = identified(EVERYTHING, gravity=9.80665)
    (statement,) = twin(model, ["mujoco"], out=tmp_path).statements
    assert {r.word.status for r in statement.rows} == {Status.SAID}
    craft = Craft.of(model)
    u = manoeuvre(craft.hover_nu)
    ours = fly(craft, START, u, 0.01)[:13]
    apart = agreement(ours, flown(tmp_path / "mujoco", craft.center_of_mass, u))
    assert max(apart.values()) < 0.01, apart


def test_the_plain_file_hovers_without_the_callback(tmp_path: Path) -> None:
    model = identified({"motor_lag.tau": 0.05, "rotor_drag.k_x": 2e-5})
    twin(model, ["mujoco"], out=tmp_path)
    plant = mujoco.MjModel.from_xml_path(str(tmp_path / "mujoco" / "model.xml"))
    data = mujoco.MjData(plant)
    data.ctrl[:] = data.act[:] = Craft.of(model).hover_nu
    for _ in range(100):
        mujoco.mj_step(plant, data)
    assert np.abs(data.qvel).max() < 1e-9


def test_commands_carry_the_battery(tmp_path: Path) -> None:
    model = identified({"battery_sag.c_V": 0.7, "thrust_curve.f": 0.2})
    twin(model, ["mujoco", "rotorpy"], out=tmp_path)
    craft = Craft.of(model)
    goal = craft.physics.body.rotors.goal
    u = np.array([0.5, 0.6, 0.7, 0.8])
    for target in ("mujoco", "rotorpy"):
        (commands,) = load(tmp_path / target, "commands")
        for volt in (10.0, 11.5):
            given = ca.DM([*u, volt])
            ours = np.asarray(goal(given, craft.values), dtype=float).ravel()
            np.testing.assert_allclose(commands.normalised_speed(u, volt), ours, rtol=1e-12)


@pytest.mark.parametrize(("low", "high"), [(0.0, 0.0), (0.04, 0.1)])
def test_commands_beyond_what_motors_saturate_at_do_no_more(
    low: float, high: float, tmp_path: Path
) -> None:
    """Without the effect, too: the range of the vehicle file is the motors' own."""
    limits = {"command_saturation.a_lo": low, "command_saturation.a_hi": high}
    twin(identified({"thrust_curve.f": 0.2, **limits}), ["mujoco"], out=tmp_path)
    (commands,) = load(tmp_path / "mujoco", "commands")
    found = commands.normalised_speed(np.array([-0.2, -5.0, 1.5, 1e9]))
    ends = commands.normalised_speed(np.array([low, low, 1.0 - high, 1.0 - high]))
    np.testing.assert_array_equal(found, ends)
    if not low:
        np.testing.assert_array_equal(ends, [0.0, 0.0, 1.0, 1.0])
