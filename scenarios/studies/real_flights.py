"""Is a sound flight ever blocked? Every real log: whether it can be fitted, what blocks it, how
many samples are taken as missing in flight.

    python -m scenarios.studies.real_flights [FOLDER ...]

Without a folder the flights of the package. A FOLDER may have logs of any format, also below it. A
log's vehicle file is that of the package where the package has a flight of that name, else what
`greybox vehicle new --from LOG` makes of it. Flights of one vehicle are judged together, as
`greybox check` does. Exit code 1 where a usable log is blocked or loses a sample in flight.
"""

from __future__ import annotations

import argparse
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path

from greybox.data import RawLog, read_table
from greybox.data.checks import CheckReport, check
from greybox.data.inspection import inspect_log
from greybox.errors import GreyboxError
from greybox.examples import SETS, flight_paths, vehicle_path
from greybox.model.vehicle import Vehicle, read_vehicle
from greybox.model.vehicle_from_log import vehicle_from_log

NO_LOGS = ("readme", "license", "flights.json", "sha256sums", "vehicle.toml")


def logs(folders: Sequence[Path]) -> Iterator[Path]:
    """All files below the folders that are not beside a log."""
    for folder in folders:
        for path in sorted(folder.rglob("*")):
            if path.is_file() and not path.name.lower().startswith(NO_LOGS):
                yield path


def known() -> dict[str, Vehicle]:
    """Vehicle of each flight of the package, by the flight's name."""
    return {
        p.name.split(".")[0]: read_vehicle(vehicle_path(s)) for s in SETS for p in flight_paths(s)
    }


def judged(raw: RawLog, report: CheckReport) -> tuple[int, int]:
    """(blocking findings, samples taken in flight) of one log in a report; both are printed."""
    mine = [f for f in report.findings if f.flight == raw.flight]
    blocking = [f for f in mine if f.severity == "blocking"]
    lost = [
        f
        for f in mine
        if f.check == "ranges" and f.severity == "warning" and "missing" in f.message
    ]
    for f in blocking + lost:
        print(f"    {f.severity} [{f.check}] {f.where}: {f.message}")
    return len(blocking), sum(int(f.evidence["rows"]) for f in lost)


def main(argv: Sequence[str] | None = None) -> int:
    """Judge all logs and print the counts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", nargs="*", type=Path, metavar="FOLDER")
    arguments = parser.parse_args(argv)
    own = known()
    paths = list(logs(arguments.folders)) or [p for s in SETS for p in flight_paths(s)]
    craft: dict[str, tuple[Vehicle, list[RawLog]]] = {}
    unusable = 0
    for path in paths:
        name = path.name.split(".")[0]
        vehicle = own.get(name) if path.name.endswith((".csv", ".csv.gz")) else None
        try:
            said = inspect_log(path, vehicle).unfit
            if said:
                unusable += 1
                print(f"{path.name}: not usable: {'; '.join(said)}")
                continue
            made = vehicle or Vehicle.from_dict(tomllib.loads(vehicle_from_log(path, {}).text))
            raw = read_table(path, made)
        except GreyboxError as error:
            unusable += 1
            print(f"{path.name}: refused: {error}")
            continue
        craft.setdefault(vehicle.name if vehicle else str(path), (made, []))[1].append(raw)
    blocked = lost = flights = 0
    for made, those in craft.values():
        report = check(those, made)
        for raw in those:
            flights += 1
            print(f"{Path(raw.source).name}:")
            found = judged(raw, report)
            blocked += found[0] > 0
            lost += found[1]
    print(
        f"{len(paths)} logs: {unusable} not usable, {flights} judged, {blocked} blocked, {lost} "
        "samples taken in flight"
    )
    return 1 if blocked or lost else 0


if __name__ == "__main__":
    raise SystemExit(main())
