"""What did not converge is said: of the fit without any addition, and of the last one."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from greybox.discovery.workflow import _unfinished
from greybox.estimation.status import Code, Status


def ended(code: Code) -> Any:
    status = Status(code=code, iterations=60, evaluations=61, decrement=1.0)
    return SimpleNamespace(status=status, converged=status.converged)


def last(code: Code, *effects: str) -> Any:
    return SimpleNamespace(fit=ended(code), effects=effects)


def test_what_converged_needs_no_words() -> None:
    assert _unfinished(ended(Code.CONVERGED), last(Code.CONVERGED, "rotor_drag")) == []


def test_the_fit_without_any_addition_may_stop_early_where_much_is_missing() -> None:
    (said,) = _unfinished(ended(Code.MAX_ITERATIONS), last(Code.CONVERGED, "pose_delay"))
    assert "without any addition stopped after 60 iterations" in said


def test_where_nothing_was_added_it_is_the_last_fit() -> None:
    null = ended(Code.MAX_ITERATIONS)
    assert _unfinished(null, SimpleNamespace(fit=null, effects=())) == [f"the last fit: {null.status.advice}"]  # type: ignore[arg-type]


@pytest.mark.parametrize("code", [c for c in Code if c is not Code.CONVERGED])
def test_a_last_fit_that_did_not_converge_is_never_silent(code: Code) -> None:
    (said,) = _unfinished(ended(Code.CONVERGED), last(code, "rotor_drag"))
    assert said == f"the last fit: {ended(code).status.advice}"


def test_a_delay_of_whole_samples_ends_at_a_kink() -> None:
    (said,) = _unfinished(ended(Code.CONVERGED), last(Code.NO_PROGRESS, "command_delay", "rotor_drag"))
    assert "kink" in said
    assert "(command_delay)" in said
