"""What the slopes of a model are is kept between processes: the same tape, and another one for all
that a tape follows from."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from greybox.estimation import cache
from greybox.estimation.build import compiler
from greybox.estimation.engine import Engine
from greybox.estimation.recursion import Compiled
from tests.motor import model

EVERY = tuple(p.name for p in model().parameters)

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler here")


@contextlib.contextmanager
def cache_in(place: Path) -> Iterator[None]:
    """A cache of its own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GREYBOX_CACHE", str(place))
        for remembered in (cache.cache_root, cache.say):
            remembered.cache_clear()
        yield
    for remembered in (cache.cache_root, cache.say):
        remembered.cache_clear()


@pytest.fixture(scope="module")
def first(tmp_path_factory) -> tuple[Path, Engine]:
    """A cache that knows one structure, and its engine."""
    place = tmp_path_factory.mktemp("known") / "cache"
    with cache_in(place):
        return place, Engine(model(), EVERY)


@pytest.fixture
def folder(first, tmp_path) -> Iterator[Path]:
    """A copy of that cache, in use."""
    shutil.copytree(first[0], tmp_path / "cache")
    with cache_in(tmp_path / "cache"):
        yield tmp_path / "cache" / "build"


def derived(engine: Engine) -> bool:
    return "slope" in vars(engine)


def tape(engine: Engine) -> dict[str, np.ndarray]:
    assert isinstance(engine._recursion, Compiled)
    return engine._recursion.slope.arrays()


def test_a_known_structure_is_not_derived_again(first, folder):
    one, second = first[1], Engine(model(), EVERY)
    assert derived(one)
    assert not derived(second)
    assert tape(one).keys() == tape(second).keys()
    for name, value in tape(one).items():
        np.testing.assert_array_equal(tape(second)[name], value)
        assert tape(second)[name].dtype == value.dtype


@pytest.mark.parametrize(
    "other",
    [
        lambda: Engine(model(), EVERY[:2]),
        lambda: Engine(model(), EVERY[::-1]),
        lambda: Engine(model(), EVERY, sensitive=False),
        lambda: Engine(replace(model(), substeps=4), EVERY),
    ],
    ids=["fewer parameters", "another order", "without sensitivities", "other equations"],
)
def test_what_a_tape_follows_from_makes_it_another(folder, other):
    assert derived(other())


def test_a_damaged_tape_is_derived_again(first, folder, capfd):
    (file,) = folder.glob("*.npz")
    file.write_bytes(file.read_bytes()[:-1])
    second = Engine(model(), EVERY)
    assert derived(second)
    assert "not as it was written" in capfd.readouterr().err
    np.testing.assert_array_equal(tape(second)["instructions"], tape(first[1])["instructions"])
    assert not derived(Engine(model(), EVERY))
