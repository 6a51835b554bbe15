"""The scores and the table of the paper's experiment, on predictors whose scores are known
beforehand."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from scenarios.studies import paper_experiment
from scenarios.studies.paper_data import OUTPUTS, TEST, paper_data
from scenarios.studies.paper_methods import HORIZON, LEAKS, METHODS, ORIGINS, Outcome
from scenarios.studies.paper_scores import (
    FLOOR,
    PAPER,
    floor,
    intensity,
    qualities,
    scores,
    table,
    verdict,
)


def outcome(mean, variance):
    return Outcome(
        mean=mean,
        variance=np.broadcast_to(variance, mean.shape),
        parameters=1,
        seconds=2.0,
        microseconds=3.0,
    )


@pytest.fixture(scope="module")
def data():
    return paper_data(1)


def oracle(bench):
    """Knows the truth: only the sensor noise is left."""
    truth = bench.data.truth
    return outcome(truth.y, truth.sensor)


def cheat(bench):
    """Repeats the measurement that it should predict."""
    return outcome(bench.measured, bench.data.truth.sensor)


def mean(bench):
    y = bench.measured
    return outcome(np.broadcast_to(y.mean(axis=0), y.shape), y.var(axis=0))


def test_knowing_the_truth_scores_the_sensor_floor_and_is_calibrated(data):
    found = scores(data, outcome(data.truth.y, data.truth.sensor))
    for i, name in enumerate(OUTPUTS):
        assert found["channels"][name]["mse"] == pytest.approx(data.truth.sensor[i], rel=0.25)
        assert found["channels"][name]["spectral_db"] == 0.0
    assert found["mse_truth"] == 0.0
    assert found["coverage95"] == pytest.approx(0.95, abs=0.02)
    assert found["coverage50"] == pytest.approx(0.50, abs=0.04)
    assert found["mse_mixed"] == pytest.approx(data.truth.sensor.mean(), rel=0.15)
    assert found["mse"] < floor(data)["mse"] * 1.1
    assert found["r2"] == pytest.approx(floor(data)["r2"], abs=0.01)
    assert found["sigma_follows_intensity"] is None, "a constant sigma follows nothing"


def test_a_cheat_is_betrayed_by_its_error_to_the_truth(data):
    found = scores(data, outcome(data.segment.matrix(OUTPUTS), data.truth.sensor))
    assert found["mse"] == 0.0
    assert found["mse_truth"] > 0.5 * floor(data)["mse"]


def test_nlpd_is_that_of_the_standardised_channels_and_lowest_at_the_right_variance(data):
    right, wide = (
        scores(data, outcome(data.truth.y, k * data.truth.sensor))["nlpd"] for k in (1.0, 4.0)
    )
    assert right < wide - 0.2
    assert right == pytest.approx(floor(data)["nlpd"], abs=0.1)


def test_a_sigma_that_grows_with_the_manoeuvre_is_seen(data):
    grows = 1e-3 * np.repeat(intensity(data)[:, None], 6, axis=1) ** 2
    assert scores(data, outcome(data.truth.y, grows))["sigma_follows_intensity"] == pytest.approx(
        1.0
    )


def test_errors_left_are_white_for_an_oracle_and_coloured_for_what_lags_behind(data):
    truth, sensor = data.truth.y, data.truth.sensor
    right, late = (
        scores(data, outcome(mean, sensor)) for mean in (truth, np.roll(truth, 3, axis=0))
    )
    assert right["coloured"] <= 1 and late["coloured"] == 6
    assert late["correlation"] > 3 * right["correlation"]
    assert late["mse_truth_hard"] > late["mse_truth_calm"] > 0


def test_a_free_run_is_held_against_the_truth_at_its_own_instant(data):
    ahead = data.truth.y[ORIGINS[:, None] + 1 + np.arange(HORIZON)]
    told = replace(outcome(data.truth.y, data.truth.sensor), ahead=ahead)
    assert scores(data, told)["free_0.1"] == scores(data, told)["free_0.5"] == 0.0
    assert scores(data, outcome(data.truth.y, data.truth.sensor))["free_0.5"] is None


def test_qualities_are_ratios_of_what_was_measured():
    def row(**changes):
        return {
            "mse_truth": 1.0,
            "mse_truth_hard": 2.0,
            "mse_truth_calm": 1.0,
            "named": 3,
            "parameters": 9,
            "coverage95": 0.9,
            "sigma_follows_intensity": None,
            "seconds": 4.0,
            "microseconds": 50.0,
        } | changes

    whole = {"seed": 1, "methods": {"PEM linear MIMO": row(), "GP": row(mse_truth_hard=0.5)}}
    less = {"seed": 1, "methods": {"GP": row(mse_truth=3.0)}}
    line = qualities([whole], [less], ["GP"]).splitlines()[1].split()
    assert line == ["GP", "3/9", "0.900", "nan", "0.25", "1.00", "3.00", "4.0", "20000"]


@pytest.mark.slow
def test_results_are_kept_per_method_and_only_the_missing_is_computed(tmp_path):
    called = []

    def counted(bench):
        called.append(bench.data.seed)
        return oracle(bench)

    def quiet(text):
        pass

    first = paper_experiment.run_seed(1, tmp_path, {"a": counted}, say=quiet)
    both = paper_experiment.run_seed(1, tmp_path, {"a": counted, "b": mean}, say=quiet)
    assert called == [1]
    assert both["methods"]["a"] == json.loads((tmp_path / "seed1.json").read_text())["methods"]["a"]
    assert set(both["methods"]) == {"a", "b", FLOOR}
    assert first["methods"]["a"]["mse"] == both["methods"]["a"]["mse"]
    paper_experiment.run_seed(1, tmp_path, {"a": counted}, again=("a",), say=quiet)
    assert called == [1, 1]
    with np.load(tmp_path / "seed1.npz") as file:
        assert file["b|mean"].shape == (500, 6)


@pytest.mark.slow
def test_the_whole_study_runs_prints_and_draws(tmp_path, monkeypatch, capsys):
    """With quick stand-ins for the methods; what it prints is the table, the verdict, and the leaks
    apart."""
    monkeypatch.setattr(paper_experiment, "METHODS", {"GP": mean, "hybrid nonlinear": oracle})
    monkeypatch.setattr(paper_experiment, "LEAKS", {"cheat": cheat})
    few = ["--seeds", "1", "--first", "2", "--quiet-seeds", "0", "--short-seeds", "0"]
    paper_experiment.main([*few, "--out", str(tmp_path)])
    said = capsys.readouterr().out
    assert "lowest test MSE in 1 of 1 seeds" in said
    assert "1.76e-03" in said, "the paper's number stands beside ours"
    assert FLOOR in said and "cheat" in said
    assert (tmp_path / "sigma-seed2.png").stat().st_size > 10_000
    assert (tmp_path / "prediction-hybrid-nonlinear-seed2.png").exists()
    assert (tmp_path / "histograms-seed2.png").stat().st_size > 5_000
    with pytest.raises(SystemExit):
        paper_experiment.main(["--methods", "horoscope", "--out", str(tmp_path)])
    assert "horoscope" in capsys.readouterr().err


def test_the_verdict_counts_seeds_and_ratios():
    def seed(hybrid, other):
        return {
            "methods": {
                "h": {"mse": hybrid, "mse_truth": hybrid},
                "o": {"mse": other, "mse_truth": other},
            }
        }

    text = verdict([seed(1.0, 4.0), seed(3.0, 4.0), seed(5.0, 4.0)], ["h"], ["o"])
    assert "in 2 of 3 seeds" in text
    assert "best other's in 1 (ratio: median 0.75" in text
    assert "no seed" in verdict([], ["h"], ["o"])


def test_every_number_of_the_paper_stands_beside_a_method_of_ours():
    assert set(PAPER) <= set(METHODS)
    assert not set(METHODS) & set(LEAKS)
    row = {"methods": {n: {"mse": 1.0, "mse_truth": 1.0} for n in METHODS}}
    lines = table([row, row], list(METHODS)).splitlines()
    assert sum("2.70e-09" in line for line in lines) == 1
    assert TEST == (25.0, 30.0)
