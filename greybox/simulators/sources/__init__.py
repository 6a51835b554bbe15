"""Sources: a simulator's file back into a vehicle file, one file per format."""

from __future__ import annotations

from pathlib import Path

from greybox.errors import VehicleError
from greybox.files import Parsed
from greybox.model.vehicle import Vehicle
from greybox.simulators.sources import crazyflow, mjcf, px4, rotorpy, sdf, urdf
from greybox.simulators.sources.found import Found

SUFFIXES = (".sdf", ".urdf", ".xml", ".py", ".toml", ".params")
FORMATS = "an SDF, URDF or MJCF model, a RotorPy or crazyflow parameter file, PX4 .params"


def is_simulator_file(path: str) -> bool:
    """Whether the name is one of a simulator's file, not of a log."""
    return Path(path).suffix.lower() in SUFFIXES


def read_craft(path: str, section: str | None = None) -> Found:
    """What a simulator's file says of a craft; `section` names one of several in a TOML file.

    Raises `VehicleError` for a file that is not there or of another kind.
    """
    place = Path(path)
    if not place.is_file():
        raise VehicleError("no such file", where=path, expected=FORMATS)
    kind = place.suffix.lower()
    if kind == ".sdf":
        return sdf.read(place)
    if kind == ".urdf":
        return urdf.read(place)
    if kind == ".xml":
        head = place.read_bytes()[:4096]
        if b"<sdf" in head:
            return sdf.read(place)
        return urdf.read(place) if b"<robot" in head else mjcf.read(place)
    if kind == ".py":
        return rotorpy.read(place)
    if kind == ".params":
        return px4.read(place)
    if kind == ".toml":
        return crazyflow.read(place, section)
    raise VehicleError("not a simulator's file", where=path, expected=FORMATS)


def vehicle_from_simulator(path: str, changes: Parsed) -> tuple[str, Found]:
    """(text of the vehicle file, what was found). `changes` may hold `section`, `mass`, `name`.

    The text is read back before it is returned. Raises `VehicleError`, `UnknownNameError`.
    """
    import tomllib
    from dataclasses import replace

    known = {"section", "mass", "name"}
    if unknown := sorted(set(changes) - known):
        raise VehicleError(
            f"--set {unknown[0]}",
            expected=f"with a simulator's file one of {', '.join(sorted(known))}",
            fix="edit the vehicle file",
        )
    found = read_craft(path, changes.get("section"))
    if "mass" in changes:
        found = replace(found, mass=float(changes["mass"]))
    if "name" in changes:
        found = replace(found, name=str(changes["name"]))
    text = found.text(Path(path).name)
    Vehicle.from_dict(tomllib.loads(text), where=path)
    return text, found
