"""Vehicle: what a ruler, a scale and a data sheet say about one craft, and its file (schema
"greybox.vehicle/2").

A number is exact (sigma 0) or a prior (value and one standard deviation). One that states no sigma
is believed within the default of its quantity (see `beliefs`); in files of schema
"greybox.vehicle/1" it is exact. SI units; body axes FLU from the body origin.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from greybox.data.readers.by_channel import is_by_channel
from greybox.data.readers.mapping import LogMapping
from greybox.errors import OldFormWarning, UnknownNameError, VehicleError
from greybox.files import Json, Parsed, read_toml
from greybox.frames import GRAVITY
from greybox.model.beliefs import Belief, Beliefs, Why, default_sigma
from greybox.model.toml_table import TomlTable
from greybox.model.vehicle_parts import (
    ASSUMED,
    EXACT_SCHEMA,
    Actuator,
    Matrix3,
    Quantity,
    Quantity3,
    Rotor,
    Vector3,
    arm_length,
)
from greybox.model.vehicle_tables import (
    Unstated,
    actuator_of,
    columns_of,
    effects_of,
    inertia_of,
    noise_of,
    quantities_at,
    quantity_at,
    rotors_of,
    schema_of,
    vector_at,
)
from greybox.shown import Cell, Shown
from greybox.takes import PATH, takes


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
        return arm_length(self.rotors)

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


def _of_effects(effects: Mapping[str, Mapping[str, Quantity]]) -> dict[str, Quantity]:
    """Parameters of the known effects under the names that the model gives them."""
    return {f"{name}.{short}": q for name, given in effects.items() for short, q in given.items()}


def _vehicle(top: TomlTable) -> Vehicle:
    schema = schema_of(top)
    rotors = rotors_of(top)
    labelled = [str(name) for name in top.array(ASSUMED, None, [])]
    unstated = Unstated(schema, arm_length(rotors), labelled)
    mass = quantity_at(top, "mass", top.get("mass"), "mass", unstated)
    if not mass.value > 0:
        raise top.error(
            "mass", "must be positive", got=f"{mass.value:g}", fix="weigh the craft, in kg"
        )
    inertia, inertia_sigma = inertia_of(top, unstated)
    effects = effects_of(top, unstated)
    noise = noise_of(top)
    battery = top.table("battery", {})
    battery.known(("nominal_voltage",))
    vehicle = Vehicle(
        name=top.text("name", "vehicle"),
        gravity=top.number("gravity", GRAVITY, positive=True),
        mass=mass,
        inertia=inertia,
        inertia_sigma=inertia_sigma,
        center_of_mass=quantities_at(
            top,
            "center_of_mass",
            ("center_of_mass.x", "center_of_mass.y", "center_of_mass.z"),
            unstated,
            [0.0, 0.0, 0.0],
        ),
        imu_position=vector_at(top, "imu_position", [0.0, 0.0, 0.0]),
        rotors=rotors,
        actuator=actuator_of(top.table("actuator"), unstated),
        effects=effects,
        nominal_voltage=battery.number("nominal_voltage", positive=True)
        if "nominal_voltage" in battery
        else None,
        noise={k: noise.number(k, positive=True) for k in noise.value},
        columns=columns_of(top.table("columns", {}), len(rotors)),
        schema=schema,
    )
    known = {**vehicle.quantities, **_of_effects(effects)}
    for label in labelled:
        if label not in known:
            raise UnknownNameError("quantity", label, known, where=top.place(ASSUMED))
    return replace(vehicle, assumed=frozenset(unstated.assumed))
