"""Every draw is a body that can be, draws repeat the posterior's means, spreads and correlations,
and what was held stays."""

from __future__ import annotations

import io
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from greybox.errors import DataError
from greybox.model.identified import IdentifiedModel
from greybox.simulators.command_text import command_text
from greybox.simulators.draws import Draws, draw
from greybox.simulators.targets import target_by_name
from scenarios.twins.written import load
from tests.simulators.identified import Array, identified
from tests.simulators.test_written_numbers_give_the_wrench import rotation

NAMES = ("inertia.xx", "inertia.yy", "inertia.zz", "thrust.c2", "motor_lag.tau", "rotor_drag.k_x")


def uncertain(sigmas: tuple[float, ...], correlation: float = 0.6) -> IdentifiedModel:
    model = identified({"motor_lag.tau": 0.05, "rotor_drag.k_x": 2e-5, "rotor_drag.k_y": 2e-5})
    size = np.array([model.values[n] for n in NAMES]) * np.array(sigmas)
    c = np.outer(size, size) * (correlation + (1 - correlation) * np.eye(len(size)))
    return replace(
        model,
        covariance_names=NAMES,
        covariance=c,
        flight_spread={"mass": (1.0, 0.02)},
    )


def moments(draws: Draws) -> np.ndarray:
    return np.array([np.linalg.eigvalsh(draws.one(i).inertia) for i in range(len(draws))])


def test_draws_of_a_wide_posterior_are_all_bodies() -> None:
    draws = draw(uncertain((0.4, 0.4, 0.4, 0.3, 0.4, 0.9), correlation=0.0), 2000, seed=1)
    j = moments(draws)
    assert (j[:, 0] > 0).all()
    assert (j[:, 2] < j[:, 0] + j[:, 1]).all()
    for name in ("thrust.c2", "motor_lag.tau", "rotor_drag.k_x", "mass"):
        assert (draws.column(name) >= 0).all()
    assert (draws.column("rotor_drag.k_x") == 0).any(), "a wide one is cut at its bound"


def test_drawn_thrust_rises_with_the_command_and_carries_the_craft() -> None:
    model = uncertain((0.1,) * 6)
    names = ("thrust.c1", "thrust.c2")
    thrust = {"thrust.c0": 0.0, "thrust.c1": 2.0, "thrust.c2": 1.0}
    model = replace(model, values=model.values.replace(thrust), covariance_names=names)
    draws = draw(replace(model, covariance=np.diag([1.0, 2.0]) ** 2), 500, seed=1)
    c1, c2 = (draws.column(n) for n in names)
    low, high = draws.craft.command_range
    assert (c2 < 0).any(), "a thrust that bends down is no fault"
    assert (c1 + 2 * c2 * low >= 0).all() and (c1 + 2 * c2 * high > 0).all()
    assert all(draws.one(i).hover_nu > 0 for i in range(500))
    assert "draws/isaac.npz" in draws.files()


def test_a_ratio_that_flights_know_is_kept_where_the_mass_was_only_held() -> None:
    """Thrust over mass is known to 1 %, each of them to 15 %."""
    model = uncertain((0.02,) * 6)
    thrust, mass = model.values["thrust.c2"], model.values["mass"]
    held = {"mass": (0.15 * mass, {"thrust.c2": thrust / mass})}
    wide = (0.15**2 + 0.01**2) * thrust**2
    model = replace(
        model,
        covariance_names=("thrust.c2",),
        covariance=np.array([[wide]]),
        considered=held,
        flight_spread={},
    )
    draws = draw(model, 4000, seed=1)
    c2, m = draws.column("thrust.c2"), draws.column("mass")
    assert m.std() == pytest.approx(0.15 * mass, rel=0.05)
    assert c2.std() == pytest.approx(0.15 * thrust, rel=0.05)
    assert (c2 / m).std() == pytest.approx(0.01 * thrust / mass, rel=0.1)
    assert (c2 / m).mean() == pytest.approx(thrust / mass, rel=2e-3)


def test_thrust_of_every_flight_is_drawn_with_the_mass_that_was_held() -> None:
    """Thrust over mass differs by 1 % between flights; both are off by the error of the mass
    together."""
    model = uncertain((0.02,) * 6)
    thrust, mass = model.values["thrust.c2"], model.values["mass"]
    model = replace(
        model,
        covariance_names=("motor_lag.tau",),
        covariance=np.array([[1e-6]]),
        considered={"mass": (0.15 * mass, {"thrust.c2": thrust / mass, "motor_lag.tau": 0.0})},
        flight_spread={"thrust.c2": (thrust, 0.01 * thrust)},
    )
    draws = draw(model, 4000, seed=1)
    c2, m = draws.column("thrust.c2"), draws.column("mass")
    assert (c2 / m).std() == pytest.approx(0.01 * thrust / mass, rel=0.1)
    assert c2.std() == pytest.approx(0.15 * thrust, rel=0.05)
    assert draws.column("motor_lag.tau").std() == pytest.approx(1e-3, rel=0.05)


def test_products_of_inertia_are_drawn_with_the_moments() -> None:
    model = uncertain((0.1,) * 6)
    products = {
        f"products_of_inertia.{n}": v for n, v in (("Jxy", 8e-4), ("Jxz", -3e-4), ("Jyz", 2e-4))
    }
    rounder = {"inertia.xx": 0.010, "inertia.yy": 0.011, "inertia.zz": 0.014}
    whole = identified({**{n: model.values[n] for n in NAMES}, **products, **rounder})
    names = (*NAMES[:3], *products)
    sigma = np.array([0.05 * whole.values[n] for n in NAMES[:3]] + [2e-4] * 3)
    model = replace(whole, covariance_names=names, covariance=np.diag(sigma**2))
    draws = draw(model, 8000, seed=2)
    columns = np.array([draws.column(n) for n in names])
    np.testing.assert_allclose(
        columns.mean(axis=1), [model.values[n] for n in names], rtol=0.02, atol=1e-5
    )
    np.testing.assert_allclose(columns.std(axis=1), sigma, rtol=0.15)
    np.testing.assert_allclose(np.corrcoef(columns), np.eye(6), atol=0.1)
    wide = draw(replace(model, covariance=25 * model.covariance), 1000, seed=2)
    j = moments(wide)
    assert (j[:, 0] > 0).all() and (j[:, 2] <= j[:, 0] + j[:, 1]).all()


def test_a_narrow_posterior_comes_back() -> None:
    model = uncertain((0.03, 0.03, 0.03, 0.02, 0.04, 0.05))
    draws = draw(model, 20_000, seed=2)
    columns = np.array([draws.column(n) for n in NAMES])
    np.testing.assert_allclose(columns.mean(axis=1), [model.values[n] for n in NAMES], rtol=5e-3)
    expected = np.sqrt(np.diag(model.covariance))
    np.testing.assert_allclose(columns.std(axis=1), expected, rtol=0.03)
    np.testing.assert_allclose(np.corrcoef(columns)[0, 1:], 0.6, atol=0.03)
    assert draws.column("mass").std() == pytest.approx(0.02, rel=0.03)
    assert np.ptp(draws.column("torque.c2")) == 0.0, "held"
    assert set(draws.drawn) == {*NAMES, "mass"}


def test_a_flat_craft_is_drawn_as_its_posterior_among_bodies() -> None:
    """The truth by rejection: normal draws of which those that no body has are thrown away. Thrust,
    which is known far better over the inertia about x than by itself, goes with it."""
    model = uncertain((0.2, 0.2, 0.2, 0.2, 0.1, 0.1), correlation=0.0)
    flat = {"inertia.xx": 0.01, "inertia.yy": 0.0105, "inertia.zz": 0.0195}
    values = model.values.replace(flat)
    sigma = 0.2 * np.array([values[n] for n in NAMES])
    correlation = np.eye(len(NAMES))
    thrust = NAMES.index("thrust.c2")
    correlation[0, thrust] = correlation[thrust, 0] = 0.95
    model = replace(model, values=values, covariance=correlation * np.outer(sigma, sigma))
    draws = draw(model, 4000, seed=3)
    j = moments(draws)
    assert (j[:, 2] < j[:, 0] + j[:, 1]).all()
    centre = np.array([values[n] for n in NAMES])
    every = np.random.default_rng(0).multivariate_normal(centre, model.covariance, 100_000)
    x, y, z = every[:, :3].T
    kept = every[(x + y > z) & (y + z > x) & (z + x > y)]
    assert 0.2 < len(kept) / len(every) < 0.8
    columns = np.array([draws.column(n) for n in NAMES]).T
    np.testing.assert_array_less(np.abs(columns.mean(axis=0) - kept.mean(axis=0)), 0.07 * sigma)
    np.testing.assert_allclose(columns.std(axis=0), kept.std(axis=0), rtol=0.1)
    ours, truth = (v[:, thrust] / v[:, 0] for v in (columns, kept))
    assert np.median(ours) == pytest.approx(float(np.median(truth)), rel=0.03)
    zz, *_ = (line for line in draws.summary().splitlines() if "inertia.zz" in line)
    assert "sigma below the identified 0.0195: cut to what can be" in zz
    assert "identified" not in draw(uncertain((0.03,) * 6), 4000, seed=3).summary(), (
        "no body was cut"
    )


def test_a_moment_of_its_own_in_every_flight_is_drawn_as_a_bodys_too() -> None:
    model = uncertain((0.03,) * 6)
    zz = model.values["inertia.zz"]
    spread = {"mass": (1.0, 0.02), "inertia.zz": (zz, 0.6 * zz)}
    kept = [n for n in NAMES if n != "inertia.zz"]
    at = [NAMES.index(n) for n in kept]
    model = replace(
        model,
        covariance_names=tuple(kept),
        covariance=model.covariance[np.ix_(at, at)],
        flight_spread=spread,
    )
    draws = draw(model, 500, seed=1)
    j = moments(draws)
    assert (j[:, 0] > 0).all()
    assert (j[:, 2] <= j[:, 0] + j[:, 1]).all()
    assert draws.column("inertia.zz").std() > 0.2 * zz
    assert draws.column("mass").std() == pytest.approx(0.02, rel=0.15)
    alone = draw(replace(model, covariance_names=(), covariance=np.zeros((0, 0))), 500, seed=1)
    j = moments(alone)
    assert (j[:, 0] > 0).all() and (j[:, 2] <= j[:, 0] + j[:, 1]).all()


@pytest.mark.parametrize("scale", [0.01, 0.1 / 3, 1.7e-5 / 7])
def test_a_flat_craft_whose_inertia_is_held_is_drawn(scale: float) -> None:
    model = uncertain((0.1,) * 6)
    flat = {"inertia.xx": scale, "inertia.yy": scale, "inertia.zz": 2 * scale}
    at = [NAMES.index(n) for n in NAMES[3:]]
    model = replace(
        model,
        values=model.values.replace(flat),
        covariance_names=NAMES[3:],
        covariance=model.covariance[np.ix_(at, at)],
    )
    draws = draw(model, 50, seed=1)
    assert np.ptp(draws.column("inertia.zz")) == 0.0
    assert draws.column("thrust.c2").std() > 0


def test_a_seed_repeats_and_the_files_hold_the_draws() -> None:
    model = uncertain((0.1,) * 6)
    one, two = draw(model, 50, seed=7), draw(model, 50, seed=7)
    np.testing.assert_array_equal(one.values, two.values)
    assert not np.array_equal(one.values, draw(model, 50, seed=8).values)
    files = one.files()
    found = np.load(io.BytesIO(bytes(files["draws/draws.npz"])))  # type: ignore[arg-type]
    np.testing.assert_array_equal(found["values"], one.values)
    cf = np.load(io.BytesIO(bytes(files["draws/crazyflow.npz"])))  # type: ignore[arg-type]
    np.testing.assert_allclose(cf["J"] @ cf["J_inv"], np.tile(np.eye(3), (50, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(1.0 / cf["rotor_dyn_coef"][:, 0], one.column("motor_lag.tau"))
    ranges = tomllib.loads(str(files["draws/ranges.toml"]))
    low, high = ranges["thrust.c2"]["low"], ranges["thrust.c2"]["high"]
    inside = (one.column("thrust.c2") >= low) & (one.column("thrust.c2") <= high)
    assert 0.92 <= inside.mean() <= 0.97


def test_no_draws_are_refused() -> None:
    with pytest.raises(DataError, match="number of draws"):
        draw(uncertain((0.1,) * 6), 0)


def test_drawn_fields_are_those_of_the_written_mujoco_models() -> None:
    mujoco = pytest.importorskip("mujoco")
    model = uncertain((0.1,) * 6)
    products = {"products_of_inertia.Jxy": 5e-4, "center_of_mass_offset.c_x": 0.01}
    whole = identified({**{n: model.values[n] for n in NAMES}, **products})
    model = replace(model, dynamics=whole.dynamics, values=whole.values)
    draws = draw(model, 3, seed=4)
    fields = np.load(io.BytesIO(bytes(draws.files()["draws/mjx.npz"])))  # type: ignore[arg-type]
    for i in range(len(draws)):
        text = target_by_name("mujoco").files(draws.one(i))["model.xml"]
        plant = mujoco.MjModel.from_xml_string(text)
        for name in fields.files:
            if name not in ("body_inertia", "body_iquat"):
                np.testing.assert_allclose(fields[name][i], getattr(plant, name), err_msg=name)
        tensors = [
            turned(quat, moments)
            for quat, moments in (
                (fields["body_iquat"][i, 1], fields["body_inertia"][i, 1]),
                (plant.body_iquat[1], plant.body_inertia[1]),
            )
        ]
        np.testing.assert_allclose(tensors[0], draws.one(i).inertia, atol=1e-12)
        np.testing.assert_allclose(tensors[1], draws.one(i).inertia, atol=1e-9)


def test_isaac_gets_inertia_in_body_axes() -> None:
    draws = draw(uncertain((0.1,) * 6), 3, seed=4)
    fields = np.load(io.BytesIO(bytes(draws.files()["draws/isaac.npz"])))  # type: ignore[arg-type]
    for i in range(len(draws)):
        craft = draws.one(i)
        np.testing.assert_array_equal(fields["inertias"][i].reshape(3, 3), craft.inertia)
        weight = fields["rotor_constant"][i].sum() * (craft.speed_max * craft.hover_nu) ** 2
        assert weight == pytest.approx(craft.mass * craft.gravity)


def asymmetric() -> Draws:
    """A craft of uneven rotors, known within bounds, with drag."""
    deltas = {"rotor_asymmetry.delta_1": 0.06, "rotor_asymmetry.delta_2": -0.02}
    names = (*deltas, "rotor_asymmetry.delta_3")
    model = identified({"motor_lag.tau": 0.05, "rotor_drag.k_x": 2e-5, "thrust.c1": 0.8, **deltas})
    return draw(
        replace(model, covariance_names=names, covariance=0.01**2 * np.eye(3)),
        4,
        seed=2,
    )


def test_uneven_rotors_push_as_their_craft_do_in_isaac_and_mjx(tmp_path: Path) -> None:
    draws = asymmetric()
    made = draws.files()
    isaac, mjx = (
        np.load(io.BytesIO(bytes(made[f"draws/{n}.npz"])))  # type: ignore[arg-type]
        for n in ("isaac", "mjx")
    )
    (tmp_path / "commands.py").write_text(command_text(draws.craft))
    (commands,) = load(tmp_path, "commands")
    for i in range(len(draws)):
        craft = draws.one(i)
        nu = craft.hover_nu
        c0, c1, c2 = craft.thrust
        q0, q1, q2 = craft.torque
        thrust = craft.strength * (c0 + nu * (c1 + nu * c2))
        torque = craft.strength * (q0 + nu * (q1 + nu * q2))
        rotors = commands.Rotors(nu)
        omega = commands.SPEED_MAX * rotors.speeds(np.full(4, nu), 0.01)
        np.testing.assert_allclose(isaac["rotor_constant"][i] * omega**2, thrust)
        np.testing.assert_allclose(isaac["rolling_moment_coefficient"][i] * omega**2, torque)
        for here in (nu, nu + 1e-3):
            slope, offset = (mjx[f"actuator_{k}prm"][i, :, 0] for k in ("gain", "bias"))
            full = craft.strength * (c0 + here * (c1 + here * c2))
            np.testing.assert_allclose(offset + slope * here, full, rtol=1e-5)
        assert (mjx["actuator_forcerange"][i, :, 1] >= thrust).all()


def test_what_arrays_of_simulators_lack_is_said() -> None:
    draws = asymmetric()
    assert "draws/crazyflow.npz" not in draws.files()
    lost, missing = draws.notes
    assert "mjx.npz is without rotor_drag:" in lost
    assert "no draws/crazyflow.npz" in missing and "rotor_asymmetry" in missing
    even = draw(identified({"motor_lag.tau": 0.05}), 2)
    assert even.notes == ()
    assert "draws/crazyflow.npz" in even.files()


def turned(quat: Array, moments: Array) -> Array:
    turn = rotation(np.asarray(quat))
    return turn @ np.diag(moments) @ turn.T
