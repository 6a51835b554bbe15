"""A page says its result first and its settings last, in the units and words of people."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from synthetic_fit import make_fit, make_validation

from greybox.frames import numeric
from greybox.report.discover_report import discover_report
from greybox.report.fit_report import fit_report
from greybox.report.flight_section import ChannelSeries, FlightSeries, _with_angles
from greybox.report.html import Report, Span
from greybox.report.identify_report import identify_report
from greybox.report.learn_report import learn_report
from greybox.validation.gap import closed_in_words
from tests.discovery.test_the_report_tells_every_verdict import content as discovery
from tests.report.identified import identified
from tests.residual.test_learn_report_says_what_was_learned import content as learned


@pytest.fixture(scope="module")
def page() -> str:
    return fit_report(make_fit(), {}, make_validation())


def test_the_result_comes_first_and_the_settings_last(page: str):
    order = [
        "NOT JUDGED",
        "<figure>",
        "What is missing:",
        "What to do next</h3>",
        'class="warnings"',
        "How far ahead it predicts</h2>",
        "Parameters</h2>",
        "What the data can and cannot tell</h2>",
        "What was fitted</h2>",
        "How to reproduce this</h2>",
    ]
    places = [page.index(words) for words in order]
    assert places == sorted(places)


@pytest.mark.parametrize("noise", ["coloured.position.T", "low_pass.gyro.T", "disturbance.force.T"])
def test_a_time_of_noise_at_its_bound_asks_for_nothing(noise: str):
    """Such a page advised to leave the effect out: there is none."""
    fit = make_fit()
    fit["settings"]["noise_parts"] = ["coloured.position", "low_pass.gyro"]
    fit["parameters"][noise] = fit["parameters"]["command_delay.d"]
    said = re.findall(r"<li>At a bound: (.*?)\. ", fit_report(fit, {}, make_validation()))
    assert said == ["command_delay.d", "command_delay.d"]


def test_rotation_is_in_degrees_by_the_numbers(page: str):
    fit, validation = make_fit(), make_validation()
    error = validation["horizons"][2]["groups"]["rotation"]
    assert error["unit"] == "rad"
    shown = re.search(r"rotation \[deg\].*?<th scope=\"row\">model</th>(.*?)</tr>", page, re.DOTALL)
    assert shown is not None
    cells = re.findall(r"<td[^>]*>([^<]*)</td>", shown[1])
    assert float(cells[2]) == pytest.approx(math.degrees(error["mae"]), rel=1e-3)
    assert "[rad]" not in page
    assert fit  # rates stay as they are
    assert "rate: mean error [rad/s]" in page


def test_attitude_is_roll_pitch_yaw_without_jumps():
    turned = np.radians(
        np.column_stack([10 + np.zeros(50), -20 + np.zeros(50), np.linspace(150, 400, 50)])
    )
    q = numeric("from_euler", turned)
    ahead = numeric("from_euler", turned + np.radians([1.0, 2.0, 3.0]))
    q[7] = np.nan
    channels = {
        n: ChannelSeries(measured=q[:, i], one_step=None, ahead=ahead[:, i])
        for i, n in enumerate(("qw", "qx", "qy", "qz"))
    }
    shown = _with_angles(FlightSeries(t=np.arange(50) * 0.01, channels=channels)).channels
    assert list(shown) == ["roll", "pitch", "yaw"]
    good = np.arange(50) != 7
    for i, (name, off) in enumerate(zip(shown, (1.0, 2.0, 3.0), strict=True)):
        assert shown[name].unit == "deg"
        assert shown[name].one_step is None
        np.testing.assert_allclose(
            shown[name].measured[good], np.degrees(turned[good, i]), atol=1e-9
        )
        gap = np.asarray(shown[name].ahead)[good] - shown[name].measured[good]
        np.testing.assert_allclose(gap, off, atol=1e-9)
        assert np.isnan(shown[name].measured[7])


def test_a_log_without_a_whole_quaternion_keeps_its_columns():
    flight = FlightSeries(t=np.arange(3.0), channels={"qw": ChannelSeries(measured=np.ones(3))})
    assert _with_angles(flight) is flight


@pytest.mark.parametrize(
    ("share", "floor", "said"),
    [
        (1.03, 0.5, "all of it: at the floor"),
        (0.996, 0.5, "all of it: at the floor"),
        (0.99, 0.5, "99 %"),
        (-0.1, 0.5, "-10 %"),
        (0.996, None, "all of it"),
    ],
)
def test_more_than_all_of_a_gap_is_at_the_floor(share: float, floor: float | None, said: str):
    assert closed_in_words(share, 1.0, floor) == said


def test_an_error_of_many_times_the_floor_is_not_at_it_however_much_closed():
    before, after, floor = 1.455, 0.0243, 0.0061
    share = 1 - (after**2 - floor**2) / (before**2 - floor**2)
    assert closed_in_words(share, before, floor) == "99.97 %: 4 times the floor, 0.0061"


def test_a_bar_shows_the_estimate_inside_its_prior():
    report = Report("t")
    span = Span(low=-1.0, high=1.0, prior=(-4.0, 4.0), text="0 standard deviations")
    report.table(["a", "b"], [["x", span]])
    places = re.findall(r'class="(\w+)" style="left: ([\d.]+)%; width: ([\d.]+)%"', report.html())
    assert places == [("prior", "0.0", "100.0"), ("estimate", "37.5", "25.0")]


def test_every_estimate_with_a_spread_has_a_t(page: str):
    row = re.search(r'<th scope="row">thrust.c2</th>(.*?)</tr>', page)
    assert row is not None
    assert re.findall(r">([^<>]+)</td>", row[1])[2] == "164"
    assert "standard deviations of the prior from its middle" in row[1]


PLACES = {
    "discover": (
        lambda: discover_report(discovery()),
        ["MISSING: rotor_drag", "<figure>", "What to do next</h3>", "<nav"],
    ),
    "learn": (
        lambda: learn_report(learned()),
        ["NOT JUDGED", "<figure>", "What to do next</h3>", 'class="warnings"'],
    ),
    "identify": (
        lambda: identify_report(identified(), {}, links={}, validation=make_validation()),
        ["USABLE", "<figure>", "What to do next</h3>", "<nav", "Stages</h2>"],
    ),
}


@pytest.mark.parametrize("name", PLACES)
def test_every_page_has_its_result_its_figure_and_the_next_step_before_all_else(name: str):
    make, order = PLACES[name]
    page = make()
    places = [page.index(words) for words in order]
    assert places == sorted(places)
    assert page.index("How to reproduce this</h2>") == page.rindex("</h2>") - len(
        "How to reproduce this"
    )
