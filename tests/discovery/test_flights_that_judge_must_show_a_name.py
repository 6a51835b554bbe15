"""Claim: how clear a name can be to the flights that judge grows with how much of it they show."""

from __future__ import annotations

from greybox.discovery.certificate import _more_told, splits
from tests.discovery.small_world import DAMPING, damped, flown


def test_a_longer_flight_tells_more_of_a_name_as_a_share_of_what_was_known() -> None:
    """Two flights of four seconds taught; flights differ by how much they turn."""
    flights = damped()
    at = flights.fit(flights.causes.base | {"rotational_damping"})
    told = [
        _more_told(
            at,
            "rotational_damping",
            splits(flights, flown(DAMPING, seeds=(3,), name="test", seconds=s)),
        )
        for s in (2.0, 4.0, 8.0)
    ]
    assert 0.1 < told[0] < told[1] < told[2] < 3.0
