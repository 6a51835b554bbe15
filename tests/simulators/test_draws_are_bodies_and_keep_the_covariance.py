"""Every draw is a body that can be, draws repeat the posterior's means, spreads and correlations,
and what was held stays."""

from __future__ import annotations

import io
import tomllib
from dataclasses import replace

import numpy as np
import pytest

from greybox.errors import DataError
from greybox.model.identified import IdentifiedModel
from greybox.simulators.draws import Draws, draw
from greybox.simulators.targets import target_by_name
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


def test_a_flat_craft_is_not_drawn_wider_than_it_is_known() -> None:
    model = uncertain((0.2, 0.2, 0.2, 0.1, 0.1, 0.1), correlation=0.0)
    flat = {"inertia.xx": 0.01, "inertia.yy": 0.0105, "inertia.zz": 0.0195}
    model = replace(model, values=model.values.replace(flat))
    draws = draw(model, 4000, seed=3)
    j = moments(draws)
    assert (j[:, 2] < j[:, 0] + j[:, 1]).all()
    for name, value in flat.items():
        sigma = np.sqrt(model.covariance[NAMES.index(name), NAMES.index(name)])
        assert draws.column(name).std() < 1.05 * sigma
        assert abs(draws.column(name).mean() - value) < sigma


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


def turned(quat: Array, moments: Array) -> Array:
    turn = rotation(np.asarray(quat))
    return turn @ np.diag(moments) @ turn.T
