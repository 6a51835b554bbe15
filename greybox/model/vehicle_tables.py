"""Tables of a vehicle file: what each may hold, what is wrong with one that holds something else,
and what a number without a sigma means."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from greybox.data.readers.by_channel import by_group, is_by_channel
from greybox.data.readers.mapping import LogMapping, mapping_of
from greybox.errors import DataError, VehicleError
from greybox.files import OTHER_VERSION, of_another_version
from greybox.model.beliefs import default_sigma
from greybox.model.body import SINGULAR, STATED_SIGMAS, TRIANGLE_SLACK, may_be_stated
from greybox.model.toml_table import TomlTable, describe
from greybox.model.vehicle_parts import (
    ASSUMED,
    EXACT_SCHEMA,
    SCHEMA,
    SCHEMAS,
    Actuator,
    Matrix3,
    Quantity,
    Quantity3,
    Rotor,
    Vector3,
)

NOISES = ("gyro", "accelerometer", "attitude", "position", "velocity", "voltage", "rotor_speed")
"""Keys of [noise]; units rad/s, m/s^2, rad, m, m/s, V, rad/s. Other names belong to sensors of the
user's own."""
MISSPELT, LETTERS = 0.7, 2
"""Likeness (`difflib`) to one of `NOISES` from which on another name is a slip for it, and by how
many letters it may be longer or shorter then: "giro" is 0.75 like "gyro"; "barometer", 0.73 like
"accelerometer", is four letters shorter."""
MOST_ROTORS = 64
"""Rotors of a vehicle file."""


class Unstated:
    """What a number without a sigma means in one file, and the names of those that got the default
    of their quantity."""

    def __init__(self, schema: str, arm: float, labelled: Iterable[str]) -> None:
        self._exact, self._arm = schema == EXACT_SCHEMA, arm
        self.assumed = set(labelled)

    def sigma(self, name: str, value: float) -> float:
        """Standard deviation of a number that states none."""
        sigma = 0.0 if self._exact else default_sigma(name, value, self._arm)
        if sigma > 0:
            self.assumed.add(name)
        return sigma


def quantity_at(
    table: TomlTable, key: str, value: object, name: str, unstated: Unstated
) -> Quantity:
    """The number at `key`, which is the quantity `name`. Raises `VehicleError`,
    `UnknownNameError`."""
    if not isinstance(value, Mapping):
        number = table.checked_number(key, value)
        return Quantity(value=number, sigma=unstated.sigma(name, number))
    inner = TomlTable(value, file=table.file, path=f"{table.path}.{key}" if table.path else key)
    inner.known(("value", "sigma"))
    number = inner.number("value")
    if "sigma" not in inner:
        return Quantity(value=number, sigma=unstated.sigma(name, number))
    return Quantity(value=number, sigma=inner.number("sigma", minimum=0.0))


def quantities_at(
    table: TomlTable,
    key: str,
    names: tuple[str, str, str],
    unstated: Unstated,
    default: Sequence[float] | None = None,
) -> Quantity3:
    """Three numbers with sigmas, from `key` (numbers or value-sigma tables) and the optional
    `key_sigma`. Raises `VehicleError`, `UnknownNameError`."""
    values = table.array(key, 3) if default is None else table.array(key, 3, default)
    sigma_key = f"{key}_sigma"
    if sigma_key not in table:
        x, y, z = (
            quantity_at(table, f"{key}[{i}]", v, name, unstated)
            for i, (v, name) in enumerate(zip(values, names, strict=True))
        )
        return x, y, z
    exact = Unstated(EXACT_SCHEMA, 0.0, ())
    read = [quantity_at(table, f"{key}[{i}]", v, "", exact) for i, v in enumerate(values)]
    if any(not q.exact for q in read):
        raise table.error(
            sigma_key, f"sigma given twice, here and in {key}", fix="keep one of the two"
        )
    x, y, z = (
        Quantity(value=q.value, sigma=s)
        for q, s in zip(read, _sigmas(table, sigma_key), strict=True)
    )
    return x, y, z


def _sigmas(table: TomlTable, key: str) -> Vector3:
    values = table.numbers(key, 3, [0.0, 0.0, 0.0])
    if min(values) < 0:
        raise table.error(
            key,
            "a sigma must not be negative",
            got=f"{min(values):g}",
            fix="use 0 for an exact value",
        )
    return values[0], values[1], values[2]


def vector_at(table: TomlTable, key: str, default: Sequence[float] | None = None) -> Vector3:
    """The three numbers at `key`. Raises `VehicleError`."""
    x, y, z = table.numbers(key, 3) if default is None else table.numbers(key, 3, default)
    return x, y, z


def inertia_of(top: TomlTable, unstated: Unstated) -> tuple[Matrix3, Vector3]:
    """(inertia [kg m^2], standard deviations of Jxx, Jyy, Jzz) of a file. Raises `VehicleError` for
    what no body can have."""
    rows = []
    for i, row in enumerate(top.array("inertia", 3)):
        if not isinstance(row, list) or len(row) != 3:
            raise top.error(
                f"inertia[{i}]",
                "not a row of 3",
                got=describe(row),
                fix="write a 3 x 3 matrix [kg m^2]",
            )
        x, y, z = (top.checked_number(f"inertia[{i}][{j}]", v) for j, v in enumerate(row))
        rows.append((x, y, z))
    matrix = np.array(rows)
    sigma = _sigmas(top, "inertia_sigma")
    size = float(np.abs(matrix).max())
    if not np.allclose(matrix, matrix.T, rtol=0, atol=1e-9 * size):
        i, j = divmod(int(np.argmax(np.abs(matrix - matrix.T))), 3)
        raise top.error(
            "inertia",
            f"not symmetric: [{i}][{j}] is {matrix[i, j]:g} but [{j}][{i}] is {matrix[j, i]:g}",
            fix="write the same product of inertia on both sides of the diagonal",
        )
    principal = np.linalg.eigvalsh(matrix)
    if not principal[0] > SINGULAR * size:
        raise top.error(
            "inertia",
            "singular or not positive definite (principal moments "
            f"{', '.join(f'{v:.3g}' for v in principal)} kg m^2)",
            fix="give positive moments about the centre of mass",
        )
    if not may_be_stated(matrix, sigma):
        raise top.error(
            "inertia",
            f"no body has the principal moments {', '.join(f'{v:.3g}' for v in principal)} kg m^2",
            expected="the largest at most the sum of the other two, within "
            f"{100 * TRIANGLE_SLACK:g} % and {STATED_SIGMAS:g} stated sigma",
            fix="check the units and exponents of the three moments",
        )
    if "inertia_sigma" not in top:
        xx, yy, zz = (unstated.sigma(f"inertia.{a}{a}", rows[i][i]) for i, a in enumerate("xyz"))
        sigma = xx, yy, zz
    return (rows[0], rows[1], rows[2]), sigma


def rotors_of(top: TomlTable) -> tuple[Rotor, ...]:
    """All rotors of a file, at places of their own. Raises `VehicleError`, `UnknownNameError`."""
    rotors = []
    if len(top.array("rotor", None)) > MOST_ROTORS:
        raise top.error(
            "rotor", f"more than {MOST_ROTORS} rotors", fix="add one [[rotor]] per rotor"
        )
    for i, value in enumerate(top.array("rotor", None)):
        table = TomlTable(value, file=top.file, path=f"rotor[{i}]")
        table.known(("position", "spin"))
        spin = table.number("spin")
        if spin not in (1.0, -1.0):
            raise table.error(
                "spin",
                "must be 1 or -1",
                got=f"{spin:g}",
                fix="1 is counter-clockwise seen from above",
            )
        rotors.append(Rotor(position=vector_at(table, "position"), spin=int(spin)))
    if not rotors:
        raise top.error(
            "rotor", "no rotor", fix="add one [[rotor]] with position and spin per rotor"
        )
    places = [r.position for r in rotors]
    if len(set(places)) < len(places):
        raise top.error(
            "rotor", "two rotors at the same position", fix="give each rotor its own hub position"
        )
    return tuple(rotors)


def actuator_of(table: TomlTable, unstated: Unstated) -> Actuator:
    """Commands and maps of a file. Raises `VehicleError`, `UnknownNameError`."""
    table.known(
        (
            "u_min",
            "u_max",
            "hold",
            "rotor_radius",
            "speed_max",
            "thrust",
            "thrust_sigma",
            "torque",
            "torque_sigma",
        )
    )
    u_min, u_max = table.number("u_min", 0.0), table.number("u_max", 1.0)
    if not u_min < u_max:
        raise table.error(
            "u_min",
            f"{u_min:g} is not below u_max {u_max:g}",
            fix="give the command range in order",
        )
    thrust = quantities_at(table, "thrust", ("thrust.c0", "thrust.c1", "thrust.c2"), unstated)
    c0, c1, c2 = (q.value for q in thrust)
    full = c0 + u_max * (c1 + u_max * c2)  # a product never raises OverflowError, a power does
    if not full > 0:
        raise table.error(
            "thrust",
            f"the thrust map gives {full:g} N at u_max",
            expected="a positive thrust",
            fix="check signs and order c0, c1, c2",
        )
    return Actuator(
        u_min=u_min,
        u_max=u_max,
        hold="linear"
        if table.choice("hold", ("previous", "linear"), "previous") == "linear"
        else "previous",
        rotor_radius=table.number("rotor_radius", positive=True)
        if "rotor_radius" in table
        else None,
        speed_max=table.number("speed_max", positive=True) if "speed_max" in table else None,
        thrust=thrust,
        torque=quantities_at(table, "torque", ("torque.c0", "torque.c1", "torque.c2"), unstated),
    )


def columns_of(table: TomlTable, rotors: int) -> LogMapping:
    """What the table says in the dialect of mapping files, or in the form before 0.1.0, of a craft
    with so many `rotors`. Raises `VehicleError`."""
    try:
        content = table.value
        if is_by_channel(content):
            content = by_group(content, rotors, where=table.place(""))
        said = mapping_of(content, where=table.file, path=table.path)
    except DataError as error:
        raise VehicleError(error.line) from None
    for group in ("command", "rotor_speed"):
        if group in said.sources and len(said.sources[group].fields) > rotors:
            raise table.error(
                f"{group}.fields",
                f"the vehicle has {rotors} rotors",
                fix="add the [[rotor]] or drop the column",
            )
    return replace(said, optional=said.groups | {"clock", "time"})


def noise_of(top: TomlTable) -> TomlTable:
    """The table of noise levels, whose keys are known. Raises `VehicleError`,
    `UnknownNameError`."""
    noise = top.table("noise", {})
    noise.known((*NOISES, *(k for k in noise.value if _names_own_sensor(k))))
    return noise


def _names_own_sensor(key: str) -> bool:
    """Whether a key of [noise] can be that of a sensor of the user's own, and is no slip of the pen
    for a known one."""
    if not re.fullmatch(r"[a-z][a-z0-9_]*", key):
        return False
    begins = any(key.startswith(n) or n.startswith(key) for n in NOISES)
    near = difflib.get_close_matches(key, NOISES, n=len(NOISES), cutoff=MISSPELT)
    return not begins and not any(abs(len(n) - len(key)) <= LETTERS for n in near)


def schema_of(top: TomlTable) -> str:
    """The schema of a file, whose keys are known. Raises `VehicleError`, `UnknownNameError`."""
    schema = top.get("schema")
    if schema not in SCHEMAS:
        expected = " or ".join(f'"{s}"' for s in SCHEMAS)
        raise top.error(
            "schema",
            OTHER_VERSION if of_another_version(schema, *SCHEMAS) else "wrong schema",
            expected=expected,
            got=repr(schema),
            fix="update the vehicle file",
        )
    top.known(
        (
            *(
                "schema",
                "name",
                "gravity",
                "mass",
                "inertia",
                "inertia_sigma",
                "center_of_mass",
                "center_of_mass_sigma",
            ),
            *("imu_position", "rotor", "actuator", "effects", "battery", "noise", "columns"),
            *((ASSUMED,) if schema == SCHEMA else ()),
        )
    )
    return str(schema)


def effects_of(top: TomlTable, unstated: Unstated) -> dict[str, Mapping[str, Quantity]]:
    """Effect -> parameter -> number. Raises `VehicleError`, `UnknownNameError`."""
    table = top.table("effects", {})
    effects: dict[str, Mapping[str, Quantity]] = {}
    for name in table.value:
        one = table.table(name)
        effects[name] = MappingProxyType(
            {k: quantity_at(one, k, v, f"{name}.{k}", unstated) for k, v in one.value.items()}
        )
    return effects
