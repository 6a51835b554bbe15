"""identify: the whole chain from Python."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from greybox.commands.chain.guess import guessed_vehicle
from greybox.commands.chain.request import Request, SoFar
from greybox.commands.chain.run import run_chain
from greybox.errors import GreyboxError
from greybox.model.identified import IdentifiedModel
from greybox.model.verdict import NOT_JUDGED, Verdict
from greybox.progress import in_notebooks
from greybox.residual.files import load_model
from greybox.shown import Row, Shown
from greybox.takes import FUNCTION, NAMES, NATURAL, PATH, PATHS, takes


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Identified(Shown):
    """What the chain made. `model` is the one that came out (`verdict` judges it, None: not judged)
    and `why`; `fit` that of the automatic fit, `discovery` that of discover and `learned` the
    hybrid, each None where that stage made none. All files are in `folder`, with report.html for a
    person.
    """

    verdict: Verdict | None
    model: IdentifiedModel
    why: str
    fit: IdentifiedModel
    discovery: IdentifiedModel | None
    learned: IdentifiedModel | None
    folder: Path

    def _shown_text(self) -> str:
        """The verdict, why this model, and where the report is."""
        line = NOT_JUDGED if self.verdict is None else self.verdict.line
        return f"{line}\n{self.why}\n{self.folder / 'report.html'}"

    def _shown_rows(self) -> Sequence[Row]:
        """That of the model."""
        return self.model._shown_rows()


def _quiet(text: str) -> None:
    pass


@in_notebooks(say="say")
@takes(vehicle=PATH, logs=PATHS, test=PATHS, skip=NAMES, accept=NAMES)
@takes(out=PATH, seed=NATURAL, say=FUNCTION)
def identify(
    vehicle: str | os.PathLike[str] | None,
    logs: Iterable[str | os.PathLike[str]],
    *,
    test: Iterable[str | os.PathLike[str]] = (),
    out: str | os.PathLike[str] = "greybox-identify",
    skip: Iterable[str] = (),
    even_so: bool = False,
    accept: Iterable[str] = (),
    seed: int = 0,
    say: Callable[[str], None] = _quiet,
) -> Identified:
    """From a vehicle file and logs (paths) to a judged, exported model: what `greybox identify`
    does.

    inspect, check, fit, discover, refit, learn, validate and export one after the other, each the
    plain command of its name with its results in a folder of `out`; what is done there already is
    kept. `test` are flights that only judge, `skip` names of stages, `even_so` learns and exports
    although the model is not usable, `accept` names checks whose findings do not block. `say` gets
    a line per step. Without a vehicle file (None) the log is asked.

    Raises `GreyboxError` for bad input, `KeyboardInterrupt` when it is stopped (call it again to go
    on).
    """
    folder = Path(out)
    train = tuple(os.fspath(log) for log in logs)
    held_out = tuple(os.fspath(log) for log in test)
    if not train:
        raise GreyboxError("no logs", expected="paths of flight logs")
    path = (
        guessed_vehicle(train, folder, go_on=False, say=say)
        if vehicle is None
        else os.fspath(vehicle)
    )
    request = Request(
        vehicle=path,
        train=train,
        test=held_out,
        out=folder,
        seed=seed,
        skip=frozenset(skip),
        even_so=even_so,
        accept=tuple(accept),
    )
    words = ["greybox", "identify", path, *train, *(["--test", *held_out] if held_out else [])]
    found = run_chain(request, command=shlex.join([*words, "--out", str(folder)]), say=say)
    if found.outcome.exit_code == 130:
        raise KeyboardInterrupt
    if found.choice is None:
        raise GreyboxError(found.outcome.line)
    verdict = found.outcome.verdict
    return Identified(
        verdict=None if verdict is None else Verdict.from_dict(verdict),
        model=load_model(found.choice.model),
        why=found.choice.why,
        fit=load_model(found.so_far.folders["fit"] / "model.json"),
        discovery=_made(found.so_far, "discover", "model.json"),
        learned=_made(found.so_far, "learn", "hybrid.json"),
        folder=folder,
    )


def _made(so_far: SoFar, stage: str, file: str) -> IdentifiedModel | None:
    path = so_far.folders[stage] / file
    return load_model(path) if so_far.ran(stage) and path.exists() else None
