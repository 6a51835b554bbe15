"""Fits of a step run side by side, in processes or on a cluster, and the result is that of one
process."""

from __future__ import annotations

import concurrent.futures
import multiprocessing
import pickle
from typing import Any

import pytest

from greybox.discovery import evidence
from greybox.discovery.evidence import Fitted, Flights, Structure, Task, problem_of, solved
from greybox.estimation.problem import Problem
from tests.discovery import small_world

RIVALS: list[Structure] = [frozenset({"rotational_damping"}), frozenset({"gyro_bias"})]


def contested(flights: Flights) -> list[Fitted]:
    return flights.contest([(s, []) for s in RIVALS], flights.fit(()))


@pytest.fixture(scope="module")
def alone() -> list[Fitted]:
    return contested(small_world.damped())


@pytest.mark.slow
def test_processes_give_the_same_numbers(alone: list[Fitted]):
    with concurrent.futures.ProcessPoolExecutor(
        2, mp_context=multiprocessing.get_context("spawn")
    ) as pool:
        flights = small_world.damped()
        flights.executor = pool
        assert [f.known for f in contested(flights)] == [f.known for f in alone]


def test_what_cannot_be_sent_runs_here(alone: list[Fitted]):
    class Refuses(concurrent.futures.Executor):
        def submit(self, fn, /, *args, **kwargs):  # type: ignore[no-untyped-def]
            raise AssertionError("sent")

    class Sealed(float):
        def __reduce__(self):  # type: ignore[no-untyped-def]
            raise pickle.PicklingError("sealed")

    flights = small_world.damped()
    flights.executor = Refuses()
    task = Task(structure=RIVALS[0], starts=(), tolerance=Sealed(0.1), iterations=3)
    other = Task(structure=RIVALS[1], starts=(), tolerance=Sealed(0.1), iterations=3)
    assert len(flights._carried_out([task, other])) == 2


def test_what_others_solve_is_set_up_here_when_it_is_asked_for(monkeypatch: pytest.MonkeyPatch):
    made = list[Structure]()

    def counted(*given: Any) -> Problem:
        made.append(given[-1])
        return problem_of(*given)

    monkeypatch.setattr(evidence, "problem_of", counted)
    flights = small_world.damped()
    tasks = [Task(structure=s, starts=(), tolerance=0.1, iterations=3) for s in RIVALS]
    with concurrent.futures.ThreadPoolExecutor(2) as flights.executor:
        first, _ = flights._carried_out(tasks)
    assert sorted(made, key=sorted) == sorted(RIVALS, key=sorted)
    assert len(first.known) == first.space.n and first.held.shape == (first.space.n,)
    assert len(made) == 2
    assert first.problem.unknowns == first.space.unknowns and first.problem is first.problem
    assert len(made) == 3


def test_tasks_survive_the_wire():
    flights = small_world.damped()
    task = Task(structure=RIVALS[0], starts=(), tolerance=0.1, iterations=3)
    here = solved(flights.causes, flights.data, flights.options, task)
    there = solved(
        *pickle.loads(pickle.dumps((flights.causes, flights.data, flights.options, task)))
    )
    assert here.theta.tolist() == there.theta.tolist()


def test_nothing_is_fitted_twice():
    flights = small_world.damped()
    once = flights.fit(())
    assert flights.fit(()) is once
