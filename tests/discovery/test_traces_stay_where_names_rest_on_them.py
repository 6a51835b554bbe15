"""A cause that is worth nothing beside the others leaves the model; where what is said rests on it,
it stays: a name that was judged beside it, or a number of the craft, would take up its numbers."""

from __future__ import annotations

import functools
from dataclasses import replace
from types import SimpleNamespace

import pytest

from greybox.discovery.evidence import Fitted
from greybox.discovery.rules import RULES
from greybox.discovery.words import moved_names, stays
from greybox.discovery.workflow import _Run
from greybox.estimation.result import Fit
from greybox.validation.worth import worth
from tests.discovery import small_world
from tests.discovery.test_names_matter_and_are_possible import (
    ALPHA,
    BAR,
    certificate,
    foresight,
    judged,
)


def names_of_two(damping: str = "certified", ahead: float = 0.999):
    """A name and a trace with which errors are `ahead` times as large."""
    good, little = (worth(foresight(1.0), foresight(v), RULES.span) for v in (0.5, ahead))
    name = judged(
        replace(certificate(nothing=80.0), name="rotational_damping"), good, "", BAR, ALPHA
    )
    trace = judged(replace(certificate(nothing=80.0), name="gyro_bias"), little, "", BAR, ALPHA)
    assert (name.status, trace.status) == ("certified", "trace")
    return [replace(name, status=damping), trace]


def test_a_name_that_moves_without_the_trace_is_told():
    flights = small_world.damped()
    whole = flights.fit({"rotational_damping"})
    fit = flights.settled(whole)
    own = fit.parameters["rotational_damping.d_p"]
    there = whole.space.unknowns
    at = [u.name for u in there].index("rotational_damping.d_p")
    for moved, told in ((10 * own.std, ["rotational_damping.d_p"]), (own.std, [])):
        theta = whole.theta.copy()
        theta[at] = own.value + moved
        bare = replace(whole, theta=theta)
        assert moved_names(names_of_two(), fit, bare) == told
        assert moved_names(names_of_two("not certified"), fit, bare) == []


def test_a_number_of_the_craft_that_moves_without_the_trace_is_told():
    """A pose that is 8 ms late was a trace; without it the motor lag was 47.3 +- .1 ms for 40."""
    flights = small_world.damped()
    whole = flights.fit({"rotational_damping"})
    fit = flights.settled(whole)
    at = [u.name for u in whole.space.unknowns].index("inertia.xx")
    for moved, told in ((4.0, ["inertia.xx"]), (2.0, [])):
        theta = whole.theta.copy()
        theta[at] += moved * fit.parameters["inertia.xx"].std
        assert moved_names(names_of_two(), fit, replace(whole, theta=theta)) == told


def test_it_stays_in_the_model_without_a_name_and_says_why():
    _, trace = names_of_two()
    kept = stays(trace, ["rotational_damping.d_p"])
    assert (kept.status, kept.kept) == ("trace", True)
    assert kept.reason.endswith(
        "in the model: without it other numbers move (rotational_damping.d_p)"
    )


@functools.cache
def with_and_without() -> tuple[Fitted, Fit, Fitted]:
    """A model with the trace, its fit, and the model without it."""
    flights = small_world.damped()
    whole = flights.fit({"rotational_damping", "gyro_bias"})
    return whole, flights.settled(whole), flights.fit({"rotational_damping"})


@pytest.mark.parametrize("asked", [False, True])
@pytest.mark.parametrize("ahead", [0.999, 1.001])
@pytest.mark.parametrize(
    ("moved", "grown"), [(10.0, 0.0), (0.0, 0.1), (0.0, 0.0), (10.0, -0.1), (0.0, -0.1)]
)
def test_a_trace_leaves_only_where_nothing_that_is_said_rests_on_it_or_errors_show_harm(
    moved: float, grown: float, ahead: float, asked: bool
):
    whole, fit, bare = with_and_without()
    place = [u.name for u in bare.space.unknowns].index("rotational_damping.d_p")
    own, theta = fit.parameters["rotational_damping.d_p"], bare.theta.copy()
    theta[place] = own.value + moved * own.std
    told = {whole.structure: whole, bare.structure: replace(bare, theta=theta)}
    run = SimpleNamespace(
        options=SimpleNamespace(trace=asked),
        flights=SimpleNamespace(
            fit=lambda structure, _starts: told[frozenset(structure)],
            causes=small_world.damped().causes,
        ),
        held_out=lambda at: foresight(1.0 + grown * (at.structure == bare.structure)),
        settled=lambda _at: fit,
        warnings=[],
    )
    run._worth = functools.partial(_Run._worth, run)
    names, at = _Run._without_traces(run, names_of_two(ahead=ahead), whole)
    stay = asked or grown > 0 or (moved > 0 and grown == 0)
    assert at.structure == (whole if stay else bare).structure
    assert names[1].kept is stay and names[1].status == "trace"
    moved_away = moved > 0 and not stay
    assert [w.partition(" (")[0] for w in run.warnings] == [
        "rotational_damping.d_p is elsewhere without gyro_bias"
    ][: int(moved_away)]


def test_a_name_that_runs_to_a_bound_without_what_left_is_none():
    """Without a lag that had run to a bound itself, a thrust curve was certified at .99 of 1."""
    whole, fit, bare = with_and_without()
    own = replace(fit["rotational_damping.d_p"], at_bound=True)
    there = {**fit.parameters, own.name: own}
    stuck = replace(fit, estimates=replace(fit.estimates, parameters=there))
    alone = small_world.damped().fit(frozenset())
    told = {bare.structure: bare, alone.structure: alone}
    run = SimpleNamespace(
        options=SimpleNamespace(trace=False),
        flights=SimpleNamespace(fit=lambda structure, _starts: told[frozenset(structure)]),
        settled=lambda at: stuck if at is bare else fit,
    )
    run._without_traces = functools.partial(_Run._without_traces, run)
    name, trace = names_of_two()
    names, at = run._without_traces([name, replace(trace, status="not certified")], whole)
    assert names[0].status == "impossible" and "ran to a bound" in names[0].reason
    assert at is alone
