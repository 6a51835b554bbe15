"""The row of an order says of its fit what refining it showed, and no order is refined twice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.linear import order as orders
from greybox.linear.pem import Status
from greybox.linear.records import Record, prepare
from greybox.linear.search import Found, Options
from scenarios.plants.linear_systems import random_system, simulate

AT_THE_LIMIT, DONE = Status.MAX_ITERATIONS, Status.CONVERGED


def _ends(found: Found, status: Status) -> Found:
    return replace(found, solution=replace(found.solution, status=status))


@pytest.mark.parametrize("scored", [False, True])
@pytest.mark.parametrize(("swept", "refined"), [(DONE, AT_THE_LIMIT), (AT_THE_LIMIT, DONE)])
def test_each_order_is_refined_once_and_its_row_says_how_that_ended(
    monkeypatch: pytest.MonkeyPatch, swept: Status, refined: Status, scored: bool
) -> None:
    """Where held-out data leave no order that settled, too."""
    rng = np.random.default_rng(4)
    u, y = simulate(rng, random_system(rng, 2, 1, 1), 1200)
    (scaled,), _ = prepare([Record(u=u, y=y)])
    seen: list[int] = []
    sweep = orders.sweep

    def swept_to(*arguments: object, **options: object) -> dict[int, Found]:
        return {k: _ends(f, swept) for k, f in sweep(*arguments, **options).items()}  # type: ignore[arg-type]

    def refined_to(found: Found, records: object, options: object) -> Found:
        seen.append(found.solution.system.order)
        return _ends(found, refined)

    monkeypatch.setattr(orders, "sweep", swept_to)
    monkeypatch.setattr(orders, "refine", refined_to)
    choice = orders.choose_order([scaled], 3, Options(), cross_validate=scored)
    assert len(seen) == len(set(seen)) and choice.order in seen
    assert all(
        r.converged == (refined if r.order in seen else swept).converged for r in choice.rows
    )
    assert choice.found[choice.order].solution.status is refined
    if not scored:
        assert seen == [choice.order]
