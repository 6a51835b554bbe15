"""MJCF: a free body with one actuator per rotor, at a site, that pushes along z and turns."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from greybox.errors import VehicleError
from greybox.simulators.sources.found import Found, used
from greybox.simulators.sources.xml_file import attribute, numbers, root_of
from greybox.symbolic import FloatArray

STANDARD_GRAVITY = "0 0 -9.81"


def read(path: Path) -> Found:
    """Raises `VehicleError` where rotors are not actuators at sites of the body."""
    root, where = root_of(path), str(path)
    body = next((b for b in root.iter("body") if b.find("inertial") is not None), None)
    sites = {str(s.attrib.get("name")): s for s in root.iter("site")}
    rotors = [
        a
        for a in root.findall("actuator/*")
        if a.attrib.get("site") in sites and _gear(a, where)[2] > 0 and _gear(a, where)[5] != 0
    ]
    if body is None or not rotors:
        raise VehicleError(
            "no rotors",
            where=where,
            expected='a body with <inertial> and actuators with site="..." gear="0 0 1 0 0 k"',
        )
    inertial = body.find("inertial")
    assert inertial is not None
    option = root.find("option")
    gravity = numbers(
        (option.attrib if option is not None else {}).get("gravity", STANDARD_GRAVITY), 3, where
    )
    first = rotors[0]
    gear = _gear(first, where)
    slope = numbers(first.attrib.get("gainprm", "1"), 1, where)[0] * gear[2]
    offset = numbers(first.attrib.get("biasprm", "0 0 0"), 3, where)[0] * gear[2]
    highest = numbers(first.attrib.get("ctrlrange", "0 1"), 2, where)[1]
    ratio = np.array([_gear(a, where)[5] / _gear(a, where)[2] for a in rotors])
    yaw = float(np.abs(ratio).mean())
    thrust = (float(offset), float(slope * highest), 0.0)
    lag = (
        attribute(first, "dynprm", where, 0.0)
        if first.attrib.get("dyntype", "").startswith("filter")
        else 0.0
    )
    return Found(
        name=str(root.attrib.get("model", path.stem)),
        mass=attribute(inertial, "mass", where),
        inertia=_inertia(inertial, where),
        center_of_mass=numbers(inertial.attrib.get("pos", "0 0 0"), 3, where),
        gravity=float(-gravity[2]),
        hubs=np.array(
            [numbers(sites[a.attrib["site"]].attrib.get("pos", "0 0 0"), 3, where) for a in rotors]
        ),
        spins=-np.sign(ratio),
        thrust=thrust,
        torque=(yaw * thrust[0], yaw * thrust[1], 0.0),
        effects=used({"motor_lag.tau": lag}),
        to_measure=(
            "thrust is linear in the control here (thrust.c1): measure the real map",
            "mass: weigh it",
        ),
    )


def _gear(actuator: ElementTree.Element, where: str) -> FloatArray:
    text = actuator.attrib.get("gear", "1")
    values = text.split()
    return numbers(" ".join([*values, *["0"] * (6 - len(values))]), 6, where)


def _inertia(inertial: ElementTree.Element, where: str) -> FloatArray:
    if "fullinertia" in inertial.attrib:
        xx, yy, zz, xy, xz, yz = numbers(inertial.attrib["fullinertia"], 6, where)
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    j = np.diag(numbers(inertial.attrib.get("diaginertia"), 3, where))
    w, x, y, z = numbers(inertial.attrib.get("quat", "1 0 0 0"), 4, where)
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return np.asarray(turn @ j @ turn.T)
