"""The record of the paper's experiment: its parts, its truth, the noise floor, and what a command
gives away."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.excitation import Hover
from greybox.plants.flight_log import fly
from greybox.plants.presets import controller_for
from scenarios.studies.paper_data import DT, OUTPUTS, TEST, TRAIN, VALIDATION, paper_data, plant


@pytest.fixture(scope="module")
def data():
    return paper_data(3)


def test_it_has_the_papers_size_and_parts(data):
    assert data.segment.n == 3000
    assert [data.part(span).segments[0].n for span in (TRAIN, VALIDATION, TEST)] == [2000, 500, 500]
    assert data.part(TEST).segments[0].t[0] == pytest.approx(25.0)
    assert data.rows(TEST) == slice(2500, 3000)


def test_measurement_is_truth_plus_noise_of_the_stated_variance(data):
    noise = data.segment.matrix(OUTPUTS) - data.truth.y
    assert noise.var(axis=0) == pytest.approx(data.truth.sensor, rel=0.1)
    assert np.abs(noise.mean(axis=0)) == pytest.approx(np.zeros(6), abs=0.004)


def test_every_output_moves_far_above_its_noise_in_every_part(data):
    for span in (TRAIN, VALIDATION, TEST):
        spread = data.truth.y[data.rows(span)].std(axis=0)
        assert np.all(spread > 2.0 * np.sqrt(data.truth.sensor))
    assert data.truth.height.min() > 0.0, "it never touches the ground"
    assert data.truth.height.min() < 0.2, "but comes near enough to feel it"


@pytest.mark.slow
def test_the_same_seed_gives_the_same_record_and_another_seed_another(data):
    assert paper_data(3).record.hash == data.record.hash
    assert paper_data(4).record.hash != data.record.hash


def test_without_noise_measurement_and_truth_are_one():
    quiet = paper_data(3, noise=False)
    assert np.array_equal(quiet.segment.matrix(OUTPUTS), quiet.truth.y)
    assert not quiet.truth.floor.any()


def test_the_process_floor_is_the_spread_of_the_next_sample_over_repeated_flights(data):
    members = 3000
    batch = plant()
    batch.reset(range(members), velocity=(0.5, 0.2, 0.0), rates=(0.3, -0.2, 0.1))
    batch.step(np.full((members, 4), 0.6), DT)
    clean = batch.measure(noise=False)
    spread = np.array([clean[name].var() for name in OUTPUTS])
    assert spread == pytest.approx(data.truth.process, rel=0.15)


def test_the_command_of_the_same_instant_carries_the_noise_of_the_measurement():
    """Why u_k may not enter a prediction of y(t_k): the controller computed it from y(t_k); u_(k-1)
    is innocent."""
    members = 2000
    batch = plant()
    log = fly(
        batch, controller_for(batch), Hover(), None, 2 * DT, DT, range(members), record=("clean",)
    )
    noise, roll = log["p"] - log["clean.p"], log["u2"] - log["u4"]
    assert abs(np.corrcoef(roll[0], noise[0])[0, 1]) > 0.12
    assert abs(np.corrcoef(roll[0], noise[1])[0, 1]) < 4.0 / np.sqrt(members)
