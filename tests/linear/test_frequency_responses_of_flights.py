"""Claims: `gb.frf` finds gain and lag within their errors and mixes commands as a pilot would; the
model of the flights lies inside the circles and a wrong one is said to part, with the frequencies;
what cannot be told is refused in one line."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal

import greybox as gb
from greybox.data import Dataset
from greybox.errors import GreyboxError
from greybox.linear.frf_channels import mixers
from greybox.model.example import example_vehicle
from greybox.model.linear import LinearModel
from greybox.model.matrices import Matrices
from greybox.symbolic import Layout, Signal
from tests.simulators.identified import identified
from tests.statistics.test_frequency_responses_have_honest_bands import DT, GAIN, POLE, flown

SIGNS = np.array([np.sign(r.position[1]) for r in example_vehicle().rotors])


def flights(
    count: int = 2,
    feedback: float = 0.0,
    noise: float = 0.02,
    gap: bool = False,
    seconds: float = 60.0,
) -> Dataset:
    """Flights whose roll command u drives p, with a hover command and small other motions."""
    data = Dataset(flights=())
    for i in range(count):
        u, y, r = flown(i, feedback, noise=noise, seconds=seconds).T
        columns = {f"u{j + 1}": 0.5 + sign * 0.2 * u for j, sign in enumerate(SIGNS)}
        columns |= {"p": y, "ref": r, "still": 0 * y}
        if gap:
            columns["p"] = np.where(np.arange(len(y)) % 900 == 450, np.nan, y)
        data = data + gb.dataset_from_arrays(DT * np.arange(len(y)), columns, name=f"flight{i}")
    return data


def linear_model(gain: float = 1.0, delay: int = 2) -> LinearModel:
    """The plant of `flown`, from the command roll, as a model."""
    one = np.eye(1)
    return LinearModel(
        name="plant",
        matrices=Matrices(POLE * one, GAIN * gain / 0.2 * one, one, 0 * one, 0 * one),
        noise=one,
        dt=DT,
        inputs=Layout([Signal(name="roll", unit="1")]),
        outputs=Layout([Signal(name="p", unit="rad/s")]),
        delays=(delay,),
    )


def test_gain_and_lag_are_found_within_their_errors():
    found = gb.frf(flights(), ["roll"], ["p"], vehicle=example_vehicle()).pairs["p/roll"]
    assert found.usable.mean() > 0.7
    form = found.form
    assert form is not None and form.integrators == 1 and form.lag_std < 0.003
    # Two samples of delay, one that the difference equation has, half a sample given back by the
    # held command.
    assert abs(form.lag - 2.5 * DT) < 3 * form.lag_std + 5e-4
    assert abs(form.gain - 250) < 3 * form.gain_std + 5
    assert "roll shows in p after 5" in "\n".join(found.lines())


def test_mixed_commands_are_those_of_a_mixer():
    mixed = mixers(example_vehicle())
    assert sorted(mixed) == ["pitch", "roll", "thrust", "yaw"]
    assert [w for w, _ in mixed["roll"].terms] == pytest.approx(0.25 * SIGNS)
    assert [w for w, _ in mixed["thrust"].terms] == pytest.approx([0.25] * 4)
    assert [w for w, _ in mixed["yaw"].terms] == pytest.approx(
        [-0.25 * r.spin for r in example_vehicle().rotors]
    )


def test_the_right_model_lies_inside_and_a_wrong_one_is_said_to_part():
    data, vehicle = flights(), example_vehicle()
    right = gb.frf(data, ["roll"], ["p"], vehicle=vehicle, model=linear_model()).pairs["p/roll"]
    assert right.outside is not None and right.outside.sum() <= 5
    assert len(list(right.parts())) == 1 and "inside the 95 % circle at" in next(right.parts())
    late = gb.frf(data, ["roll"], ["p"], vehicle=vehicle, model=linear_model(delay=4)).pairs[
        "p/roll"
    ]
    said = "\n".join(late.parts())
    assert "outside the 95 % circle from" in said and " Hz: " in said and late.outside is not None
    assert late.outside[-5:].any() and not late.outside[:2].all()


def test_a_closed_loop_is_said_and_a_reference_mends_it():
    data, vehicle = flights(count=3, feedback=0.2, noise=0.4), example_vehicle()
    direct = gb.frf(data, ["roll"], ["p"], vehicle=vehicle, model=linear_model())
    assert any("closed loop" in w and "--references" in w for w in direct.warnings)
    said = list(direct.pairs["p/roll"].parts())
    assert "does not judge the model" in said[0] and "closed loop" in said[0]
    assert any(" % off" in line for line in said), "the numbers stay"
    assert not any("inside" in line or "outside" in line for line in said)
    summary = direct.summary()
    assert summary.index("warning:") < summary.index("p/roll: coherence")
    by_reference = gb.frf(
        data, ["roll"], ["p"], vehicle=vehicle, model=linear_model(), references=["ref"]
    )
    assert by_reference.warnings == () and by_reference.references == ("ref",)
    assert (
        "the model is inside the 95 % circle at" in list(by_reference.pairs["p/roll"].parts())[-1]
    )
    shares = []
    for found in (direct, by_reference):
        pair = found.pairs["p/roll"]
        assert pair.model is not None
        shares.append(np.mean(np.abs(pair.model - pair.value) < pair.radius))
    assert shares[0] < 0.3 and shares[1] > 0.7
    pair = direct.pairs["p/roll"]
    assert not direct.measured and direct.closed_by == ("roll",)
    assert pair.coherent.any() and not pair.usable.any() and pair.form is None
    assert not any(r["usable"] for r in direct.rows())
    assert by_reference.closed_by == ()
    assert gb.frf(flights(), ["roll"], ["p"], vehicle=vehicle).warnings == ()


def test_outputs_with_later_samples_are_not_called_a_closed_loop():
    """They foretell the input in an open loop too: who says so gets the response, with what it
    leaves open; who does not is told both."""
    data, vehicle = flights(), example_vehicle()
    b, a = scipy.signal.butter(2, 0.4)
    smooth = Dataset(
        flights=tuple(
            gb.dataset_from_arrays(
                f.segments[0].t,
                {
                    n: scipy.signal.filtfilt(b, a, x) if n == "p" else x
                    for n, x in f.segments[0].channels.items()
                },
                name=f.name,
            ).flights[0]
            for f in data.flights
        )
    )
    silent = gb.frf(smooth, ["roll"], ["p"], vehicle=vehicle)
    assert not silent.measured and "or outputs with later samples" in silent.line
    assert any("causal = false" in w for w in silent.warnings)
    told = Dataset(flights=tuple(replace(f, noncausal=frozenset({"p"})) for f in smooth.flights))
    found = gb.frf(told, ["roll"], ["p"], vehicle=vehicle, model=linear_model())
    assert found.line.startswith("measured, if roll did not follow the outputs: p/roll")
    assert found.closed_by == () and found.pairs["p/roll"].fed_back
    assert any("whether roll follows p cannot be told" in w for w in found.warnings)
    assert any("phases are not those" in w for w in found.warnings)
    assert not any("closed loop), or" in w for w in found.warnings)


def test_a_loop_is_seen_by_outputs_that_hold_no_later_samples():
    data = flights(count=3, feedback=0.2, noise=0.4)
    two = Dataset(flights=tuple(replace(f, noncausal=frozenset({"u1"})) for f in data.flights))
    direct = gb.frf(two, ["roll"], ["p"], vehicle=example_vehicle())
    assert not direct.measured and direct.closed_by == ("roll",)


def test_a_craft_is_flown_by_feedback_whether_its_outputs_show_it_or_not():
    """The response of a model that flies is judged by references alone."""
    data, vehicle = flights(noise=0.4), example_vehicle()
    craft = replace(identified({}), sample_time=DT)
    direct = gb.frf(data, ["roll"], ["p"], vehicle=vehicle, model=craft).pairs["p/roll"]
    assert direct.fed_back
    said = "\n".join(direct.parts())
    assert "does not judge the model" in said and "circle at" not in said
    by_reference = gb.frf(
        data, ["roll"], ["p"], vehicle=vehicle, model=craft, references=["ref"]
    ).pairs["p/roll"]
    assert not by_reference.fed_back
    assert "circle" in "\n".join(by_reference.parts())


def test_gaps_cost_averages_and_no_honesty():
    whole, holed = (
        gb.frf(flights(gap=g), ["roll"], ["p"], vehicle=example_vehicle(), window=4.0)
        for g in (False, True)
    )
    assert holed.averages[0] < whole.averages[0] and np.isfinite(holed.pairs["p/roll"].value).all()
    assert holed.pairs["p/roll"].form is not None


def test_what_is_measured_shows_itself_and_draws_itself():
    found = gb.frf(flights(), ["roll"], ["p"], vehicle=example_vehicle(), model=linear_model())
    assert repr(found).startswith("measured: p/roll, from 120 s of 2 flight(s)")
    assert len(found._shown_rows()) == len(found.frequency)
    axes = found.plot()
    assert [a.get_xscale() for a in axes] == ["log"] * 3


REFUSED = {
    "an input that is still": ({"inputs": ["still"]}, "channel still does not move"),
    "an unknown channel": ({"inputs": ["u9"]}, "unknown channel 'u9'"),
    "a factor that is no number": ({"inputs": ["x=1.2.3*u1"]}, "channel 'x=1.2.3.u1'"),
    "no vehicle": ({"vehicle": None}, "--vehicle V.toml"),
    "one thing twice": ({"inputs": ["p"]}, "named as two things"),
    "too few references": (
        {"inputs": ["u1", "u2"], "references": ["ref"]},
        "1 reference.s. for 2 inputs",
    ),
    "a window too long": ({"window": 40.0}, "too short: 60 s"),
    "a band that is none": ({"band": (9.0, 3.0)}, "a band from 9 to 3 Hz"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_told_is_one_line(case: str) -> None:
    changes, said = REFUSED[case]
    arguments = {"inputs": ["roll"], "outputs": ["p"], "vehicle": example_vehicle(), **changes}
    with pytest.raises(GreyboxError, match=said):
        gb.frf(flights(count=1), **arguments)


def test_too_short_a_flight_is_refused_and_noise_is_not_called_a_response():
    with pytest.raises(GreyboxError, match="too short: 8 s"):
        gb.frf(flights(count=1, seconds=8.0), ["roll"], ["p"], vehicle=example_vehicle())
    rng = np.random.default_rng(0)
    noise = gb.dataset_from_arrays(
        DT * np.arange(4000), {"a": rng.standard_normal(4000), "b": rng.standard_normal(4000)}
    )
    found = gb.frf(noise, ["a"], ["b"])
    assert not found.measured and found.line == "not measured: no frequency has coherence above 0.6"


def test_a_channel_moves_by_its_own_size():
    rng = np.random.default_rng(1)
    a = rng.standard_normal(4000)
    b = np.convolve(a, [0.5, 0.3, 0.2])[:4000] + 0.1 * rng.standard_normal(4000)
    one, other = (
        gb.frf(
            gb.dataset_from_arrays(DT * np.arange(4000), {"a": 1e9 * a, "b": k * b}), ["a"], ["b"]
        )
        for k in (1.0, 1e-3)
    )
    assert one.measured
    np.testing.assert_allclose(other.pairs["b/a"].value, 1e-3 * one.pairs["b/a"].value, rtol=1e-9)


@pytest.mark.parametrize("window", [float("nan"), float("inf"), 0.0, -2.0])
def test_a_window_that_is_no_length_is_refused(window):
    with pytest.raises(GreyboxError, match="a positive number of seconds"):
        gb.frf(flights(count=1), ["roll"], ["p"], vehicle=example_vehicle(), window=window)
