"""RotorPy: a file with the dictionary quad_params. It is parsed, never executed."""

from __future__ import annotations

import ast
import operator
from pathlib import Path

import numpy as np

from greybox.errors import VehicleError
from greybox.files import Parsed, read_limited
from greybox.simulators.sources.found import Found, used
from greybox.simulators.targets.rotorpy import GRAVITY

LARGEST = 2**20
_BINARY = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
}


def read(path: Path) -> Found:
    """Raises `VehicleError` for a file without quad_params, or with values that are computed."""
    where = str(path)
    p = _parameters(path)
    try:
        places = p["rotor_pos"]
        hubs = np.array([np.asarray(places[k], dtype=float) for k in places])
        spins = -np.asarray(p["rotor_directions"], dtype=float)
        speed = float(p["rotor_speed_max"])
        inertia = np.array(
            [
                [p["Ixx"], p["Ixy"], p["Ixz"]],
                [p["Ixy"], p["Iyy"], p["Iyz"]],
                [p["Ixz"], p["Iyz"], p["Izz"]],
            ],
            dtype=float,
        )
        effects = {
            "motor_lag.tau": float(p["tau_m"]),
            "rotor_drag.k_x": float(p.get("k_d", 0.0)),
            "rotor_drag.k_y": float(p.get("k_d", 0.0)),
            "axial_inflow.k_z": float(p.get("k_z", 0.0)),
            "translational_lift.k_h": float(p.get("k_h", 0.0)),
            "blade_flapping.k_flap": -float(p.get("k_flap", 0.0)),
            **{f"parasitic_drag.c_{a}": float(p.get(f"c_D{a}", 0.0)) for a in "xyz"},
        }
        return Found(
            name=path.stem if path.stem != "vehicle" else path.resolve().parent.name,
            mass=float(p["mass"]),
            gravity=GRAVITY,
            inertia=inertia,
            hubs=hubs,
            spins=np.sign(spins),
            thrust=(0.0, 0.0, float(p["k_eta"]) * speed**2),
            torque=(0.0, 0.0, float(p["k_m"]) * speed**2),
            speed_max=speed,
            effects=used(effects),
            to_measure=("mass: weigh it ready to fly",),
        )
    except KeyError as missing:
        raise VehicleError(f"quad_params has no {missing}", where=where) from None
    except (TypeError, ValueError) as error:
        raise VehicleError(f"quad_params: {error}", where=where) from None


def _parameters(path: Path) -> Parsed:
    where = str(path)
    try:
        tree = ast.parse(read_limited(path, LARGEST).decode("utf-8"))
    except (SyntaxError, ValueError) as error:
        raise VehicleError(f"not Python: {error}", where=where) from None
    known: dict[str, object] = {}
    for node in tree.body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            name = node.targets[0].id
            try:
                known[name] = _value(node.value, known)
            except _Computed as what:
                if name == "quad_params":
                    raise VehicleError(
                        f"quad_params computes {what}",
                        where=where,
                        expected="numbers, np.array([...]) and + - * /",
                    ) from None
    found = known.get("quad_params")
    if not isinstance(found, dict):
        raise VehicleError("no dictionary quad_params", where=where)
    return found


class _Computed(Exception):
    """An expression that is more than numbers."""


def _value(node: ast.expr, known: dict[str, object]) -> object:
    if isinstance(node, ast.Constant):
        return node.value
    if isinstance(node, ast.Name) and node.id in known:
        return known[node.id]
    if isinstance(node, ast.List | ast.Tuple):
        return [_value(e, known) for e in node.elts]
    if isinstance(node, ast.Dict):
        return {
            _value(k, known): _value(v, known)
            for k, v in zip(node.keys, node.values, strict=True)
            if k is not None
        }
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        return -np.asarray(_value(node.operand, known))
    if isinstance(node, ast.BinOp) and type(node.op) in _BINARY:
        left, right = (np.asarray(_value(e, known)) for e in (node.left, node.right))
        return _BINARY[type(node.op)](left, right)
    if isinstance(node, ast.Call) and ast.unparse(node.func) in ("np.array", "numpy.array"):
        return np.array(_value(node.args[0], known), dtype=float)
    raise _Computed(ast.unparse(node))
