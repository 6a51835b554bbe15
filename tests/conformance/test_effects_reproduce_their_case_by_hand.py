"""The numbers that somebody worked out by hand for an effect are what its formula gives."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from specimen import crooked, effects_under_test

from greybox.model.effect import SLOTS, Flow


def matrix(value):
    """Numbers, rows or rows of rows as a CasADi matrix."""
    return ca.DM(np.asarray(value, dtype=float))


def flow_of(effect):
    """The signals of the case; what it does not name is at rest, in still air, on the vehicle's own
    arms."""
    vehicle = crooked()
    given = {k: matrix(v) for k, v in effect.case.flow.items() if k != "measured"}
    at_rest = {k: ca.DM.zeros(3) for k in ("velocity", "omega", "wind")}
    arms = ca.horzcat(*(ca.DM(list(r.position)) for r in vehicle.rotors))
    measured = None
    if "measured" in effect.case.flow:
        measured = {sensor: matrix(effect.case.flow["measured"]) for sensor in effect.case.expected}
    return Flow(vehicle=vehicle, **({"arms": arms} | at_rest | given), measured=measured)


@pytest.mark.parametrize("effect", effects_under_test())
def test_the_formula_gives_the_numbers_worked_by_hand(effect):
    order = [p.name for p in effect.parameters(crooked())]
    slots = effect.apply(
        flow_of(effect), {name: ca.DM(effect.case.parameters[name]) for name in order}
    )
    assert set(slots) == set(effect.case.expected)
    assert set(slots) <= SLOTS[effect.stage]
    for slot, expected in effect.case.expected.items():
        got = np.squeeze(ca.DM(slots[slot]).full())
        expected = np.asarray(expected, dtype=float)
        assert got.shape == expected.shape
        np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-12)
