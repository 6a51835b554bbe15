"""What forbids to build on a vehicle file and its flights: one answer for all that build on them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

from greybox.data import Dataset, Flight
from greybox.data.airframe import Airframe
from greybox.data.checks import VEHICLE, CheckReport, Finding
from greybox.data.checks import check as check_flights
from greybox.data.raw import RawLog
from greybox.errors import DataError
from greybox.model.plausibility import vehicle_findings
from greybox.model.plausibility.finding import SEVERITIES, Severity
from greybox.model.vehicle import Vehicle
from greybox.takes import LOGS, takes
from greybox.takes import NAMES as LIST_OF_NAMES
from greybox.takes import VEHICLE as A_VEHICLE


class BadDataError(DataError):
    """Faults of a vehicle file or of flights block what was asked for; `report` has them."""

    def __init__(self, report: CheckReport, what: str) -> None:
        self.report = report
        first, *others = report.blocking
        more = f" (and {len(others)} more)" if others else ""
        accept = list(dict.fromkeys(f.check for f in report.blocking))
        super().__init__(
            f"faults block {what}: {first.flight}: {first.message}{more}",
            fix=f"{first.fix or 'see greybox.check'}; to go on all the same, accept={accept}",
        )


def faults_of(
    vehicle: Vehicle,
    data: Dataset | Flight | Sequence[RawLog] = (),
    *,
    accept: Iterable[str] = (),
    file: str | None = None,
) -> CheckReport:
    """What is wrong with a vehicle (read from `file`), and with flights: these are not judged by a
    vehicle that no craft is like. Blocking findings of the checks in `accept` do not block. Raises
    what `check` raises."""
    report = check_flights((), vehicle, accept=accept)
    own = _of_vehicle(vehicle, file, ("blocking",))
    report = replace(report, findings=own)
    if not report.ok:
        return report
    found = check_flights(data, vehicle, accept=report.accepted)
    return replace(found, findings=(*own, *found.findings))


@takes(data=LOGS, vehicle=A_VEHICLE, accept=LIST_OF_NAMES)
def check(
    data: Dataset | Flight | Sequence[RawLog],
    vehicle: Airframe,
    *,
    accept: Iterable[str] = (),
    file: str | None = None,
) -> CheckReport:
    """Look for faults of flights, and of the vehicle (read from `file`), of which `fit` says or
    refuses the same. Raw logs (`read_table`) show everything; a data set no longer shows faults of
    its clock.

    Blocking findings of the checks named in `accept` do not block; the report keeps them and says
    so. Raises `DataError` where two logs have the same name or one is none (no rows, no channels,
    stamps that are no numbers), and `UnknownNameError` for a check that there is not.
    """
    found = check_flights(data, vehicle, accept=accept)
    if not isinstance(vehicle, Vehicle):
        return found
    every = (*_of_vehicle(vehicle, file, ("blocking", "warning")), *found.findings)
    return replace(found, findings=tuple(sorted(every, key=lambda f: SEVERITIES.index(f.severity))))


def _of_vehicle(
    vehicle: Vehicle, file: str | None, severities: Sequence[Severity]
) -> tuple[Finding, ...]:
    return tuple(
        Finding(
            check=VEHICLE,
            severity=f.severity,
            flight=file or vehicle.name,
            where=f.where,
            message=f"{f.where}: {f.message}; expected {f.expected}, got {f.got}",
            fix=f.fix,
        )
        for f in vehicle_findings(vehicle)
        if f.severity in severities
    )


def demand_sound(report: CheckReport, what: str) -> None:
    """Raise `BadDataError` where faults block `what`."""
    if not report.ok:
        raise BadDataError(report, what)
