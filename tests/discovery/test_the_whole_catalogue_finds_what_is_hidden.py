"""discover with the whole catalogue on simulated flights, in a file of its own: others shorten the
catalogue for all of theirs."""

from __future__ import annotations

import pytest

from greybox.discovery.workflow import discover
from scenarios.studies.discovery_cells import Cell, flown, nominal
from scenarios.studies.discovery_grid import judge


@pytest.mark.slow
@pytest.mark.parametrize(
    "hidden",
    [
        (),
        ("motor_lag",),
        ("rotor_drag",),
        ("linear_drag",),
        ("accelerometer_bias",),
        ("steady_wind", "rotor_drag"),
        ("motor_lag", "command_delay"),
        ("motor_lag", "battery_sag", "rotor_drag", "blade_flapping", "rotational_damping"),
    ],
    ids="+".join,
)
@pytest.mark.parametrize("noise", ["white", "gusts"])
def test_the_whole_catalogue_on_flights_of_the_grid(hidden: tuple[str, ...], noise: str):
    ((_, plant, _, train, test),) = list(flown(Cell(hidden=hidden, noise=noise), [41]))
    found = discover(nominal(plant, "off", 41), train, test)
    # Biases are in every model, and no names. Gusts are there and have none.
    names = [n for n in hidden if n not in found.base]
    nameless = ("silent",) if noise == "gusts" and not names else ()
    assert judge(found, names) in ("right", "group", *nameless)
