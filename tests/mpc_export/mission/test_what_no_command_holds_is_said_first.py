"""Before a vehicle flies, `greybox mpc` says what it cannot hold, and refuses what cannot hover."""

import functools

import numpy as np
import pytest

from greybox.errors import ModelError
from mpc_export.functions import model_functions
from mpc_export.mission.headroom import headroom
from tests.mpc_export import cases


@functools.cache
def functions():
    return model_functions(cases.disturbed(), with_=("target",))


def push(times, axis):
    """(3, 6) one of `times` the weight [N], or the torque of all rotors at full command [N m]."""
    values, out = cases.disturbed().values, np.zeros((3, 6))
    out[:, axis] = times * (9.81 * values["mass"] if axis < 3 else 4.0 * values["torque.c2"])
    return out


def test_a_push_that_leaves_no_lift_loses_the_place_and_a_turn_the_heading_alone():
    calm = headroom(functions(), push(0.0, 0), 0.05, 0.95)
    assert (calm.place_lost, calm.heading_lost, calm.words) == (0.0, 0.0, "")
    heavy = headroom(functions(), push(-2.0, 2), 0.05, 0.95)
    assert (heavy.place_lost, heavy.heading_lost) == (1.0, 1.0)
    turned = headroom(functions(), push(0.45, 5), 0.05, 0.95)
    assert (turned.place_lost, turned.heading_lost) == (0.0, 1.0)
    assert f"hovers at {turned.hover:.2f} of 0.95: under 0 %" in turned.words
    assert "under 100 % none the heading" in turned.words


def test_without_logs_the_identified_pushes_are_drawn_and_the_same_every_time():
    one, two = (headroom(functions(), None, 0.05, 0.74) for _ in range(2))
    assert one == two
    assert 0.0 < one.heading_lost < 1.0


def test_what_cannot_hover_is_refused():
    with pytest.raises(ModelError, match="cannot hover within the commands of the course"):
        headroom(functions(), None, 0.05, 0.6)
