"""Target: a simulator, as one small file that says what it can express and writes its files.

`greybox.simulators.targets` lists them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from greybox.simulators.craft import Craft
from greybox.simulators.words import Word


class Target(Protocol):
    """A simulator that a craft can be written for."""

    @property
    def name(self) -> str:
        """What `--target` takes, and the folder."""

    @property
    def simulator(self) -> str:
        """What people call it."""

    @property
    def source(self) -> str:
        """Where its formulas are published."""

    def words(self, craft: Craft) -> tuple[Word, ...]:
        """What becomes of every effect. Raises `ModelError` for a rotor layout that the simulator
        cannot express."""

    def files(self, craft: Craft) -> Mapping[str, str]:
        """File name -> text, from a craft that holds only what the simulator says (`changed` by its
        words)."""
