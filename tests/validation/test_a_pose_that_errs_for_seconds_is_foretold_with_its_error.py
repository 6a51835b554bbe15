"""A position whose error lasts (GPS) is no fault of a model that knows how long it lasts: what the
sensor will read is foretold, and stated, like what holding its last value repeats."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.data import Segment
from greybox.estimation.filtering import Filter
from greybox.model.noise import Augmented, Coloured
from greybox.model.noise.gauss_markov import renewed
from greybox.model.parameter import ParameterValues
from greybox.validation.groups import error_norms
from greybox.validation.horizon_table import GroupErrors, HorizonTable
from greybox.validation.open_loop import GroupReader, predict_from
from greybox.validation.result import Validation
from greybox.validation.validate import validate
from tests.validation.test_validate_judges_causally import DT, dataset, fly, make_model

SIGMA, TIME = 0.3, 15.0
"""Of the error of the position [m, s]."""
POSITION = ("x", "y", "z")


def knowing(time: float, *sensors: str, sigma: float = SIGMA):
    """The model with noise of these sensors that lasts `time` [s]."""
    model = make_model()
    dynamics = Augmented(
        core=model.dynamics, parts=tuple(Coloured(sensor=s, time=time) for s in sensors)
    )
    more = 3 * len(sensors)
    level = sigma * np.sqrt(renewed(time, DT))
    return replace(
        model,
        dynamics=dynamics,
        values=ParameterValues(dict(model.values) | {f"coloured.{s}.T": time for s in sensors}),
        process_noise=np.append(model.process_noise, np.full(more, level)),
        weak=np.append(model.weak, np.full(more, 100.0)),
        reference_state=dynamics.reference({f"u{i}": 0.849 for i in range(1, 5)}),
    )


def flown(every: int = 10, seconds: float = 40.0) -> Segment:
    """A flight whose position is measured at every so many samples, with an error that lasts."""
    n = round(seconds / DT)
    true = fly(make_model(), n, seed=2, noise=1.0)
    rng = np.random.default_rng(3)
    error = SIGMA * rng.standard_normal((1, 3))
    steps = SIGMA * np.sqrt(renewed(TIME, DT)) * rng.standard_normal((n, 3))
    track = np.zeros((n, 3))
    for k in range(n):
        error = np.exp(-DT / TIME) * error + steps[k]
        track[k] = error
    track[np.arange(n) % every != 0] = np.nan
    moved = {c: true.channels[c] + track[:, i] for i, c in enumerate(POSITION)}
    return true.replace(moved)


def white(sigma: float):
    """The model with white noise of the position."""
    model = make_model()
    return replace(model, sensor_noise=np.append([sigma] * 3, model.sensor_noise[3:]))


def test_the_model_that_knows_of_it_is_as_near_as_the_measured_imu_and_says_how_near():
    flight = dataset(flown())
    found = validate(knowing(TIME, "position"), flight, every=20, adapt=0.0)
    blind = validate(white(0.1), flight, every=20, adapt=0.0)
    own, taken = found.table.groups["position"], blind.table.groups["position"]
    assert own.mae[9] < 1.05 * found.dead_reckoning.groups["position"].mae[9]
    assert own.mae[9] < 0.5 * taken.mae[9]
    assert own.coverage[0.95][[9, 49, 99]].min() > 0.9


def test_noise_that_lasts_no_sample_leaves_the_numbers_of_white_noise():
    flight = dataset(flown(seconds=8.0))
    models = white(SIGMA), knowing(1e-3, "position")
    tables = [validate(m, flight, every=20).table for m in models]
    for group in ("position", "velocity", "rotation", "rate"):
        a, b = (t.groups[group] for t in tables)
        np.testing.assert_allclose(a.mae, b.mae, rtol=1e-3)
        np.testing.assert_allclose(a.coverage[0.95], b.coverage[0.95], atol=0.01)


@pytest.mark.parametrize("group", ["position", "rotation", "rate"])
def test_one_sample_ahead_the_error_is_the_innovation(group: str):
    sensor, rows = {
        "position": ("position", slice(0, 3)),
        "rotation": ("attitude", slice(3, 6)),
        "rate": ("gyro", slice(6, 9)),
    }[group]
    model, segment = knowing(2.0, sensor, sigma=0.001), flown(every=1, seconds=4.0)
    runner, reader = Filter(model), GroupReader(model)
    run = runner.run(segment)
    origins = np.arange(50, 300)
    ahead = predict_from(runner.engine, reader, run, origins, steps=1)[group][:, 0]
    reference = segment.matrix(reader.table[group].columns)[origins + 1]
    expected = np.linalg.norm(run.innovations[origins + 1, rows], axis=1)
    np.testing.assert_allclose(error_norms(group, ahead, reference), expected, atol=2e-5)


def test_regions_that_are_too_narrow_are_said_to_be():
    sure = replace(white(1e-3), sensor_noise=np.append([1e-4] * 3, white(1e-3).sensor_noise[3:]))
    sure = replace(sure, process_noise=0.01 * sure.process_noise)
    flight = dataset(flown(every=1, seconds=8.0))
    told = validate(sure, flight, every=20).format()
    assert "too narrow: the stated 95 % regions hold position" in told
    held = validate(white(1.0), flight, every=20).format()
    assert "hold position" not in held


def test_every_horizon_that_a_region_is_too_narrow_at_is_said():
    def held(*shares: float) -> GroupErrors:
        one, n = np.ones(len(shares)), np.ones(len(shares), dtype=np.int64)
        return GroupErrors(
            mae=one, rmse=one, n=n, diverged=0 * n, origins=1, left_out=0,
            coverage={0.95: np.array(shares)},
        )  # fmt: skip

    groups = {"rate": held(0.35, 0.65, 0.66, 0.672), "position": held(0.95, 0.93, 0.85, 0.91)}
    rows = HorizonTable(label="model", sample_time=0.1, required=2, groups=groups)
    told = Validation(
        model="m", file=None, flights=[], sample_time=0.1, horizons=(1, 2, 3, 4), table=rows
    )
    assert told.table_text().splitlines()[-1] == (
        "too narrow: the stated 95 % regions hold rate 35 to 67 % 0.1, 0.2, 0.3, 0.4 s ahead; "
        "position 85 % 0.3 s ahead"
    )
