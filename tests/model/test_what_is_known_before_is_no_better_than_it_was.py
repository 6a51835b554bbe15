"""The numbers of an identified model, taken for independent, say no more in any direction than the
model did; and what two flights had says little of a third."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from greybox.model.identified import IdentifiedModel
from greybox.model.known import known_numbers, untold

VALUES = {
    "thrust.c2": 6.0,
    "inertia.xx": 4.5e-3,
    "inertia.yy": 5e-3,
    "torque.c2": 0.11,
    "mass": 0.6,
    "gyro_bias.b_x": 0.01,
    "thrust_level.s": 0.0,
}
USUAL = {"gyro_bias.b_x": 1e-3, "thrust_level.s": 0.01}
NAMES = tuple(VALUES)[:4]
SIZE = np.array([VALUES[n] for n in NAMES]) / 100


class StandIn(SimpleNamespace):
    """A model, as far as its errors go."""

    joint_covariance = IdentifiedModel.joint_covariance


def model_of(covariance: np.ndarray, **changes: object) -> IdentifiedModel:
    """A model, as far as its errors go: those of four numbers, each about a hundredth."""
    nothing: dict[str, Any] = {
        "considered": {},
        "form_errors": {},
        "flight_spread": {},
        "flight_covariance": np.zeros((0, 0)),
        "per_flight": {},
    }
    model = StandIn(
        values=VALUES,
        dynamics=SimpleNamespace(
            parameters=[SimpleNamespace(name=n, scale=s) for n, s in USUAL.items()]
        ),
        covariance_names=NAMES,
        covariance=covariance * np.outer(SIZE, SIZE),
        **(nothing | changes),
    )
    return cast(IdentifiedModel, model)


@given(st.integers(0, 10_000), st.integers(1, 4))
def test_the_diagonal_is_at_least_the_covariance(seed: int, rank: int) -> None:
    part = np.random.default_rng(seed).normal(size=(4, rank))
    covariance = part @ part.T + 1e-3 * np.eye(4)
    known = known_numbers(model_of(covariance))
    diagonal = np.diag([known[n][1] ** 2 for n in NAMES]) / np.outer(SIZE, SIZE)
    assert np.linalg.eigvalsh(diagonal - covariance).min() > -1e-9 * np.trace(covariance)


def test_numbers_without_correlation_keep_their_errors() -> None:
    known = known_numbers(model_of(np.eye(4)))
    for n in NAMES:
        value = VALUES[n]
        assert known[n] == pytest.approx((value, abs(value) / 100))


def test_one_scale_that_five_numbers_share_is_measured_once() -> None:
    """Flights tell ratios: mass, held and known to 1 %, moves the other four by as much."""
    mass = VALUES["mass"]
    moves = {n: VALUES[n] / mass for n in NAMES}
    model = model_of(np.ones((4, 4)), considered={"mass": (mass / 100, moves)})
    known = known_numbers(model)
    names = ("mass", *NAMES)
    told = sum((VALUES[n] / 100 / known[n][1]) ** 2 for n in names)
    assert told == pytest.approx(1.0)  # the precision of the scale, in hundredths


def test_what_a_given_number_tells_of_others_is_taken_over() -> None:
    both = np.ones((4, 4)) + 1e-4 * np.eye(4)
    base = VALUES["thrust.c2"]
    known = known_numbers(model_of(both), given={"thrust.c2": 1.02 * base})
    for n in NAMES[1:]:
        assert known[n][0] == pytest.approx(1.02 * VALUES[n], rel=1e-4)
        assert known[n][1] < 1e-3 * abs(VALUES[n])


@pytest.mark.parametrize(("flights", "factor"), [(1, 1.0), (2, 7.94), (9, 1.24)])
def test_few_flights_say_little_of_the_next_one(flights: int, factor: float) -> None:
    own = {f"run{i}": {"gyro_bias.b_x": 0.01 * i} for i in range(flights)}
    model = model_of(np.eye(4), per_flight=own, flight_spread={"gyro_bias.b_x": (0.01, 0.02)})
    value, error = known_numbers(model)["gyro_bias.b_x"]
    assert value == 0.01
    assert error == pytest.approx(0.02 * factor, rel=0.01)


def of_a_level() -> IdentifiedModel:
    """Thrust of which flights tell only the product with their own level, to a thousandth."""
    own = {f"run{i}": {"thrust_level.s": 0.0} for i in range(9)}
    size = VALUES["thrust.c2"]
    covariance = np.diag([1.0, 1e-2, 1e-2, 1e-2])
    cross = np.zeros((5, 1))
    cross[0, 0], cross[4, 0] = -size * (0.01**2 - 0.001**2), 0.01**2 - 0.001**2
    return model_of(
        covariance,
        per_flight=own,
        flight_spread={"thrust_level.s": (0.0, 1e-4)},
        flight_covariance=cross,
    )


def test_what_only_shows_with_the_level_of_a_flight_is_known_as_that_level_is_given() -> None:
    value, error = known_numbers(of_a_level())["thrust.c2"]
    assert value == VALUES["thrust.c2"]
    assert error == pytest.approx(1e-3 * value, rel=0.01)


def test_what_no_new_flight_tells_is_how_thrust_and_level_move_against_each_other() -> None:
    (together,) = untold(of_a_level(), ())
    assert together["thrust_level.s"] == pytest.approx(-together["thrust.c2"] / 6.0)
    assert abs(together["thrust.c2"]) == pytest.approx(0.01 * 6.0, rel=0.01)


def test_with_the_mass_held_a_ratio_is_as_well_known_as_it_was() -> None:
    """What is untold and what is known together are the model's covariance again."""
    mass = VALUES["mass"]
    moves = {n: VALUES[n] / mass for n in NAMES}
    model = model_of(np.ones((4, 4)) + 1e-4 * np.eye(4), considered={"mass": (mass / 100, moves)})
    known = known_numbers(model, {"mass": mass})
    (together,) = untold(model, ("mass",))
    for n in NAMES:
        assert known[n][1] < 2e-4 * VALUES[n]
        assert np.hypot(known[n][1], together[n]) == pytest.approx(VALUES[n] / 100, rel=1e-3)
    assert abs(together["mass"]) == pytest.approx(mass / 100)


def test_what_hardly_varied_between_flights_may_vary_as_usual_on_another_day() -> None:
    assert known_numbers(of_a_level())["thrust_level.s"] == (0.0, 0.03)
