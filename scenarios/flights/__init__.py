"""Real flights that come with greybox: each set is a folder with logs, vehicle file, licence, provenance, checksums."""

from __future__ import annotations

from pathlib import Path

from greybox.errors import UnknownNameError

ROOT = Path(__file__).parent

SETS = ("nanobench", "arpl_crazyflie")
"""Names of the sets."""

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


def set_folder(set_name: str) -> Path:
    """Folder of a set. Raises `UnknownNameError`."""
    if set_name not in SETS:
        raise UnknownNameError("flight set", set_name, SETS)
    return ROOT / set_name


def flight_paths(set_name: str) -> list[Path]:
    """Log files of a set, sorted by name. Raises `UnknownNameError`."""
    return sorted(set_folder(set_name).glob("*.csv.gz"))


def flight_path(set_name: str, flight: str) -> Path:
    """Log file of one flight. Raises `UnknownNameError` for a set or a flight that is not there."""
    paths = {p.name.removesuffix(".csv.gz"): p for p in flight_paths(set_name)}
    if flight not in paths:
        raise UnknownNameError("flight", flight, paths)
    return paths[flight]


def vehicle_path(set_name: str) -> Path:
    """Vehicle file of a set. Raises `UnknownNameError`."""
    return set_folder(set_name) / "vehicle.toml"


def nanobench_split() -> tuple[list[Path], list[Path]]:
    """(training logs, test logs) of the nanobench set: nine and five flights, every test trajectory type trained on."""
    return (
        [flight_path("nanobench", name) for name in NANOBENCH_TRAIN],
        [flight_path("nanobench", name) for name in NANOBENCH_TEST],
    )
