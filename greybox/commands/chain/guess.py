"""A vehicle file where none was given: from what a log knows, and what a person must still
measure."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from pathlib import Path

from greybox.data.inspection import inspect_log
from greybox.errors import VehicleError
from greybox.files import write_atomic
from greybox.model.vehicle_from_log import vehicle_from_log

FILE = "vehicle.toml"


def guessed_vehicle(
    logs: Sequence[str], out: Path, *, go_on: bool, say: Callable[[str], None]
) -> str:
    """Write the vehicle file of the craft that wrote the first log into `out` and return its path.

    One that is there already (and perhaps was edited) stays. Raises `VehicleError` with what must
    be measured unless `go_on`, `DataError` for a log that does not say where the motors are.
    """
    path = out / FILE
    found = vehicle_from_log(logs[0])
    # Before anybody weighs a craft for it.
    if unfit := inspect_log(logs[0]).unfit:
        say(
            f"this log cannot be fitted ({'; '.join(unfit)}): greybox inspect "
            f"{shlex.quote(logs[0])} says what to log"
        )
    for line in found.known:
        say(f"from the log: {line}")
    for line in found.to_measure:
        say(f"to measure: {line}")
    if not path.exists():
        write_atomic(path, found.text)
    if go_on:
        say(f"going on with the guesses of {path}")
        return str(path)
    again = shlex.join(["greybox", "identify", str(path), *logs, "--out", str(out)])
    measure = "; ".join(found.to_measure) or "nothing more, look the file over"
    raise VehicleError(
        "no vehicle file was given; this one holds what the log knows",
        where=str(path),
        expected=f"that you measure {measure}",
        fix=f"edit it, then: {again} (or --guess to go on as it is)",
    )
