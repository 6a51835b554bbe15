"""One vehicle file serves all flights of a command: what one of them proves wrong in it blocks those
that cannot tell, be they to train or to test, unless a flight shows it right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest

import greybox as gb
from greybox.cli import main
from greybox.data.checks import Checked, check
from greybox.data.checks.craft import of_the_craft
from greybox.data.checks.finding import Finding, Severity, Unjudged
from greybox.examples import flight_path, vehicle_path
from greybox.model.faults import BadDataError
from greybox.model.vehicle import Vehicle
from tests.data.faults import real, vehicle

SET = "nanobench"
VAGUE, CLEAR = "B7_oval_medium_rep2", "B5_helix_medium_rep2"
PLACE = "spin of the rotors"


def reversed_spins() -> Vehicle:
    own = vehicle(SET)
    return replace(own, rotors=tuple(replace(r, spin=-r.spin) for r in own.rotors))


def test_a_flight_that_shows_the_spins_poorly_is_told_what_another_proves() -> None:
    wrong = reversed_spins()
    assert check([real(SET, VAGUE)], wrong).ok
    report = check([real(SET, f) for f in (VAGUE, CLEAR)], wrong)
    assert {f.flight for f in report.blocking} == {VAGUE, CLEAR}
    told = next(f for f in report.blocking if f.flight == VAGUE)
    assert f"the wrong way round (by {CLEAR}; this flight does not tell)" in told.message
    assert [f.severity for f in report.of("motors", VAGUE)] == ["blocking"]


def test_a_test_flight_proves_it_for_the_training_flight() -> None:
    log = replace(real(SET, CLEAR), flight=VAGUE)  # as files of one name in two folders are
    own, beside = (Checked.of([r], reversed_spins()) for r in (real(SET, VAGUE), log))
    report = own.report(beside=beside)
    assert [(f.flight, f.check) for f in report.blocking] == [(VAGUE, "motors")]
    assert {f.name for f in report.flights} == {VAGUE}


def test_fit_refuses_it_from_python_and_by_the_command(tmp_path, capsys) -> None:
    train, test = (gb.read_logs([flight_path(SET, f)], vehicle(SET)) for f in (VAGUE, CLEAR))
    with pytest.raises(BadDataError, match=f"{VAGUE}: .*wrong way round .by {CLEAR}"):
        gb.fit(reversed_spins(), train, test=test)
    text = vehicle_path(SET).read_text()
    swapped = text.replace("spin = 1", "spin = 9").replace("spin = -1", "spin = 1")
    file = tmp_path / "v.toml"
    file.write_text(swapped.replace("spin = 9", "spin = -1"))
    logs = ["--train", str(flight_path(SET, VAGUE)), "--test", str(flight_path(SET, CLEAR))]
    assert main(["fit", "--vehicle", str(file), *logs, "--out", str(tmp_path / "out")]) == 1
    assert "BAD DATA" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()


def found(flight: str, severity: Severity = "blocking", kind: str = "motors") -> Finding:
    return Finding(check=kind, severity=severity, flight=flight, where=PLACE, message="wrong")


def left(flight: str, part: str = "", *, open: bool = True) -> Unjudged:
    return Unjudged(check="motors", flight=flight, reason="calm", part=part, open=open)


def blocked(told: Sequence[Finding]) -> list[str]:
    return [f.flight for f in told if f.severity == "blocking"]


def test_a_flight_that_shows_it_right_keeps_the_fault_with_its_log() -> None:
    assert blocked(of_the_craft([found("a")], [left("b")], "ab")) == ["a", "b"]
    assert blocked(of_the_craft([found("a")], [left("b")], "abc")) == ["a"]
    # Open is another question than the one that is answered.
    assert blocked(of_the_craft([found("a")], [left("b", "strength")], "ab")) == ["a"]
    assert blocked(of_the_craft([found("a")], [left("b", "spins")], "ab")) == ["a", "b"]


def test_a_flight_that_has_not_what_is_wrong_is_told_nothing() -> None:
    assert blocked(of_the_craft([found("a")], [left("b", open=False)], "ab")) == ["a"]


def test_a_doubt_becomes_the_fault_that_explains_it() -> None:
    told = of_the_craft([found("a"), found("b", "warning")], [], "ab")
    assert [(f.flight, f.severity) for f in told] == [("a", "blocking"), ("b", "blocking")]


def test_what_is_of_one_log_is_told_to_no_other() -> None:
    open_ = [replace(left("b"), check="alignment")]
    assert blocked(of_the_craft([found("a", kind="alignment")], open_, "ab")) == ["a"]


def test_flights_that_contradict_each_other_prove_nothing_of_the_file() -> None:
    mirrored = replace(found("a"), message="x and y are mirrored")
    for said, told in (("turned by 90 deg", "ab"), ("x and y are mirrored", "abc")):
        other = replace(found("b"), message=said)
        assert blocked(of_the_craft([mirrored, other], [left("c")], "abc")) == list(told)
    some = [
        replace(found(n), message=f"turned by {d} deg; of 3") for n, d in (("a", 89), ("b", 91.5))
    ]
    assert blocked(of_the_craft(some, [left("c")], "abc")) == ["a", "b", "c"]


def test_a_flight_of_which_the_same_check_warns_shows_nothing_right() -> None:
    open_ = [replace(left("c"), check="motion")]
    doubt = replace(found("b", "warning", "motion"), where="elsewhere")
    assert blocked(of_the_craft([found("a", kind="motion"), doubt], open_, "abc")) == ["a", "c"]
    assert blocked(of_the_craft([found("a", kind="motion")], open_, "abc")) == ["a"]
