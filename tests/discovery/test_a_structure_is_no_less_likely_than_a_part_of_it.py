"""Claim: wherever the fit of a structure starts, it ends no less likely than a fit of a part of it
on the same flights: what the part says is one of its own points."""

from __future__ import annotations

from tests.discovery.small_world import damped

VANISHED = -15.0
"""Logarithm of a noise level next to nothing."""

FAR = {"x": 0.05, "y": -0.05}
"""Offsets [m] that no flight agrees with."""


def test_a_start_where_noise_has_vanished_costs_no_evidence() -> None:
    """As of a structure that explained everything, one cause of which is taken away."""
    flights = damped()
    base = flights.fit(flights.causes.base)
    start = {
        key: VANISHED if key[0].startswith("noise.process") else value
        for key, value in base.known.items()
    }
    start |= {(f"center_of_mass_offset.c_{axis}", None): off for axis, off in FAR.items()}
    more = flights.fit(flights.causes.base | {"center_of_mass_offset"}, [start])
    assert more.value.likelihood < base.value.likelihood + flights.effort.rough
    assert more.log_evidence > base.log_evidence - 30.0
