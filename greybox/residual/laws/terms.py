"""Terms: what a law of the leftover may be made of, as numbers along the flight and as a line of an
effect file.

Signals are those that the physics of multirotors knows: body velocity, rates, directions of gravity
and north in body axes, place and height, and the rotors by their collective sums of nu^2 (thrust,
roll, pitch and yaw, as the geometry mixes them). Laws are linear in terms: signals, x |x|, products
of signals that occur together in mechanics, 1/height^2, and bumps: over the rotor speed for a
thrust law that is not a parabola, over the place for a force that stands in the room. Few terms on
purpose: a smoothed discrepancy has no more independent values than the flight has correlation
times.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from greybox.frames import numeric
from greybox.model.dynamics import Dynamics
from greybox.model.layer import physics_of
from greybox.model.vehicle import Vehicle
from greybox.residual.features import available, default_features
from greybox.symbolic import FloatArray

SPEEDS, PLACES = 6, 10
"""Bumps over the rotor speed, and over each coordinate of the place."""
ALONG = {"position.x": ("east", "up"), "position.y": ("north", "up"), "height": ("up",)}
"""Coordinate of the place -> axes of the world along which a force that depends on it points."""
SIDES = ("heading", "tilt")
PAIRS = (
    ("velocity", "velocity"),
    ("rate", "rate"),
    ("velocity", "rate"),
    ("velocity", "collective"),
    ("rate", "collective"),
    ("heading", "place"),
)


@dataclass(frozen=True, kw_only=True)
class Memory:
    """How a term follows its signal: a lag of `time` [s] or, with a `damping` ratio, a swing of
    1/(2 pi time) Hz."""

    time: float
    damping: float | None = None

    @property
    def kind(self) -> str:
        """What it is apart from its numbers: terms of one kind that follow one signal are the same
        with another time."""
        return "lag" if self.damping is None else "swing"

    def __str__(self) -> str:
        if self.damping is None:
            return f"within {self.time:.2g} s"
        return f"swinging at {1 / (2 * math.pi * self.time):.2g} Hz"

    @property
    def numbers(self) -> dict[str, float]:
        """What a refit frees, by name."""
        return {"time": self.time} | ({} if self.damping is None else {"damping": self.damping})

    def moved(self, numbers: Mapping[str, float]) -> Memory:
        """The same with other numbers."""
        return Memory(time=numbers["time"], damping=numbers.get("damping"))


@dataclass(frozen=True, kw_only=True)
class Bump:
    """A term that acts where the `signal` is near a `place`: exp(-((signal - place) / width)^2)."""

    signal: str
    place: float
    width: float

    def __str__(self) -> str:
        return f"{self.signal} near {self.place:.3g}, {self.width:.2g} wide"

    @property
    def numbers(self) -> dict[str, float]:
        """What a refit frees, by name; `Term.code` holds them as {place} and {width}."""
        return {"place": self.place, "width": self.width}

    def moved(self, numbers: Mapping[str, float]) -> Bump:
        """The same with other numbers."""
        return replace(self, place=numbers["place"], width=numbers["width"])


Shape = Memory | Bump
Shaped = tuple[Shape, float] | None
"""The shape of a term, and the RMS of its column; None for a term without one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Term:
    """One column: `text` for people, `code` for an effect file (CasADi, `flow`), signals it `uses`,
    values (N,).

    With a memory as its `shape` the column is what that keeps of `code`
    (greybox.residual.laws.lagged)."""

    text: str
    code: str
    uses: tuple[str, ...]
    values: FloatArray
    shape: Shape | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class FlightSignal:
    """One signal along the flight: its kind groups what mechanics multiplies, `code` as in `Term`,
    values (N,)."""

    name: str
    kind: str
    code: str
    values: FloatArray


def wanted_features(dynamics: Dynamics) -> tuple[str, ...]:
    """Names of the model's features that terms read; of a model of the user's own all states and
    inputs."""
    if physics_of(dynamics) is None:
        return default_features(dynamics)
    there = available(dynamics)
    rotors = [n for n in there if n[:2] == "nu"] or [
        n for n in dynamics.inputs.names if n[0] == "u"
    ]
    names = (
        [f"body_velocity.{a}" for a in "xyz"] + ["p", "q", "r"] + [f"attitude.{a}" for a in "wxyz"]
    )
    names += [f"position.{a}" for a in "xyz"] + ["vbat"] + rotors
    return tuple(n for n in names if n in there)


def terms(channel: str, names: Sequence[str], z: FloatArray, vehicle: Vehicle) -> list[Term]:
    """Terms for a law of `channel` (force.x, ...) from the features `names` with values z (N,
    m)."""
    there = signals(names, z, vehicle)
    out: list[Term] = []
    for s in there:
        out.append(_term(s.name, s.code, (s.name,), s.values))
        if s.kind in ("velocity", "rate", "place"):
            out.append(
                _term(
                    f"{s.name} |{s.name}|",
                    f"{s.code} * ca.fabs({s.code})",
                    (s.name,),
                    s.values * abs(s.values),
                )
            )
        if s.kind in ("velocity", "place"):
            out.append(_term(f"{s.name}^2", f"{s.code} ** 2", (s.name,), s.values**2))
        if s.name == "height":
            near = f"1 / ca.fmax(ca.fabs({s.code}), 0.05) ** 2"
            out.append(
                _term("1/height^2", near, (s.name,), 1 / np.maximum(abs(s.values), 0.05) ** 2)
            )
    for a, b in itertools.combinations(there, 2):
        if b.kind == "place" and a.kind in SIDES and not _felt_along(channel, a):
            continue
        if (a.kind, b.kind) in PAIRS or (b.kind, a.kind) in PAIRS:
            out.append(
                _term(
                    f"{a.name} {b.name}",
                    f"{a.code} * {b.code}",
                    (a.name, b.name),
                    a.values * b.values,
                )
            )
        if a.kind == "tilt" and b.name == "height":
            out.append(
                _term(
                    f"{a.name} {b.name}",
                    f"{a.code} * {b.code}",
                    (a.name, b.name),
                    a.values * b.values,
                )
            )
        if (a.kind, b.kind) == ("heading", "place"):
            code = f"{a.code} * {b.code} ** 2"
            out.append(
                _term(f"{a.name} {b.name}^2", code, (a.name, b.name), a.values * b.values**2)
            )
    return [*out, *_fields(channel, there), *_speeds(channel, names, z, vehicle)]


def _term(text: str, code: str, uses: Iterable[str], values: FloatArray) -> Term:
    return Term(
        text=text,
        code=code,
        uses=tuple(dict.fromkeys(uses)),
        values=np.asarray(values, dtype=float),
    )


def rotors(names: Sequence[str], z: FloatArray) -> FloatArray:
    """Rotor speeds or, without rotor states, commands (N, n); (N, 0) where the features hold
    neither."""
    return z[
        :, [i for i, n in enumerate(names) if n[:2] == "nu" or (n[0] == "u" and n[1:].isdigit())]
    ]


def _weights(vehicle: Vehicle) -> dict[str, list[float]]:
    """Collective -> weight of every rotor: thrust, and the moments about the body axes that its
    thrust and drag give."""
    rows = vehicle.rotors
    return {
        "thrust": [1.0] * len(rows),
        "roll": [round(float(r.position[1]), 6) for r in rows],
        "pitch": [-round(float(r.position[0]), 6) for r in rows],
        "yaw": [-float(r.spin) for r in rows],
    }


def signals(names: Sequence[str], z: FloatArray, vehicle: Vehicle) -> list[FlightSignal]:
    """All signals of the features `names` with values z (N, m)."""
    at = {n: z[:, i] for i, n in enumerate(names)}
    out: list[FlightSignal] = []

    def add(name: str, kind: str, code: str, values: FloatArray) -> None:
        out.append(FlightSignal(name=name, kind=kind, code=code, values=values))

    for i, a in enumerate("xyz"):
        if f"body_velocity.{a}" in at:
            add(f"velocity.{a}", "velocity", f"flow.velocity[{i}]", at[f"body_velocity.{a}"])
    for i, a in enumerate("pqr"):
        if a in at:
            add(a, "rate", f"flow.omega[{i}]", at[a])
    if "attitude.w" in at:
        q = np.column_stack([at[f"attitude.{a}"] for a in "wxyz"])
        q = q / np.linalg.norm(q, axis=1, keepdims=True)
        for row, name, kind in ((2, "up", "tilt"), (1, "north", "heading"), (0, "east", "heading")):
            axis = np.zeros((len(q), 3))
            axis[:, row] = 1.0
            body = numeric("rotate_inverse", q, axis)
            for i, a in enumerate("xyz"):
                add(f"{name}.{a}", kind, f"flow.rotation[{row}, {i}]", body[:, i])
    for i, a in enumerate("xyz"):
        if f"position.{a}" in at:
            add(
                "height" if a == "z" else f"position.{a}",
                "place",
                f"flow.position[{i}]",
                at[f"position.{a}"],
            )
    if "vbat" in at:
        add("vbat", "battery", "flow.vbat", at["vbat"])
    nu = rotors(names, z)
    if nu.shape[1] == len(vehicle.rotors):
        for name, w in _weights(vehicle).items():
            kind = "collective" if name == "thrust" else "mix"
            add(f"rotors.{name}", kind, f"ca.dot(ca.DM({w}), flow.nu**2)", nu**2 @ np.array(w))
    return out


def _felt_along(channel: str, side: FlightSignal) -> bool:
    """Whether a force along this axis of the world, which stands in the room, is felt there: as its
    component in body axes, or as a moment about the others."""
    kind, axis = channel.split(".")
    return (side.name[-1] == axis) == (kind == "force")


def _bumps_over(values: FloatArray, signal: str, count: int) -> list[Bump]:
    """Bumps over what the flight saw of a signal; none where that stood still."""
    low, high = np.quantile(values, [0.02, 0.98])
    if not high - low >= 1e-3:
        return []
    width = round(float(high - low) / (count - 1), 4)
    places = np.linspace(low, high, count)
    return [Bump(signal=signal, place=round(float(c), 4), width=width) for c in places]


def _near(bump: Bump, values: FloatArray) -> FloatArray:
    return np.asarray(np.exp(-(((values - bump.place) / bump.width) ** 2)))


def _near_code(code: str) -> str:
    return f"ca.exp(-((({code} - {{place}}) / {{width}}) ** 2))"


def _fields(channel: str, there: Sequence[FlightSignal]) -> list[Term]:
    """Bumps over the place, of a force that stands in the room: a wall, a fan, a ceiling. It
    points along the coordinate that it depends on, or up; a torque is its moment."""
    sides = [s for s in there if s.kind in SIDES and _felt_along(channel, s)]
    return [
        Term(
            text=f"{side.name} ({bump})",
            code=f"{side.code} * {_near_code(place.code)}",
            uses=(side.name, place.name),
            values=side.values * _near(bump, place.values),
            shape=bump,
        )
        for place in there
        if place.kind == "place"
        for bump in _bumps_over(place.values, place.name, PLACES)
        for side in sides
        if side.name.split(".")[0] in ALONG[place.name]
    ]


def _speeds(channel: str, names: Sequence[str], z: FloatArray, vehicle: Vehicle) -> list[Term]:
    """Sums over rotors of bumps over their speed nu, weighted as the rotor's thrust enters the
    channel."""
    mix = {"force.z": "thrust", "torque.x": "roll", "torque.y": "pitch", "torque.z": "yaw"}.get(
        channel
    )
    nu = rotors(names, z)
    if mix is None or nu.shape[1] != len(vehicle.rotors):
        return []
    w = _weights(vehicle)[mix]
    return [
        Term(
            text=f"rotors.{mix} ({bump})",
            code=f"ca.dot(ca.DM({w}), {_near_code('flow.nu')})",
            uses=("nu",),
            values=_near(bump, nu) @ np.array(w),
            shape=bump,
        )
        for bump in _bumps_over(nu, "nu", SPEEDS)
    ]
