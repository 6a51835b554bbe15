"""Two of late commands, IMU and pose can be said with another two: which, and how large they then are."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from greybox.discovery.clocks import COMMAND, IMU, POSE, THREE, never_separated, said_two_ways
from greybox.discovery.name import Addition

NEST: Any = SimpleNamespace(
    candidates=SimpleNamespace(
        parameters={n: (f"{n}.d",) for n in (*THREE, "motor_lag")},
        model=SimpleNamespace(parameters=[SimpleNamespace(name=f"{n}.d", upper=0.1) for n in sorted(THREE)]),
    )
)


def fitted(**sizes: float) -> Any:
    """A fit with these delays."""
    return SimpleNamespace(
        effects=tuple(sizes), fit=SimpleNamespace(parameters={f"{n}.d": SimpleNamespace(value=v) for n, v in sizes.items()})
    )


def added(*effects: str, **more: Any) -> Addition:
    """A step that added them."""
    at: Any = None
    facts = {"p_value": 0.001, "delta_bic": 100.0, "delta_bic_rival": 50.0, "rivals": {}, "scores": ()} | more
    return Addition(effects=effects, before=at, after=at, **facts)


delays = st.floats(min_value=0.001, max_value=0.045)


@given(a=delays, b=delays, had=st.sampled_from([(COMMAND, POSE), (IMU, POSE), (COMMAND, IMU)]))
def test_the_other_way_shifts_the_clock_and_nothing_else(a: float, b: float, had: tuple[str, str]):
    """c + i and c + p stay, and no delay is negative; it is the one other way."""
    first = dict(zip(had, (a, b), strict=True))
    out, notes = said_two_ways(NEST, fitted(**first), [added(n) for n in had])
    (group,) = [x.rivals for x in out if x.rivals]
    (note,) = notes
    (new,) = set(group) - set(had)
    (one,) = set(group) & set(had)
    (kept,) = set(had) - {one}
    told = float(note.split(f"next to a {kept} of ")[1].split(" ms")[0]) / 1e3
    second = {new: float(note.split(f"{new} of ")[1].split(" ms")[0]) / 1e3, kept: told}
    assert min(second.values()) >= 0
    for other in (IMU, POSE):
        sums = [way.get(COMMAND, 0.0) + way.get(other, 0.0) for way in (first, second)]
        assert np.isclose(*sums, rtol=0.01, atol=1e-5)
    assert never_separated(fitted(**first), group)


def test_a_name_that_came_with_it_stays_clear():
    out, _ = said_two_ways(NEST, fitted(command_delay=0.01, pose_delay=0.02), [added("motor_lag", COMMAND), added(POSE)])
    assert [(a.effects, set(a.rivals)) for a in out] == [
        (("motor_lag",), set()), ((COMMAND,), {COMMAND, IMU}), ((POSE,), set())
    ]  # fmt: skip


def test_one_word_is_enough_or_what_is_known_is_not_asked():
    alone = [added(COMMAND)]
    assert said_two_ways(NEST, fitted(command_delay=0.01), alone) == (alone, [])
    knows: Any = SimpleNamespace(candidates=SimpleNamespace(parameters={COMMAND: (), POSE: ()}))
    both = [added(COMMAND), added(POSE)]
    assert said_two_ways(knows, fitted(command_delay=0.01, pose_delay=0.02), both) == (both, [])
    early = fitted(command_delay=0.01, pose_delay=-0.005)
    assert said_two_ways(NEST, early, both) == (both, [])
    assert not never_separated(early, {COMMAND, "motor_lag"})


def test_a_delay_beyond_its_bounds_is_no_other_way():
    both = [added(COMMAND), added(POSE)]
    assert said_two_ways(NEST, fitted(command_delay=0.06, pose_delay=0.06), both) == (both, [])


def test_a_group_that_there_is_stays():
    both = [added(COMMAND, rivals={COMMAND: 0.6, IMU: 0.4}), added(POSE)]
    out, _ = said_two_ways(NEST, fitted(command_delay=0.01, pose_delay=0.02), both)
    assert out == both
