"""The option --mcap, without what writing a recording needs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from greybox.commands.command_line import Options

if TYPE_CHECKING:
    from greybox.data import Dataset
    from greybox.model.identified import IdentifiedModel
    from greybox.validation.adapt import AdaptedRow


def mcap_option(p: Options) -> None:
    """Declare --mcap."""
    p.add_argument(
        "--mcap",
        metavar="F.mcap",
        default=None,
        help="also write the flights beside the model's predictions, with innovations, force and "
        "torque, for Foxglove, Rerun or PlotJuggler",
    )


def need_mcap(path: str | None) -> None:
    """Raises `DataError` for another ending, and where the library is not there: before any
    work."""
    if path is None:
        return
    from greybox.data.readers.recording import library
    from greybox.errors import DataError

    if Path(path).suffix.lower() != ".mcap":
        raise DataError(
            "a recording ends in .mcap",
            where="--mcap",
            got=path,
            fix=f"--mcap {Path(path).stem}.mcap",
        )
    library("mcap.writer", where="--mcap", what="a recording for Foxglove")


def need_ulog(path: str | None) -> None:
    """Raises `DataError` for another ending: before any work."""
    from greybox.errors import DataError

    if path is not None and Path(path).suffix.lower() != ".ulg":
        raise DataError(
            "Flight Review takes .ulg",
            where="--ulog",
            got=path,
            fix=f"--ulog {Path(path).stem}.ulg",
        )


def write_if_asked(
    path: str | None,
    model: IdentifiedModel,
    *datasets: Dataset,
    adapted: Mapping[str, Mapping[str, AdaptedRow]] | None = None,
) -> None:
    """Write the recording of flights beside a model, where one was asked for."""
    if path is not None:
        from greybox.commands.mcap_out import write_mcap

        write_mcap(path, model, *datasets, adapted=adapted)
