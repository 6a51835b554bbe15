"""Flight logs as a command reads them: all by one door, with what was taken as missing listed."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

from greybox.commands.command_line import Options

if TYPE_CHECKING:
    from greybox.data import Dataset
    from greybox.data.airframe import Airframe


def flight_log_options(p: Options) -> None:
    """Declare how logs are read."""
    p.add_argument(
        "--mapping",
        metavar="MAP.toml",
        help="which fields of the logs are which channels (docs/logs.md)",
    )
    p.add_argument(
        "--keep-impossible",
        action="store_true",
        help="keep samples that no craft can have made",
    )


def read_flight_logs(
    arguments: argparse.Namespace,
    paths: Sequence[str],
    vehicle: Airframe,
    *,
    rate: float | Literal["needed"] | None,
    trim: bool = True,
) -> Dataset:
    """The logs of a command on a uniform clock of `rate` [Hz] (None: their own; "needed": one for
    all, no higher than the response of the craft needs, as a plain fit takes them), and a line on
    standard error per kind of sample that became missing. Raises what `read_logs` raises."""
    from greybox.automatic.flights import needed_rate
    from greybox.data.logs import read_logs

    def read(rate: float | None) -> Dataset:
        return read_logs(
            paths,
            vehicle,
            rate=rate,
            trim=trim,
            mapping=arguments.mapping,
            keep_impossible=arguments.keep_impossible,
        )

    if not paths:
        return Dataset(flights=())
    data = read(None if rate == "needed" else rate)
    if rate == "needed" and (enough := needed_rate(data)) is not None:
        data = read(enough)
        said = f"flights are taken at {enough:g} Hz, enough for the response of this craft"
        print(f"{said} (--rate: another)", file=sys.stderr, flush=True)
    for removed in data.removed:
        print(removed.line(), file=sys.stderr, flush=True)
    return data
