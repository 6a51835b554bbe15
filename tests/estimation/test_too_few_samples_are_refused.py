"""A fit of fewer samples than unknowns is refused, and the errors of few are doubted."""

from __future__ import annotations

import pytest

from greybox import build_model, fit
from greybox.data import Dataset, dataset_from_arrays
from greybox.errors import DataError
from greybox.estimation.engine import unfelt_place
from tests.simulated import flights, vehicle

EFFECTS = ("motor_lag", "command_delay", "rotor_drag", "rotational_damping")


def cut(rows: int) -> Dataset:
    """The first rows of a simulated flight."""
    one = flights().flights[0].segments[0]
    return dataset_from_arrays(one.t[:rows], {k: v[:rows] for k, v in one.channels.items()}, name="cut")


@pytest.mark.parametrize("rows", [2, 20])
def test_fewer_samples_than_unknowns_are_refused(rows: int) -> None:
    data = cut(rows)
    with pytest.raises(DataError, match="fewer than the"):
        fit(build_model(vehicle(), data.channels, EFFECTS), data)


@pytest.mark.parametrize(("rows", "short"), [(100, True), (500, False)])
def test_a_short_flight_says_that_its_errors_are_too_small(rows: int, short: bool) -> None:
    data = cut(rows)
    found = fit(build_model(vehicle(), data.channels, ("motor_lag",)), data)
    assert any("standard errors are too small" in w and "--hold-noise" in w for w in found.warnings) is short


def test_the_place_is_felt_only_where_something_depends_on_it() -> None:
    channels = flights().channels
    assert unfelt_place(build_model(vehicle(), channels, ("rotor_drag",))) == {"x", "y", "z"}
    assert unfelt_place(build_model(vehicle(), channels, ("ground_effect",))) == {"x", "y"}
