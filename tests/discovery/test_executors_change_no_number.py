"""The fits of a step run side by side, in processes or on a cluster, and the result is that of one process."""

from __future__ import annotations

import concurrent.futures
import pickle
import warnings
from collections.abc import Iterator
from dataclasses import replace

import pytest

from greybox.discovery.nested import Nest, Refit, Task, solve
from tests.discovery import small_world


@pytest.fixture(scope="module")
def nest() -> Nest:
    return small_world.damped()


@pytest.fixture(scope="module")
def tasks(nest: Nest) -> list[Task]:
    return [nest.task(()), nest.task(("gyro_bias",))]


@pytest.fixture(scope="module")
def alone(nest: Nest, tasks: list[Task]) -> list[Refit]:
    return nest.refits(tasks)


def same(a: list[Refit], b: list[Refit]) -> bool:
    keys = ("theta", "loglik", "bounds", "n_parameters", "n_samples", "converged")
    return all(getattr(x, k) == getattr(y, k) for x, y in zip(a, b, strict=True) for k in keys)


@pytest.fixture(scope="module")
def processes() -> Iterator[concurrent.futures.Executor]:
    import multiprocessing

    with concurrent.futures.ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield pool


def test_processes_give_the_same_numbers(
    nest: Nest, tasks: list[Task], alone: list[Refit], processes: concurrent.futures.Executor
):
    there = Nest(candidates=nest.candidates, data=nest.data, executor=processes)
    assert same(there.refits(tasks), alone)


def test_a_cluster_gives_the_same_numbers(nest: Nest, tasks: list[Task], alone: list[Refit]):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        distributed = pytest.importorskip("distributed")
        with (
            distributed.LocalCluster(
                n_workers=2, threads_per_worker=1, dashboard_address=None, processes=True
            ) as cluster,
            distributed.Client(cluster) as client,
        ):
            there = Nest(candidates=nest.candidates, data=nest.data, executor=client.get_executor(pure=False))
            assert same(there.refits(tasks), alone)


def test_a_settled_fit_is_the_refit(nest: Nest, alone: list[Refit]):
    whole = nest.settle(alone[1])
    assert whole.bic == pytest.approx(alone[1].bic, abs=1e-9)
    assert whole.fit.converged
    assert whole.fit["gyro_bias.b_x"].scope == "flight"


def test_what_cannot_be_sent_runs_here(nest: Nest, tasks: list[Task], alone: list[Refit]):
    class Refuses(concurrent.futures.Executor):
        def submit(self, fn, /, *args, **kwargs):  # type: ignore[no-untyped-def]
            raise AssertionError("sent")

    class Sealed(float):
        def __reduce__(self):  # type: ignore[no-untyped-def]
            raise pickle.PicklingError("sealed")

    closed = [replace(t, tolerance=Sealed(t.tolerance)) for t in tasks]
    there = Nest(candidates=nest.candidates, data=nest.data, executor=Refuses())
    assert [r.theta for r in there.refits(closed)] == [r.theta for r in alone]


def test_tasks_survive_the_wire(nest: Nest, tasks: list[Task], alone: list[Refit]):
    sent, data = pickle.loads(pickle.dumps((tasks[0], nest.data)))
    assert solve(sent, data).theta == alone[0].theta


def test_nothing_is_fitted_twice_in_a_row(nest: Nest, tasks: list[Task], alone: list[Refit]):
    again = nest.refits(tasks[::-1])
    assert [a is b for a, b in zip(again, alone[::-1], strict=True)] == [True, True]
