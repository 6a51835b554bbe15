"""Whether the data say something about a parameter is judged by its information and its typical
size, not by where its estimate happens to lie."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.estimation.identifiability import unidentified

NAMES = ("mass", "thrust.c2", "accelerometer_bias.b_y")
SCALES = (0.03, 0.6, 0.1)
ERRORS = np.array([3e-6, 1e-5, 4.4e-3])


@pytest.mark.parametrize("bias", [-6e-5, 0.0, 1e-9, -0.05])
def test_an_estimate_next_to_zero_is_not_unseen(bias: float) -> None:
    assert not unidentified(np.diag(ERRORS**-2.0), NAMES, (0.03, 0.6, bias), SCALES)


@pytest.mark.parametrize("bias", [0.3, -6e-5, 0.0])
@pytest.mark.parametrize("information", [0.0, 1e-9])
def test_what_is_truly_unseen_is_named_wherever_its_estimate_lies(
    bias: float, information: float
) -> None:
    matrix = np.diag([*ERRORS[:2] ** -2.0, information])
    found = unidentified(matrix, NAMES, (0.03, 0.6, bias), SCALES)
    assert [c.names for c in found] == [("accelerometer_bias.b_y",)]
    assert "the data say nothing about it" in found[0].text


def test_an_estimate_next_to_zero_takes_no_part_in_what_others_share() -> None:
    """Mass and thrust only as a ratio; the bias has next to nothing of that direction."""
    slope = np.array([[1.0 / 0.03, -1.0 / 0.6, 1e-7], [0.0, 0.0, 200.0]])
    found = unidentified(1e8 * slope.T @ slope, NAMES, (0.03, 0.6, 1e-9), SCALES)
    assert [set(c.names) for c in found] == [{"mass", "thrust.c2"}]
    assert "only as a ratio" in found[0].text


def test_what_is_not_told_from_nothing_shares_no_factor() -> None:
    """Offsets of a sensor in two flights whose sum is not seen: no factor moves either."""
    names = ("accelerometer_bias.b_z (a)", "accelerometer_bias.b_z (b)")
    slope = np.array([[1.0, -1.0]])
    for values in ((0.005, 0.006), (0.005, -0.006)):
        (found,) = unidentified(slope.T @ slope, names, values, (0.1, 0.1))
        assert "not separately: the change" in found.text and "factor" not in found.text
    (found,) = unidentified(1e6 * slope.T @ slope, names, (0.05, 0.05), (0.1, 0.1))
    assert "only as a ratio" in found.text


@pytest.mark.parametrize(("together", "unseen"), [(0.05, False), (2.0, True)])
def test_two_that_nearly_cancel_are_told_where_all_of_them_is_felt(
    together: float, unseen: bool
) -> None:
    """A drag above the centre of mass and a flapping that takes its moment away: each alone would
    turn the craft by far more than is seen, both together move it."""
    names, values = ("rotor_drag.k_x", "blade_flapping.k_flap"), (0.12, -0.006)
    slope = np.array([[1e6 / 0.12, 1e6 / 0.006], [1.0 / (together * 0.12), 0.0]])
    found = unidentified(slope.T @ slope, names, values, (0.1, 0.1))
    assert bool(found) == unseen
