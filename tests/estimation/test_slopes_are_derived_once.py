"""What the slopes of a model are is kept between processes: the same tape, and another one for all
that a tape follows from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.estimation import cache
from greybox.estimation.build import compiler
from greybox.estimation.engine import Engine
from greybox.estimation.recursion import Compiled
from tests.motor import model

EVERY = tuple(p.name for p in model().parameters)

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler here")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A cache of its own."""
    monkeypatch.setenv("GREYBOX_CACHE", str(tmp_path / "cache"))
    for remembered in (cache.cache_root, cache.say):
        remembered.cache_clear()
    yield tmp_path / "cache" / "build"
    for remembered in (cache.cache_root, cache.say):
        remembered.cache_clear()


def derived(engine: Engine) -> bool:
    return "slope" in vars(engine)


def tape(engine: Engine) -> dict[str, np.ndarray]:
    assert isinstance(engine._recursion, Compiled)
    return engine._recursion.slope.arrays()


def test_a_known_structure_is_not_derived_again(folder):
    first, second = Engine(model(), EVERY), Engine(model(), EVERY)
    assert derived(first)
    assert not derived(second)
    assert tape(first).keys() == tape(second).keys()
    for name, value in tape(first).items():
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
    Engine(model(), EVERY)
    assert derived(other())


def test_a_damaged_tape_is_derived_again(folder, capfd):
    first = Engine(model(), EVERY)
    (file,) = folder.glob("*.npz")
    file.write_bytes(file.read_bytes()[:-1])
    second = Engine(model(), EVERY)
    assert derived(second)
    assert "not as it was written" in capfd.readouterr().err
    np.testing.assert_array_equal(tape(second)["instructions"], tape(first)["instructions"])
    assert not derived(Engine(model(), EVERY))
