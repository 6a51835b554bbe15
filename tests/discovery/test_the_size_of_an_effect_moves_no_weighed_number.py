"""The prior of an effect's size is an order of magnitude: an effect far beyond it is found at its
size, and what was weighed stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.integrate

from greybox.discovery.cause import offer
from greybox.discovery.evidence import Flights
from greybox.estimation.prior import log_peak, prior_terms, spread_at
from greybox.estimation.unknown import Unknown
from greybox.model.effects import CATALOGUE
from greybox.model.vehicle import Vehicle
from greybox.plants.effects import ParasiticDrag
from tests.discovery.small_world import flown, shorten, vehicle

TIMES = 25.0


def typical(name: str) -> float:
    """Declared typical size of the first number of an effect."""
    effect = next(e for e in CATALOGUE if e.name == name)
    return effect.parameters(vehicle())[0].scale


def weighed() -> Vehicle:
    """The file with a mass that a scale knows to 3 %."""
    mass = vehicle().mass
    return replace(vehicle(), mass=replace(mass, sigma=0.03 * mass.value))


def test_a_drag_many_times_its_typical_size_moves_no_weighed_mass(monkeypatch):
    shorten(monkeypatch)
    true = TIMES * typical("parasitic_drag")
    data = flown(ParasiticDrag(c_x=true, c_y=true, c_z=true))
    causes = offer(weighed(), data.channels, sample_time=0.01)
    flights = Flights(causes=causes, data=data)
    fit = flights.settled(flights.fit(causes.base | {"parasitic_drag"})).parameters
    stated = weighed().mass
    assert abs(fit["mass"].value - stated.value) < 2 * stated.sigma
    for axis in "xyz":
        drag = fit[f"parasitic_drag.c_{axis}"]
        assert abs(drag.value - true) < 3 * drag.std


SHAPES = {
    "normal": {"long_tails": False},
    "size": {"long_tails": True},
    "stated": {"long_tails": True, "normal_core": True},
}


def unknown(shape: str, *, lower: float = -np.inf, upper: float = np.inf) -> Unknown:
    return Unknown(
        name="a",
        kind="parameter",
        flight=None,
        start=0.0,
        lower=lower,
        upper=upper,
        mean=1.0,
        sigma=0.4,
        scale=0.1,
        unit="-",
        **SHAPES[shape],
    )


def cost(u: Unknown, at: float) -> float:
    return prior_terms([u], np.array([at]))[0]


@pytest.mark.parametrize("shape", SHAPES)
def test_a_prior_is_a_density(shape: str):
    for low, high in ((-np.inf, np.inf), (0.0, np.inf), (0.5, 3.0), (1.7, 3.0), (0.0, 0.4)):
        u = unknown(shape, lower=low, upper=high)
        mass, _ = scipy.integrate.quad(lambda t, u=u: np.exp(log_peak(u) - cost(u, t)), low, high)
        assert mass == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("at", [-3.0, 0.9, 1.0, 1.3, 8.0])
def test_its_gradient_is_that_of_the_cost_and_its_curvature_never_negative(at, shape):
    u, step = unknown(shape), 1e-6
    _, slope, curvature = prior_terms([u], np.array([at]))
    ahead, behind = cost(u, at + step), cost(u, at - step)
    assert slope[0] == pytest.approx((ahead - behind) / (2 * step), rel=1e-6, abs=1e-6)
    assert curvature[0] > 0


@pytest.mark.parametrize("shape", ["size", "stated"])
def test_beyond_what_is_typical_it_no_longer_pulls(shape: str):
    pulls = [prior_terms([unknown(shape)], np.array([at]))[1][0] for at in (1.4, 5, 41)]
    assert pulls[0] > pulls[1] > pulls[2] > 0


def test_a_stated_number_is_normal_within_its_sigma():
    normal, stated = unknown("normal"), unknown("stated")
    for at in (0.61, 1.0, 1.39):
        pair = [prior_terms([u], np.array([at])) for u in (normal, stated)]
        assert pair[0] == pair[1]


@pytest.mark.parametrize("shape", ["size", "stated"])
@pytest.mark.parametrize("at", [1.0, 1.4, 3.0, 21.0])
def test_the_normal_prior_in_its_place_believes_as_much(at: float, shape: str):
    u = unknown(shape)
    s = spread_at(u, at)
    normal = -np.log(s * np.sqrt(2 * np.pi)) - 0.5 * ((at - u.mean) / s) ** 2
    assert normal == pytest.approx(log_peak(u) - cost(u, at), abs=0.1)
