"""Too few samples are refused; few give errors that take up that the noise levels are not known either."""

from __future__ import annotations

import numpy as np
import pytest

from greybox import build_model, fit
from greybox.data import Dataset, dataset_from_arrays
from greybox.errors import DataError
from greybox.estimation.engine import unfelt_place
from greybox.estimation.few_samples import doubt_of_levels
from tests.simulated import flights, truth, vehicle

EFFECTS = ("motor_lag", "command_delay", "rotor_drag", "rotational_damping")


def cut(rows: int, which: int = 0, data: Dataset | None = None) -> Dataset:
    """The first rows of a simulated flight."""
    one = (data or flights()).flights[which].segments[0]
    return dataset_from_arrays(one.t[:rows], {k: v[:rows] for k, v in one.channels.items()}, name="cut")


@pytest.mark.parametrize("rows", [2, 20])
def test_fewer_samples_than_unknowns_are_refused(rows: int) -> None:
    data = cut(rows)
    with pytest.raises(DataError, match="fewer than the"):
        fit(build_model(vehicle(), data.channels, EFFECTS), data)


def test_a_short_flight_doubts_its_noise_levels_and_a_long_one_does_not() -> None:
    data = cut(100)
    short = fit(build_model(vehicle(), data.channels, EFFECTS), data)
    held = np.zeros(short.problem.n, dtype=bool)
    more = doubt_of_levels(short.problem, short.theta, short.covariance.fisher, held)
    parameters = [i for i, u in enumerate(short.problem.unknowns) if u.kind == "parameter"]
    gain = np.diag(more)[parameters] / np.diag(short.covariance.fisher)[parameters]
    assert np.linalg.eigvalsh(more).min() > -1e-9 * np.abs(more).max()
    assert (gain >= 0).all()
    assert 0.05 < np.median(gain) < 10.0


def test_the_place_is_felt_only_where_something_depends_on_it() -> None:
    channels = flights().channels
    assert unfelt_place(build_model(vehicle(), channels, ("rotor_drag",))) == {"x", "y", "z"}
    assert unfelt_place(build_model(vehicle(), channels, ("ground_effect",))) == {"x", "y"}


@pytest.mark.slow
def test_intervals_of_one_second_hold_the_truth() -> None:
    many = flights(count=30, seconds=1.3, first_seed=1000)
    inside = []
    for i in range(30):
        data = cut(100, i, many)
        found = fit(build_model(vehicle(), data.channels, EFFECTS), data)
        inside += [
            abs(e.value - truth()[n]) < 1.96 * e.std for n, e in found.parameters.items() if np.isfinite(e.std)
        ]
    print(f"{np.mean(inside):.3f} of {len(inside)} intervals")
    assert np.mean(inside) > 0.88
