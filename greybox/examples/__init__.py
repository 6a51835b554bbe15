"""Real flights that come with greybox, for trying it:
`greybox.examples.vehicle_path("arpl_crazyflie")`.

Each set is a folder with logs, vehicle file, licence, provenance (README.md) and checksums.
`greybox examples` lists and copies them.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

from greybox.errors import GreyboxError, UnknownNameError
from greybox.files import write_atomic

__all__ = [
    "NANOBENCH_TEST",
    "NANOBENCH_TRAIN",
    "SETS",
    "copy",
    "flight_path",
    "flight_paths",
    "nanobench_split",
    "vehicle_path",
]
ROOT = Path(__file__).parent

SETS = {
    "nanobench": "14 flights of Crazyflie 2.1 craft in motion capture, 20 to 40 s at 100 Hz (BSD "
    "3-Clause)",
    "arpl_crazyflie": "3 flights of a Crazyflie, IMU and motor commands at 1 kHz (MIT)",
}
"""Name of a set -> what it is."""

NANOBENCH_TEST = (
    "B2_circle_fast_rep1",
    "B3_figure8_fast_rep1",
    "B5_helix_medium_rep2",
    "B7_oval_fast_rep1",
    "B8_star_medium_rep1",
)
"""Flights of the nanobench set that are held out."""

NANOBENCH_TRAIN = (
    "B2_circle_medium_rep1",
    "B2_circle_slow_rep1",
    "B3_figure8_medium_rep2",
    "B3_figure8_slow_rep1",
    "B5_helix_fast_mell_rep1",
    "B7_oval_medium_rep2",
    "B8_star_fast_rep2",
    "B8_star_fast_rep3",
    "B8_star_slow_rep2",
)
"""Flights of the nanobench set to train on."""


def path(set_name: str) -> Path:
    """Folder of a set. Raises `UnknownNameError`."""
    if set_name not in SETS:
        raise UnknownNameError("example", set_name, SETS)
    return ROOT / set_name


def flight_paths(set_name: str) -> list[Path]:
    """Log files of a set, sorted by name. Raises `UnknownNameError`."""
    return sorted(path(set_name).glob("*.csv.gz"))


def flight_path(set_name: str, flight: str) -> Path:
    """Log file of one flight. Raises `UnknownNameError` for a set or a flight that is not there."""
    paths = {p.name.removesuffix(".csv.gz"): p for p in flight_paths(set_name)}
    if flight not in paths:
        raise UnknownNameError("flight", flight, paths)
    return paths[flight]


def vehicle_path(set_name: str) -> Path:
    """Vehicle file of a set. Raises `UnknownNameError`."""
    return path(set_name) / "vehicle.toml"


def nanobench_split() -> tuple[list[Path], list[Path]]:
    """(training logs, test logs) of the nanobench set: nine and five flights, every test trajectory
    type trained on."""
    return (
        [flight_path("nanobench", name) for name in NANOBENCH_TRAIN],
        [flight_path("nanobench", name) for name in NANOBENCH_TEST],
    )


def copy(set_name: str, folder: str | Path) -> list[Path]:
    """Copy all files of a set into `folder`, which is made; licence and provenance come along.
    Returns the copies.

    Raises `UnknownNameError`, `OutputError`, and `GreyboxError` before anything is written where a
    file of that name and other content is there, or where greybox's own files are not those of
    SHA256SUMS.
    """
    contents = {Path(folder) / name: content for name, content in sound(set_name).items()}
    for target, content in contents.items():
        if target.exists() and not _holds(target, content):
            raise GreyboxError(
                f"there is a {target.name} of yours",
                where=str(target),
                expected="a folder without one",
                fix="choose another --out",
            )
    for target, content in contents.items():
        write_atomic(target, content)
    return list(contents)


def sound(set_name: str) -> dict[str, bytes]:
    """Name -> content of the files of a set; all that SHA256SUMS lists are whole. Raises
    `UnknownNameError`, `GreyboxError`."""
    folder = path(set_name)
    fix = "install greybox again (pip install --force-reinstall --no-deps greybox-sysid)"
    try:
        contents = {p.name: p.read_bytes() for p in sorted(folder.iterdir()) if p.is_file()}
        sums = [line.split() for line in contents["SHA256SUMS"].decode("ascii").splitlines()]
        listed = {name: digest for digest, name in sums}
    except OSError as error:
        where = str(error.filename or folder)
        raise GreyboxError(
            f"cannot read: {error.strerror or error}", where=where, fix=fix
        ) from None
    except (KeyError, ValueError):
        raise GreyboxError(
            "is missing or damaged", where=str(folder / "SHA256SUMS"), fix=fix
        ) from None
    for name, digest in listed.items():
        if name not in contents or hashlib.sha256(contents[name]).hexdigest() != digest:
            what = "is missing" if name not in contents else "is not the file that was shipped"
            raise GreyboxError(what, where=str(folder / name), fix=fix)
    return contents


def _holds(target: Path, content: bytes) -> bool:
    """Whether a file is there with this content. Raises `GreyboxError` where it cannot be read."""
    try:
        return not target.is_dir() and target.read_bytes() == content
    except OSError as error:
        raise GreyboxError(
            f"cannot read: {error.strerror or error}", where=str(target), fix="choose another --out"
        ) from None


def __dir__() -> list[str]:
    """What an editor and a notebook offer."""
    return __all__
