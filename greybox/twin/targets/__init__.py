"""Targets: one file per simulator, and the table that `--target` looks into."""

from __future__ import annotations

from greybox.errors import UnknownNameError
from greybox.twin.target import Target
from greybox.twin.targets.rotorpy import RotorPy

TARGETS: tuple[Target, ...] = (RotorPy(),)


def target_by_name(name: str) -> Target:
    """Raises `UnknownNameError` with the nearest names."""
    for target in TARGETS:
        if target.name == name:
            return target
    raise UnknownNameError("target", name, (t.name for t in TARGETS))
