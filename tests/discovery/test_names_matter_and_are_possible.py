"""A name is worth something and of a size that a craft can have; otherwise it is said to be that,
and is none."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import greybox.model.effects.gyro_bias
from greybox.data import Dataset
from greybox.discovery.cause import offer
from greybox.discovery.certificate import Certificate, Whole
from greybox.discovery.evidence import Flights
from greybox.discovery.name import (
    Name,
    held,
    judged,
    unneeded,
    untold,
    with_values_elsewhere,
)
from greybox.discovery.result import Discovery
from greybox.discovery.rules import RULES
from greybox.discovery.search import Rival
from greybox.discovery.words import with_size
from greybox.discovery.workflow import discover
from greybox.errors import ModelError, VehicleError
from greybox.estimation.result import Estimate, Fit
from greybox.validation.gap import HeldOutErrors
from greybox.validation.sanity import impossible
from greybox.validation.worth import seconds, worth
from tests.discovery import small_world

BAR, ALPHA = 6.0, 0.05


def foresight(
    level: float,
    noise: float = 0.0,
    groups: tuple[str, ...] = ("velocity", "rotation"),
    reading: float = 0.0,
) -> HeldOutErrors:
    rng = np.random.default_rng(0)
    own = {
        (g, h): [level * (1 + noise * rng.uniform(-1, 1)) * np.ones(20) for _ in range(12)]
        for g in groups
        for h in (0.0, 0.1, 0.5)
    }
    return HeldOutErrors(own=own, floor={}, reading=dict.fromkeys(groups, reading))


def certificate(**rivals: float) -> Certificate:
    found = {() if n == "nothing" else tuple(n.split("_")): e for n, e in rivals.items()}
    return Certificate(name="a", rivals=found)


def test_worth_is_the_share_of_the_squared_error_that_goes():
    found = worth(foresight(4.0), foresight(1.0), RULES.span)
    assert found.share == pytest.approx(0.75)
    assert found.matters
    assert found.seconds == 12
    assert seconds(foresight(4.0), foresight(1.0), RULES.span) == pytest.approx(np.full(12, 0.6))
    assert found.log_e > np.log(1 / ALPHA)


@pytest.mark.parametrize(("most", "said"), [(-90.0, ""), (60.0, "26.1"), (np.inf, "inf")])
def test_an_e_value_whose_fits_did_not_arrive_says_so(most: float, said: str):
    short = replace(certificate(nothing=-100.0), most=most)
    reason = judged(short, None, "", BAR, ALPHA).reason
    assert reason.startswith("log10 e -43.4 of 2.6 that a name needs")
    assert ("to arrive" in reason) is bool(said) and said in reason


def test_flights_that_show_little_of_a_name_are_said_to_be_why():
    for expected, said in ((0.5, True), (9.0, False)):
        short = replace(certificate(nothing=1.0), expected=expected)
        assert ("0.2 was to be expected" in judged(short, None, "", BAR, ALPHA).reason) is said


def test_what_is_certain_and_worth_nothing_is_a_trace():
    little = worth(foresight(1.0), foresight(1.0 - 0.5 * RULES.trace), RULES.span)
    assert not little.matters
    assert judged(certificate(nothing=80.0), little, "", BAR, ALPHA).status == "trace"


@pytest.mark.parametrize(("now", "harms"), [(1.2, True), (0.8, False)])
def test_what_makes_errors_ahead_larger_is_no_name(now: float, harms: bool):
    """A battery that emptied without a voltage was a thrust curve, and a pendulum two lever arms:
    both certified, and the position half a second ahead got twice and four times worse."""
    first = foresight(1.0, groups=("velocity",), noise=0.1)
    shown = replace(first, own={**first.own, **foresight(1.0, groups=("rate",)).own})
    later = foresight(now, groups=("velocity",), noise=0.1).own
    better = replace(first, own={**later, **foresight(0.9, groups=("rate",)).own})
    found = worth(shown, better, RULES.span)
    assert found.matters and found.harms is harms
    name = judged(certificate(nothing=80.0), found, "", BAR, ALPHA)
    assert (name.status, name.kept) == (("not certified", True) if harms else ("certified", False))
    assert ("stands for something else" in name.reason) is harms


@pytest.mark.parametrize(("reading", "status"), [(0.5, "certified"), (0.6, "trace")])
def test_a_share_of_what_no_reading_can_show_is_worth_nothing(reading: float, status: str):
    """A thrust curve of 1 % was worth 58 % where all else was exact: of next to nothing."""
    most = worth(foresight(1.0, reading=reading), foresight(0.42, reading=reading), RULES.span)
    assert most.share == pytest.approx(0.58)
    name = judged(certificate(nothing=80.0), most, "", BAR, ALPHA)
    assert name.status == status
    assert ("one reading" in name.reason) == (status == "trace")


@pytest.mark.parametrize(
    ("rivals", "better", "odd", "status"),
    [
        ({"nothing": 20.0}, 0.5, "", "certified"),
        ({"nothing": 20.0, "b": 15.0}, 0.5, "", "certified"),
        ({"nothing": 20.0, "b": 3.0}, 0.5, "", "one of these"),
        ({"nothing": 20.0}, 0.5, "no craft has more", "impossible"),
        ({"nothing": 2.0}, 0.8, "", "supported"),
        ({"nothing": 2.0}, 0.0, "", "not certified"),
    ],
)
def test_the_status_follows_from_evidence_worth_and_size(
    rivals: dict[str, float], better: float, odd: str, status: str
):
    bar = BAR if status != "supported" else 3.0  # twelve seconds of bets do not reach more
    name = judged(
        certificate(**rivals),
        worth(foresight(1.0), foresight(1.0 - better), RULES.span),
        odd,
        bar,
        ALPHA,
    )
    assert name.status == status


@pytest.mark.parametrize(("odd", "kept"), [("", True), ("no craft has more", False)])
def test_flights_that_proposed_keep_a_cause_in_the_model_and_name_none(odd: str, kept: bool):
    """A wall in gusts was one of a drag and a steady force where all flights could support a name."""
    whole = {(): Whole(odds=9.0, log_e=9.0, judge=0.5)}
    better = worth(foresight(1.0), foresight(0.5), RULES.span)
    for rivals in ({"nothing": 1.0}, {"nothing": 1.0, "b": 0.0}):
        name = judged(replace(certificate(**rivals), whole=whole), better, odd, BAR, ALPHA)
        assert (name.status, name.kept) == ("not certified", kept)
        assert "that a name needs" in name.reason


@pytest.mark.parametrize(("e", "said"), [(-2.0, False), (-20.0, True)])
def test_flights_that_judge_and_deny_what_all_together_ask_for_are_not_like_the_others(
    e: float, said: bool
):
    """A test flight in wind denied the drag of calm ones by log10 e 89; "nothing clear is left"."""
    whole = {(): Whole(odds=9.0, log_e=9.0, judge=0.5)}
    better = worth(foresight(1.0), foresight(0.5), RULES.span)
    name = judged(replace(certificate(nothing=e), whole=whole), better, "", BAR, ALPHA)
    found = Discovery(
        verdict="nothing_missing", names=(name,), bar=BAR, omega_known=True, seconds=0.0
    )
    assert ("they are not like the others" in found.line) is said


def test_names_beside_an_impossible_offset_of_a_sensor_are_doubted_first(
    monkeypatch: pytest.MonkeyPatch,
):
    """A gyro was off by 1.4 rad/s to make a trim with the rotors' spin, of five certified names."""
    small_world.shorten(monkeypatch)
    monkeypatch.setattr(greybox.model.effects.gyro_bias, "POSSIBLE", 0.05)
    off = {"p": 0.1}
    train, test = small_world.flown(), small_world.flown(seeds=(11,), name="test")
    for wrong in (False, True):
        data = [shifted(d, off) if wrong else d for d in (train, test)]
        found = discover(small_world.vehicle(), *data)
        assert found.line.startswith("DOUBTFUL, beside an impossible offset") is wrong
        assert [f.split(" = ")[0] for f in found.faults] == ["gyro_bias.b_x"] * wrong
        assert ("  fault: gyro_bias.b_x" in found.summary()) is wrong


def shifted(data: Dataset, by: dict[str, float]) -> Dataset:
    """The flights with an offset on some channels."""
    flights = tuple(
        replace(
            f,
            segments=tuple(
                s.replace({n: s.channels[n] + o for n, o in by.items()}) for s in f.segments
            ),
        )
        for f in data.flights
    )
    return Dataset(flights=flights)


def test_next_to_a_law_only_an_e_value_holds():
    better = worth(foresight(1.0), foresight(0.2), RULES.span)
    name = judged(certificate(nothing=2.0), better, "", 3.0, ALPHA)
    assert name.status == "supported"
    assert (held(name).status, held(name).kept) == ("not certified", True)


def test_a_name_says_which_rivals_its_e_value_did_not_beat():
    whole = {("b", "c"): Whole(odds=40.0, log_e=40.0, judge=0.5)}
    found = replace(certificate(nothing=20.0, b_c=-3.0), whole=whole)
    name = judged(found, worth(foresight(1.0), foresight(0.5), RULES.span), "", BAR, ALPHA)
    assert (name.status, name.certificate.log_e, name.shares) == ("certified", 20.0, {})
    assert held(name) is name
    (said,) = name.to_dict()["unlikely"]
    assert said["name"] == "b+c" and said["log10_e"] < 0 < said["log10_odds"]


def test_shares_of_a_set_are_probabilities_and_follow_the_evidence():
    name = judged(
        certificate(nothing=20.0, b=1.0, c_d=-5.0),
        worth(foresight(1.0), foresight(0.5), RULES.span),
        "",
        BAR,
        ALPHA,
    )
    assert list(name.shares) == ["a", "b", "c+d"]
    assert sum(name.shares.values()) == pytest.approx(1.0)
    assert name.shares["c+d"] > name.shares["a"] > name.shares["b"]


def set_of_two(moved: float, fit: Fit) -> Name:
    """a or b, of which b moves the damping about x to `moved`."""
    name = judged(
        certificate(nothing=20.0, b=1.0),
        worth(foresight(1.0), foresight(0.5), RULES.span),
        "",
        BAR,
        ALPHA,
    )
    known = {(n, None): e.value for n, e in fit.parameters.items()}
    known["rotational_damping.d_p", None] = moved
    fitted = SimpleNamespace(known=known)
    rivals = [Rival(instead=(), fitted=fitted), Rival(instead=("b",), fitted=fitted)]
    return with_values_elsewhere(name, fit, rivals)


def test_the_number_of_a_name_holds_what_causes_make_of_it_that_look_alike():
    """A late IMU and a late pose, or late commands and another late pose: the same readings."""
    flights = small_world.damped()
    fit = flights.settled(flights.fit({"rotational_damping"}))
    own = fit.parameters["rotational_damping.d_p"]
    beyond = own.value + 10 * own.std
    two = set_of_two(beyond, fit)
    assert two.elsewhere == {"b": {"rotational_damping.d_p": beyond}}
    sure = replace(
        judged(certificate(nothing=20.0), None, "", BAR, ALPHA), name="rotational_damping"
    )
    found = Discovery(
        verdict="named", names=(sure, two), fit=fit, bar=BAR, omega_known=False, seconds=0.0
    )
    (row,) = found.effects()
    wide = np.sqrt(own.std**2 + two.shares["b"] * (beyond - own.value) ** 2)
    assert row["parameters"]["d_p"]["std"] == pytest.approx(wide)
    assert row["parameters"]["d_q"]["std"] == fit.parameters["rotational_damping.d_q"].std
    assert f"with b: rotational_damping.d_p = {beyond:.4g}" in found.summary()


def test_a_trace_says_how_large_it_is():
    flights = small_world.damped()
    fit = flights.settled(flights.fit({"rotational_damping"}))
    little = worth(foresight(1.0), foresight(0.999), RULES.span)
    found = replace(certificate(nothing=80.0), name="rotational_damping")
    trace = with_size(judged(found, little, "", BAR, ALPHA), fit)
    own = fit.parameters["rotational_damping.d_p"]
    assert trace.status == "trace"
    assert trace.reason.startswith(f"d_p = {own.value:.2g} +- {own.std:.2g} ")
    assert "it is there" in trace.reason
    name = judged(found, None, "", BAR, ALPHA)
    assert with_size(name, fit) is name


def test_a_set_that_is_not_needed_beside_laws_is_told_without_its_like():
    flights = small_world.damped()
    fit = flights.settled(flights.fit({"rotational_damping"}))
    two = set_of_two(fit.parameters["rotational_damping.d_p"].value + 1.0, fit)
    alone = unneeded(two, certificate(nothing=1.0), BAR)
    found = Discovery(
        verdict="unnamed", names=(alone,), fit=fit, bar=BAR, omega_known=False, seconds=0.0
    )
    assert "next to the laws" in found.summary()
    assert found.numbers_of("rotational_damping")["d_p"]["std"] == pytest.approx(
        fit.parameters["rotational_damping.d_p"].std
    )


def test_numbers_that_stay_within_their_errors_are_not_told_twice():
    flights = small_world.damped()
    fit = flights.settled(flights.fit({"rotational_damping"}))
    own = fit.parameters["rotational_damping.d_p"]
    assert set_of_two(own.value + own.std, fit).elsewhere == {}


def test_a_size_that_no_craft_has_is_a_fault_of_the_data():
    flights = small_world.damped()
    found = flights.settled(flights.fit({"rotational_damping"}))
    assert impossible(found, "rotational_damping") == ""
    declared = found.model.dynamics.parameters
    for d in declared:
        if d.name == "rotational_damping.d_p":
            object.__setattr__(d, "possible", 1e-3)
    try:
        assert "fault of the data" in impossible(found, "rotational_damping")
    finally:
        for d in declared:
            object.__setattr__(d, "possible", np.inf)


def with_estimate(found: Fit, estimate: Estimate) -> Fit:
    """The fit with another estimate."""
    there = {**found.parameters, estimate.name: estimate}
    return replace(found, estimates=replace(found.estimates, parameters=there))


def test_numbers_that_are_nothing_within_their_errors_are_no_certain_name():
    """Beside a wall blades that flap the wrong way, within three errors of nothing, were certified."""
    flights = small_world.damped()
    found = flights.settled(flights.fit({"rotational_damping"}))
    sure = judged(
        replace(certificate(nothing=20.0), name="rotational_damping"), None, "", BAR, ALPHA
    )
    assert untold(sure, found) is sure
    for n, own in found.of_effect("rotational_damping").items():
        found = with_estimate(found, replace(own, std=own.value / 2, name=n))
    alone = found.correlations * np.eye(len(found.correlations))
    apart = replace(found, estimates=replace(found.estimates, correlations=alone))
    assert not apart.feels("rotational_damping")
    assert apart.tells("rotational_damping"), "three of two errors each are more than three of one"
    one = replace(found["rotational_damping.d_p"], value=0.0, std=1.0)
    for n in found.of_effect("rotational_damping"):
        apart = with_estimate(apart, replace(one, name=n, value=1.0))
    name = untold(sure, apart)
    assert (name.status, name.kept) == ("not certified", True)
    assert "no number of it is clear" in name.reason
    trace = replace(sure, status="trace")
    assert untold(trace, apart) is trace


def test_a_sum_that_is_told_is_felt_where_neither_part_is():
    flights = small_world.damped()
    found = flights.settled(flights.fit({"rotational_damping"}))
    names = list(found.of_effect("rotational_damping"))
    for n in names:
        found = with_estimate(found, replace(found[n], value=1.0, std=1.0))
    alike = np.full((3, 3), -0.49) + 1.49 * np.eye(3)
    there = [found.correlation_names.index(n) for n in names]
    whole = np.eye(len(found.correlations))
    whole[np.ix_(there, there)] = alike
    found = replace(found, estimates=replace(found.estimates, correlations=whole))
    assert not found.feels("rotational_damping")
    assert found.tells("rotational_damping")


def test_an_estimate_at_a_bound_is_felt_unless_that_is_its_null():
    flights = small_world.damped()
    found = flights.settled(flights.fit({"rotational_damping"}))
    for n, own in found.of_effect("rotational_damping").items():
        found = with_estimate(found, replace(own, value=0.0, std=1.0, name=n))
    at_bound = replace(found["rotational_damping.d_p"], std=np.nan, at_bound=True)
    assert not with_estimate(found, at_bound).feels("rotational_damping")
    assert with_estimate(found, replace(at_bound, value=1.0)).feels("rotational_damping")
    each = {"a": (0.1, 1.0), "b": (4.0, 1.0)}
    assert with_estimate(found, replace(at_bound, per_flight=each)).feels("rotational_damping")


@pytest.mark.parametrize(
    ("size", "why"), [(0.2, ""), (-0.4, "fault of the data"), (-0.5, "fault of the data")]
)
def test_an_accelerometer_that_is_off_by_half_is_no_property_of_a_craft(size: float, why: str):
    """-0.5 was the bound at which a real nano quadrotor had its name."""
    with pytest.MonkeyPatch.context() as patch:
        small_world.shorten(patch, "accelerometer_scale")
        data = small_world.flown()
        flights = Flights(
            causes=offer(small_world.vehicle(), data.channels, sample_time=0.01), data=data
        )
    found = flights.settled(flights.fit({"accelerometer_scale"}))
    scale = found["accelerometer_scale.s_x"]
    said = impossible(with_estimate(found, replace(scale, value=size)), "accelerometer_scale")
    assert why in said and bool(said) == bool(why)


def test_what_is_neither_a_vehicle_nor_a_model_is_refused_in_one_line() -> None:
    with pytest.raises(ModelError, match=r"takes a vehicle, .* or a StateSpaceModel; got 42"):
        discover(42, Dataset(flights=()))  # type: ignore[arg-type]
    with pytest.raises(VehicleError, match="craft: no such vehicle file"):
        discover("craft", Dataset(flights=()))  # type: ignore[arg-type]
