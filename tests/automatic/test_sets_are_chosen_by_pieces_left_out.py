"""Of the sets that predict pieces left out as well as any the likelihood chooses; thrust per flight
where flights differ."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import greybox as gb
from greybox.automatic.decide import Decided, decide
from greybox.automatic.facts import facts_of
from greybox.automatic.fit import prepare
from greybox.automatic.foretell import Score, foretell
from greybox.automatic.sets import Step, names_of, nested_sets
from greybox.automatic.setting import Given
from greybox.automatic.trials import Candidate, likeliest_of_the_good, plainer
from greybox.data import Dataset, Flight
from greybox.estimation.recipe import Decision
from tests import simulated
from tests.automatic.craft import flight, flights, flown, vehicle

BASE = ("motor_lag", "command_delay", "gyro_bias")


def decided(data: Dataset) -> Decided:
    ready = prepare(vehicle(), data)
    return decide(vehicle(), ready.data, facts_of(ready.data, vehicle(), ready.report), Given())


def of(found: Decided, about: str) -> Decision:
    (one,) = [d for d in found.decisions if d.about == about]
    return one


@pytest.fixture(scope="module")
def plain() -> Decided:
    return decided(flights())


def test_without_the_effects_of_the_larger_sets_the_base_set_is_taken(plain):
    assert plain.recipe.effect_names == BASE
    assert "as well as the best" in of(plain, "effects").reason


def test_with_them_the_larger_set_is_taken():
    found = decided(flights(damping=1e-4))
    assert set(found.recipe.effect_names) == {*BASE, "rotational_damping"}


def test_flights_that_agree_share_one_thrust_scale(plain):
    assert of(plain, "thrust scale").choice == "one value for all flights"
    assert "another craft" not in of(plain, "thrust scale").reason
    assert "thrust.c2" not in plain.recipe.options.per_flight


def test_flights_that_differ_get_one_each():
    first, second = (dict(c) for c in flown())
    weaker = {
        f"u{i}": second[f"u{i}"] * 1.05 for i in range(1, 5)
    }  # the same motion took more command
    data = Dataset(flights=(*flight(first, "run0"), *flight(second | weaker, "run1")))
    found = decided(data)
    assert found.recipe.options.per_flight == ("thrust.c2",)
    assert of(found, "thrust scale").choice == "one value per flight"
    assert of(found, "thrust scale").reason.endswith("a battery, a load or another craft")
    assert found.candidate is not None
    each = found.candidate.fit["thrust.c2"].per_flight
    assert each["run1"][0] / each["run0"][0] == pytest.approx(1 / 1.05**2, rel=0.01)


def test_scores_are_compared_block_by_block():
    rough = np.array([1.0, 50.0, 2.0, 40.0])
    better, worse = Score(blocks=rough), Score(blocks=rough + np.array([0.1, 0.12, 0.08, 0.1]))
    gain, error = better.better_by(worse)
    assert gain == pytest.approx(0.1)
    assert error < 0.01, "a rough piece counts against neither"
    one = Score(blocks=rough[:1])
    assert one.better_by(one)[1] == np.inf, "of a single block nobody knows how much it scatters"


def candidate(name: str, score: float, bic: float) -> Candidate:
    """One that foretells every piece alike."""
    fitted = SimpleNamespace(bic=bic)
    blocks = np.array([1.0, 1.1, 0.9, 1.0]) * score
    return Candidate(
        steps=(Step(name=name, effects=()),),
        likelihood=fitted,  # type: ignore[arg-type]  # its BIC is all that is asked
        likelihood_score=Score(blocks=blocks),
    )


def test_among_those_that_foretell_alike_the_likelihood_chooses():
    small, large = candidate("small", 0.102, 50.0), candidate("large", 0.1, 0.0)
    poor = candidate("poor", 0.2, -900.0)
    assert likeliest_of_the_good([small, large, poor]) is large
    assert (
        likeliest_of_the_good([replace(small, likelihood=SimpleNamespace(bic=-20.0)), large]).name
        == "small"
    )


@pytest.mark.parametrize(
    ("bic", "error", "kept"), [(133.0, 0.0022, False), (-9.0, 0.0022, True), (-9.0, 0.0020, False)]
)
def test_what_nothing_feels_stays_where_likelihood_and_pieces_left_out_both_ask_for_it(
    bic: float, error: float, kept: bool
):
    """Luck on a few pieces kept nine effects that were not there; BIC alone kept two on real
    flights, with which others were foretold a fifth worse."""
    chosen, less = candidate("chosen", 0.0020, bic), candidate("less", error, 0.0)
    assert plainer(chosen, less).name == ("chosen" if kept else "less")


def test_inflow_is_offered_where_something_shows_the_climb():
    seen = facts_of(flights(), vehicle(), prepare(vehicle(), flights()).report)
    offered = {n for s in nested_sets(vehicle(), seen) for n in names_of(s)}
    assert "axial_inflow" not in offered
    placed = replace(seen, sensors=seen.sensors | {"position"})
    assert "axial_inflow" in {n for s in nested_sets(vehicle(), placed) for n in names_of(s)}


@pytest.mark.slow
def test_a_channel_that_is_never_seen_where_it_is_foretold_is_left_out_quietly():
    """A position every fifth row, as its origins are: none is seen 0.1 or 0.5 s after one."""
    data = simulated.flights(1, 4.0)
    model = gb.fit(
        gb.build_model(simulated.vehicle(), data.channels, ("motor_lag",)), data, use_compiler=False
    ).model
    rare = np.arange(data.flights[0].segments[0].n) % 5 == 3

    def slower(f: Flight) -> Flight:
        (s,) = f.segments
        thin = {
            k: np.where(rare[: s.n], v, np.nan) if k in "xyz" else v for k, v in s.channels.items()
        }
        return replace(f, segments=(replace(s, channels=thin),))

    thinned = Dataset(flights=tuple(map(slower, data.flights)))
    scores = [foretell(model, d, use_compiler=False).blocks for d in (data, thinned)]
    assert np.isfinite(scores).all()
    assert scores[0].size == scores[1].size > 0
