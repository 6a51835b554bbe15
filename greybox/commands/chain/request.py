"""Request: what a chain is asked for. Stage, Work and Skip: what it consists of."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from greybox.commands.chain.record import StageRecord


@dataclass(frozen=True, kw_only=True)
class Request:
    """The vehicle file, the logs, the folder of the results, and what holds for all stages.

    `rate` [Hz] is left to the fit where it is None. `skip` are names of stages. `even_so`: learn
    and export although the model was judged not usable. `accept` are checks whose findings do not
    block.
    """

    vehicle: str
    train: tuple[str, ...]
    test: tuple[str, ...]
    out: Path
    mapping: str | None = None
    rate: float | None = None
    seed: int = 0
    skip: frozenset[str] = frozenset()
    even_so: bool = False
    accept: tuple[str, ...] = ()

    @property
    def inputs(self) -> tuple[str, ...]:
        """Every file that is read: a change of one of them makes stages run again."""
        return (self.vehicle, *self.train, *self.test, *([self.mapping] if self.mapping else []))


@dataclass(frozen=True, kw_only=True)
class Work:
    """What a stage does: command lines without the word greybox, files of earlier stages that they
    read, and the files that are there when it is done."""

    commands: tuple[tuple[str, ...], ...]
    writes: tuple[Path, ...]
    reads: tuple[Path, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Skip:
    """Why a stage does nothing."""

    reason: str


@dataclass(frozen=True, kw_only=True)
class SoFar:
    """What a stage may look at: the request and the records of the stages that ran before it."""

    request: Request
    folders: Mapping[str, Path]
    done: Mapping[str, StageRecord]

    def ran(self, name: str) -> bool:
        """Whether that stage did its work and wrote its results."""
        return name in self.done and not self.done[name].skipped and self.done[name].finished


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One step of the chain.

    `plan` makes its command lines from what is there. Its time is estimated as `start` plus `each`
    times the seconds of all flights [s of CPU]. A stage that is not `needed` may fail without
    ending the chain.
    """

    name: str
    about: str
    plan: Callable[[SoFar], Work | Skip]
    start: float
    each: float
    needed: bool = False
