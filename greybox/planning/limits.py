"""Limits: the room, speed, tilt and command range that a planned flight must keep, and what a flown
one used of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from greybox.data import Dataset
from greybox.errors import GreyboxError
from greybox.model.vehicle import Vehicle
from greybox.planning.document import LimitsPart, UsedPart
from greybox.planning.manoeuvres import TILT
from greybox.symbolic import BoolArray, FloatArray
from greybox.takes import numbers_of, taken_fields

OUTSIDE = 0.01
"""Share of the samples in which a command may lie outside its range."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """`box` (length along x, width along y, height above the floor) [m], centred on the origin;
    `floor` is the lowest height [m] that the craft may sink to, `speed` [m/s], `tilt` [rad],
    `command` (lowest, highest); None: the vehicle's range less 2 % at both ends.

    Raises `GreyboxError` for limits that leave no room.
    """

    box: tuple[float, float, float] = (4.0, 4.0, 2.5)
    floor: float = 0.3
    speed: float = 3.0
    tilt: float = TILT
    command: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        taken_fields(self, box=numbers_of(3), command=numbers_of(2))
        for name, value, low, high in (
            ("the box's length", self.box[0], 0.2, 1e4),
            ("the box's width", self.box[1], 0.2, 1e4),
            ("the box's height", self.box[2], self.floor + 0.2, 1e4),
            ("the floor", self.floor, 0.0, 1e4),
            ("the speed", self.speed, 0.05, 100.0),
            ("the tilt", self.tilt, 0.02, TILT + 1e-9),
            ("the highest command", self.commands[1], self.commands[0] + 1e-6, 1e4),
        ):
            if not low <= value <= high:
                raise GreyboxError(
                    f"{name} leaves no room to fly",
                    expected=f"{low:.3g} to {high:.3g}",
                    got=f"{value:.3g}",
                    fix="check --box L,W,H [m], --floor [m], --speed [m/s], --tilt [degrees, at "
                    "most 35] and --command",
                )

    @property
    def commands(self) -> tuple[float, float]:
        """Lowest and highest command; 0 and 1 where no vehicle is known."""
        return self.command or (0.0, 1.0)

    def of(self, vehicle: Vehicle) -> Limits:
        """The same with the range of commands of a vehicle, where none was given."""
        return self if self.command else replace(self, command=command_range(vehicle))

    @property
    def home(self) -> tuple[float, float, float]:
        """Where every manoeuvre starts and ends."""
        return 0.0, 0.0, 0.5 * (self.floor + self.box[2])

    def used(self, data: Dataset) -> UsedPart:
        """The most that noise-free flights took: m, m/s, rad, share of the samples with a command
        outside its range."""
        c = _columns(data)
        return {
            "x": float(np.abs(c["x"]).max()),
            "y": float(np.abs(c["y"]).max()),
            "lowest": float(c["z"].min()),
            "highest": float(c["z"].max()),
            "speed": float(_speed(c).max()),
            "tilt": float(_tilt(c).max()),
            "commands_outside": float(self._outside(c).mean()),
        }

    def breaches(self, data: Dataset) -> dict[str, BoolArray]:
        """Where (n,) the flights, one after the other, are outside of which limit; commands may be
        for a short while."""
        c = _columns(data)
        outside = self._outside(c)
        rules = {
            "x": np.abs(c["x"]) > 0.5 * self.box[0],
            "y": np.abs(c["y"]) > 0.5 * self.box[1],
            "floor": c["z"] < self.floor,
            "height": c["z"] > self.box[2],
            "speed": _speed(c) > self.speed,
            "tilt": _tilt(c) > self.tilt,
            "command range": outside if outside.mean() > OUTSIDE else np.zeros_like(outside),
        }
        return {name: where for name, where in rules.items() if where.any()}

    def broken(self, data: Dataset) -> list[str]:
        """Which limits the flights break, in words; empty where they keep all."""
        return list(self.breaches(data))

    def _outside(self, c: Mapping[str, FloatArray]) -> BoolArray:
        u = np.stack([v for n, v in c.items() if n[0] == "u" and n[1:].isdigit()])
        return np.asarray(((u < self.commands[0]) | (u > self.commands[1])).any(axis=0))

    def to_dict(self) -> LimitsPart:
        """As in plan.json."""
        return {
            "box_m": list(self.box),
            "floor_m": self.floor,
            "speed_m_s": self.speed,
            "tilt_rad": self.tilt,
            "command": list(self.commands),
        }


def _columns(data: Dataset) -> dict[str, FloatArray]:
    segments = [s.channels for f in data.flights for s in f.segments]
    return {n: np.concatenate([s[n] for s in segments]) for n in segments[0]}


def _speed(c: Mapping[str, FloatArray]) -> FloatArray:
    return np.asarray(np.sqrt(c["vx"] ** 2 + c["vy"] ** 2 + c["vz"] ** 2))


def _tilt(c: Mapping[str, FloatArray]) -> FloatArray:
    return np.asarray(np.arccos(np.clip(1 - 2 * (c["qx"] ** 2 + c["qy"] ** 2), -1, 1)))


def command_range(vehicle: Vehicle, share: float = 0.02) -> tuple[float, float]:
    """The vehicle's command range less `share` of it at either end."""
    low, high = vehicle.actuator.u_min, vehicle.actuator.u_max
    return low + share * (high - low), high - share * (high - low)
