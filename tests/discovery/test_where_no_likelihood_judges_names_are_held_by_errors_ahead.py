"""Where the likelihood bends a model, a name is supported at best: by what it is worth to errors
ahead. A law that explains what is left comes first."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import greybox.discovery.workflow
from greybox.automatic.held_ahead import HeldAhead
from greybox.discovery.document import DiscoveryDocument
from greybox.discovery.further import further
from greybox.discovery.left import Left
from greybox.discovery.name import by_errors_ahead
from greybox.discovery.result import Discovery
from greybox.discovery.workflow import _Run
from greybox.model.known import NOTHING, Known
from greybox.validation.gap import GapRow, HeldOutErrors
from greybox.validation.judges import Judges
from greybox.validation.sanity import impossible
from greybox.validation.worth import Worth
from tests.discovery import small_world

BAR, DAMPING = 6.4, "rotational_damping"
GOOD = Worth(share=0.9, seen=True, group="rate", horizon=0.5, log_e=7.0, seconds=30)


@pytest.mark.parametrize(
    ("worth", "kept", "status", "says"),
    [
        (GOOD, True, "supported", ""),
        (
            replace(GOOD, log_e=4.0),
            True,
            "not certified",
            "90.0% of errors ahead at most, log10 e 1.7 of 2.8",
        ),
        (replace(GOOD, share=0.01), True, "not certified", "removes 1.0% of errors ahead at most"),
        (replace(GOOD, log_e=-1.0, harms=True), True, "not certified", "they grow with it"),
        (None, True, "not certified", "no fit ends without it"),
        (None, False, "not certified", "flights do without it"),
    ],
)
def test_what_errors_ahead_say_of_a_name(worth, kept, status, says):
    name = by_errors_ahead("rotor_drag", race(worth, kept), "", BAR)
    assert name.status == status
    assert says in name.reason
    assert bool(name.reason) == (status != "supported")
    assert name.kept == (kept and status != "supported")


def race(worth: Worth | None, kept: bool = True, *crowded: str) -> Any:
    there = SimpleNamespace(model=SimpleNamespace(effects=("rotor_drag",) if kept else ()))
    made = {"fit": there, "worth": {"rotor_drag": worth}, "crowded_out": frozenset(crowded)}
    return HeldAhead(**made)  # type: ignore[arg-type]


def test_what_no_craft_has_is_no_name_and_what_had_no_room_is_not_idle():
    odd = by_errors_ahead("rotor_drag", race(GOOD), "of a size that no craft has", BAR)
    assert (odd.status, odd.reason, odd.kept) == ("impossible", "of a size that no craft has", True)
    full = by_errors_ahead("rotor_drag", race(GOOD, False, "rotor_drag"), "", BAR)
    assert (full.status, full.kept) == ("not certified", False)
    assert "--max-effects" in full.reason and full.certificate.log_e == GOOD.log_e


def test_a_size_that_ran_to_its_bound_is_impossible():
    flights = small_world.damped()
    found = flights.settled(flights.fit({"rotational_damping"}))
    assert impossible(found, "rotational_damping") == ""
    damping = found["rotational_damping.d_p"]
    there = {**found.parameters, damping.name: replace(damping, value=9.0, at_bound=True)}
    stuck = replace(found, estimates=replace(found.estimates, parameters=there))
    assert "d_p ran to a bound" in impossible(stuck, "rotational_damping")


@dataclass(frozen=True)
class Of:
    structure: frozenset[str]


NULL = Of(frozenset())
LAST, NAMED, LAWS = Of(frozenset({"lag", "drag"})), Of(frozenset({"lag"})), Of(frozenset({"law"}))


@pytest.fixture
def answered(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """(names by name, the structure, what is left) of a search that ended at LAST and named NAMED,
    of which those that are `bent` are; `lawful`: laws were found, `mended`: they mend that."""
    worths = {"lag": GOOD, "drag": GOOD}
    found = SimpleNamespace(fit="by errors ahead", worth=worths, crowded_out=())
    found.held = lambda name: name == "lag"
    monkeypatch.setattr(greybox.discovery.workflow, "held_ahead", lambda *_, **_said: found)
    monkeypatch.setattr(greybox.discovery.workflow, "impossible", lambda *_: "")
    monkeypatch.setattr(greybox.discovery.workflow, "physics_of", lambda _: "physics")
    by_likelihood = [by_errors_ahead(n, found, "", BAR) for n in ("lag", "drag")]  # type: ignore[arg-type]

    unfitted: list[str] = []

    def answer(
        *bent: Any,
        lawful: bool = False,
        mended: bool = False,
        then: Any = None,
        harms: bool = False,
    ) -> Any:
        searched = []

        def searches(at: Any) -> Any:
            at = LAST if at is NULL else at
            searched.append(getattr(search, "hopeless", run._hopeless)(at, 1))
            return at

        run: Any = SimpleNamespace(
            null=NULL,
            then=then,
            warnings=[],
            bar=BAR,
            ahead=False,
            unchanged="",
            judges=None,
            options=SimpleNamespace(fixed=(), per_flight=(), max_effects=2, known=NOTHING),
            unfitted=unfitted,
            held_out=lambda at: (at, "ahead" if run.ahead else "by likelihood"),
            bent=lambda at, laws=None: at in bent and not (laws and mended),
            flights=SimpleNamespace(
                causes=SimpleNamespace(built=frozenset), data=None, arrived=lambda at: at
            ),
            say=lambda *_: None,
            settled=lambda _: SimpleNamespace(model=SimpleNamespace(dynamics=None)),
            _settled={},
            _left=lambda *_: Left(axes=(), written=LAWS if lawful else None),
            _rest=lambda _: Left(axes=()),
            _worth=lambda *_: replace(GOOD, harms=harms),
            _named=lambda *_: (by_likelihood, NAMED),
            _keep=lambda *_: None,
            _beside_laws=lambda names, at, _laws: (names, at),
        )
        run._by_errors_ahead = functools.partial(_Run._by_errors_ahead, run)
        run._hopeless = functools.partial(_Run._hopeless, run)
        search: Any = SimpleNamespace(
            run=searches,
            taken={"lag", "drag"},
            named=lambda names: sorted(names, reverse=True),
            added=lambda at: sorted(at.structure, reverse=True),
            contest=lambda _: {},
            every=lambda _: None,
            crowded_out=lambda _: [],
        )
        names, at, left = _Run._answer(run, search)
        assert run.ahead == bool(run._settled) or run.unchanged
        twice = LAST in bent and (mended or not run.ahead)
        assert then or searched == ([True, False] if twice else [LAST in bent])
        return {n.name: n.status for n in names}, at, left.written, run.ahead

    answer.unfitted = lambda: unfitted  # type: ignore[attr-defined]
    return answer


def test_errors_ahead_judge_what_was_found_or_what_was_named_where_it_is_bent(answered):
    said = {"lag": "supported", "drag": "not certified"}
    assert answered() == (said, NAMED, None, False)
    assert answered(LAST, NAMED) == (said, LAST, None, True)
    assert answered(NAMED) == (said, NAMED, None, True), "traces have left it"


def test_a_model_without_a_name_that_foretells_worse_than_the_base_is_not_kept(
    answered, monkeypatch
):
    """Ideal flights of a simulator, nothing missing: a scale of the accelerometer was left in the
    model, with which positions .5 s ahead erred by 15 mm, 4 without."""
    assert answered(LAST, NAMED, harms=True)[1] == LAST, "one has a name"
    doubted = by_errors_ahead("rotor_drag", race(None), "", BAR)
    monkeypatch.setattr(greybox.discovery.workflow, "by_errors_ahead", lambda *_: doubted)
    assert answered(LAST, NAMED)[1] == LAST
    assert answered(LAST, NAMED, harms=True)[1:] == (NULL, None, True)


class Then:
    """A model of then, of which the errors of now say `line`; what it was asked."""

    def __init__(self, line: str = "") -> None:
        self.line = line
        self.asked: list[Any] = []

    def beats(self, *_: Any) -> bool:
        return False

    def unchanged(self, new: Any, added: Any, span: Any) -> str:
        self.asked.append(new)
        return self.line


def test_what_has_changed_is_asked_of_a_model_that_was_fitted_by_errors_ahead(answered):
    """One that the likelihood bends foretells badly whatever has changed."""
    then, said = Then(), {"lag": "supported", "drag": "not certified"}
    assert answered(LAST, then=then) == (said, LAST, None, True)
    assert then.asked == [(LAST, "ahead")]
    straight = Then()
    assert answered(then=straight)[3] is False
    assert straight.asked == [(LAST, "by likelihood")]


def test_where_nothing_has_changed_nothing_is_named_by_errors_ahead(answered):
    names, at, _, ahead = answered(LAST, then=Then("NOTHING HAS CHANGED"))
    assert (names, at, ahead) == ({}, NULL, False)


def test_where_errors_ahead_fit_nothing_that_is_said(answered, monkeypatch):
    def none(*_: Any, unable: Callable[[str], None], **_said: Any) -> None:
        unable("nothing can be fitted")

    monkeypatch.setattr(greybox.discovery.workflow, "held_ahead", none)
    assert answered(LAST, NAMED)[3] is False
    assert answered.unfitted() == ["nothing can be fitted"] * 2


@pytest.fixture
def asked(monkeypatch) -> list[Any]:
    """What `is_bent` was given, which says no."""
    given: list[Any] = []
    monkeypatch.setattr(
        greybox.discovery.workflow, "is_bent", lambda *said: given.append(said) or False
    )
    monkeypatch.setattr(greybox.discovery.workflow, "physics_of", lambda _: "physics")
    return given


def on_flights(*rows: GapRow, known: Known = NOTHING, bare: float = 1.0) -> Any:
    """A search of which a structure leaves these errors on the flights that judge, after those of
    the base, and itself without a lag `bare` times the squared errors."""
    lag = SimpleNamespace(name="lag.tau", null=0.0, lower=1e-3, upper=1.0)
    dynamics: Any = SimpleNamespace(parameters=[lag, SimpleNamespace(name="mass", null=None)])
    model = SimpleNamespace(dynamics=dynamics, with_values=str)
    seconds = np.random.default_rng(0).uniform(0.9, 1.1, 20)

    def errors(of: Any) -> HeldOutErrors:
        ratio = bare if of == "{'lag.tau': 0.001}" else 1.0
        return HeldOutErrors(
            own={("rate", 0.5): [np.array([ratio * s]) for s in seconds]}, floor={}
        )

    judges: Any = SimpleNamespace(
        rows=lambda old, _: rows if old == "of the base" else (), errors=errors
    )
    judges.oppose = functools.partial(Judges.oppose, judges)
    run: Any = SimpleNamespace(
        _bent={},
        null=NULL,
        then=SimpleNamespace(errors="of then"),
        held_out=lambda at: "of the base" if at is NULL else None,
        settled=lambda _: SimpleNamespace(model=model),
        options=SimpleNamespace(known=known),
        flights=SimpleNamespace(data=None),
        judges=judges,
        unfitted=[],
    )
    run._opposed = functools.partial(_Run._opposed, run)
    return run


def test_what_was_known_before_is_handed_to_whoever_asks_errors_ahead(asked):
    known = Known(prior={"mass": (1.0, 0.1)})
    run = on_flights(known=known)
    assert not _Run.bent(run, LAST) and not _Run.bent(run, LAST)  # type: ignore[arg-type]
    assert len(asked) == 1 and asked[0][-2] is known


def test_names_that_what_has_no_name_stands_against_are_not_for_the_likelihood_to_judge(asked):
    """Beside a wall a wind, a force and a flapping were certified, with which positions erred by a
    third more; the force without a name that the filter sees took that back. More than the base,
    which takes their place: not than the model of then, than which both may be worse."""
    row = GapRow(
        group="velocity",
        unit="m/s",
        horizon_s=0.1,
        before=0.057,
        after=0.082,
        floor=0.03,
        closed=-1.1,
        ci95=(-1.6, -0.7),
        filtered=0.05,
    )
    for one, opposed in ((row, True), (replace(row, filtered=0.07), False)):
        assert _Run.bent(on_flights(one, bare=0.5), LAST) is opposed  # type: ignore[arg-type]
    assert len(asked) == 1


def test_commands_that_answer_gusts_are_nothing_that_stands_against_a_name(asked):
    """Gusts of torque under feedback: a craft with two delays, which both were right, foretold rates
    1 s ahead a third worse than one without, which turned less at each command. At the same
    numbers it foretells no worse with its delays than without, all in all."""
    row = GapRow(
        group="rate",
        unit="rad/s",
        horizon_s=1.0,
        before=2.22,
        after=2.89,
        floor=None,
        closed=-0.7,
        ci95=(-0.84, -0.53),
        filtered=1.75,
    )
    for bare in (0.99, 1.0, 2.0):
        assert not _Run.bent(on_flights(row, bare=bare), LAST)  # type: ignore[arg-type]
    assert _Run.bent(on_flights(row, bare=0.5), LAST)  # type: ignore[arg-type]
    assert len(asked) == 3


def test_laws_that_foretell_as_well_come_first(answered):
    assert answered(LAST, NAMED, lawful=True, mended=True)[2:] == (LAWS, False)
    assert answered(LAST, NAMED, lawful=True)[2:] == (None, True)


def test_the_line_says_so_and_no_further_flight_multiplies_it():
    flights = small_world.damped()
    fit = flights.settled(flights.fit({"rotational_damping"}))
    found = Discovery(
        verdict="named",
        names=(replace(by_errors_ahead("rotor_drag", race(GOOD), "", BAR), name=DAMPING),),
        fit=fit,
        omega_known=True,
        seconds=1.0,
        ahead=True,
    )
    assert found.line.startswith("BY ERRORS AHEAD, as likelihood is no judge here: MISSING: rot")
    content: DiscoveryDocument = found.to_dict()
    assert content["by_errors_ahead"] is True
    with pytest.raises(ValueError, match="none has an e-value by likelihood"):
        further(content, fit.model, small_world.flown(seeds=(21,), name="more"))
