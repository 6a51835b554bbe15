"""URDF: the models of gym-pybullet-drones, whose properties say how rotors push."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from greybox.errors import VehicleError
from greybox.simulators.sources.found import Found, used
from greybox.simulators.sources.xml_file import attribute, numbers, root_of
from greybox.symbolic import FloatArray

PER_MINUTE = 60.0 / (2.0 * math.pi)
SPINS = (1, -1, 1, -1)
"""Of prop0 to prop3: their torques on the body have the signs -, +, -, +."""


def read(path: Path) -> Found:
    """Raises `VehicleError` for a URDF without the properties."""
    root, where = root_of(path), str(path)
    properties, base = root.find("properties"), root.find("link")
    if properties is None or base is None or "kf" not in properties.attrib:
        raise VehicleError(
            "no rotors",
            where=where,
            expected='<properties kf="..." km="...">, as in gym-pybullet-drones',
        )
    links = [e for e in root.findall("link") if str(e.attrib.get("name")).startswith("prop")]
    hubs = [_origin(e.find("inertial/origin"), where) for e in links]
    inertial = base.find("inertial")
    mass_tag, table = base.find("inertial/mass"), base.find("inertial/inertia")
    if len(hubs) != 4 or inertial is None or mass_tag is None or table is None:
        raise VehicleError("expected four prop links and the inertia of the base", where=where)
    mass = attribute(mass_tag, "value", where)
    xx, xy, xz, yy, yz, zz = (
        attribute(table, t, where, 0.0) for t in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    )
    kf, km = (attribute(properties, k, where) for k in ("kf", "km"))
    ratio = attribute(properties, "thrust2weight", where)
    gravity = 9.8
    full = ratio * mass * gravity / 4.0
    speed = math.sqrt(full / kf) / PER_MINUTE
    drag = attribute(properties, "drag_coeff_xy", where, 0.0)
    effects = {
        "rotor_drag.k_x": drag,
        "rotor_drag.k_y": drag,
        "axial_inflow.k_z": attribute(properties, "drag_coeff_z", where, 0.0),
    }
    return Found(
        name=str(root.attrib.get("name", path.stem)),
        mass=mass,
        gravity=gravity,
        inertia=np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]),
        center_of_mass=_origin(inertial.find("origin"), where),
        hubs=np.array(hubs),
        spins=np.array(SPINS),
        thrust=(0.0, 0.0, full),
        torque=(0.0, 0.0, full * km / kf),
        speed_max=speed,
        rotor_radius=attribute(properties, "prop_radius", where, 0.0) or None,
        effects=used(effects),
        to_measure=("motor_lag.tau: the simulator has none", "mass: weigh it ready to fly"),
    )


def _origin(element: ElementTree.Element | None, where: str) -> FloatArray:
    text = None if element is None else element.attrib.get("xyz")
    return numbers(text or "0 0 0", 3, where)
