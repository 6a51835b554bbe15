"""The proposed manoeuvre is one in which the rivals differ, and its length is what the ratio
needs."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from greybox.estimation.fit import Fit, fit
from greybox.model.model import build_model
from greybox.planning.experiment import Separation, separating_manoeuvre, separations
from greybox.planning.manoeuvres import LIBRARY, Manoeuvre, flown, flown_together
from greybox.plants.effects import RotorDrag
from tests.discovery import small_world

SHORT = tuple(m for m in LIBRARY if m.name in ("hover", "forward_and_back"))


@functools.cache
def fitted(name: str) -> Fit:
    """An effect, fitted to flights of linear drag."""
    data = small_world.flown(RotorDrag(k_x=2e-5, k_y=2e-5))
    model = build_model(small_world.vehicle(), data.channels, [name])
    return fit(model, data, initialisation="noise")


def rivals() -> dict[str, Fit]:
    """Linear and quadratic drag."""
    return {name: fitted(name) for name in ("rotor_drag", "parasitic_drag")}


@pytest.mark.slow
def test_speed_separates_drags_and_hover_does_not():
    found = {
        (s.manoeuvre.name, s.amplitude): s.expected
        for s in separations(rivals(), library=SHORT, seconds=4.0)
    }
    assert found["hover", 0.0] < 0.1
    assert found["forward_and_back", 4.0] > found["forward_and_back", 1.5] > 1.0
    best = separating_manoeuvre(rivals(), library=SHORT, seconds=4.0)
    assert best is not None
    assert (best["name"], best["amplitude"]) == ("forward_and_back", 4.0)
    assert best["seconds_to_bic_10"] == pytest.approx(
        4.0 * 5 / best["expected_log_likelihood_ratio"]
    )
    assert [r["name"] for r in best["runners_up"]] == ["hover"]
    assert (
        best["runners_up"][0]["seconds_to_bic_10"] is None
        or best["runners_up"][0]["seconds_to_bic_10"] > 100
    )


@pytest.mark.slow
def test_one_model_in_two_fits_is_not_separated_by_how_a_flight_starts():
    """The truth itself does not foretell the start of its own flight: that separates nothing."""
    fit = fitted("rotor_drag")
    fast = tuple(m for m in LIBRARY if m.name == "climb_at_speed")
    told = separations({"one": fit, "other": fit}, library=fast, seconds=3.0)
    assert told and all(s.expected == 0.0 for s in told)
    best = separating_manoeuvre({"one": fit, "other": fit}, library=fast, seconds=3.0)
    assert best is not None and best["seconds_to_bic_10"] is None


def test_no_flights_are_none():
    assert flown_together(fitted("rotor_drag").model, []) == []


def test_a_flight_follows_its_path_and_its_commands_are_within_limits():
    model = fitted("rotor_drag").model
    log = flown(model, next(m for m in SHORT if m.name == "forward_and_back"), 1.5, seconds=4.0)
    assert log is not None
    channels = log.flights[0].segments[0].channels
    assert channels["x"].max() == pytest.approx(1.5 * 4.0 / (2 * np.pi), rel=0.35)
    for i in range(1, 5):
        assert (channels[f"u{i}"] >= 0).all()
        assert (channels[f"u{i}"] <= 1).all()


def test_what_the_vehicle_cannot_fly_is_left_out():
    wild = Manoeuvre(
        name="wild",
        text="",
        unit="m/s^2",
        amplitudes=(1.0,),
        twist=lambda t, a: (0.0, 0.0, 0.0, 9.0),
    )
    assert flown(rivals()["rotor_drag"].model, wild, 1.0, seconds=2.0) is None
    assert separating_manoeuvre(rivals(), library=(wild,), seconds=2.0) is None


def test_rivals_that_predict_the_same_never_part():
    never = Separation(manoeuvre=SHORT[0], amplitude=0.0, seconds=6.0, expected=0.0)
    assert never.to_dict()["seconds_to_bic_10"] is None
    assert Separation(
        manoeuvre=SHORT[0], amplitude=0.0, seconds=6.0, expected=30.0
    ).seconds_to_clear == pytest.approx(1.0)
