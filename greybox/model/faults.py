"""What forbids to build on a vehicle file and its flights: one answer for all that build on them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

from greybox.data import Dataset, Flight
from greybox.data.checks import VEHICLE, CheckReport, Finding, check
from greybox.data.raw import RawLog
from greybox.errors import DataError
from greybox.model.plausibility import vehicle_findings
from greybox.model.vehicle import Vehicle


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
    report = check((), vehicle, accept=accept)
    own = tuple(
        Finding(
            check=VEHICLE,
            severity="blocking",
            flight=file or vehicle.name,
            where=f.where,
            message=f"{f.where}: {f.message}; expected {f.expected}, got {f.got}",
            fix=f.fix,
        )
        for f in vehicle_findings(vehicle)
        if f.severity == "blocking"
    )
    report = replace(report, findings=own)
    if not report.ok:
        return report
    found = check(data, vehicle, accept=report.accepted)
    return replace(found, findings=(*own, *found.findings))


def demand_sound(report: CheckReport, what: str) -> None:
    """Raise `BadDataError` where faults block `what`."""
    if not report.ok:
        raise BadDataError(report, what)
