"""Real flights that come with greybox, for trying it: `greybox.examples.vehicle_path("arpl_crazyflie")`.

Each set is a folder with logs, vehicle file, licence, provenance (README.md) and checksums. `greybox examples` lists and
copies them.
"""

from __future__ import annotations

from pathlib import Path

from greybox.errors import GreyboxError, UnknownNameError
from greybox.files import write_atomic

ROOT = Path(__file__).parent

SETS = {
    "nanobench": "14 flights of Crazyflie 2.1 craft in motion capture, 20 to 40 s at 100 Hz (BSD 3-Clause)",
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
    """(training logs, test logs) of the nanobench set: nine and five flights, every test trajectory type trained on."""
    return (
        [flight_path("nanobench", name) for name in NANOBENCH_TRAIN],
        [flight_path("nanobench", name) for name in NANOBENCH_TEST],
    )


def copy(set_name: str, folder: str | Path) -> list[Path]:
    """Copy all files of a set into `folder`, which is made; licence and provenance come along. Returns the copies.

    Raises `UnknownNameError`, `OutputError`, and `GreyboxError` before anything is written where a file of that name
    and other content is there.
    """
    files = sorted(p for p in path(set_name).iterdir() if p.is_file())
    copies = [Path(folder) / p.name for p in files]
    for source, target in zip(files, copies):
        if target.exists() and (target.is_dir() or target.read_bytes() != source.read_bytes()):
            raise GreyboxError(
                f"there is a {target.name} of yours", where=str(target), expected="a folder without one",
                fix="choose another --out",
            )  # fmt: skip
    for source, target in zip(files, copies):
        write_atomic(target, source.read_bytes())
    return copies
