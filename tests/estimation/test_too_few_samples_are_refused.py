"""A fit of fewer samples than unknowns is refused, and the errors of few are doubted."""

from __future__ import annotations

import pytest

from greybox import build_model, fit
from greybox.data import Dataset, dataset_from_arrays
from greybox.errors import DataError
from greybox.estimation.engine import unfelt_place
from greybox.estimation.fit import noise_of
from scenarios.studies.short_flights import study
from tests.simulated import flights, vehicle

EFFECTS = ("motor_lag", "command_delay", "rotor_drag", "rotational_damping")


def cut(rows: int) -> Dataset:
    """The first rows of a simulated flight."""
    one = flights().flights[0].segments[0]
    return dataset_from_arrays(
        one.t[:rows], {k: v[:rows] for k, v in one.channels.items()}, name="cut"
    )


@pytest.mark.parametrize("rows", [2, 20])
def test_fewer_samples_than_unknowns_are_refused(rows: int) -> None:
    data = cut(rows)
    with pytest.raises(DataError, match="fewer than the"):
        fit(build_model(vehicle(), data.channels, EFFECTS), data)


@pytest.mark.parametrize(("rows", "short"), [(100, True), (500, False)])
def test_a_short_flight_says_that_its_errors_are_too_small(rows: int, short: bool) -> None:
    data = cut(rows)
    found = fit(build_model(vehicle(), data.channels, EFFECTS), data)
    first = "\n".join(found.summary().splitlines()[:3])
    assert ("standard errors are too small" in first and "--hold-noise" in first) is short
    assert found.summary().count("standard errors are too small") == short
    assert (
        "standard errors are too small" in found.warnings[0] if found.warnings else False
    ) is short


def test_levels_that_are_held_are_no_reason_for_doubt() -> None:
    data = cut(100)
    model = build_model(vehicle(), data.channels, EFFECTS)
    found = fit(model, data, noise=noise_of(fit(model, cut(500)).model), estimate_noise=False)
    assert not found.diagnostics.coloured
    assert "standard errors are too small" not in found.summary()


@pytest.mark.slow
def test_intervals_hold_the_truth_or_the_first_lines_say_that_they_do_not() -> None:
    for row in study(24, (1.0, 4.0)):
        assert row.failed == 0
        assert row.said in (0, len(row.shares)), row.format()
        if row.said == 0:
            assert abs(row.coverage - 0.95) <= 0.02 + 2.0 * row.error, row.format()
        else:  # nobody is warned for nothing
            assert row.coverage < 0.93, row.format()


def test_the_place_is_felt_only_where_something_depends_on_it() -> None:
    channels = flights().channels
    assert unfelt_place(build_model(vehicle(), channels, ("rotor_drag",))) == {"x", "y", "z"}
    assert unfelt_place(build_model(vehicle(), channels, ("ground_effect",))) == {"x", "y"}
