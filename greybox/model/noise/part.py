"""NoisePart: one kind of noise that is correlated in time, as data that an `Augmented` model reads.

A part has own states that are driven by white noise and acts on the model at one place: a
`SensorPart` on a sensor (it adds to the sensor's error, or stands between the sensor and its
reading), a `Disturbance` on the process noise. Each kind is one file of this folder: what it is
called, its parameters, the step of its own states, and how it starts.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import ClassVar, Self

import numpy as np

from greybox.errors import ModelError, UnknownNameError
from greybox.model.dynamics import Dynamics
from greybox.model.layer import physics_of
from greybox.model.parameter import Parameter
from greybox.symbolic import Expr, FloatArray, Signal


@dataclass(frozen=True, kw_only=True)
class Place:
    """Where a part acts: `signals` are its components (of the process noise, or of the innovation
    of a sensor), `rows` their places there, `readings` the names of the outputs of the sensor and
    `columns` their places among the outputs. The own states of errors of a `world` vector are in
    the axes of the world."""

    signals: tuple[Signal, ...]
    rows: tuple[int, ...]
    readings: tuple[str, ...] = ()
    columns: tuple[int, ...] = ()
    world: bool = False


class NoisePart(ABC):
    """Base of all kinds. A part is a frozen record of its place and of start values.

    `quantities` are the short names of its parameters, `copies` the letters of its own states: each
    component of the place has one state per letter, all components of a letter together. The first
    letter's states are what acts on the model.
    """

    kind: ClassVar[str]
    quantities: ClassVar[tuple[str, ...]]
    copies: ClassVar[tuple[str, ...]] = ("c",)
    lasting: ClassVar[bool] = False
    """Whether it was there long before the flight, which then begins anywhere in it: a Gauss-Markov
    process starts in its stationary state."""

    @property
    @abstractmethod
    def name(self) -> str:
        """kind.place, the prefix of its parameters."""

    def to_dict(self) -> dict[str, str | float]:
        """Its kind and the fields of its record, for files (`kinds.noise_part` reads them)."""
        return {"kind": self.kind, **{f.name: getattr(self, f.name) for f in fields(self)}}  # type: ignore[arg-type]

    @abstractmethod
    def place(self, core: Dynamics) -> Place:
        """Where it acts on `core`. Raises `UnknownNameError` where `core` has no such place."""

    @abstractmethod
    def signals(self, place: Place) -> tuple[Signal, ...]:
        """Its own states; its driving noises have the same names and units."""

    @abstractmethod
    def parameters(self, core: Dynamics) -> tuple[Parameter, ...]:
        """One declaration per member of `quantities`, full names."""

    @abstractmethod
    def typical(self, core: Dynamics, place: Place, dt: float) -> FloatArray:
        """Start values of the white noise at its place: standard deviation per sample of dt
        seconds, one per component."""

    @abstractmethod
    def rate(self, c: Expr, values: Mapping[str, Expr], reading: Expr) -> Expr:
        """dc/dt of its own states c without noise; `values` by short name, `reading` of its sensor
        (None elsewhere)."""

    @abstractmethod
    def step(self, c: Expr, w: Expr, values: Mapping[str, Expr], reading: Expr, dt: Expr) -> Expr:
        """Its own states one sample of dt seconds later, driven by w."""

    @abstractmethod
    def driving(self, level: FloatArray, dt: float) -> FloatArray:
        """Start values of the levels of its driving noise; `level` as `typical` gives it for dt."""

    @abstractmethod
    def rescaled(self, values: Mapping[str, float], own: float, dt: float) -> float:
        """Factor from the level of its driving noise per sample of `own` seconds to that per sample
        of `dt`, for the same noise; `values` of parameters by full name."""

    def start(
        self, place: Place, level: FloatArray, seen: Mapping[str, FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """(start value, spread) of its own states in a flight whose channels show `seen` at first;
        `level` as `typical`."""
        spread = np.tile(level, len(self.copies))
        return np.zeros(spread.size), spread

    def settled(self, place: Place, means: Mapping[str, float]) -> FloatArray:
        """Its own states where the model is linearised, given the mean of every channel."""
        return np.zeros(len(self.copies) * len(place.rows))


@dataclass(frozen=True, kw_only=True)
class SensorPart(NoisePart):
    """Base of the noise of one sensor: `sensor` is a name of `greybox.model.sensors`.

    It adds to the innovation of its sensor and to nothing else, e = y - h(x) - c: the vehicle does
    not feel it. A filter (`filters`) stands between the sensor and its reading instead.
    """

    filters: ClassVar[bool] = False
    sensor: str

    @property
    def name(self) -> str:
        """kind.sensor, the prefix of its states and parameters."""
        return f"{self.kind}.{self.sensor}"

    def place(self, core: Dynamics) -> Place:
        """Innovation components and columns of the sensor. Raises `UnknownNameError`, and
        `ModelError` for a filter of a sensor whose components are not its columns (a
        quaternion)."""
        physics = physics_of(core)
        if physics is None:
            raise ModelError(
                f"{core.name} has no sensors whose noise could have states",
                expected="a physics model",
            )
        e = y = 0
        for s in physics.sensors:
            own, columns = s.innovation_signals(physics.vehicle), s.signals(physics.vehicle)
            if s.name == self.sensor:
                if self.filters and len(own) != len(columns):
                    raise ModelError(
                        f"{self.name}: the innovation of {s.name} is not a difference of readings"
                    )
                return Place(
                    signals=tuple(own),
                    rows=tuple(range(e, e + len(own))),
                    readings=tuple(c.name for c in columns),
                    columns=tuple(range(y, y + len(columns))),
                    world=s.world and not self.filters,
                )
            e, y = e + len(own), y + len(columns)
        raise UnknownNameError("sensor", self.sensor, [s.name for s in physics.sensors])

    def signals(self, place: Place) -> tuple[Signal, ...]:
        """kind.sensor.letter.component, in the unit of the component."""
        return tuple(
            Signal(
                name=f"{self.name}.{letter}.{s.name.split('.')[-1]}",
                unit=s.unit,
                meaning=f"{self.kind} noise, {s.meaning}",
            )
            for letter in self.copies
            for s in place.signals
        )

    def typical(self, core: Dynamics, place: Place, dt: float) -> FloatArray:
        """The white noise of its sensor."""
        return core.sensor_scale()[list(place.rows)]

    def shown(self, c: Expr, w: Expr, values: Mapping[str, Expr], reading: Expr, dt: Expr) -> Expr:
        """What a filter makes of the `reading` of its sensor; the reading itself for other
        parts."""
        return reading

    @abstractmethod
    def renewed(self, values: Mapping[str, float], dt: float) -> float:
        """Share of the variance of its noise that is new in every sample of dt seconds; 1 where it
        never settles."""

    @abstractmethod
    def described(self, level: float, values: Mapping[str, float], dt: float) -> dict[str, float]:
        """What a report says of one component: numbers by name, from the `level` of its driving
        noise and parameter values by full name."""

    def estimated(self, values: Mapping[str, float]) -> Self:
        """The same part with parameter values (by full name) for start values."""
        return self
