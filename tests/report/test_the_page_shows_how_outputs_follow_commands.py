"""Claims: the page of a fit shows what `gb.frf` finds in its flights with the model over it, says
first what must be known before it is believed, and shows steps as large as the flights' own
commands; where flights tell none it says why."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import greybox as gb
from greybox.commands.responses import responses
from greybox.data import Dataset
from greybox.report.fit_report import fit_report
from greybox.report.response_section import Responses
from tests.linear.test_frequency_responses_of_flights import SIGNS, flights
from tests.report.synthetic_fit import make_fit
from tests.simulators.identified import identified


def flown(seconds: float = 60.0, feedback: float = 0.0) -> Dataset:
    """Flights with all outputs of rates; pitch, yaw and thrust do not move anything."""
    data = flights(seconds=seconds, feedback=feedback)
    rng = np.random.default_rng(0)
    found = Dataset(flights=())
    for flight in data:
        s = flight.segments[0]
        noise = rng.standard_normal((7, s.n))
        columns = {n: s.column(n) for n in ("u1", "u2", "u3", "u4", "p")}
        columns |= {f"u{j + 1}": columns[f"u{j + 1}"] + 0.05 * noise[j] for j in range(4)}
        columns |= {"q": noise[4], "r": noise[5], "az": noise[6]}
        found = found + gb.dataset_from_arrays(s.t, columns, name=flight.name)
    return found


def answers(data: Dataset | None = None) -> Responses:
    """How a model and these flights answer."""
    data = data or flown()
    found = responses(replace(identified({}), sample_time=data.flights[0].dt), data)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def shown() -> tuple[Dataset, Responses]:
    data = flown()
    return data, answers(data)


def test_the_pairs_are_those_of_frf_and_the_model_lies_over_them(shown: tuple[Dataset, Responses]):
    data, found = shown
    assert found.measured is not None
    pairs = {(p["input"], p["output"]): p for p in found.measured["pairs"]}
    assert list(pairs) == [("roll", "p"), ("pitch", "q"), ("yaw", "r"), ("thrust", "az")]
    model = replace(identified({}), sample_time=data.flights[0].dt)
    own = gb.frf(data, ["roll", "pitch", "yaw", "thrust"], ["p", "q", "r", "az"], model=model)
    assert pairs["roll", "p"] == own.pairs["p/roll"].to_dict()
    assert np.isfinite(pairs["roll", "p"]["model"]["magnitude"][0])
    assert any(pairs["roll", "p"]["usable"]) and not any(pairs["pitch", "q"]["usable"])


def test_steps_are_as_large_as_the_commands_of_the_flights(shown: tuple[Dataset, Responses]):
    data, found = shown
    roll = np.concatenate(
        [
            sum(sign * f.segments[0].column(f"u{j + 1}") for j, sign in enumerate(SIGNS)) / 4
            for f in data
        ]
    )
    step = next(s for s in found.steps if s.input == "roll")
    assert step.size == pytest.approx(np.std(roll))
    # Thrust 5 u^2 N at four rotors, arms of 0.1 m, 0.01 kg m^2: the left wing goes up, at a
    # constant rate of turn.
    assert step.unit == "rad/s" and step.values[0] == 0 and np.all(np.diff(step.values)[2:] > 0)


def test_the_page_says_first_that_a_loop_is_closed():
    page = fit_report(make_fit(), responses=answers(flown(feedback=0.5)))
    said, figure = (
        page.index("a closed loop"),
        page.index("Magnitude, phase and coherence of p over roll"),
    )
    assert (
        page.index("How it answers to commands</h2>")
        < said
        < figure
        < page.index("Step response of the model")
    )
    assert "greybox frf --references" in page
    assert "shows in p after" not in page, "a gain of the controller is no gain of the craft"


def test_flights_that_are_too_short_leave_the_steps_and_a_reason():
    found = answers(flown(seconds=1.0))
    assert found.measured is None and len(found.steps) == 4
    page = fit_report(make_fit(), responses=found)
    assert "The flights tell no frequency response: too short" in page
    assert "How it answers to commands" not in fit_report(make_fit())
