"""How long is left: by the share that is done, and of a solver by how fast its promise falls."""

from __future__ import annotations

import re

import pytest

from greybox.progress import FIRST, TimeLeft, in_words


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.mark.parametrize(
    ("seconds", "said"),
    [(3, "about 10 s left"), (44, "about 40 s left"), (95, "about 2 min left"), (7000, "about 1.9 h left")],
)
def test_it_is_rounded_as_a_person_would(seconds: float, said: str):
    assert in_words(seconds) == said


def test_the_share_gives_the_rest_at_the_pace_so_far():
    clock = Clock()
    left = TimeLeft(clock)
    clock.now += 0.5 * FIRST
    assert left.after(0.5) == ""  # too early to tell
    clock.now = 130.0
    assert left.after(0.5) == ", about 30 s left"
    assert left.after(0.25) == ", about 90 s left" or left.after(0.25) == ", about 2 min left"
    assert left.after(0.0) == left.after(1.0) == ""


def test_a_solver_that_converges_is_told_to_the_right_iteration():
    clock = Clock()
    left = TimeLeft(clock)
    told = []
    for k in range(1, 13):  # a tenth of the promise each second; 1e-6 after the twelfth
        clock.now += 10.0
        told.append(left.after_step(k, 10.0 ** (6 - k)))
    said = [int(m[1]) for t in told if (m := re.search(r"about (\d+) s", t))]
    true = [10 * (12 - k) for k in range(1, 13)]
    for k, t in enumerate(told, start=1):
        if m := re.search(r"about (\d+) s", t):
            assert int(m[1]) == pytest.approx(true[k - 1], abs=10)
    assert len(said) >= 7
    assert said == sorted(said, reverse=True)


def test_a_solver_that_does_not_converge_promises_nothing():
    clock = Clock()
    left = TimeLeft(clock)
    for k in range(1, 20):
        clock.now += 5.0
        assert left.after_step(k, 3.0) == ""


def test_another_fit_begins_anew():
    clock = Clock()
    left = TimeLeft(clock)
    for k in range(1, 8):
        clock.now += 5.0
        left.after_step(k, 10.0 ** (4 - k))
    clock.now += 5.0
    assert left.after_step(1, 1e4) == ""
