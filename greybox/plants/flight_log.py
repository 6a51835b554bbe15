"""Fly a simulated plant in closed loop and keep the log, in memory or as the flight-log CSV of the
file contract."""

from __future__ import annotations

import functools
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from greybox.plants.controller import CascadeController, Mixer, Setpoint
from greybox.plants.quadrotor import Quadrotor
from greybox.plants.vectors import Command, Number, Quaternion, Vector

Array = NDArray[np.float64]
Log = dict[str, Array]
"""Columns by name; t has shape (N,), every other column (N,), or (N, B) for a batch."""
TRUTH = "true."
"""Prefix of the columns that a real log would not have: the true states."""
CLEAN = "clean."
"""Prefix of what the sensors would have said without noise, bias, scale and delay included."""
FEW = 8
"""A batch steps through arrays, which takes as long as this many flights one after the other."""
EXTRAS = ("truth", "clean")
"""What a log can hold beside the measurements: see `fly`."""


class Plant(Protocol):
    """A vehicle that can be flown: `greybox.plants.quadrotor.Quadrotor`, or one of another
    simulator."""

    @property
    def batch(self) -> int | None:
        """Number of vehicles flown at once, or None for a single one."""
        ...

    def reset(
        self,
        seed: int | Sequence[int],
        *,
        position: Vector,
        velocity: Vector,
        attitude: Quaternion,
        charge_used: Number,
    ) -> None:
        """Start anew at t = 0."""
        ...

    def step(self, u: Command, dt: float | None = None) -> None:
        """Hold command u for dt [s]."""
        ...

    def measure(self, u: Command | None = None, *, noise: bool = True) -> dict[str, Number]:
        """Measurements by flight-log column; u is the command that begins now."""
        ...

    def states(self) -> dict[str, Number]:
        """True state by name."""
        ...


class SampledPath(Protocol):
    """position, velocity, acceleration (N, 3), yaw, yaw_rate (N,); `Trajectory` of
    greybox.excitation."""

    @property
    def position(self) -> Array:
        """World [m]."""
        ...

    @property
    def velocity(self) -> Array:
        """World [m/s]."""
        ...

    @property
    def acceleration(self) -> Array:
        """World [m/s^2]."""
        ...

    @property
    def yaw(self) -> Array:
        """[rad]."""
        ...

    @property
    def yaw_rate(self) -> Array:
        """[rad/s]."""
        ...


class Reference(Protocol):
    """A path to fly; see greybox.excitation."""

    def sample(self, time: Array, rng: np.random.Generator) -> SampledPath:
        """The path at the times (N,)."""
        ...


class Excitation(Protocol):
    """Signals added to the loop; see greybox.excitation."""

    def sample(self, time: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Mixer inputs (N, 4) and setpoint offsets (N, 4) at the times (N,)."""
        ...


class Controller(Protocol):
    """A flight controller, see CascadeController."""

    feedback: str

    def reset(self) -> None:
        """Forget everything."""
        ...

    def __call__(
        self, seen: dict[str, Number], goal: Setpoint, dt: float, inject: Mixer
    ) -> list[Number]:
        """Rotor commands from measurements by column name."""
        ...


def fly(
    plant: Plant,
    controller: Controller,
    reference: Reference,
    excitation: Excitation | None,
    duration: float,
    dt: float = 0.01,
    seed: int | Sequence[int] = 0,
    *,
    warm_up: float = 0.0,
    charge_used: Number = 0.0,
    record: Collection[str] = (),
) -> Log:
    """Fly `duration` s from the start of the reference and return the log.

    dt [s]: sample time of controller and log. seed: an integer, or a sequence of B integers, which
    flies B vehicles, each with its own noise, reference and excitation: at once, or one after the
    other where they are few and differ in their seeds alone, which is faster. warm_up [s]: flown
    before the log begins (its time starts at zero all the same). charge_used [A s]: what the
    battery has given before. record: columns to add, "truth" (the true states, as `true.<state>`)
    and "clean" (`clean.<column>`, what the sensors would have said without noise). Row k holds the
    measurement at t_k and the command held from t_k to t_k+1. Raises `ValueError` for another word
    in `record`.
    """
    if unknown := sorted(set(record) - set(EXTRAS)):
        raise ValueError(f"record takes {' and '.join(EXTRAS)}, not {', '.join(unknown)}")
    flown = functools.partial(
        _flown, plant, controller, reference, excitation, duration, dt, warm_up, record
    )
    if isinstance(seed, int | np.integer):
        return flown(seed, charge_used)
    if not (0 < len(seed) < FEW and _one_by_one(plant, controller)):
        return flown(seed, charge_used)
    used = np.broadcast_to(charge_used, len(seed)).tolist()
    logs = [flown(s, charge) for s, charge in zip(seed, used)]
    return {
        name: values if name == "t" else np.stack([one[name] for one in logs], axis=-1)
        for name, values in logs[0].items()
    }


def _one_by_one(plant: Plant, controller: Controller) -> bool:
    """Whether a batch of this plant is as many single flights; what keeps a batch's books is flown
    as one."""
    return type(plant) is Quadrotor and plant.alike and type(controller) is CascadeController


def _flown(
    plant: Plant,
    controller: Controller,
    reference: Reference,
    excitation: Excitation | None,
    duration: float,
    dt: float,
    warm_up: float,
    record: Collection[str],
    seed: int | Sequence[int],
    charge_used: Number,
) -> Log:
    """As `fly`, a batch at once."""
    single = isinstance(seed, int | np.integer)
    lead, rows = round(warm_up / dt), round(duration / dt)
    time = dt * np.arange(lead + rows)
    plan = _Plan(reference, excitation, time, [seed] if single else list(seed), single)  # type: ignore[arg-type,list-item]
    goal = plan.setpoint(0)
    plant.reset(
        seed,
        position=goal.position,
        velocity=goal.velocity,
        attitude=_facing(goal.yaw),
        charge_used=charge_used,
    )
    controller.reset()
    use_truth = controller.feedback == "truth"
    kept: list[list[Number]] = []
    names: list[str] = []
    for k in range(lead + rows):
        seen = plant.states() if use_truth else plant.measure()
        command = controller(seen, plan.setpoint(k), dt, plan.injection(k))
        u = (
            command
            if single
            else np.column_stack([np.broadcast_to(c, (plant.batch or 1,)) for c in command])
        )
        if k >= lead:
            row = _row(plant, u, record)
            if not names:
                names = list(row)
            kept.append(list(row.values()))
        plant.step(u, dt)
    log = {name: np.array([row[j] for row in kept], dtype=float) for j, name in enumerate(names)}
    log["t"] = time[:rows].copy()
    return log


def _row(plant: Plant, u: Sequence[Number] | Array, record: Collection[str]) -> dict[str, Number]:
    """What the log says of this instant, under the command u that begins now."""
    row = plant.measure(u)
    if "clean" in record:
        row |= {
            CLEAN + name: value
            for name, value in plant.measure(u, noise=False).items()
            if name != "t"
        }
    if "truth" in record:
        row |= {TRUTH + name: value for name, value in plant.states().items()}
    return row


def member(log: Mapping[str, Array], index: int) -> Log:
    """The log of one vehicle of a batch: every column (N,)."""
    return {name: values if values.ndim == 1 else values[:, index] for name, values in log.items()}


def write_log(
    path: str | Path,
    log: Mapping[str, Array],
    *,
    drop: Iterable[str] = (),
    truth: bool = False,
) -> Path:
    """Write a log as flight-log CSV: a header row, one row per sample, missing values as empty
    cells.

    drop: columns to leave out, a name or a prefix of numbered ones ("omega" drops omega1..n);
    truth: keep the `true.` and `clean.` columns. Raises `ValueError` for a log of several plants.
    """
    left_out = set(drop)
    names = [
        name
        for name in log
        if not (
            name in left_out
            or name.rstrip("0123456789") in left_out
            or (name.startswith((TRUTH, CLEAN)) and not truth)
        )
    ]
    for name in names:
        if log[name].ndim != 1:
            raise ValueError(
                f"column {name} holds a batch {log[name].shape}: take one with member(log, index)"
            )
    columns = [["" if np.isnan(v) else repr(v) for v in log[name].tolist()] for name in names]
    lines = [",".join(names), *(",".join(row) for row in zip(*columns))]
    path = Path(path)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def _facing(yaw: Number) -> Quaternion:
    """Attitude quaternion of a level vehicle at this yaw [rad]."""
    zero = 0.0 * np.asarray(yaw)
    return (np.cos(0.5 * yaw), zero, zero, np.sin(0.5 * yaw))


class _Plan:
    """Reference and excitation of all members, ready to be read row by row: floats, or arrays
    (B,)."""

    def __init__(
        self,
        reference: Reference,
        excitation: Excitation | None,
        time: Array,
        seeds: list[int],
        single: bool,
    ) -> None:
        tables = []
        for seed in seeds:
            path = reference.sample(time, np.random.default_rng([seed, 1]))
            mixer, offset = np.zeros((time.size, 4)), np.zeros((time.size, 4))
            if excitation is not None:
                mixer, offset = excitation.sample(time, np.random.default_rng([seed, 2]))
            tables.append(
                np.column_stack(
                    [
                        path.position + offset[:, :3],
                        path.velocity,
                        path.acceleration,
                        path.yaw + offset[:, 3],
                        path.yaw_rate,
                        mixer,
                    ]
                )
            )
        self._rows: list[list[Number]] | list[Array] = (
            tables[0].tolist() if single else list(np.stack(tables, axis=-1))
        )

    def setpoint(self, k: int) -> Setpoint:
        """What sample k asks for."""
        r = self._rows[k]
        return Setpoint(
            position=(r[0], r[1], r[2]),
            velocity=(r[3], r[4], r[5]),
            acceleration=(r[6], r[7], r[8]),
            yaw=r[9],
            yaw_rate=r[10],
        )

    def injection(self, k: int) -> Mixer:
        """Mixer excitation of sample k."""
        r = self._rows[k]
        return (r[11], r[12], r[13], r[14])
