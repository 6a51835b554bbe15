"""Vehicle templates: vehicle files of known craft (package data) and how their numbers are changed.

Comments stay, because they say where a number comes from; a number that was changed loses its
source and says so instead.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

import numpy as np

from greybox.errors import UnknownNameError, VehicleError
from greybox.model.beliefs import default_sigma
from greybox.model.vehicle import Vehicle

TEMPLATES = ("crazyflie", "racer250", "duckiedrone", "x", "plus")
SIZED = ("x", "plus")
"""Templates whose inertia and maps follow mass and arm."""
AXES = "xyz"
Tree = dict[str, Any]
"""A parsed template, which is changed in place: its keys are known, as it comes along."""
PARTS = {
    "inertia": [f"{a}{b}" for i, a in enumerate(AXES) for b in AXES[i:]],
    "thrust": ["c0", "c1", "c2"],
    "torque": ["c0", "c1", "c2"],
    "center_of_mass": list(AXES),
}
"""Keys of the file that are arrays, and how their entries are called."""
SIZES = ("mass", "arm", "hover")
_TABLE = re.compile(r"^\s*(\[\[?)\s*([^\]]+?)\s*\]\]?")
_KEY = re.compile(r"^(\s*)([A-Za-z_]\w*)(\s*=\s*)")


def template_text(name: str) -> str:
    """The file of a template. Raises `UnknownNameError`."""
    if name not in TEMPLATES:
        raise UnknownNameError("template", name, TEMPLATES)
    return files("greybox").joinpath(f"templates/{name}.toml").read_text(encoding="utf-8")


def settings(pairs: list[str]) -> dict[str, object]:
    """KEY=VALUE texts as names and TOML values (what is no TOML value is a text). Raises
    `VehicleError`."""
    out: dict[str, object] = {}
    for pair in pairs:
        key, sign, text = pair.partition("=")
        if not sign or not key.strip():
            raise VehicleError(
                "a setting needs a name and a value",
                where="--set",
                expected="KEY=VALUE",
                got=repr(pair),
                fix="--set mass=0.5",
            )
        try:
            out[key.strip()] = tomllib.loads(f"v = {text.strip()}")["v"]
        except tomllib.TOMLDecodeError:
            out[key.strip()] = text.strip()
    return out


def vehicle_text(name: str, changes: Mapping[str, object]) -> str:
    """The file of template `name` with `changes`, checked by the vehicle reader.

    Keys: `mass`, `inertia.xx`, `thrust.c2`, `torque.c0`, `center_of_mass.x`, each also with
    `.sigma` behind it (a value alone keeps its relative sigma); `arm` [m] moves the rotors out or
    in, `hover` is the command that carries the weight and scales thrust and torque (of the
    templates x and plus, inertia and maps follow mass and arm first); any other scalar key of the
    file, as `name`, `noise.gyro` or `effects.motor_lag.tau`. Raises `UnknownNameError`,
    `VehicleError`.
    """
    text = template_text(name)
    data = tomllib.loads(text)
    notes: dict[str, str] = {}
    rest = dict(changes)
    sizes = {k: _positive(k, rest.pop(k)) for k in SIZES if k in rest}
    _resize(name, data, sizes, notes)
    for key, value in rest.items():
        _assign(data, key, value, notes)
    out = text
    for place, note in notes.items():
        out = written(out, place, _value_at(data, place), note)
    Vehicle.from_dict(tomllib.loads(out), where=f"template {name}")
    return out


def _positive(key: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
        raise VehicleError(
            "must be a number above zero",
            where=f"--set {key}",
            got=repr(value),
            fix=f"--set {key}=0.5",
        )
    return float(value)


def _resize(name: str, data: Tree, sizes: Mapping[str, float], notes: dict[str, str]) -> None:
    """Apply mass, arm and hover to the parsed file, and to what follows from them."""
    actuator = data["actuator"]
    mass, sigma = data["mass"]["value"], data["mass"]["sigma"]
    heavier = sizes.get("mass", mass) / mass
    if "mass" in sizes:
        data["mass"] = {"value": _round(mass * heavier), "sigma": _round(sigma * heavier)}
        notes["mass"] = "kg, given"
    arm = _arm(data)
    longer = sizes.get("arm", arm) / arm
    if "arm" in sizes:
        for i, rotor in enumerate(data["rotor"]):
            rotor["position"] = [_round(v * longer) for v in rotor["position"]]
            notes[f"rotor[{i}].position"] = "m, from the arm that was given"
    maps = 1.0
    if name in SIZED and (heavier, longer) != (1.0, 1.0):
        _scale(data, "inertia", heavier * longer**2, notes, "kg m^2, a m L^2 as above")
        actuator["rotor_radius"] = _round(actuator["rotor_radius"] * longer)
        notes["actuator.rotor_radius"] = "m, assumed: half the arm"
        maps = heavier
    if "hover" in sizes:
        u = sizes["hover"]
        if u > actuator["u_max"]:
            raise VehicleError(
                "hover must lie inside the command range",
                where="--set hover",
                got=f"{u:g}",
                fix="--set hover=0.5",
            )
        thrust = sum(c * u**k for k, c in enumerate(actuator["thrust"]))
        maps = data["mass"]["value"] * data["gravity"] / (len(data["rotor"]) * thrust)
    if maps != 1.0:
        why = f"hovers at u = {sizes['hover']:g}" if "hover" in sizes else "scaled with the mass"
        _scale(actuator, "thrust", maps, notes, f"N per rotor, {why}", "actuator.")
        wider = longer if name in SIZED else 1.0
        _scale(
            actuator,
            "torque",
            maps * wider,
            notes,
            "N m per rotor, scaled with the thrust",
            "actuator.",
        )


def _arm(data: Tree) -> float:
    """Longest arm [m] of a parsed file."""
    return max(float(np.hypot(*r["position"][:2])) for r in data["rotor"])


def _scale(
    table: Tree,
    key: str,
    factor: float,
    notes: dict[str, str],
    note: str,
    prefix: str = "",
) -> None:
    for k in (key, f"{key}_sigma"):
        table[k] = (np.array(table[k]) * factor).tolist()
        table[k] = [[_round(v) for v in r] if isinstance(r, list) else _round(r) for r in table[k]]
        notes[prefix + k] = note


def _assign_part(data: Tree, key: str, number: float, notes: dict[str, str]) -> None:
    """Set one of `PARTS` or, with .sigma behind it, its sigma; a value alone keeps its relative
    sigma."""
    head, _, tail = key.removesuffix(".sigma").partition(".")
    table, prefix = (data["actuator"], "actuator.") if head in ("thrust", "torque") else (data, "")
    i = PARTS[head].index(tail) if head != "inertia" else AXES.index(tail[0])
    silent = [default_sigma(f"{head}.{t}", 0.0, _arm(data)) for t in PARTS[head][:3]]
    sigmas = table.setdefault(f"{head}_sigma", silent)
    if key.endswith(".sigma"):
        if head == "inertia" and tail[0] != tail[1]:
            raise VehicleError(
                "products of inertia have no sigma", where=f"--set {key}", fix="leave it out"
            )
        sigmas[i] = number
    elif head == "inertia":
        j = AXES.index(tail[1])
        if i == j:
            sigmas[i] = _round(sigmas[i] * number / table[head][i][i])
        table[head][i][j] = table[head][j][i] = number
    else:
        sigmas[i] = _round(sigmas[i] * number / table[head][i]) if table[head][i] else sigmas[i]
        table[head][i] = number
    notes[f"{prefix}{head}"] = notes[f"{prefix}{head}_sigma"] = f"{tail} given"


def _assign(data: Tree, key: str, value: object, notes: dict[str, str]) -> None:
    """Set one key that is no size. Parameter names first, then keys of the file."""
    wants_sigma = key.endswith(".sigma")
    base = key.removesuffix(".sigma")
    head, _, tail = base.partition(".")
    if head in PARTS and tail:
        if tail not in PARTS[head]:
            raise UnknownNameError(
                "parameter", base, [f"{head}.{t}" for t in PARTS[head]], where="--set"
            )
        _assign_part(data, key, _number(key, value), notes)
        return
    *path, last = base.split(".")
    table = data
    for part in path:
        table = table.setdefault(part, {})
        if not isinstance(table, dict):
            raise UnknownNameError("key", key, _keys(data), where="--set")
    old = table.get(last)
    if wants_sigma or (isinstance(old, dict) and isinstance(value, int | float)):
        was = (
            old
            if isinstance(old, dict)
            else {"value": old if old is not None else 0.0, "sigma": 0.0}
        )
        number = _number(key, value)
        ratio = was["sigma"] / was["value"] if was["value"] else 0.0
        table[last] = (
            {"value": was["value"], "sigma": number}
            if wants_sigma
            else {"value": number, "sigma": _round(number * ratio)}
        )
    else:
        table[last] = value
    notes[base] = "given"


def _number(key: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise VehicleError(
            "a number is needed here", where=f"--set {key}", got=repr(value), fix=f"--set {key}=0.1"
        )
    return float(value)


def _keys(data: Tree, prefix: str = "") -> list[str]:
    return [
        k
        for n, v in data.items()
        for k in (_keys(v, f"{prefix}{n}.") if isinstance(v, dict) else [f"{prefix}{n}"])
    ]


def _round(value: float) -> float:
    return float(f"{value:.6g}")


def _value_at(data: Tree, place: str) -> object:
    value: Any = data
    for part in place.split("."):
        match = re.fullmatch(r"(\w+)\[(\d+)\]", part)
        value = value[match[1]][int(match[2])] if match else value[part]
    return value


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", " ") + '"'
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {_toml(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    return repr(value)


def written(text: str, place: str, value: object, note: str) -> str:
    """`text` with the value of one key replaced, or added at the end of its table. Every key of a
    template is one line."""
    path, _, key = place.rpartition(".")
    line = f"{key} = {_toml(value)}  # {note}"
    lines = text.splitlines()
    table, count, last = "", -1, None
    for i, row in enumerate(lines):
        if match := _TABLE.match(row):
            table = match[2]
            if match[1] == "[[":
                count += 1
                table = f"{table}[{count}]"
        if table == path:
            if row.strip() and not row.lstrip().startswith("#"):
                last = i
            if (match := _KEY.match(row)) and match[2] == key:
                lines[i] = line
                return "\n".join(lines) + "\n"
    if last is None:
        return "\n".join([*lines, "", f"[{path}]", line]) + "\n"
    lines.insert(last + 1, line)
    return "\n".join(lines) + "\n"
