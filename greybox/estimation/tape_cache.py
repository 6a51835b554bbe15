"""Tapes that were written before, by this process or another one: deriving the slopes of a model and
writing them down takes longer than all else of its set-up.

The key holds what a tape follows from: the expressions, what they are derived by, and the code that
derives and writes them.
"""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Callable, Iterable, Mapping
from importlib import resources
from pathlib import Path

import casadi as ca
import numpy as np

from greybox.estimation.cache import cache_dir, find, keep, key_of, say
from greybox.estimation.tape import Linear

MAKERS = (
    "engine.py",
    "tape.py",
    "write_tape.c",
    "tape_cache.py",
    "reference_point.py",
    "point_functions.py",
    "gain.py",
)
"""What a tape depends on besides the expressions, in this package."""
SUFFIX = ".npz"


@functools.cache
def _made_by() -> str:
    own = resources.files("greybox.estimation")
    return "".join(own.joinpath(name).read_text(encoding="utf-8") for name in MAKERS)


def linears(
    expressions: ca.Function, derived_by: str, functions: Mapping[str, Callable[[], ca.Function]]
) -> dict[str, Linear]:
    """Name -> what a function gives that is only made where the cache does not know it.

    `expressions` is a CasADi function that all of them follow from by way of `derived_by`. Raises
    `ModelError` like `tape_of`.
    """
    key = key_of(ca.CasadiMeta.version(), _made_by(), derived_by, expressions.serialize())
    try:
        if (path := find(key, SUFFIX)) is not None:
            return _read(path, functions)
    except (OSError, ValueError, KeyError) as error:
        say(f"slopes of a model cannot be read from {cache_dir()} ({error}); they are made again")
    made = {name: Linear.of(make()) for name, make in functions.items()}
    try:
        with tempfile.TemporaryDirectory(dir=cache_dir(), prefix="tape-") as folder:
            file = Path(folder) / f"tape{SUFFIX}"
            arrays = {f"{n}.{k}": v for n, f in made.items() for k, v in f.arrays().items()}
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
            keep(key, file, SUFFIX)
    except OSError as error:
        say(f"slopes of a model cannot be kept in {cache_dir()} ({error.strerror or error})")
    return made


def _read(path: Path, names: Iterable[str]) -> dict[str, Linear]:
    with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as stored:
        return {
            name: Linear.from_arrays(
                {k.partition(".")[2]: stored[k] for k in stored if k.startswith(f"{name}.")}
            )
            for name in names
        }
