"""The band of drawn craft holds a flight that the model describes, not one of another craft; a box
of 30 % is far wider."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

import greybox.simulators.coverage as coverage_module
from greybox.data import Dataset
from greybox.errors import DataError
from greybox.model.identified import IdentifiedModel
from greybox.model.model import build_model
from greybox.model.noise import with_disturbance
from greybox.model.parameter import ParameterValues
from greybox.simulators.coverage import Covered, coverage, format_table, share_error
from greybox.simulators.craft import Craft
from greybox.simulators.draws import Draws, draw
from greybox.simulators.make import twin
from greybox.simulators.push_levels import with_push_levels
from greybox.symbolic import FloatArray
from tests import simulated

NAMES = ("thrust.c2", "inertia.xx", "inertia.yy", "inertia.zz")


@functools.cache
def model(off: float = 1.0) -> IdentifiedModel:
    """The simulated craft as it is, thrust `off`, known within a percent."""
    data = simulated.flights(1, 10.0)
    physics = build_model(
        simulated.vehicle(),
        data.channels,
        ("motor_lag", "rotor_drag", "gyro_bias"),
        sample_time=0.01,
    )
    settled = {d.name: d.null if d.null is not None else d.nominal for d in physics.parameters}
    true = {k: v for k, v in simulated.truth().items() if k in settled}
    own = {
        "thrust.c2": off * true["thrust.c2"],
        "inertia.zz": 0.97 * true["inertia.zz"],
    }  # no body has the plant's own
    values = ParameterValues({**settled, **true, **own})
    sigma = 0.01 * np.array([values[n] for n in NAMES])
    return IdentifiedModel(
        dynamics=physics,
        values=values,
        covariance_names=NAMES,
        covariance=np.diag(sigma**2),
        process_noise=physics.noise_scale(0.01),
        sensor_noise=physics.sensor_scale(),
        weak=np.full(len(physics.error_states), 1e3),
        reference_state=physics.reference({}),
        reference_inputs=np.full(len(physics.inputs), 0.7),
        sample_time=0.01,
    )


def rows(m: IdentifiedModel) -> dict[tuple[str, float, bool], Covered]:
    found = coverage(m, draw(m, 100, seed=1), simulated.flights(1, 10.0), seed=1)
    assert "needed" in format_table(found)
    return {(r.group, r.seconds, r.adapted): r for r in found}


@pytest.mark.slow
def test_the_right_craft_is_held_and_a_wrong_one_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(coverage_module, "SPACING", 0.5)
    right, wrong = rows(model()), rows(model(off=1.1))
    for group in ("position", "velocity"):
        ours, theirs = right[group, 0.5, False], wrong[group, 0.5, False]
        assert ours.share > 0.5 > theirs.share  # the plant has gusts that this model does not know
        assert ours.needed < 0.5 * theirs.needed
        assert ours.box_width > 3.0 * ours.width
        assert ours.share_error is None and list(ours.by_flight.values()) == [ours.share]


def test_the_error_of_a_share_counts_flights_and_not_instants() -> None:
    """Twice the instants of the same flights tell nothing new; flights that agree leave no error;
    one has none."""
    flights = [np.array([1.0, 1.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0]), np.array([1.0, 1.0])]
    error = share_error(flights)
    assert share_error([np.tile(f, 2) for f in flights]) == pytest.approx(error)
    assert share_error([np.array([1.0, 0.0])] * 3) == 0.0
    assert share_error(flights[:1]) is None
    even = [np.array([v]) for v in (1.0, 1.0, 1.0, 0.0)]  # one value a flight: that of a mean
    assert share_error(even) == pytest.approx(np.std([1, 1, 1, 0], ddof=1) / 2.0)


@pytest.mark.slow
def test_pushes_counted_on_flights_hold_another_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Filter's levels five times too small, as where one step ahead says little of half a second;
    the plant has gusts."""
    monkeypatch.setattr(coverage_module, "SPACING", 0.5)
    m = replace(model(), process_noise=0.2 * model().process_noise)
    few = draw(m, 60, seed=1)
    counted = with_push_levels(m, few, simulated.flights(4, 9.0, first_seed=60), seed=1)
    assert (
        counted.levels.shape == few.levels.shape
        and "pushes, counted on 4 flights" in counted.summary()
    )
    assert np.ptp(few.levels, axis=0).max() == 0.0
    unseen = simulated.flights(1, 10.0)
    before, after = (
        {(r.group, r.seconds): r for r in coverage(m, d, unseen, seed=1)} for d in (few, counted)
    )
    shares = [
        [r[g, h].share for g in ("velocity", "rate") for h in (0.5, 1.0)] for r in (before, after)
    ]
    assert np.mean(shares[1]) > np.mean(shares[0]) + 0.1
    assert np.mean(shares[1]) > 0.85


def factors(m: IdentifiedModel, flights: Dataset, seed: int) -> FloatArray:
    """Median level of every noise over that of the filter."""
    counted = with_push_levels(m, few_draws(), flights, seed=seed)
    return np.asarray(np.median(counted.levels, axis=0) / m.process_noise)


@functools.cache
def few_draws() -> Draws:
    return draw(model(), 24, seed=1)


@pytest.mark.slow
def test_push_levels_follow_the_flights_and_not_the_seed() -> None:
    """Pushes of force at the filter's level move this craft by a thousandth of its error: nothing
    tells of them."""
    m, flights = model(), simulated.flights(2, 9.0, first_seed=60)
    one, two = (factors(m, flights, seed) for seed in (1, 2))
    names = m.dynamics.noises.names
    for i in (names.index("torque.x"), names.index("torque.y")):
        assert one[i] > 2.0
        assert two[i] == pytest.approx(one[i], rel=0.3)
    for found in (one, two):
        assert found[names.index("force.x")] == pytest.approx(1.0, abs=0.4)
        assert found[names.index("force.z")] == pytest.approx(1.0, abs=0.4)


@pytest.mark.slow
@pytest.mark.parametrize("place", [0, 1])
def test_a_flight_without_velocity_counts_by_its_other_sensors(place: int) -> None:
    flights = list(simulated.flights(3, 7.0, first_seed=60))
    blind = {"vx", "vy", "vz"}
    flights[place] = replace(
        flights[place],
        segments=tuple(
            replace(s, channels={k: v for k, v in s.channels.items() if k not in blind})
            for s in flights[place].segments
        ),
    )
    found = with_push_levels(model(), few_draws(), Dataset(flights=tuple(flights)), seed=1)
    assert "counted on 3 flights" in found.pushes


@pytest.mark.slow
def test_every_file_has_the_level_of_pushes_ahead() -> None:
    """A model with calibrated levels: words, simulate.py and draws say these, not those of one step
    ahead."""
    m = model()
    whole = with_disturbance(m.dynamics, ["force"], time=0.5)
    values = ParameterValues({d.name: d.nominal for d in whole.parameters}).replace(dict(m.values))
    m = replace(
        m,
        dynamics=whole,
        values=values,
        process_noise=whole.noise_scale(0.01),
        weak=np.full(len(whole.error_states), 1e3),
        reference_state=whole.reference({}),
    )
    calibrated = replace(m, horizon_noise=3.0 * m.process_noise)
    said = [
        Craft.of(one).pushes
        for one in (m, replace(m, process_noise=3.0 * m.process_noise), calibrated)
    ]
    # What a prediction has to allow for is more than what pushes a craft about.
    assert "unexplained force" in said[0] and said[1] != said[0] == said[2]
    draws = draw(calibrated, 20, seed=1)
    np.testing.assert_array_equal(draws.levels[0], m.process_noise)
    np.testing.assert_array_equal(
        coverage_module.module_of(calibrated, draws)["NOISE"], m.process_noise
    )


@pytest.mark.slow
def test_pushes_that_are_counted_on_flights_of_no_fit_are_said() -> None:
    flights = simulated.flights(1, 7.0, first_seed=60)
    (name,) = flights.names
    for trained_on, said in (((name,), False), ((), False), (("morning",), True)):
        notes = twin(
            replace(model(), trained_on=trained_on), ["numpy"], draws=20, train=flights
        ).notes
        assert (
            f"pushes are counted on {name}, but the model says that it was fitted to morning"
            in str(notes)
        ) is said


def test_too_short_flights_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(coverage_module, "START", 9.5)
    m = model()
    with pytest.raises(DataError, match="long enough"):
        coverage(m, draw(m, 20), simulated.flights(1, 10.0))


def test_too_few_draws_are_refused_and_not_divided_by() -> None:
    m = model()
    for few in (1, 19):
        with pytest.raises(
            DataError, match=f"too few draws for bands; expected 20 or more; got {few}"
        ):
            coverage(m, draw(m, few), simulated.flights(1, 10.0))
