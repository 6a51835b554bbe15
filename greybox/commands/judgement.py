"""What the commands that judge have in common: options, and the exit code."""

from __future__ import annotations

import argparse
import enum
import math
import shlex
import sys
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from greybox.commands.command_line import Options
from greybox.commands.console import Console

if TYPE_CHECKING:
    from greybox.data.checks import CheckReport
    from greybox.files import Parsed
    from greybox.model.identified import IdentifiedModel
    from greybox.model.vehicle import Vehicle
    from greybox.model.verdict import Verdict
    from greybox.validation.options import HorizonChoices


def accept_option(p: argparse.ArgumentParser) -> None:
    """Declare --accept."""
    p.add_argument(
        "--accept",
        default="",
        metavar="CHECK,...",
        help="checks whose blocking findings are overruled, by the name in brackets "
        "(frozen,motors); the result says so",
    )


def adapt_option(p: Options) -> None:
    """Declare --adapt."""
    p.add_argument(
        "--adapt",
        type=float,
        default=None,
        metavar="S",
        help="fit per-flight parameters on the first S seconds of each flight that judges (default: "
        "5, at most a third; 0: not)",
    )


def demand_adapt(arguments: argparse.Namespace) -> None:
    """Raise `DataError` for an --adapt that is no time."""
    from greybox.errors import DataError

    if arguments.adapt is not None and not 0 <= arguments.adapt < math.inf:
        raise DataError(
            "--adapt takes a time, zero or above", got=f"{arguments.adapt:g} s", fix="--adapt 5"
        )


def accepted(text: str) -> tuple[str, ...]:
    """The checks named by --accept."""
    return tuple(n.strip() for n in text.split(",") if n.strip())


def log_faults(arguments: argparse.Namespace, vehicle: Vehicle) -> CheckReport:
    """What the checks say of the vehicle file, where the command has one, and of the logs of
    --train and --test (with --mapping and --accept): of the files, which show faults of their
    clocks that reading mends. Raises `DataError` for a flight in both."""
    from greybox.data.checks import check
    from greybox.data.halves import demand_disjoint
    from greybox.data.logs import read_table
    from greybox.model.faults import faults_of

    train, test = (
        [read_table(p, vehicle, mapping=arguments.mapping) for p in paths]
        for paths in (arguments.train, arguments.test)
    )
    demand_disjoint(*([r.file for r in logs] for logs in (train, test)))
    accept, file = accepted(arguments.accept), arguments.vehicle
    if file is None:  # a model holds what its vehicle file said
        return check([*train, *test], vehicle, accept=accept)
    return faults_of(vehicle, [*train, *test], accept=accept, file=file)


def fault_lines(faults: CheckReport) -> list[str]:
    """What blocks, in words, for a command that goes on."""
    return [f"data fault in {f.flight}: {f.message}" for f in faults.blocking]


def next_of_faults(faults: CheckReport) -> str:
    """What to do about faults that block, and how to go on all the same."""
    from greybox.data.checks import VEHICLE
    from greybox.validation.advice import Symptom, likely

    _, action, anchor = likely((), Symptom.LOG_FAULT)
    of_file = next((f for f in faults.blocking if f.check == VEHICLE), None)
    action = action if of_file is None else f"greybox vehicle check {shlex.quote(of_file.flight)}"
    accept = ",".join(dict.fromkeys(f.check for f in faults.blocking))
    return f"  next: {action} ({anchor}); --accept {accept} goes on all the same"


def refuse_faults(faults: CheckReport, console: Console, what: str) -> int:
    """Say which faults block `what`, and how to go on. Returns the exit code: the answer is no."""
    console.result(
        faults.to_dict(),
        f"BAD DATA: the data have faults that block {what}",
        *(f"  fault: {f.flight}: {f.message}" for f in faults.blocking),
        next_of_faults(faults),
    )
    return 1


def horizon_options(p: Options) -> None:
    """Declare --horizons (seconds) and --horizons-samples."""
    from greybox.validation.horizons import HORIZONS, SAMPLES

    default = ",".join(f"{h:g}" for h in HORIZONS)
    samples = ", ".join(map(str, SAMPLES))
    p.add_argument(
        "--horizons",
        default=None,
        metavar="S,...",
        help=f"seconds ahead to list (default {default}; {samples} samples of a model of your own)",
    )
    p.add_argument(
        "--horizons-samples",
        default=None,
        metavar="N,...",
        help="the same in numbers of samples",
    )


def given_horizons(arguments: argparse.Namespace, *, own: bool = False) -> HorizonChoices:
    """`horizons` and `horizon_samples` as `validate` takes them, None where nothing was said. A
    model of the user's `own` has no longest horizon. Raises `DataError` for what is neither."""
    from greybox.validation.horizons import LONGEST, parse_samples, parse_seconds

    samples = (
        None if arguments.horizons_samples is None else parse_samples(arguments.horizons_samples)
    )
    longest = math.inf if own else LONGEST
    seconds = (
        None if arguments.horizons is None else parse_seconds(arguments.horizons, longest=longest)
    )
    return {"horizons": seconds, "horizon_samples": samples}


def horizon_steps(arguments: argparse.Namespace, sample_time: float) -> tuple[int, ...]:
    """The horizons that were asked for as numbers of samples of `sample_time` [s]; what was changed
    is said."""
    from greybox.validation.horizons import HORIZONS, horizons_of, parse_samples, parse_seconds

    samples = (
        None if arguments.horizons_samples is None else parse_samples(arguments.horizons_samples)
    )
    seconds = HORIZONS if arguments.horizons is None else parse_seconds(arguments.horizons)
    found = horizons_of(seconds, samples=samples, sample_time=sample_time)
    for note in found.notes:
        print(f"greybox: {note}", file=sys.stderr)
    return found.steps


def exit_code(verdict: Verdict | None) -> int:
    """0: usable, too calm to tell, or too little data to judge (which is said); 1: not usable."""
    return 0 if verdict is None else verdict.exit_code


@dataclass(frozen=True, kw_only=True)
class Gate:
    """Whether a command that builds on a model goes on (`open`), and the `line` that says what the
    model is worth."""

    open: bool
    line: str

    def say(self, command: str) -> None:
        """Print the line on standard error; nothing where the model is of a kind that is not judged
        this way."""
        if self.line:
            print(f"greybox {command}: {self.line}", file=sys.stderr)


class Use(enum.Enum):
    """What a command makes of a model, and what closes it to the model."""

    FLIES = "it goes on as it is: to a controller or a simulator"
    """Closed to what is not usable."""
    BUILDS = "something else begins with it, which is judged in its turn"
    """Closed to what is not finished; what is not usable is said."""


def even_so_option(p: Options, judged: str = "judged not usable") -> None:
    """Declare --even-so, of a command that refuses a model that was `judged` so."""
    p.add_argument("--even-so", action="store_true", help=f"go on although the model was {judged}")


def source_option(p: Options) -> None:
    """Declare --even-so, of a command whose result begins with a model: see `admitted`."""
    even_so_option(p, "not finished")


def admitted(arguments: argparse.Namespace, path: str | None) -> bool:
    """Whether a command may begin with the model file at `path` (None: with none), which is said on
    standard error where it is not, or where the model is not usable. Raises what `gate` and
    `read_json` raise."""
    from greybox.files import read_json

    if path is None:
        return True
    found = gate(read_json(path), path, even_so=arguments.even_so, use=Use.BUILDS)
    found.say(arguments.command)
    return found.open


def begun_with(model: IdentifiedModel, arguments: argparse.Namespace) -> IdentifiedModel:
    """The model of an `admitted` file; without its verdict where --even-so overruled that."""
    return replace(model, verdict=None) if arguments.even_so else model


def gate(content: Parsed, path: str, *, even_so: bool, use: Use = Use.FLIES) -> Gate:
    """Judge a model file (`content`, read from `path`) by the verdict that it carries, for `use`.

    Closed where that says so and nobody said `even_so`. To fly, a file without a verdict (an older
    one) passes with a warning; who builds is told of what is wrong alone. A linear model whose fit
    did not converge passes with a warning. Raises `FileFormatError` for a verdict that is
    incomplete.
    """
    from greybox.errors import FileFormatError
    from greybox.model.identified import SCHEMA
    from greybox.model.verdict import NOT_JUDGED, Outcome, Verdict

    base = content.get("base")
    linear = base if content.get("kind") == "output-hybrid" and isinstance(base, dict) else content
    if linear.get("schema") != SCHEMA:
        return Gate(open=True, line=_unsettled(linear, path))
    data = (base if isinstance(base, dict) else content).get("verdict")
    if data is None:
        missing = f"warning: {path}: {NOT_JUDGED}" if use is Use.FLIES else ""
        return Gate(open=True, line=missing)
    try:
        verdict = Verdict.from_dict(data)
    except (KeyError, TypeError, ValueError, AttributeError):
        raise FileFormatError(
            "incomplete verdict", where=path, fix="write the file again"
        ) from None
    unfinished = verdict.outcome is Outcome.UNFINISHED
    closed = verdict.refused if use is Use.FLIES else unfinished
    if closed and not even_so:
        return Gate(
            open=False, line=f"{path}: {verdict.sentence}. To go on all the same: --even-so"
        )
    if use is Use.BUILDS and not verdict.refused:
        return Gate(open=True, line="")
    mark = "" if verdict.outcome is Outcome.USABLE else "warning: "
    return Gate(open=True, line=f"{mark}{path}: {verdict.line}")


def _unsettled(content: Parsed, path: str) -> str:
    """The warning of a linear model, or of several in one file, that did not converge. Whether they
    predict well stands in tables of their own."""
    parts = content.get("models")
    ends = [m["unsettled"] for m in (parts or [content]) if m.get("unsettled")]
    return f"warning: {path}: {'; '.join(dict.fromkeys(ends))}" if ends else ""
