"""A report is well-formed, needs nothing from outside, escapes what it shows, and stays light."""

import json
import re
import xml.etree.ElementTree as ET
from importlib import resources

import jsonschema
import numpy as np
import pytest
from synthetic_fit import SHARED, make_fit, make_flights, make_validation

from greybox.errors import DataError
from greybox.report.fit_report import fit_report
from greybox.report.flight_section import ChannelSeries, FlightSeries
from greybox.report.html import Report
from tests.report.scripts import foreign_scripts


@pytest.fixture(scope="module")
def page() -> str:
    return fit_report(make_fit(), make_flights(), make_validation())


def _tree(html: str) -> ET.Element:
    assert html.startswith("<!DOCTYPE html>")
    return ET.fromstring(html[len("<!DOCTYPE html>") :])


def test_it_is_well_formed_and_ids_are_unique(page: str) -> None:
    tree = _tree(page)
    ids = [e.get("id") for e in tree.iter() if e.get("id")]
    assert len(ids) == len(set(ids))
    targets = {"#" + i for i in ids}
    for element in tree.iter():
        if element.get("href"):
            assert element.get("href") in targets
    for used in re.findall(r"url\((#[^)]*)\)", page):
        assert used in targets


def test_nothing_comes_from_outside_and_nothing_runs_but_our_own(page: str) -> None:
    assert "http:" not in page
    assert "https:" not in page
    assert foreign_scripts(page) == []
    assert foreign_scripts(page.replace("'use strict'", "'use strict';x=1")) != []
    assert "@import" not in page
    for element in _tree(page).iter():
        assert element.get("src") is None
        assert not any(name.startswith("on") for name in element.attrib)
        assert element.tag not in ("link", "iframe", "object", "embed", "img")
    assert "default-src 'none'" in page


def test_it_is_light(page: str) -> None:
    assert len(page.encode()) < 3_000_000


@pytest.mark.slow
def test_many_long_flights_stay_light() -> None:
    flight = next(iter(make_flights(n=20_000).values()))
    many = {f"flight{i}": flight for i in range(9)}
    page = fit_report(make_fit(), many, None)
    assert len(page.encode()) < 3_000_000
    assert "flight8" in page


def test_every_parameter_and_its_estimate_are_there(page: str) -> None:
    for name in SHARED:
        assert name in page
    assert "1.830e−5" in page
    assert "0.0405 .. 0.0449" in page
    assert "at bound" in page
    assert "prior decides" in page


def test_warnings_come_before_everything_else(page: str) -> None:
    assert page.index("41 samples of vbat are frozen") < page.index("What was fitted</h2>")
    assert page.index("only as a ratio") < page.index("What was fitted</h2>")


def test_a_fit_that_did_not_converge_says_so_first() -> None:
    fit = make_fit()
    fit["status"] = {
        "converged": False,
        "code": "max_iter",
        "advice": "Ran out of iterations: start nearer.",
    }
    page = fit_report(fit)
    assert "did not converge" in page
    assert page.index("Ran out of iterations") < page.index("What was fitted</h2>")


def test_hostile_names_are_shown_not_run() -> None:
    evil = "<script>alert(\"$x$ & 'y'\")</script>"
    fit = make_fit()
    fit["flights"][0]["name"] = evil
    fit["warnings"] = [evil]
    fit["parameters"]["gyro_bias.x"]["per_flight"] = {
        evil: {"value": 1.0, "std": 0.1},
        "飞行$": {"value": 1, "std": None},
    }
    flights = {evil: next(iter(make_flights(300).values()))}
    validation = make_validation()
    validation["flights"][0]["name"] = evil
    page = fit_report(fit, flights, validation)
    assert foreign_scripts(page) == []
    assert "<script>alert" not in page
    assert "&lt;script&gt;" in page
    _tree(page)


def test_axis_labels_keep_their_digits(page: str) -> None:
    # Coordinates are rounded to make the page light; numbers that people read are not.
    assert re.search(r">0\.0001</text>|>0\.001</text>", page)


def test_optional_parts_may_be_missing() -> None:
    fit = make_fit()
    for key in ("noise", "correlations", "unidentifiable", "command"):
        del fit[key]
    for p in fit["parameters"].values():
        p["per_flight"] = None
        p["prior_influence"] = None
        p["prior"] = None
    validation = make_validation()
    for key in (
        "curves",
        "whiteness",
        "cross_correlation",
        "coverage",
        "dead_reckoning",
        "one_step",
    ):
        del validation[key]
    validation["adapted_on"] = None
    _tree(fit_report(fit, {}, validation))


def test_short_flights_with_one_missing_channel_are_drawn() -> None:
    t = np.arange(5) * 0.01
    gone = ChannelSeries(measured=np.full(5, np.nan), unit="m")
    flights = {
        "a": FlightSeries(t=t, channels={"x": gone, "soc": ChannelSeries(measured=np.ones(5))})
    }
    page = fit_report(make_fit(), flights)
    assert "soc" in page
    _tree(page)


def test_diverged_numbers_are_dashes_not_nan() -> None:
    validation = make_validation()
    validation["horizons"][2]["groups"]["position"]["mae"] = None
    validation["simerr"]["position"] = None
    validation["curves"]["model"]["position"][40:] = [None] * 10
    page = re.sub(
        r"<script\b.*?</script>", "", fit_report(make_fit(), {}, validation), flags=re.DOTALL
    )
    assert "nan" not in re.sub(r"<[^>]*>", " ", page).lower().split()


def test_a_table_row_of_the_wrong_length_is_refused() -> None:
    with pytest.raises(DataError, match="cells"):
        Report("t").table(["a", "b"], [["x"]])


def test_the_synthetic_fit_follows_the_published_schema() -> None:
    schema = json.loads(resources.files("greybox").joinpath("schemas/fit.json").read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.Draft202012Validator(schema).validate(make_fit())
    schema = json.loads(resources.files("greybox").joinpath("schemas/validate.json").read_text())
    jsonschema.Draft202012Validator(schema).validate(make_validation())
