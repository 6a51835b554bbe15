"""`greybox inspect`: what a log holds, what greybox can use, what is missing, and how to log it."""

from __future__ import annotations

import argparse
import shlex
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from greybox.commands.command_line import Subcommands
from greybox.commands.console import Console, json_option

if TYPE_CHECKING:
    from greybox.data.column_guess import Guess
    from greybox.data.document import Allowed, Findings, GuessRow, Uses
    from greybox.data.inspection import Inspection
    from greybox.model.vehicle import Vehicle


def add(subparsers: Subcommands) -> None:
    """Declare the command."""
    p = subparsers.add_parser(
        "inspect",
        help="show what a log of any format holds and what greybox can use of it",
        description="Show the streams of a log (PX4 ULog, ROS bag, MCAP, Betaflight, Crazyflie, "
        "MATLAB, Parquet, CSV) with rates and gaps, and the channels that greybox makes of them. "
        "Says which effects they allow, what is missing and which logging settings would provide "
        "it. Exit code 0: the log can be used; 1: it cannot as it is; 2: bad input.",
    )
    p.add_argument("log", metavar="LOG", help="flight log of any format (docs/logs.md)")
    p.add_argument(
        "--mapping",
        metavar="MAP.toml",
        help="which fields of the log are which channels (docs/logs.md)",
    )
    p.add_argument(
        "--vehicle",
        metavar="V.toml",
        help="vehicle file: names of columns, number of rotors, known facts",
    )
    p.add_argument(
        "--all", action="store_true", help="list every stream, also those that are not used"
    )
    p.add_argument(
        "--out",
        metavar="LOG.csv",
        help="write the canonical channels to this CSV file (.csv or .csv.gz)",
    )
    p.add_argument(
        "--draft",
        metavar="MAP.toml",
        help="write what columns with names of their own look like as a mapping "
        "file, to be looked over",
    )
    p.add_argument("--force", action="store_true", help="let --draft write over an existing file")
    json_option(p, "the findings")
    p.set_defaults(run=run, one_file=True)


def run(arguments: argparse.Namespace) -> int:
    """Inspect, convert, print. Returns 0, or 1 where the log has no commands and sensors in common
    to fit."""
    from greybox.data.column_guess import draft
    from greybox.data.inspection import inspect_log
    from greybox.data.logs.write import write_csv
    from greybox.errors import DataError
    from greybox.files import no_overwriting, write_atomic
    from greybox.model.vehicle import read_vehicle

    if arguments.draft:
        no_overwriting(arguments.draft, "--draft", force=arguments.force)
    vehicle = read_vehicle(arguments.vehicle) if arguments.vehicle else None
    found = inspect_log(arguments.log, vehicle, mapping=arguments.mapping)
    guesses, time = looks(found, named=bool(arguments.mapping))
    content: Findings = {
        **found.to_dict(),
        "effects": effects(found, vehicle),
        "uses": uses(found),
        "looks_like": guessed(guesses, time),
        "next": [],
    }
    content["next"] = advice(
        found,
        content,
        arguments,
        beside(arguments.log, found) if vehicle is None else None,
        time,
    )
    written = None
    if arguments.draft:
        if not guesses:
            raise DataError("no column looks like a channel that is missing", where=arguments.log)
        there = (g.group for g in found.groups)
        text_of = draft(guesses, time, there, clocked=clocked(found))
        write_atomic(arguments.draft, text_of)
    if arguments.out:
        if found.raw is None:
            raise DataError(f"nothing to write to {arguments.out}: {found.problem}")
        written = write_csv(arguments.out, found.raw)
    csv = (
        []
        if written is None
        else [f"wrote {written}: {content['rows']} rows, {content['duration']:.3f} s"]
    )
    Console.of(arguments).result(content, text(content, every=arguments.all), *csv)
    return 0 if content["uses"]["fit"] else 1


def guessed(guesses: Sequence[Guess], time: tuple[str, str] | None) -> list[GuessRow]:
    """What columns look like, the clock first."""
    rows: list[GuessRow] = []
    if guesses and time is not None:
        rows += [
            {
                "group": "time",
                "fields": [time[0]],
                "unit": time[1],
                "frame": "",
                "limits": None,
                "why": "grows by the steps of a flight log",
            }
        ]
    rows += [
        {
            "group": g.group,
            "fields": list(g.fields),
            "unit": g.unit,
            "frame": g.frame,
            "limits": g.limits,
            "why": g.why,
        }
        for g in guesses
    ]
    return rows


def looks(found: Inspection, *, named: bool) -> tuple[tuple[Guess, ...], tuple[str, str] | None]:
    """(guesses, time column) of tables with columns of their own; nothing where a mapping file says
    what they are."""
    from greybox.data.column_guess import guess_columns, guess_streams, guess_time
    from greybox.data.readers.folder import FORMAT
    from greybox.data.readers.mapping import TABLE

    if found.format is FORMAT and not named:
        tables = {n: s.fields for n, s in found.recording.streams.items()}
        return guess_streams(tables, without={g.group for g in found.groups}), None
    if named or found.format.table is None or TABLE not in found.recording.streams:
        return (), None
    columns = found.recording.streams[TABLE].fields
    return guess_columns(columns, without={g.group for g in found.groups}), guess_time(columns)


def clocked(found: Inspection) -> bool:
    """Whether a log has a time."""
    return any(s.rate > 0.0 for s in found.recording.streams.values())


def beside(log: str, found: Inspection) -> str | None:
    """A vehicle file in the folder of the log whose `[columns]` are all there."""
    from greybox.data.readers.mapping import TABLE
    from greybox.errors import GreyboxError, OldFormWarning
    from greybox.model.vehicle import read_vehicle

    stream = found.recording.streams.get(TABLE)
    if stream is None:
        return None
    for path in sorted(Path(log).parent.glob("*.toml"))[:20]:
        try:
            with warnings.catch_warnings():  # nobody asked for this file
                warnings.simplefilter("ignore", OldFormWarning)
                columns = read_vehicle(path).columns
        except GreyboxError:
            continue
        if columns.names and columns.names <= set(stream.fields):
            return str(path)
    return None


def advice(
    found: Inspection,
    content: Findings,
    arguments: argparse.Namespace,
    known: str | None,
    time: tuple[str, str] | None = None,
) -> list[str]:
    """What to do next, in the order in which to try it; `time` is the column that looks like a
    clock."""
    log, has = (
        shlex.quote(arguments.log),
        [f"--mapping {shlex.quote(arguments.mapping)}"] if arguments.mapping else [],
    )
    has += [f"--vehicle {shlex.quote(arguments.vehicle)}"] if arguments.vehicle else []
    if known is not None:
        return [
            f"{known} knows these columns: greybox inspect {log} --vehicle {shlex.quote(known)}"
        ]
    out = []
    if content["looks_like"]:
        mapped = shlex.quote(arguments.draft or "map.toml")
        again = f"greybox inspect {log}"
        again += f" --vehicle {shlex.quote(arguments.vehicle)}" if arguments.vehicle else ""
        if arguments.draft:
            fill = (
                "" if time or clocked(found) else "no column looks like a clock: fill in [time], "
            )
            like = {g["group"] for g in content["looks_like"]} | {g.group for g in found.groups}
            if like.isdisjoint(("command", "rotor_speed")):
                fill += "no columns look like commands: fill in [command], "
            out.append(f"{fill}look {arguments.draft} over, then: {again} --mapping {mapped}")
        else:
            out.append(f"write the guess and look it over: {again} --draft {mapped}")
            out.append(f"then: {again} --mapping {mapped}")
        if not arguments.mapping:
            has.insert(0, f"--mapping {mapped}")
    if arguments.vehicle is None:
        from greybox.model.vehicle_template import TEMPLATES

        start, names = f"--from {log}", "what the log knows of the craft"
        if found.format.table is not None or found.format.name == "folder":
            start, names = "--template NAME", ", ".join(TEMPLATES)
        out.append(
            f"a vehicle file: greybox vehicle new {start} --out V.toml ({names}; docs/vehicle.md)"
        )
        has.append("--vehicle V.toml")
    if content["uses"]["fit"]:
        out.append(f"greybox check {' '.join([*has, log])}")
        if arguments.vehicle is not None:
            out.append(f"greybox fit {' '.join(has)} --train {log} ... (docs/tutorial.md)")
    return out


def _sensors(found: Inspection) -> tuple[str, ...]:
    from greybox.model.sensors import SENSORS

    groups = {g.group for g in found.groups}
    measured = {"rotation": "attitude"}
    return tuple(s.name for s in SENSORS if measured.get(s.group, s.group) in groups)


def uses(found: Inspection) -> Uses:
    """Which sensors of the model the log feeds, and what can be fitted: commands or rotor speeds,
    and a sensor."""
    from greybox.model.sensors import USUAL

    groups = {g.group for g in found.groups}
    sensors = [s for s in _sensors(found) if s in {x.name for x in USUAL}]
    driven = bool({"command", "rotor_speed"} & groups)
    measured = ("rate", "specific_force", "attitude", "position", "velocity", "rotor_speed")
    return {
        "fit": driven and bool(sensors) and not found.unfit,
        "sensors": list(_sensors(found)),
        "rotation": driven and bool({"rate", "attitude"} & groups),
        "translation": driven and bool({"specific_force", "velocity", "position"} & groups),
        "speed_input": "rotor_speed" in groups and bool(sensors) and not found.unfit,
        # The stationary gain of the innovation form takes every channel to be there at every
        # sample.
        "predictor": "kalman"
        if any(g.share < 0.9 for g in found.groups if g.group in measured)
        else "innovation",
        "open_loop_horizons": sorted(groups & {"position", "velocity", "attitude", "rate"}),
    }


def effects(found: Inspection, vehicle: Vehicle | None) -> Allowed:
    """Effects of the catalogue that the log allows, and what the others lack. Facts of a vehicle
    file count if given. Where rotor speeds drive the model, what shapes a command lacks it."""
    from greybox.model.composition import acts_on_speeds
    from greybox.model.effects import CATALOGUE

    sensors = _sensors(found)
    groups = {g.group for g in found.groups}
    of_speeds = "rotor_speed" in groups and "command" not in groups
    columns = [c for g in found.groups for c in g.channels]
    possible: list[str] = []
    lacking: dict[str, list[str]] = {}
    for effect in CATALOGUE:
        lacks = effect.missing(vehicle, sensors, columns)
        if vehicle is None:
            lacks = tuple(part for part in lacks if not part.endswith("in the vehicle file"))
        if of_speeds and not acts_on_speeds(effect):
            lacks = ("commands", *lacks)
        if lacks:
            lacking[effect.name] = list(lacks)
        else:
            possible.append(effect.name)
    return {"possible": possible, "lacking": lacking}


def text(content: Findings, *, every: bool = False) -> str:
    """The result for a terminal."""
    problem = content["problem"]
    lines = [f"{content['log']}: {content['title']}", f"  {content['verdict']}"]
    lines += [f"  {k}: {v}" for k, v in content["info"].items()]
    lines += _holds(content, every)
    lines += ["", f"CANNOT BE USED AS IT IS  {problem}"] if problem else _usable(content)
    if content["looks_like"]:
        lines += _looks_like(content)
    if content["missing"] and not problem:
        lines += _missing(content)
    if content["advice"]:
        lines += ["", f"HOW TO LOG  {content['advice']}"]
    if content["rotors"]:
        lines += _rotors(content)
    for title, said in (("NOTES", content["notes"]), ("NEXT", content["next"])):
        if said:
            lines += ["", title, *(f"  {n}" for n in said)]
    return "\n".join(lines)


def _holds(content: Findings, every: bool) -> list[str]:
    """The streams of the log, all of them or those that are used."""
    used = {c["from"].partition(": ")[2].partition(" [")[0] for c in content["channels"]}
    used |= {o.split(": ")[2].partition(" [")[0] for o in content["other_sources"]}
    shown = [
        s for s in content["streams"] if every or s["name"] in used or len(content["streams"]) <= 12
    ]
    lines = ["", f"HOLDS  {len(content['streams'])} stream(s)"]
    width = min(max((len(s["name"]) for s in shown), default=0), 40)
    for s in shown:
        span = "" if s["start"] is None else f"{s['start']:.2f}..{s['end']:.2f} s"
        gaps = f", {s['gaps']} gap(s), longest {1e3 * s['longest_gap']:.0f} ms" if s["gaps"] else ""
        back = f", {s['backward_steps']} step(s) back" if s["backward_steps"] else ""
        lines.append(
            f"  {s['name']:{width}}  {s['samples']:7d} x {s['rate']:7.5g} Hz  {span}{gaps}{back}"
        )
        if len(content["streams"]) <= 3 or every:
            fields = [f for f in s["fields"] if "covariance" not in f]
            names = ", ".join(fields[:24]) + (", ..." if len(fields) > 24 else "")
            lines.append(f"    {names}")
    if len(shown) < len(content["streams"]):
        lines.append(
            f"  and {len(content['streams']) - len(shown)} that greybox has no use for (--all "
            "lists them)"
        )
    clocks = sorted({s["clock"] for s in shown if s["clock"]})
    lines += [f"  clock: {c}" for c in clocks[:4]]
    lost = content["dropouts"]
    if lost:
        lines.append(
            f"  the logger reports {len(lost)} drop-out(s), {sum(d['length'] for d in lost):.2f} s "
            "in all"
        )
    return lines


def _usable(content: Findings) -> list[str]:
    """What greybox takes of them, and what it can fit."""
    lines = ["", f"GREYBOX CAN USE  {content['rows']} rows over {content['duration']:.2f} s"]
    for c in content["channels"]:
        few = "" if c["enough"] else "  (slow)"
        units = ", ".join(sorted({u["unit"] for u in c["channels"]} - {"1"}))
        lines.append(f"  {c['from']}{' -> ' + units if units else ''}{few}")
    good = content["uses"]
    whole = good["fit"] or good["speed_input"]
    none = (
        "nothing under these names (see LOOKS LIKE and NEXT)"
        if content["looks_like"]
        else "nothing"
    )
    lines.append(
        "  fits: "
        + (
            (
                ", ".join(["rotation"] * good["rotation"] + ["translation"] * good["translation"])
                or none
            )
            if whole
            else none
            if content["looks_like"]
            else "no"
        )
        + (", also with rotor speeds as the input" if good["speed_input"] else "")
    )
    if whole and good["predictor"] == "kalman":
        lines.append("  some channels come slower than the rows: fit with --predictor kalman")
    for other in content["other_sources"][:8]:
        lines.append(f"  also there: {other}")
    possible, lacking = content["effects"]["possible"], content["effects"]["lacking"]
    lines.append(f"  effects: {len(possible)} of {len(possible) + len(lacking)}")
    lines += [f"    {name} lacks {', '.join(lacks)}" for name, lacks in lacking.items()]
    return lines


def _looks_like(content: Findings) -> list[str]:
    """What columns with names of their own may be."""
    lines = ["", "LOOKS LIKE  a guess from names and sizes; nothing of it is used by itself"]
    for g in content["looks_like"]:
        span = f"{g['limits'][0]:g} to {g['limits'][1]:g}" if g["limits"] else ""
        said = ", ".join(part for part in (*g["fields"], g["unit"], span, g["frame"]) if part)
        lines.append(f"  {g['group']}: {said}  ({g['why']})")
    return lines


def _missing(content: Findings) -> list[str]:
    """Channels that are not there, what for, and how to log them."""
    guessed = {g["group"] for g in content["looks_like"]}
    lines = ["", "MISSING"]
    for m in content["missing"]:
        if m["group"] in guessed:
            lines.append(
                f"  {m['group']} ({', '.join(m['channels'])}): not by this name, see above; "
                f"{m['purpose']}"
            )
            continue
        lines.append(f"  {m['group']} ({', '.join(m['channels'])}): {m['reason']}; {m['purpose']}")
        if m["advice"]:
            lines.append(f"    to log it: {m['advice']}")
    return lines


def _rotors(content: Findings) -> list[str]:
    """The rotors that the log states, as a vehicle file has them."""
    lines = ["", "ROTORS of the log, for the vehicle file"]
    for r in content["rotors"]:
        x, y, z = r["position"]
        lines += [
            "  [[rotor]]",
            f"  position = [{x:.4g}, {y:.4g}, {z:.4g}]",
            f"  spin = {r['spin']}",
        ]
    return lines
