"""Run the chain: what is done already is kept, what was stopped half way is done again.

A stage runs in this process, so that killing it leaves nobody behind who goes on writing. It counts
as done when identify.json says so, with a checksum of all that it was given: command line, vehicle
file, logs, files of earlier stages, version of greybox.
"""

from __future__ import annotations

import contextlib
import io
import os
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from greybox.commands.chain.choice import Choice, best, verdict_of
from greybox.commands.chain.left import flight_seconds, seconds_left
from greybox.commands.chain.record import Outcome, StageRecord, read_record, write_record
from greybox.commands.chain.request import Request, Skip, SoFar, Stage, Work
from greybox.commands.chain.stages import NAMES, STAGES
from greybox.distribution import VERSION
from greybox.errors import GreyboxError, UnknownNameError
from greybox.files import checksum, content_sha256, file_sha256, read_json, write_atomic
from greybox.model.verdict import NOT_JUDGED
from greybox.progress import in_words
from greybox.report.identify_report import identify_report
from greybox.validation.result import ValidationDocument

Say = Callable[[str], None]
FIRST_LINES = 4
"""Lines of what a command says that stand on the page."""
OUTPUT = "output.txt"
"""All that the commands of a stage printed, in its folder."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """How a chain ended, and what its stages did."""

    outcome: Outcome
    choice: Choice | None
    so_far: SoFar


def run_chain(
    request: Request,
    *,
    command: str,
    say: Say,
    progress: TextIO | None = None,
    stages: Sequence[Stage] = STAGES,
) -> Result:
    """Run all stages that are not done. Ctrl-C is an `Outcome` with the stage in `stopped`, too.

    What the commands say of their progress goes to `progress` (None: nowhere). Raises
    `GreyboxError` for input that no stage could read, and for a folder of somebody else.
    """
    _look_over(request)
    chain = _Chain(
        request=request, command=command, say=say, progress=progress, stages=tuple(stages)
    )
    return chain.run()


def _look_over(request: Request) -> None:
    """What can be said of the input before any work. Raises `GreyboxError`."""
    from greybox.model.vehicle import read_vehicle

    for name in sorted(request.skip - set(NAMES)):
        raise UnknownNameError("stage", name, NAMES)
    if "fit" in request.skip:
        raise GreyboxError("--skip fit: nothing is left without it", fix="--skip discover,learn")
    if not request.train:
        raise GreyboxError("no logs", expected="VEHICLE.toml LOG ...")
    for log in (*request.train, *request.test):
        if not Path(log).exists():
            raise GreyboxError("no such file", where=log, fix="check the path")
    given = [str(Path(p).resolve()) for p in (*request.train, *request.test)]
    if double := sorted({p for p in given if given.count(p) > 1}):
        raise GreyboxError(
            "given twice", where=double[0], fix="give every log once, to train or --test"
        )
    read_vehicle(request.vehicle)


@dataclass(kw_only=True, eq=False)
class _Chain:
    request: Request
    command: str
    say: Say
    progress: TextIO | None
    stages: tuple[Stage, ...]

    def run(self) -> Result:
        out = self.request.out
        self.kept = read_record(out)
        self.done: dict[str, StageRecord] = {}
        self.folders = {s.name: out / f"{k}_{s.name}" for k, s in enumerate(self.stages, start=1)}
        self.inputs = [content_sha256(path) for path in self.request.inputs]
        for number, stage in enumerate(self.stages, start=1):
            try:
                record = self._stage(number, stage)
            except KeyboardInterrupt:
                return self._end(
                    Outcome(line=self._stopped(stage), exit_code=130, stopped=stage.name)
                )
            if record.exit_code == 130:
                return self._end(
                    Outcome(line=self._stopped(stage), exit_code=130, stopped=stage.name)
                )
            self.done[stage.name] = record
            write_record(out, None, self._records(), self.command)
            if not record.finished and stage.needed:
                last = record.lines[-1] if record.lines else f"exit code {record.exit_code}"
                return self._end(
                    Outcome(line=f"stage {stage.name}: {last}", exit_code=2, stopped=stage.name)
                )
            if stage.needed and not all(
                (self.folders[stage.name] / w).exists() for w in record.writes
            ):
                line = "; ".join(" ".join(text.split()) for text in record.lines)
                return self._end(
                    Outcome(line=f"stage {stage.name}: {line}", exit_code=1, stopped=stage.name)
                )
        return self._end(self._outcome())

    @property
    def so_far(self) -> SoFar:
        return SoFar(request=self.request, folders=self.folders, done=dict(self.done))

    def _records(self) -> dict[str, StageRecord]:
        """Those of this run, and of stages that it has not come to: they may still be good."""
        return {
            s.name: r for s in self.stages if (r := self.done.get(s.name, self.kept.get(s.name)))
        }

    def _stopped(self, stage: Stage) -> str:
        return f"stopped in stage {stage.name}: run the same command again to go on"

    # ------------------------------------------------------------ one stage

    def _stage(self, number: int, stage: Stage) -> StageRecord:
        title = f"stage {number} of {len(self.stages)}: {stage.name}"
        work = Skip(reason="--skip") if stage.name in self.request.skip else stage.plan(self.so_far)
        folder = self.folders[stage.name]
        if isinstance(work, Skip):
            self.say(f"{title} skipped ({work.reason})")
            return StageRecord(name=stage.name, folder=folder.name, skipped=work.reason)
        key = self._key(work)
        kept = self.kept.get(stage.name)
        there = kept is not None and kept.key == key and kept.finished and not kept.skipped
        if kept is not None and there and all(p.exists() for p in work.writes):
            self.say(f"{title} is done ({kept.seconds:.0f} s in an earlier run)")
            self._first(kept)
            return kept
        # From here on its files may be those of other input: it is not done until it is done again.
        if self.kept.pop(stage.name, None) is not None:
            write_record(self.request.out, None, self._records(), self.command)
        self.say(f"{title}, {stage.about}{self._left(number)}")
        record = self._work(stage, work, key)
        self._first(record)
        return record

    def _left(self, number: int) -> str:
        flown = flight_seconds(self.folders["inspect"], self.done.get("inspect"))
        if flown is None:
            return ""
        names = [s.name for s in self.stages[number - 1 :] if s.name not in self.request.skip]
        return f"; {in_words(seconds_left(self.stages, names, self.done, flown))}"

    def _first(self, record: StageRecord) -> None:
        """The verdict of a stage that judges, at once."""
        if record.lines and record.name in ("fit", "refit", "learn", "discover"):
            self.say(f"  {record.lines[0]}")

    def _key(self, work: Work) -> str:
        """Checksum of all that a stage is given; where the files lie does not matter."""
        places = {path: f"input {k}" for k, path in enumerate(self.request.inputs)}
        out = f"{self.request.out}{os.sep}"
        words = [[places.get(w, w.removeprefix(out)) for w in line] for line in work.commands]
        reads = [file_sha256(p) for p in work.reads]
        names = [Path(p).name for p in self.request.inputs]
        return checksum([words, names, self.inputs, reads, VERSION])

    def _work(self, stage: Stage, work: Work, key: str) -> StageRecord:
        folder = self.folders[stage.name]
        began, used = time.perf_counter(), _cpu()
        said: list[str] = []
        lines: list[str] = []
        code = 0
        for words in work.commands:
            typed = "greybox " + shlex.join(words)
            self.say(f"  $ {typed}")
            ran = run_command(words, self.progress)
            code = max(code, ran.exit_code)
            said.append(f"$ {typed}\n{ran.output}")
            first = [line for line in ran.output.splitlines() if line.strip()][:FIRST_LINES]
            lines += ran.errors[-1:] if ran.exit_code == 2 else first
            if ran.exit_code not in (0, 1):
                break
        write_atomic(folder / OUTPUT, "\n".join(said))
        return StageRecord(
            name=stage.name,
            folder=folder.name,
            key=key,
            exit_code=code,
            lines=tuple(lines),
            commands=tuple("greybox " + shlex.join(w) for w in work.commands),
            seconds=round(time.perf_counter() - began, 2),
            cpu_seconds=round(_cpu() - used, 2),
            writes=tuple(str(p.relative_to(folder)) for p in work.writes),
        )

    # ------------------------------------------------------------ the end

    def _outcome(self) -> Outcome:
        """The verdict of the model that came out; validate may find it worse, not better: what was
        refused on the way was neither learned from nor exported."""
        choice = best(self.so_far)
        assert choice is not None  # a fit that failed ended the chain
        verdict = choice.verdict
        if self.so_far.ran("validate"):
            last = verdict_of(read_json(self.folders["validate"] / "validate.json"))
            fitted = choice.model == self.folders["fit"] / "model.json"
            if last is not None and (verdict is None or last.refused or not fitted):
                verdict = verdict if fitted and verdict is not None and verdict.refused else last
        if verdict is None:
            code, line = self.done["fit"].exit_code, NOT_JUDGED
        else:
            code, line = verdict.exit_code, verdict.line
        return Outcome(
            line=line,
            exit_code=code,
            model=str(choice.model),
            why=choice.why,
            verdict=None if verdict is None else verdict.to_dict(),
        )

    def _validation(self, model: Path) -> ValidationDocument | None:
        """Errors ahead of the model that came out: of its own stage, else as its fit saw them."""
        ran = self.so_far.ran("validate")
        found = (self.folders["validate"] if ran else model.parent) / "validate.json"
        if not found.exists():
            return None
        content: ValidationDocument = read_json(found)
        return content

    def _end(self, outcome: Outcome) -> Result:
        """Write the record and the page, whatever happened."""
        records = self._records() if outcome.stopped else self.done
        write_record(self.request.out, outcome, records, self.command)
        page = identify_report(
            read_json(self.request.out / "identify.json"),
            {s.name: s.about for s in self.stages},
            links={r.name: _links(self.folders[r.name]) for r in records.values()},
            validation=None if outcome.stopped else self._validation(Path(outcome.model)),
        )
        write_atomic(self.request.out / "report.html", page)
        return Result(
            outcome=outcome,
            choice=None if outcome.stopped else best(self.so_far),
            so_far=self.so_far,
        )


def _links(folder: Path) -> list[tuple[str, str]]:
    """(what, path from the page) of what a stage has for a person."""
    files = (("its report", "report.html"), ("all that it said", OUTPUT))
    return [(what, f"{folder.name}/{name}") for what, name in files if (folder / name).exists()]


def _cpu() -> float:
    """Seconds of CPU of this process and of children that have ended (compilers)."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


# ------------------------------------------------------------ one command


@dataclass(frozen=True, kw_only=True)
class Ran:
    """How a command ended, what it printed, and its lines on standard error."""

    exit_code: int
    output: str
    errors: tuple[str, ...]


class _Echo(io.StringIO):
    """Keeps what is written and passes it on where somebody listens."""

    def __init__(self, to: TextIO | None) -> None:
        super().__init__()
        self.to = to

    def write(self, text: str) -> int:
        if self.to is not None:
            self.to.write(text)
        return super().write(text)

    def flush(self) -> None:
        if self.to is not None:
            self.to.flush()

    def isatty(self) -> bool:
        return self.to is not None and self.to.isatty()


@contextlib.contextmanager
def _typed(words: Sequence[str]) -> Iterator[None]:
    """The command line that result files quote is that of the stage."""
    before = sys.argv
    sys.argv = ["greybox", *words]
    try:
        yield
    finally:
        sys.argv = before


def run_command(words: Sequence[str], progress: TextIO | None) -> Ran:
    """Run a plain command in this process; its standard error is passed on to `progress`."""
    from greybox.cli import main

    output, errors = io.StringIO(), _Echo(progress)
    with _typed(words), contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors):
        try:
            code = main(list(words))
        except SystemExit as stop:  # a command line that argparse refuses
            code = 2 if stop.code else 0
        except io.UnsupportedOperation:  # main gave up a standard output that is none
            code = 2
    lines = tuple(line for line in errors.getvalue().splitlines() if line.strip())
    return Ran(exit_code=code, output=output.getvalue(), errors=lines)
