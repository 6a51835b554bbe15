"""A blocking finding can be accepted by the name of its check: it no longer blocks, and the result
keeps it."""

from __future__ import annotations

import pytest

from greybox.data.checks import NAMES, check
from greybox.errors import UnknownNameError
from tests.data.faults import exchanged, frozen, real, vehicle

SET, FLIGHT = "nanobench", "B2_circle_medium_rep1"


def test_what_is_accepted_does_not_block_and_is_recorded() -> None:
    raw = frozen(exchanged(real(SET, FLIGHT), "u1", "u2"), "x y z", 800, 1400)
    blocked = check([raw], vehicle(SET))
    assert {f.check for f in blocked.blocking} >= {"motors", "frozen"}
    report = check([raw], vehicle(SET), accept=sorted({f.check for f in blocked.blocking}))
    assert report.ok
    assert report.verdict == "warnings"
    assert {f.check for f in report.overruled} == set(report.to_dict()["accepted"])
    assert "accepted B2_circle_medium_rep1 [motors]" in report.summary()
    assert "accepted all the same: " in report.summary()


def test_only_the_checks_that_are_named_are_accepted() -> None:
    raw = frozen(exchanged(real(SET, FLIGHT), "u1", "u2"), "x y z", 800, 1400)
    assert {f.check for f in check([raw], vehicle(SET), accept=["motors"]).blocking} >= {"frozen"}


def test_a_check_that_there_is_not_is_said() -> None:
    assert {"frozen", "motors", "motion", "attitude", "acceleration"} <= set(NAMES)
    with pytest.raises(UnknownNameError, match="frozen"):
        check([], vehicle(SET), accept=["frozn"])
