"""SDF: a Gazebo model with motor plugins, gz-sim or classic, as `greybox twin` writes it or as the
models of PX4 have it."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from greybox.errors import VehicleError
from greybox.simulators.sources.found import Found, used
from greybox.simulators.sources.xml_file import number, numbers, root_of
from greybox.symbolic import FloatArray


def read(path: Path) -> Found:
    """Raises `VehicleError` for a model without motor plugins."""
    root = root_of(path)
    model = root if root.tag == "model" else root.find(".//model")
    where = str(path)
    if model is None:
        raise VehicleError("no <model>", where=where)
    plugins = [p for p in model.iter("plugin") if p.find("motorConstant") is not None]
    if not plugins:
        raise VehicleError(
            "no motor plugin",
            where=where,
            expected="plugins with motorConstant, as of PX4's or gz-sim's multicopters",
        )
    links = {
        str(e.attrib.get("name")): e for e in model.iter("link") if e.find("inertial") is not None
    }
    bodies = [_body(e, where) for e in links.values()]
    mass = sum(m for m, _, _ in bodies)
    com = sum((m * p for m, p, _ in bodies), np.zeros(3)) / mass
    inertia = sum((j + m * _steiner(p - com) for m, p, j in bodies), np.zeros((3, 3)))
    key = "motorNumber" if plugins[0].find("motorNumber") is not None else "actuator_number"
    plugins.sort(key=lambda p: number(p, key, where, 0.0))
    hubs = [_place(links[str(p.findtext("linkName"))], where) for p in plugins]
    motors = np.array([number(p, "motorConstant", where) for p in plugins])
    speed = number(plugins[0], "maxRotVelocity", where)
    mean = float(motors.mean())
    moment = number(plugins[0], "momentConstant", where)
    up = number(plugins[0], "timeConstantUp", where, 0.0)
    down = number(plugins[0], "timeConstantDown", where, up)
    drag = number(plugins[0], "rotorDragCoefficient", where, 0.0)
    radius = links[str(plugins[0].findtext("linkName"))].find("visual/geometry/cylinder")
    effects = {
        "motor_lag.tau": 0.5 * (up + down),
        "motor_lag_asymmetry.a": (down - up) / (down + up) if up + down else 0.0,
        "rotor_drag.k_x": drag,
        "rotor_drag.k_y": drag,
    }
    return Found(
        name=str(model.attrib.get("name", path.stem)),
        mass=float(mass),
        inertia=np.asarray(inertia),
        center_of_mass=np.asarray(com),
        hubs=np.array(hubs),
        spins=np.array([1 if p.findtext("turningDirection") == "ccw" else -1 for p in plugins]),
        thrust=(0.0, 0.0, mean * speed**2),
        torque=(0.0, 0.0, mean * moment * speed**2),
        speed_max=speed,
        rotor_radius=None if radius is None else number(radius, "radius", where),
        effects=used(effects | _uneven(motors / mean)),
        to_measure=("mass: weigh it ready to fly",),
    )


def _uneven(strength: FloatArray) -> dict[str, float]:
    return {f"rotor_asymmetry.delta_{i}": float(s - 1) for i, s in enumerate(strength[:-1], 1)}


def _place(link: ElementTree.Element, where: str) -> FloatArray:
    return numbers(link.findtext("pose") or "0 0 0 0 0 0", 6, where)[:3]


def _body(link: ElementTree.Element, where: str) -> tuple[float, FloatArray, FloatArray]:
    inertial = link.find("inertial")
    assert inertial is not None
    own = numbers(inertial.findtext("pose") or "0 0 0 0 0 0", 6, where)[:3]
    table = inertial.find("inertia")
    if table is None:
        raise VehicleError("a link without <inertia>", where=where)
    xx, xy, xz, yy, yz, zz = (
        number(table, t, where, 0.0) for t in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    )
    j = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return number(inertial, "mass", where), _place(link, where) + own, j


def _steiner(arm: FloatArray) -> FloatArray:
    return np.asarray(float(arm @ arm) * np.eye(3) - np.outer(arm, arm))
