"""What `greybox fit` writes and says of a fit."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from greybox.commands.fit_flights import Job
    from greybox.estimation.document import FitDocument
    from greybox.estimation.recipe import Recipe
    from greybox.estimation.result import Fit
    from greybox.validation.result import Validation

from greybox.commands.command_line import typed
from greybox.commands.fit_own import COMMAND
from greybox.commands.mcap_option import write_if_asked
from greybox.commands.model_options import explicit_recipe


def save(job: Job, found: Fit) -> FitDocument:
    """Write fit.json, model.json and, where something was decided, the explicit command as a
    script. Returns the first."""
    from greybox.files import write_atomic, write_json

    content = _content(job, found)
    write_json(job.out / "fit.json", content)
    found.model.save(job.out / "model.json")
    if "explicit" in content:
        write_atomic(job.out / COMMAND, _script(content["explicit"]["command"]))
    return content


def _script(command: str) -> str:
    """A shell script of the `command`, one option a line; what its caller adds comes last."""
    lines = [["greybox", "fit"]]
    for word in shlex.split(command)[2:]:
        lines += [[word]] if word.startswith("--") else []
        lines[-1] += [] if word.startswith("--") else [word]
    told = "# The same fit with every choice said: change them here. What is added comes last."
    return f"{told}\n" + " \\\n  ".join([*map(shlex.join, lines), '"$@"']) + "\n"


def _content(job: Job, result: Fit) -> FitDocument:
    """fit.json, with the commands that do the same."""
    content = result.to_dict()
    content["warnings"] = [*job.warnings[0], *content["warnings"], *job.warnings[1]]
    content["command"] = typed("fit")
    if "explicit" in content:
        content["explicit"]["command"] = _explicit(job, result)
        # The recipe speaks of the vehicle with another's effects.
        if job.arguments.source is not None:
            file = str(job.out / "model.json")
            content["explicit"]["python"] = (
                "from greybox.model.identified import IdentifiedModel\n"
                f"vehicle = IdentifiedModel.load({file!r}).physics.vehicle\n"
                f"{content['explicit']['python']}"
            )
    return content


def recipe_of(job: Job, result: Fit) -> Recipe:
    """What was fitted."""
    return result.provenance.recipe or explicit_recipe(job.arguments, result)


def _explicit(job: Job, result: Fit) -> str:
    """The explicit command line: every choice is said, flights that were left out are not named."""
    from greybox.automatic.fit import adaptation_of

    arguments, prepared, recipe = job.arguments, job.prepared, recipe_of(job, result)
    recipe = replace(recipe, adapt=adaptation_of(recipe, job.test, arguments.adapt))
    out = {f.flight for f in prepared.left_out}
    train = [p for p, name in zip(arguments.train, prepared.names, strict=True) if name not in out]
    words = recipe.command_line(arguments.vehicle, train, arguments.test)
    more = ["--mapping", arguments.mapping] if arguments.mapping else []
    told = [d.choice for d in result.provenance.decisions if d.option == "--from"]
    more += ["--from", arguments.source] if arguments.source and told != ["nothing"] else []
    more += (
        []
        if arguments.max_iterations is None
        else ["--max-iterations", str(arguments.max_iterations)]
    )
    more += ["--effects-file", *arguments.effects_file] if arguments.effects_file else []
    more += ["--keep-impossible"] if arguments.keep_impossible else []
    more += ["--keep-noise-free"] if arguments.keep_noise_free else []
    more += ["--accept", arguments.accept] if arguments.accept else []
    more += ["--judge-left-out"] if arguments.judge_left_out or not arguments.test else []
    return words + (" " + shlex.join(more) if more else "")


def report(job: Job, result: Fit, content: FitDocument, seen: Validation | None) -> str:
    """Write validate.json, report.html and the recording. Returns the names of all files of the
    fit, for people."""
    from greybox.commands.flight_series import series
    from greybox.commands.responses import responses
    from greybox.data import Dataset
    from greybox.files import write_atomic, write_json
    from greybox.report.fit_report import fit_report
    from greybox.validation.usefulness import LEFT_OUT

    out, data, test = job.out, job.prepared.data, job.test
    checked = None if seen is None else seen.to_dict()
    if checked is not None:
        if not test.flights:
            verdict = result.verdict
            pieces = verdict is not None and verdict.judged_on == LEFT_OUT
            where = "pieces of the training flights" if pieces else "the flights that were fitted"
            checked["warnings"].insert(0, f"validated on {where}: give --test flights")
        write_json(out / "validate.json", checked)
    on = None if checked is None else checked["adapted_on"]
    adapted = {} if on is None else on["flights"]
    # The flight that judges is drawn; a fitted one where there is none.
    drawn = (Dataset(flights=()), test) if test.flights else (data,)
    drawing = series(result.model, *drawn, adapted=adapted)
    # What physics says on the terminal stands on the page, too.
    said: FitDocument = {**content, "warnings": [*sanity_lines(result), *content["warnings"]]}
    answers = responses(result.model, data, test)
    title = f"Fit of {result.model.physics.vehicle.name}"
    report = write_atomic(
        out / "report.html", fit_report(said, drawing, checked, responses=answers, title=title)
    )
    write_if_asked(job.arguments.mcap, result.model, data, test, adapted=adapted)
    return f"{', '.join(p.name for p in sorted(out.glob('*.json')))} and {report.name}"


def lines(
    job: Job, result: Fit, table: str, content: FitDocument, pushed: Sequence[str]
) -> list[str]:
    """The verdict and what the logs, pushes and physics say, the decisions with their reasons, the
    estimates, the script that says every choice."""
    all_said = result.summary().splitlines()
    judged = 1 if result.verdict is None else len(result.verdict.lines())
    first, rest = all_said[:judged], all_said[judged:]
    doubts = result.covariance
    for line in (doubts.beyond, *doubts.changed, doubts.form):
        if line:  # it is said at once, with what to do next
            rest.remove(f"warning: {line}")
    told = [f"warning: {w}" for some in job.warnings for w in some]
    lines = [*first, *next_step(job, result, pushed), *told, *sanity_lines(result)]
    if result.provenance.decisions:
        lines += ["", "Decided, because nothing else was said:"]
        lines += [f"  {decision.line()}" for decision in result.provenance.decisions]
        lines += [""]
    lines += rest
    if table:
        lines += [table, ""]
    if "explicit" in content:
        again = shlex.join(["sh", str(job.out / COMMAND), "--out", "again"])
        lines += [f"the same with every choice said: {again}"]
    return lines


def sanity_lines(result: Fit) -> list[str]:
    """What physics says about the estimates."""
    from greybox.validation.sanity import sanity_of

    return sanity_of(result).lines()


def with_pushes(job: Job, result: Fit) -> tuple[Fit, list[str]]:
    """(the judged fit, whose verdict says first that pushes without a name carry it; what such
    pushes tell)."""
    from greybox.residual.followed import told_of_pushes

    verdict = result.verdict
    if verdict is None or verdict.refused or not verdict.groups or not result.converged:
        return result, []
    pushed, reserve = told_of_pushes(result.model, job.prepared.data, verdict.groups)
    if reserve:
        line, why = f"USE WITH ITS FILTER ONLY: {verdict.line}", (reserve, *verdict.why)
        verdict = replace(verdict, line=line, why=why)
    return result.judged(verdict), pushed


def next_step(job: Job, result: Fit, pushed: Sequence[str]) -> list[str]:
    """What to do where flights push beyond a bound, which comes before all else; where the craft
    changed within a flight, which looks like whatever may be missing; and the command that names
    what is missing, where parameters stand in for that, or pushes without a name follow the motion
    and matter ahead or carry the craft."""
    form, changed = result.covariance.form, result.covariance.changed
    told = [*([form] if form else []), *pushed]
    if result.covariance.beyond:
        return [f"next: {result.covariance.beyond}", *(f"then: {t}" for t in (*changed, *told))]
    steps = [f"fit apart what was flown before and after: {'; '.join(changed)}"] if changed else []
    steps += [discover_command(job.arguments)] if told else []
    said = [f"{word}: {step}" for word, step in zip(("next", "then"), steps, strict=False)]
    return [*said, *(f"  {reason}" for reason in told)]


def discover_command(arguments: argparse.Namespace) -> str:
    """The search in the same flights."""
    words = ["greybox", "discover", "--vehicle", arguments.vehicle, "--train", *arguments.train]
    for option, values in (
        ("--test", arguments.test),
        ("--mapping", [arguments.mapping] if arguments.mapping else []),
        ("--accept", [arguments.accept] if arguments.accept else []),
        ("--effects-file", arguments.effects_file),
    ):
        words += [option, *values] if values else []
    words += ["--keep-impossible"] if arguments.keep_impossible else []
    return shlex.join(words)
