"""A held parameter with a stated error widens the errors of others: as in the joint posterior where
a ratio shows."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from greybox.data import Dataset, dataset_from_arrays
from greybox.errors import ModelError
from greybox.estimation.considered import by_flights_alone
from greybox.estimation.fit import fit
from greybox.estimation.other_scales import on_other_scales
from greybox.estimation.result import Fit
from greybox.files import FileFormatError
from greybox.model.dynamics import StateSpaceModel
from greybox.model.identified import IdentifiedModel
from greybox.model.parameter import Parameter
from greybox.symbolic import Layout, Signal

MASS, SIGMA = 2.0, 0.02
"""The cart's mass and its stated error [kg]."""


def cart(sigma: float = SIGMA, drag: float | None = None) -> StateSpaceModel:
    """A damped cart of a weighed mass, pushed by gain times voltage: its speed shows gain over mass
    alone, unless the `drag` [N s/m] that brakes it is known."""
    speed = Signal(name="speed", unit="m/s")
    return StateSpaceModel(
        name="cart",
        states=Layout([speed]),
        inputs=Layout([Signal(name="u", unit="V")]),
        outputs=Layout([speed]),
        parameters=(
            Parameter(name="gain", unit="N/V", nominal=3.0, lower=0.01, upper=100.0, scale=3.0),
            Parameter(
                name="mass", unit="kg", nominal=MASS, sigma=sigma, lower=0.1, upper=10.0, scale=2.0
            ),
        ),
        dynamics=lambda t, x, u, p: [
            -(1.0 if drag is None else drag / p["mass"]) * x[0] + p["gain"] / p["mass"] * u
        ],
        measurement=lambda t, x, u, p: [x[0]],
        noise_states=("speed",),
        initial_sigma={"speed": 0.1},
        sensor_sigma={"speed": 0.02},
    )


@cache
def record(name: str = "run") -> Dataset:
    draw, t = np.random.default_rng(0), 0.02 * np.arange(800)
    u = np.repeat(draw.uniform(-1, 1, 40), 20)
    x = np.zeros(800)
    for k in range(799):
        x[k + 1] = np.exp(-0.02) * x[k] + (1 - np.exp(-0.02)) * 1.5 * u[k]
    return dataset_from_arrays(t, {"u": u, "speed": x + 0.02 * draw.normal(size=800)}, name=name)


CHOICES = {"predictor": "simulation", "use_compiler": False}


@cache
def found_with(*held: str) -> Fit:
    """The cart with a stated error of its mass: "fixed", "considered" or, without, free."""
    return fit(cart(), record(), **{key: ["mass"] for key in held}, **CHOICES)


@pytest.fixture(scope="module")
def stds() -> dict[str, float]:
    """Standard error of the gain, with the mass held, considered, free within its prior."""
    held, considered = found_with("fixed"), found_with("fixed", "considered")
    joint = found_with()
    assert held["gain"].value == considered["gain"].value
    return {
        "held": held["gain"].std,
        "considered": considered["gain"].std,
        "joint": joint["gain"].std,
    }


def test_the_error_is_that_of_the_joint_posterior(stds):
    assert stds["considered"] == pytest.approx(stds["joint"], rel=2e-3)


def test_it_is_the_error_of_the_ratio_and_that_of_the_mass(stds):
    assert stds["considered"] == pytest.approx(np.hypot(stds["held"], 3.0 * SIGMA / MASS), rel=1e-2)
    assert stds["held"] < 0.3 * stds["considered"]


@pytest.mark.parametrize(
    ("sigma", "choices", "why"),
    [(SIGMA, {}, "not held"), (np.inf, {"fixed": ["mass"]}, "no stated error")],
)
def test_what_cannot_be_considered_is_said_before_the_fit(sigma, choices, why):
    with pytest.raises(ModelError, match=f"mass is considered but .*{why}"):
        fit(cart(sigma), record(), considered=["mass"], **choices, **CHOICES)


def test_a_parameter_whose_ratio_alone_shows_is_never_told():
    found = found_with("fixed", "considered")
    assert not found.estimates.told
    assert not any("mass is held" in w for w in found.warnings)


def test_one_that_the_record_knows_better_than_the_scale_is_told_to_what_a_free_fit_gives():
    choices = {"fixed": ["mass"], "considered": ["mass"], **CHOICES}
    found = fit(cart(sigma=0.4, drag=2.0), record(), **choices)
    alone = fit(cart(sigma=1e6, drag=2.0), record(), **CHOICES)["mass"].std
    assert found.estimates.told["mass"] == (pytest.approx(alone, rel=2e-2), 0.4)
    assert any("mass is held, but these flights tell it" in w for w in found.warnings)
    assert not fit(cart(sigma=0.2 * alone, drag=2.0), record(), **choices).estimates.told


def test_rounding_of_an_ill_conditioned_ratio_tells_nothing():
    draw = np.random.default_rng(1)
    for apart in (3e-5, 1e-4, 3e-4):
        for _ in range(40):
            free = draw.normal(size=(4000, 6)) * 1e4
            free[:, 1] = free[:, 0] + apart * free[:, 1]
            held = free @ draw.normal(size=6)  # an exact combination: nothing is told of it
            columns = np.column_stack([free, held])
            found = by_flights_alone(
                columns.T @ columns, np.arange(6), np.array([6]), np.array([0.03])
            )
            assert found[0] > 0.03


def test_unknowns_that_are_hard_to_tell_apart_hide_nothing_of_what_is_told():
    """Their condition number is not the rounding of what is left of a held parameter: one that
    stands clear of that is told, whether or not its neighbours are."""
    draw = np.random.default_rng(2)
    for apart in (1e-5, 1e-4, 1e-3):
        free = draw.normal(size=(4000, 6))
        free[:, 1] = free[:, 0] + apart * free[:, 1]
        own = 1e-4 * draw.normal(size=4000)
        columns = np.column_stack([free, free @ draw.normal(size=6) + own])
        (found,) = by_flights_alone(
            columns.T @ columns, np.arange(6), np.array([6]), np.array([np.inf])
        )
        assert found == pytest.approx(np.sum(own**2) ** -0.5, rel=0.05)


def test_one_anchor_of_a_common_factor_is_told_by_the_other_one():
    """Record and scale tell two numbers as a ratio and, badly, a third one's: what is stated to
    30 % is told by what is stated to 0.2 %, not the other way round."""
    draw = np.random.default_rng(3)
    ratio, nuisance = 1e3 * draw.normal(size=(2, 4000))
    near = nuisance + 3e-5 * draw.normal(size=4000)
    columns = np.column_stack([nuisance, near, ratio + nuisance, -ratio + near])
    errors = by_flights_alone(
        columns.T @ columns, np.arange(2), np.array([2, 3]), np.array([2e-3, 0.3])
    )
    assert errors[1] == pytest.approx(2e-3, rel=0.01) and errors[0] > 2e-3


def test_the_model_keeps_how_well_the_ratio_is_known_and_its_file_too(tmp_path):
    found = found_with("fixed", "considered")
    joint = found_with().model
    for model in (found.model, IdentifiedModel.load(found.model.save(tmp_path / "model.json"))):
        names, c = model.joint_covariance
        at = [names.index("gain"), names.index("mass")]
        slope = np.array([1 / MASS, -found["gain"].value / MASS**2])
        ratio = np.sqrt(slope @ c[np.ix_(at, at)] @ slope)
        free = [joint.covariance_names.index(n) for n in ("gain", "mass")]
        assert ratio == pytest.approx(
            np.sqrt(slope @ joint.covariance[np.ix_(free, free)] @ slope), rel=2e-2
        )
        assert np.sqrt(c[at[1], at[1]]) == pytest.approx(SIGMA)
        assert np.linalg.eigvalsh(c).min() > 0


def test_a_gain_of_every_flight_moves_with_the_mass_that_all_share(tmp_path):
    data = Dataset(flights=(*record().flights, *record("again").flights))
    found = fit(cart(), data, fixed=["mass"], considered=["mass"], per_flight=["gain"], **CHOICES)
    for model in (found.model, IdentifiedModel.load(found.model.save(tmp_path / "model.json"))):
        sigma, moves = model.considered["mass"]
        assert sigma == SIGMA
        assert moves["gain"] == pytest.approx(found["gain"].value / MASS, rel=1e-2)


@pytest.mark.parametrize(
    ("held", "why"),
    [
        ((-0.02, {"gain": 1.5}), "the error of mass, which was held, is negative: -0.02"),
        ((0.02, {"nonsense": 3.0}), "mass moves nonsense, which was not estimated"),
    ],
)
def test_a_file_whose_held_errors_mean_nothing_is_refused(tmp_path, held, why):
    found = found_with("fixed", "considered").model
    path = replace(found, considered={"mass": held}).save(tmp_path / "model.json")
    with pytest.raises(FileFormatError, match=why):
        IdentifiedModel.load(path)


def test_what_flights_tell_of_a_held_parameter_counts_blocks_where_these_scatter_more():
    """Of two parameters the second is held. White scores scatter as the Hessian says; where four
    neighbours say the same, an error is twice as large."""
    rng = np.random.default_rng(0)
    hessian = np.array([[2.0, 0.6], [0.6, 1.0]])
    root = np.linalg.cholesky(hessian / 4000)
    white = rng.normal(size=(4000, 2)) @ root.T
    places = np.array([0]), np.array([1])
    sigma = np.array([np.inf])
    exact = by_flights_alone(hessian, *places, sigma)
    assert exact[0] == pytest.approx((1.0 - 0.6**2 / 2.0) ** -0.5)
    assert by_flights_alone(hessian, *places, sigma, white)[0] == pytest.approx(exact[0], rel=0.05)
    coloured = 4 * white[::4]
    assert by_flights_alone(hessian, *places, sigma, coloured)[0] == pytest.approx(
        2 * exact[0], rel=0.1
    )
    assert np.isinf(by_flights_alone(hessian, *places, sigma, white[:7])).all()


def test_what_no_flight_tells_adds_the_same_to_a_fit_that_did_not_ask():
    """A fit that holds the mass as exact, and learns afterwards that nobody knows the unit."""
    asked = fit(cart(), record(), fixed=["mass"], considered=["mass"], **CHOICES)
    exact = fit(cart(), record(), fixed=["mass"], **CHOICES)
    assert exact.parameters["gain"].std < 0.5 * asked.parameters["gain"].std
    found = on_other_scales(exact, [{"mass": SIGMA}])
    assert found.parameters["gain"].std == pytest.approx(asked.parameters["gain"].std, rel=1e-3)
    assert found.model.covariance == pytest.approx(asked.model.covariance, rel=2e-3)
    for (sigma, moves), (own, by) in zip(
        found.model.considered.values(), asked.model.considered.values(), strict=True
    ):
        assert sigma == pytest.approx(own)
        assert moves["gain"] == pytest.approx(by["gain"], rel=1e-3)
    assert on_other_scales(exact, ()) is exact


def test_how_shared_numbers_vary_with_means_of_flights_is_kept(tmp_path):
    data = Dataset(flights=tuple(f for n in "ab" for f in record(n).flights))
    found = fit(cart(), data, fixed=["mass"], per_flight=["gain"], **CHOICES)
    (variance,) = found.model.flight_covariance.ravel()
    assert variance**0.5 <= found.parameters["gain"].std * (1 + 1e-9)
    assert variance == pytest.approx(
        sum(s**2 for _, s in found.parameters["gain"].per_flight.values()) / 4, rel=0.2
    )
    kept = IdentifiedModel.load(found.model.save(tmp_path / "model.json"))
    assert (kept.flight_covariance == found.model.flight_covariance).all()
