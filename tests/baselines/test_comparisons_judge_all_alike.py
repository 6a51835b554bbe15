"""compare: same samples for all, failures in their row, partial results; its schema accepts and its
page shows them."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib.resources import files
from xml.etree import ElementTree

import jsonschema
import numpy as np
import pytest

from greybox.baselines import compare_methods
from greybox.baselines.compare import compare
from greybox.baselines.compare_bench import Bench
from greybox.baselines.compare_methods import METHODS, Outcome, candidates, pairs
from greybox.baselines.compare_options import CompareOptions
from greybox.baselines.compare_scores import one_step_scores
from greybox.cli import main
from greybox.errors import DataError, UnknownNameError
from greybox.files import to_plain
from greybox.report.compare_report import compare_report, format_table
from greybox.residual.learners import LEARNERS
from tests.simulated import flights, vehicle

SCHEMA = json.loads(files("greybox").joinpath("schemas/compare.json").read_text())


def bench(**options):
    train, test = flights(3, 6.0).split_by_flight(["run2"])
    return Bench(
        vehicle=vehicle(),
        train=train,
        test=test,
        fit=lambda: 1 / 0,
        options=CompareOptions(**options),
    )


@pytest.fixture(scope="module")
def judged():
    return bench(adapt=2.0)


@pytest.fixture(scope="module")
def results(judged):
    """Persistence, the linear models, and a nonlinear fit that fails."""
    return list(compare(judged, ("persistence", "linear SISO PEM", "nonlinear PEM")))


def test_a_failing_method_has_its_error_in_its_row(results):
    rows = {m["method"]: m for m in results[-1]["methods"]}
    assert rows["nonlinear PEM"] == {
        "method": "nonlinear PEM",
        "status": "failed",
        "error": "ZeroDivisionError: division by zero",
    }
    assert rows["linear SISO PEM"]["status"] == "done"


def test_every_method_leaves_a_result_behind(results):
    assert [len(r["methods"]) for r in results] == [1, 2, 3]
    assert results[0]["not_run"] == ["linear SISO PEM", "nonlinear PEM"]


def test_the_schema_accepts_every_partial_result(results):
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    for r in results:
        jsonschema.validate(to_plain({**r, "command": "greybox compare"}), SCHEMA)


def slower(segment, name):
    """The channel on every other row alone."""
    values = np.where(np.arange(len(segment.t)) % 2, np.nan, segment.channels[name])
    return replace(segment, channels={**segment.channels, name: values})


def test_persistence_states_its_error_of_a_channel_measured_on_every_other_row(judged):
    whole = METHODS["persistence"](judged).variance[0][-1]
    slow = bench(adapt=2.0)
    slow.train_segments = tuple(slower(s, "p") for s in slow.train_segments)
    seen = METHODS["persistence"](slow).variance[0][-1]
    assert whole[0] < seen[0] < 6 * whole[0]
    np.testing.assert_allclose(seen[1:], whole[1:])


def test_all_methods_are_judged_on_the_same_samples(results):
    done = [m for m in results[-1]["methods"] if m["status"] == "done"]
    assert len({m["channels"]["p"]["n"] for m in done}) == 1
    assert len({m["multi_step"]["origins"]["rate"]["used"] for m in done}) == 1


def test_the_linear_model_beats_persistence_and_covers(results):
    still, linear = (m for m in results[-1]["methods"] if m["status"] == "done")
    assert linear["mean"]["mse"] < 0.7 * still["mean"]["mse"]
    assert linear["mean"]["nlpd"] < still["mean"]["nlpd"] - 0.5
    assert 0.9 < linear["mean"]["coverage95"] < 0.99
    for group in ("rate", "rotation", "velocity", "position"):
        assert linear["curve"][group][9] < 0.5 * still["curve"][group][9], group


def test_the_page_and_the_table_name_every_method(results):
    content = {**results[-1], "command": "greybox compare"}
    page = compare_report(content)
    text = format_table(content)
    for m in content["methods"]:
        assert m["method"] in page
        assert m["method"] in text
    assert "ZeroDivisionError" in page
    ElementTree.fromstring(page.removeprefix("<!DOCTYPE html>\n"))
    assert page.count("PIT histogram of") >= 2
    assert page.count("histogram of the errors of") >= 2
    assert "0.5 s" in text


def test_means_are_over_standardised_channels():
    rng = np.random.default_rng(0)
    y = rng.standard_normal((2000, 2)) * [1.0, 100.0]
    given = {
        "inputs": [rng.standard_normal((2000, 1))],
        "names": ("p", "ax"),
        "units": ("", ""),
        "dt": 0.01,
    }
    scored = one_step_scores(
        [y],
        [np.zeros_like(y)],
        [np.ones_like(y) * [1.0, 1e4]],
        spread=np.array([1.0, 100.0]),
        **given,
    )
    one, two = scored["channels"].values()
    assert scored["mean"]["mse"] == pytest.approx((one["mse"] + two["mse"] / 1e4) / 2)
    assert scored["mean"]["nlpd"] == pytest.approx(0.5 * np.log(2 * np.pi) + 0.5, abs=0.05)
    assert scored["mean"]["r2"] == pytest.approx(0.0, abs=0.01)
    y[5] = np.nan
    with pytest.raises(DataError, match="have no prediction"):
        one_step_scores([np.ones_like(y)], [y], [np.ones_like(y)], spread=np.ones(2), **given)


def test_a_deviation_that_follows_the_error_and_the_manoeuvre_is_seen_to_do_so():
    rng = np.random.default_rng(1)
    u = rng.standard_normal((4000, 2))
    size = 0.1 + np.linalg.norm(u - u.mean(axis=0), axis=1)[:, None]
    y = size * rng.standard_normal((4000, 1))
    given = {"names": ("p",), "units": ("",), "dt": 0.01, "spread": np.ones(1)}
    told = one_step_scores([y], [0 * y], [size**2], [u], **given)["channels"]["p"]
    assert told["sigma_manoeuvre"] == pytest.approx(1.0)
    assert 0.3 < told["sigma_error"] < 0.7
    assert sum(told["histogram"]) == pytest.approx(1.0) and len(told["histogram"]) == 16
    flat = one_step_scores([y], [0 * y], [0 * y + 1.0], [u], **given)["channels"]["p"]
    assert flat["sigma_error"] is None and flat["sigma_manoeuvre"] is None


def test_all_searches_have_the_budget_and_try_every_kind():
    drawn = candidates(
        bench(budget=4), {"features": ("a", "b"), "kernel": (1, 2), "points": (3, 4)}, "features"
    )
    assert [d["features"] for d in drawn] == ["a", "b", "a", "b"]
    assert len({tuple(d.items()) for d in drawn}) == 4


def test_every_promised_method_is_there():
    assert {
        "linear SISO PEM",
        "linear MIMO PEM",
        "nonlinear PEM",
        "LSTM",
        "TCN",
        "GP alone",
        "linear PEM + GP",
        "nonlinear PEM + GP",
    } <= set(METHODS)
    with pytest.raises(UnknownNameError, match="linear SISO PEM"):
        next(compare(bench(), ("linear SIS PEM",)))


@pytest.mark.slow
def test_pairs_are_every_model_with_every_learner(judged):
    found = pairs(("gp", *LEARNERS))
    assert set(found) | set(METHODS) >= {
        f"{base} PEM + {learner}"
        for base in ("linear SISO", "linear MIMO", "nonlinear")
        for learner in LEARNERS
    } | {"linear PEM + GP", "linear MIMO PEM + GP", "nonlinear PEM + GP"}
    judged.budget = 1
    rows = next(compare(judged, ("linear MIMO PEM + sparse",)))["methods"]
    assert rows[0]["status"] == "done", rows[0]
    assert rows[0]["search"][0]["points"] in (25, 50)


@pytest.mark.slow
@pytest.mark.parametrize("learner", ["gp", *LEARNERS])
def test_every_pair_has_its_row(learner):
    from greybox.estimation.fit import fit
    from greybox.model.model import build_model

    judge = bench(adapt=2.0, budget=1, points=12)
    judge.fit = lambda: fit(build_model(vehicle(), judge.train.channels), judge.train).model
    *_, last = compare(judge, (), learners=(learner,))
    for row in last["methods"]:
        assert row["status"] == "done", row.get("error")
        assert row["multi_step"] is not None
        assert np.isfinite(row["mean"]["nlpd"])


def test_a_linear_model_does_not_see_the_measurement_that_it_predicts(judged):
    at, segment, predictor = 400, judged.segments[0], judged.siso[0]
    moved = {
        n: np.where(np.arange(segment.n) == at, v + 0.1, v)
        for n, v in segment.channels.items()
        if n[0] != "u"
    }
    before, after = predictor.one_step(segment)[0], predictor.one_step(segment.replace(moved))[0]
    assert np.array_equal(before[: at + 1], after[: at + 1], equal_nan=True)
    assert not np.array_equal(before[at + 1], after[at + 1])


def test_bad_input_is_one_line(tmp_path, capsys):
    from greybox.examples import flight_path, vehicle_path

    log = str(flight_path("nanobench", "B2_circle_fast_rep1"))
    common = ["compare", "--vehicle", str(vehicle_path("nanobench")), "--out", str(tmp_path)]
    for extra, text in (
        (["--train", log, "--test", log], "both train and test"),
        (["--train", log, "--test", log, "--budget", "0"], "--budget"),
        (["--train", log, "--test", log, "--learners", "neura"], "neural"),
        (["--train", log, "--test", log, "--adapt", "-1"], "--adapt"),
    ):
        assert main([*common, *extra]) == 2
        error = capsys.readouterr().err.strip()
        assert text in error
        assert "\n" not in error


def test_outcomes_of_a_method_of_ones_own_are_judged_too(judged, monkeypatch):
    """A row is whatever a function of the bench returns: here the truth itself, with a small
    spread."""

    def oracle(given):
        mean = [s.matrix(given.outputs) for s in given.segments]
        return Outcome(
            mean=mean,
            variance=[np.full_like(m, 1e-6) for m in mean],
            table=None,
            parameters=0,
            seconds=0.0,
            microseconds=0.0,
        )

    monkeypatch.setitem(compare_methods.METHODS, "oracle", oracle)
    row = next(compare(judged, ("oracle",)))["methods"][0]
    assert row["mean"]["mse"] == 0.0
    assert row["mean"]["coverage95"] == 1.0
    assert row["multi_step"] is None
