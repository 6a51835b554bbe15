"""What is done to a log grows with its length and no faster, however often it lands.

Counted in numbers that numpy is given to work on, not in seconds.
"""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np
import pytest

from greybox.data.airborne import _first_above, _tree, airborne
from greybox.data.checks.view import View

work = 0


class Counted(np.ndarray):
    """An array that counts how many numbers are read of it, and of all that is made of it."""

    def __array_finalize__(self, made_of):
        pass

    def _count(self, arguments) -> None:
        global work
        work += sum(a.size for a in arguments if isinstance(a, np.ndarray))

    def __array_ufunc__(self, ufunc, method, *inputs, out=None, **options):
        self._count(inputs)
        plain = [np.asarray(i) for i in inputs]
        where = {"out": tuple(np.asarray(o) for o in out)} if out else {}
        found = getattr(ufunc, method)(*plain, **options, **where)
        return found.view(Counted) if isinstance(found, np.ndarray) else found

    def __array_function__(self, function, types, arguments, options):
        if function is not np.searchsorted:  # which reads a few, or as many as it looks for
            self._count(itertools.chain(arguments, options.values()))
        found = super().__array_function__(function, types, arguments, options)
        return found.view(Counted) if isinstance(found, np.ndarray) else found

    def __getitem__(self, key):
        self._count([key])
        return super().__getitem__(key)


def hops(count: int) -> dict[str, np.ndarray]:
    """A craft at 50 Hz that stands for 1.2 s and flies for 1.2 s, again and again."""
    command = np.tile(np.r_[np.zeros(60), np.full(60, 0.5)], count)
    height = np.tile(np.r_[np.zeros(60), np.sin(np.linspace(0, np.pi, 60))], count)
    return {"t": 0.02 * np.arange(command.size), "u1": command, "z": height}


def of_landings(count: int, seen: bool) -> None:
    """What is flight in so many hops, with or without a height."""
    log = {n: v.view(Counted) for n, v in hops(count).items()}
    keep, _ = airborne(log["t"], {n: log[n] for n in ("u1", "z")[: 1 + seen]}, driving=("u1",))
    assert 0 < keep.sum() < keep.size


@pytest.mark.parametrize("seen", [True, False])
def test_four_times_the_landings_are_about_four_times_the_work(seen: bool) -> None:
    def cost(count: int) -> int:
        global work
        work = 0
        of_landings(count, seen)
        return work

    few = cost(100)
    assert few > 100
    assert cost(400) < 4.6 * few


def test_the_end_of_a_landing_is_the_one_that_a_look_at_every_row_finds() -> None:
    rng = np.random.default_rng(3)
    for n in (1, 2, 3, 7, 16, 33, 100):
        values = rng.normal(size=n)
        levels = _tree(values)
        for start, limit in itertools.product(range(n + 1), (-0.5, 0.5, 1.5, 9.0)):
            above = np.flatnonzero(values[start:] > limit)
            assert _first_above(levels, start, limit) == (start + above[0] if above.size else n)


def test_an_instant_is_in_flight_where_a_segment_holds_it() -> None:
    segments = tuple(SimpleNamespace(t=np.array([a, a + 1.0])) for a in (0.0, 2.0, 5.0))
    view = View(raw=None, vehicle=None)  # type: ignore[arg-type]
    view.__dict__["flight"] = SimpleNamespace(segments=segments)
    assert [view.in_flight(t) for t in (-0.1, 0.0, 1.0, 1.5, 2.5, 3.1, 5.9, 6.1)] == [
        False,
        True,
        True,
        False,
        True,
        False,
        True,
        False,
    ]
    view.__dict__.update(flight=None)
    view.__dict__.pop("_segments")
    assert not view.in_flight(0.5)
