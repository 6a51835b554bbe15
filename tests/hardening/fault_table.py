"""Every fault of channels and vehicle files, put into sound flights: found, refused, survived or
silent.

    python -m tests.hardening.fault_table [FOLDER ...]

Without a folder the flights are real ones of the package. A folder has vehicle.toml and train1.csv,
as `python -m scenarios.foreign.draw` writes them. Prints one row per fault and the counts; exit
code 1 where a fault is silent.
"""

from __future__ import annotations

import argparse
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from greybox.data import RawLog, read_table
from greybox.data.checks import check
from greybox.errors import GreyboxError
from greybox.examples import flight_path, vehicle_path
from greybox.model.plausibility import check_vehicle
from greybox.model.vehicle import Vehicle, read_vehicle
from tests.hardening.channel_faults import CHANNEL_FAULTS, have
from tests.hardening.vehicle_faults import VEHICLE_FAULTS

REAL = (("nanobench", "B2_circle_medium_rep1"),)
SILENT, NONE = "SILENT", "-"
Said = frozenset[tuple[str, str, str]]


def said(raw: RawLog, vehicle: Vehicle) -> Said:
    """(severity, check, message without its numbers) of what `greybox check` says."""
    findings = check([raw], vehicle).findings
    words = [(f.severity, f.check, re.sub(r"[-+\d.e]+", "#", f.message)) for f in findings]
    return frozenset(w for w in words if w[0] != "info")


def outcome(find: Callable[[], Said], clean: Said) -> str:
    """What became of a fault: refused, blocked by, warning of, or SILENT."""
    try:
        new = find() - clean
    except GreyboxError:
        return "refused"
    for severity, word in (("blocking", "blocked by"), ("warning", "warning of")):
        checks = sorted({c for s, c, _ in new if s == severity})
        if checks:
            return f"{word} {', '.join(checks)}"
    return SILENT


def of_vehicle(vehicle: Vehicle, raw: RawLog) -> Said:
    """What a vehicle file is told by its own check, and by a flight."""
    own = {
        (f.severity, "vehicle check", f.message)
        for f in check_vehicle(vehicle).findings
        if f.severity != "info"
    }
    return frozenset(own) | said(raw, vehicle)


def table(
    raw: RawLog, vehicle: Vehicle, names: Sequence[str] | None = None
) -> Iterator[tuple[str, str, str]]:
    """(class, fault, outcome) for every fault that this log can have, or those named."""
    clean = of_vehicle(vehicle, raw)
    for name, fault in CHANNEL_FAULTS.items():
        if names is not None and name not in names:
            continue
        if not have(raw, fault.needs):
            yield fault.kind, name, NONE
            continue
        found = outcome(lambda make=fault.make: said(make(raw), vehicle), clean)  # type: ignore[misc]
        yield (
            fault.kind,
            name,
            f"survived: {fault.harmless}" if found == SILENT and fault.harmless else found,
        )
    for name, change in VEHICLE_FAULTS.items():
        if names is None or name in names:
            yield (
                "vehicle file",
                name,
                outcome(lambda make=change: of_vehicle(make(vehicle), raw), clean),
            )  # type: ignore[misc]


def flights(folders: Sequence[str]) -> Iterator[tuple[str, RawLog, Vehicle]]:
    """(name, log, vehicle) of what is to be judged."""
    if folders:
        for folder in map(Path, folders):
            vehicle = read_vehicle(folder / "vehicle.toml")
            yield folder.name, read_table(folder / "train1.csv", vehicle), vehicle
        return
    for of, name in REAL:
        vehicle = read_vehicle(vehicle_path(of))
        yield f"{of} {name}", read_table(flight_path(of, name), vehicle), vehicle


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", nargs="*", metavar="FOLDER")
    arguments = parser.parse_args(argv)
    silent = 0
    for name, raw, vehicle in flights(arguments.folders):
        print(f"## {name}\n\n| class | fault | outcome |\n|---|---|---|")
        counts: Counter[str] = Counter()
        for kind, fault, found in table(raw, vehicle):
            print(f"| {kind} | {fault} | {found} |", flush=True)
            counts[found.split(" ")[0].rstrip(":")] += 1
        silent += counts[SILENT]
        total = sum(n for w, n in counts.items() if w != NONE)
        print(
            f"\n{total} faults: {', '.join(f'{n} {w}' for w, n in counts.items() if w != NONE)}\n",
            flush=True,
        )
    return 1 if silent else 0


if __name__ == "__main__":
    raise SystemExit(main())
