"""Vehicle: what a ruler, a scale and a data sheet say about one craft, and its file (schema
"greybox.vehicle/2").

A number is exact (sigma 0) or a prior (value and one standard deviation). One that states no sigma
is believed within the default of its quantity (see `beliefs`); in files of schema
"greybox.vehicle/1" it is exact. SI units; body axes FLU from the body origin.
"""

from __future__ import annotations

import difflib
import os
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Literal

import numpy as np

from greybox.data.readers.by_channel import by_group, is_by_channel
from greybox.data.readers.mapping import LogMapping, mapping_of
from greybox.errors import DataError, OldFormWarning, UnknownNameError, VehicleError
from greybox.files import OTHER_VERSION, Json, Parsed, of_another_version, read_toml
from greybox.frames import GRAVITY
from greybox.model.beliefs import Belief, Beliefs, Why, default_sigma
from greybox.model.body import SINGULAR, STATED_SIGMAS, TRIANGLE_SLACK, may_be_stated
from greybox.model.toml_table import TomlTable, describe
from greybox.shown import Cell, Shown
from greybox.takes import PATH, takes

SCHEMA = "greybox.vehicle/2"
EXACT_SCHEMA = "greybox.vehicle/1"
"""Schema of older files, in which a number without a sigma is exact and bounds are four sigma."""
SCHEMAS = (EXACT_SCHEMA, SCHEMA)
ASSUMED = "default_sigma"
"""Key of a written vehicle: names of the numbers whose sigma nobody stated."""
NOISES = ("gyro", "accelerometer", "attitude", "position", "velocity", "voltage", "rotor_speed")
"""Keys of [noise]; units rad/s, m/s^2, rad, m, m/s, V, rad/s. Other names belong to sensors of the
user's own."""
MISSPELT, LETTERS = 0.7, 2
"""Likeness (`difflib`) to one of `NOISES` from which on another name is a slip for it, and by how
many letters it may be longer or shorter then: "giro" is 0.75 like "gyro"; "barometer", 0.73 like
"accelerometer", is four letters shorter."""

Vector3 = tuple[float, float, float]
Matrix3 = tuple[Vector3, Vector3, Vector3]

MOST_ROTORS = 64
"""Rotors of a vehicle file."""


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """A number with one standard deviation; `sigma` 0 means exact."""

    value: float
    sigma: float = 0.0

    @property
    def exact(self) -> bool:
        """Whether the number is held fixed by default."""
        return self.sigma == 0.0


Quantity3 = tuple[Quantity, Quantity, Quantity]


@dataclass(frozen=True, kw_only=True)
class Rotor:
    """Hub position [m] from the body origin, and spin (+1 counter-clockwise seen from above, -1
    clockwise)."""

    position: Vector3
    spin: int


@dataclass(frozen=True, kw_only=True)
class Actuator:
    """Commands and the thrust and torque maps, c0 + c1 nu + c2 nu^2 per rotor ([N] and [N m]).

    `hold` says how the command runs between samples; `rotor_radius` [m] and `speed_max` [rad/s at
    nu = 1] are optional.
    """

    u_min: float = 0.0
    u_max: float = 1.0
    hold: Literal["previous", "linear"] = "previous"
    rotor_radius: float | None = None
    speed_max: float | None = None
    thrust: Quantity3
    torque: Quantity3


@dataclass(frozen=True, kw_only=True, repr=False)
class Vehicle(Shown):
    """One craft. `inertia` [kg m^2] is about the centre of mass, `inertia_sigma` belongs to Jxx,
    Jyy, Jzz.

    `effects` maps effect names to their parameters (the model's catalogue knows which names exist);
    `noise` has the known sensor sigmas by sensor name (see `NOISES`); `columns` says which fields
    of its logs are which channels. `assumed` names the numbers whose sigma is the default of their
    quantity; `schema` is that of the file.
    """

    name: str
    gravity: float
    mass: Quantity
    inertia: Matrix3
    inertia_sigma: Vector3 = (0.0, 0.0, 0.0)
    center_of_mass: Quantity3
    imu_position: Vector3 = (0.0, 0.0, 0.0)
    rotors: tuple[Rotor, ...]
    actuator: Actuator
    effects: Mapping[str, Mapping[str, Quantity]] = field(default_factory=dict)
    nominal_voltage: float | None = None
    noise: Mapping[str, float] = field(default_factory=dict)
    columns: LogMapping = field(default_factory=LogMapping)
    assumed: frozenset[str] = frozenset()
    schema: str = EXACT_SCHEMA

    def __post_init__(self) -> None:
        for key in ("effects", "noise"):
            object.__setattr__(self, key, MappingProxyType(dict(getattr(self, key))))

    def __getstate__(self) -> dict[str, Json]:
        return self.to_dict()

    def __setstate__(self, state: Parsed) -> None:
        self.__dict__.update(Vehicle.from_dict(state).__dict__)

    def __hash__(self) -> int:
        return hash(repr(self.to_dict()))

    def _shown_text(self) -> str:
        """Name, weight and size, then every believed number with its standard deviation."""
        first = f"{self.name}: {self.n_rotors} rotors, arm {self.arm_length:.4g} m, {self.schema}"
        lines = [
            f"  {b.quantity} {b.value:.5g} +- {b.sigma:.2g} ({b.why})"
            for b in self.beliefs.entries
            if b.value
        ]
        known = ", ".join(self.effects) or "none"
        return "\n".join([first, f"  effects known to be there: {known}", *lines])

    def _shown_rows(self) -> list[dict[str, Cell]]:
        """One row per number: value, standard deviation and why it is believed so far."""
        return [
            {"quantity": b.quantity, "value": b.value, "sigma": b.sigma, "why": b.why}
            for b in self.beliefs.entries
        ]

    @property
    def n_rotors(self) -> int:
        """Number of rotors."""
        return len(self.rotors)

    @property
    def omega_scale(self) -> float:
        """Rotor speed at nu = 1 [rad/s]: speed_max, or 1 where it is unknown (coefficients are then
        per unit nu)."""
        return self.actuator.speed_max or 1.0

    @property
    def arm_length(self) -> float:
        """Longest horizontal distance of a hub from the body origin [m] (a scale, never a
        parameter)."""
        return _arm_length(self.rotors)

    @property
    def stated_inertia_sigma(self) -> Vector3:
        """Standard deviations of Jxx, Jyy, Jzz; 0 where nobody stated one."""
        x, y, z = (
            0.0 if f"inertia.{a}{a}" in self.assumed else s
            for a, s in zip("xyz", self.inertia_sigma, strict=True)
        )
        return x, y, z

    @property
    def quantities(self) -> Mapping[str, Quantity]:
        """The core parameters by name: mass, inertia.xx, thrust.c2, torque.c2, center_of_mass.x,
        ..."""
        out = {"mass": self.mass}
        for i, axis in enumerate("xyz"):
            out[f"inertia.{axis}{axis}"] = Quantity(
                value=self.inertia[i][i], sigma=self.inertia_sigma[i]
            )
        for kind, curve in (("thrust", self.actuator.thrust), ("torque", self.actuator.torque)):
            out.update({f"{kind}.c{i}": quantity for i, quantity in enumerate(curve)})
        out.update(
            {
                f"center_of_mass.{axis}": q
                for axis, q in zip("xyz", self.center_of_mass, strict=True)
            }
        )
        return out

    @property
    def beliefs(self) -> Beliefs:
        """How sure the file is of every number, for people; `arm` is no parameter, its error ends
        up in the inertia."""
        arm = self.arm_length
        named = {**self.quantities, **_of_effects(self.effects)}
        entries = [self._belief(name, q) for name, q in named.items()]
        if self.schema != EXACT_SCHEMA:
            sigma = default_sigma("arm", arm, arm)
            entries.insert(1, Belief(quantity="arm", value=arm, sigma=sigma, why="default"))
        return Beliefs(entries=tuple(entries))

    def _belief(self, name: str, quantity: Quantity) -> Belief:
        why: Why = "exact" if quantity.exact else "default" if name in self.assumed else "stated"
        return Belief(quantity=name, value=quantity.value, sigma=quantity.sigma, why=why)

    def to_dict(self) -> dict[str, Json]:
        """The vehicle as plain values in the shape of its TOML file; `from_dict` reads it back
        exactly."""
        bare = self.schema == EXACT_SCHEMA  # where a number without sigma is exact
        actuator: dict[str, Json] = {
            "u_min": self.actuator.u_min,
            "u_max": self.actuator.u_max,
            "hold": self.actuator.hold,
        }
        for key in ("rotor_radius", "speed_max"):
            if getattr(self.actuator, key) is not None:
                actuator[key] = getattr(self.actuator, key)
        for key in ("thrust", "torque"):
            actuator[key] = [q.value for q in getattr(self.actuator, key)]
            actuator[f"{key}_sigma"] = [q.sigma for q in getattr(self.actuator, key)]
        out: dict[str, Json] = {
            "schema": self.schema,
            "name": self.name,
            "gravity": self.gravity,
            "mass": _plain(self.mass, bare),
            "inertia": [list(row) for row in self.inertia],
            "inertia_sigma": list(self.inertia_sigma),
            "center_of_mass": [_plain(q, bare) for q in self.center_of_mass],
            "imu_position": list(self.imu_position),
            "rotor": [{"position": list(r.position), "spin": r.spin} for r in self.rotors],
            "actuator": actuator,
            "effects": {
                k: {n: _plain(q, bare) for n, q in v.items()} for k, v in self.effects.items()
            },
            "noise": dict(self.noise),
            "columns": self.columns.to_dict(),
        }
        if self.nominal_voltage is not None:
            out["battery"] = {"nominal_voltage": self.nominal_voltage}
        if self.assumed:
            out[ASSUMED] = sorted(self.assumed)
        return out

    @staticmethod
    def from_dict(value: Parsed, *, where: str = "vehicle") -> Vehicle:
        """Build and check a vehicle from the values of its file. `where` names the file in errors.

        Raises `VehicleError` (or `UnknownNameError` for an unknown key, with the nearest names).
        """
        return _vehicle(TomlTable(value, file=where))


@takes(path=PATH)
def read_vehicle(path: str | os.PathLike[str]) -> Vehicle:
    """Read a vehicle file (TOML, schema "greybox.vehicle/2"; files of "greybox.vehicle/1" keep
    their meaning).

    Raises `VehicleError` naming file and key: no such file, TOML syntax (with line), missing key,
    wrong type, inertia that no body can have, zero mass, no rotor, u_min >= u_max, negative sigma;
    `UnknownNameError` for a key that is not known, with the nearest names.
    """
    data = read_toml(path, what="vehicle file", error=VehicleError)
    if _by_channel(data):
        warnings.warn(
            f"{path}: [columns] by channel goes with 0.2.0. Usual fix: `greybox vehicle check "
            f"{path}` prints it by group (docs/logs.md)",
            OldFormWarning,
            stacklevel=2,
        )
    return Vehicle.from_dict(data, where=str(path))


def columns_by_channel(path: str | os.PathLike[str]) -> bool:
    """Whether a vehicle file has `[columns]` in the form before 0.1.0. Raises `VehicleError`."""
    return _by_channel(read_toml(path, what="vehicle file", error=VehicleError))


def _by_channel(data: Parsed) -> bool:
    columns = data.get("columns")
    return isinstance(columns, Mapping) and is_by_channel(columns)


def _plain(quantity: Quantity, bare: bool) -> float | dict[str, float]:
    """As in a file; `bare` says that a number without sigma is exact there."""
    return (
        quantity.value
        if quantity.exact and bare
        else {"value": quantity.value, "sigma": quantity.sigma}
    )


def _arm_length(rotors: Iterable[Rotor]) -> float:
    return max(float(np.hypot(r.position[0], r.position[1])) for r in rotors) or 0.1


def _of_effects(effects: Mapping[str, Mapping[str, Quantity]]) -> dict[str, Quantity]:
    """Parameters of the known effects under the names that the model gives them."""
    return {f"{name}.{short}": q for name, given in effects.items() for short, q in given.items()}


class _Silent:
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


def _quantity(table: TomlTable, key: str, value: object, name: str, silent: _Silent) -> Quantity:
    """The number at `key`, which is the quantity `name`."""
    if not isinstance(value, Mapping):
        number = table.checked_number(key, value)
        return Quantity(value=number, sigma=silent.sigma(name, number))
    inner = TomlTable(value, file=table.file, path=f"{table.path}.{key}" if table.path else key)
    inner.known(("value", "sigma"))
    number = inner.number("value")
    if "sigma" not in inner:
        return Quantity(value=number, sigma=silent.sigma(name, number))
    return Quantity(value=number, sigma=inner.number("sigma", minimum=0.0))


def _quantities(
    table: TomlTable,
    key: str,
    names: tuple[str, str, str],
    silent: _Silent,
    default: Sequence[float] | None = None,
) -> Quantity3:
    """Three numbers with sigmas, from `key` (numbers or value-sigma tables) and the optional
    `key_sigma`."""
    values = table.array(key, 3) if default is None else table.array(key, 3, default)
    sigma_key = f"{key}_sigma"
    if sigma_key not in table:
        x, y, z = (
            _quantity(table, f"{key}[{i}]", v, name, silent)
            for i, (v, name) in enumerate(zip(values, names, strict=True))
        )
        return x, y, z
    exact = _Silent(EXACT_SCHEMA, 0.0, ())
    read = [_quantity(table, f"{key}[{i}]", v, "", exact) for i, v in enumerate(values)]
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


def _vector(table: TomlTable, key: str, default: Sequence[float] | None = None) -> Vector3:
    x, y, z = table.numbers(key, 3) if default is None else table.numbers(key, 3, default)
    return x, y, z


def _inertia(top: TomlTable, silent: _Silent) -> tuple[Matrix3, Vector3]:
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
        xx, yy, zz = (silent.sigma(f"inertia.{a}{a}", rows[i][i]) for i, a in enumerate("xyz"))
        sigma = xx, yy, zz
    return (rows[0], rows[1], rows[2]), sigma


def _rotors(top: TomlTable) -> tuple[Rotor, ...]:
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
        rotors.append(Rotor(position=_vector(table, "position"), spin=int(spin)))
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


def _actuator(table: TomlTable, silent: _Silent) -> Actuator:
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
    thrust = _quantities(table, "thrust", ("thrust.c0", "thrust.c1", "thrust.c2"), silent)
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
        torque=_quantities(table, "torque", ("torque.c0", "torque.c1", "torque.c2"), silent),
    )


def _columns(table: TomlTable, rotors: int) -> LogMapping:
    """What the table says in the dialect of mapping files, or in the form before 0.1.0."""
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


def _names_own_sensor(key: str) -> bool:
    """Whether a key of [noise] can be that of a sensor of the user's own, and is no slip of the pen
    for a known one."""
    if not re.fullmatch(r"[a-z][a-z0-9_]*", key):
        return False
    begins = any(key.startswith(n) or n.startswith(key) for n in NOISES)
    near = difflib.get_close_matches(key, NOISES, n=len(NOISES), cutoff=MISSPELT)
    return not begins and not any(abs(len(n) - len(key)) <= LETTERS for n in near)


def _schema(top: TomlTable) -> str:
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


def _effects(top: TomlTable, silent: _Silent) -> dict[str, Mapping[str, Quantity]]:
    table = top.table("effects", {})
    effects: dict[str, Mapping[str, Quantity]] = {}
    for name in table.value:
        one = table.table(name)
        effects[name] = MappingProxyType(
            {k: _quantity(one, k, v, f"{name}.{k}", silent) for k, v in one.value.items()}
        )
    return effects


def _vehicle(top: TomlTable) -> Vehicle:
    schema = _schema(top)
    rotors = _rotors(top)
    labelled = [str(name) for name in top.array(ASSUMED, None, [])]
    silent = _Silent(schema, _arm_length(rotors), labelled)
    mass = _quantity(top, "mass", top.get("mass"), "mass", silent)
    if not mass.value > 0:
        raise top.error(
            "mass", "must be positive", got=f"{mass.value:g}", fix="weigh the craft, in kg"
        )
    inertia, inertia_sigma = _inertia(top, silent)
    effects = _effects(top, silent)
    noise = top.table("noise", {})
    noise.known((*NOISES, *(k for k in noise.value if _names_own_sensor(k))))
    battery = top.table("battery", {})
    battery.known(("nominal_voltage",))
    vehicle = Vehicle(
        name=top.text("name", "vehicle"),
        gravity=top.number("gravity", GRAVITY, positive=True),
        mass=mass,
        inertia=inertia,
        inertia_sigma=inertia_sigma,
        center_of_mass=_quantities(
            top,
            "center_of_mass",
            ("center_of_mass.x", "center_of_mass.y", "center_of_mass.z"),
            silent,
            [0.0, 0.0, 0.0],
        ),
        imu_position=_vector(top, "imu_position", [0.0, 0.0, 0.0]),
        rotors=rotors,
        actuator=_actuator(top.table("actuator"), silent),
        effects=effects,
        nominal_voltage=battery.number("nominal_voltage", positive=True)
        if "nominal_voltage" in battery
        else None,
        noise={k: noise.number(k, positive=True) for k in noise.value},
        columns=_columns(top.table("columns", {}), len(rotors)),
        schema=schema,
    )
    known = {**vehicle.quantities, **_of_effects(effects)}
    for label in labelled:
        if label not in known:
            raise UnknownNameError("quantity", label, known, where=top.place(ASSUMED))
    return replace(vehicle, assumed=frozenset(silent.assumed))
