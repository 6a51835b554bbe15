"""Oracle of power: can anybody see in these logs what is hidden in them?

The flights are cut into windows of a second. In every window the plant of `greybox.plants` with
all hidden effects flies the recorded commands from the true state; so does the plant without one of
them. The difference of their noise-free readings, D, is what the effect does to the log. Against it
stand the sensors' noise (white, coloured, vibration and jitter of real ones) and everything that
its size could hide behind, each by its own change of the readings: the start of the window, gusts
as a Gauss-Markov force and moment, biases of the IMU, the numbers of the vehicle file within their
errors, the sizes of the other hidden effects. All of that is Gaussian to first order, so that

    strength = D' (noise + hiding places)^-1 D

is twice the log likelihood ratio that the best of all methods gains on average by knowing the
effect (Neyman and Pearson 1933). An effect of d parameters has power where strength - d ln(rows)
exceeds 10, the step of BIC that is taken as clear (Schwarz 1978; Kass and Raftery 1995). Strengths
beyond some hundreds are not to scale where the file's numbers are not exact: to first order a wrong
mass can do away with a drag. What a simulator does in a form of its own has no twin here, and no
statement.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from greybox.plants.effects import BatterySag, MotorLag
from greybox.plants.effects.base import Body, PlantEffect
from greybox.plants.noise import SensorNoise
from greybox.plants.quadrotor import Quadrotor
from greybox.plants.vectors import Vector, apply_transposed
from scenarios.foreign.flights import SAMPLE_TIME
from scenarios.foreign.hidden import with_battery
from scenarios.foreign.naming_cells import LAG_ERROR, Case, air_of
from scenarios.foreign.stranger import INERTIA_ERROR, MASS_ERROR, THRUST_ERROR, TORQUE_ERROR

Array = NDArray[np.float64]
CLEAR = 10.0
"""Difference of BIC that counts as clear."""
WINDOW = 100
"""Rows of a window."""
WINDOWS = 8
"""Windows that are looked at, spread over the flights; the others are taken to show as much."""
KNOT = 25
"""Rows over which a gust is constant."""
LEAD = 4
"""Rows before a window whose commands may still be on their way."""
TINY = 1e-3
"""Step of finite differences: m, m/s, rad, rad/s, shares of a parameter, shares of a gust."""
LOOSE = 1e3
"""Prior standard deviation, in such units, of what is free."""
CHANNELS = ("gyro", "accelerometer", "attitude", "position", "velocity")


@dataclass(frozen=True, kw_only=True)
class Nudge(PlantEffect):
    """A force [N, world] and a moment [N m, body] from `begin` to `end` [s], one per member."""

    name: ClassVar[str] = "nudge"
    force: Array
    moment: Array
    begin: Array
    end: Array

    def parameters(self) -> dict[str, Any]:
        """None that a batch must agree on."""
        return {}

    def _on(self, body: Body) -> Array:
        return np.asarray((self.begin <= body.time + 1e-9) & (body.time + 1e-9 < self.end), float)

    def body_force(self, body: Body) -> Vector:
        """The force, body axes."""
        x, y, z = self.force * self._on(body)
        return apply_transposed(body.rotation, (x, y, z))

    def body_moment(self, body: Body) -> Vector:
        """The moment."""
        x, y, z = self.moment * self._on(body)
        return (x, y, z)


@dataclass(frozen=True, kw_only=True)
class Windows:
    """Starts and commands of windows: states by name (n,), commands (n, LEAD + WINDOW, rotors),
    flight of each (n,); share: of all windows."""

    start: dict[str, Array]
    commands: Array
    flight: NDArray[np.int64]
    share: float

    @property
    def count(self) -> int:
        """Number of windows."""
        return len(self.flight)

    def repeated(self, times: int) -> Windows:
        """Every window so many times, copies side by side."""
        if times == 1:
            return self
        return Windows(
            start={n: np.repeat(v, times) for n, v in self.start.items()},
            commands=np.repeat(self.commands, times, axis=0),
            flight=np.repeat(self.flight, times),
            share=self.share,
        )


def windows_of(flights: Mapping[str, Mapping[str, Array]]) -> Windows:
    """Windows of the training flights."""
    start: dict[str, list[float]] = {}
    commands, flight = [], []
    names = sorted(n for n in flights if n.startswith("train"))
    for index, name in enumerate(names):
        log = flights[name]
        u = np.stack([log[c] for c in log if c[0] == "u" and c[1:].isdigit()], axis=-1)
        for first in range(LEAD, len(u) - WINDOW, WINDOW):
            commands.append(u[first - LEAD : first + WINDOW])
            flight.append(index)
            for column in log:
                if column.startswith("true."):
                    start.setdefault(column[5:], []).append(float(log[column][first]))
    few = np.unique(np.linspace(0, len(flight) - 1, WINDOWS).round().astype(int))
    return Windows(
        start={n: np.array(v)[few] for n, v in start.items()},
        commands=np.array(commands)[few],
        flight=np.array(flight)[few],
        share=len(few) / len(flight),
    )


def twin(case: Case, effects: Sequence[PlantEffect], **factors: Any) -> Quadrotor:
    """The plant of `greybox.plants` with these effects; factors (shares, numbers or one per
    member) of mass, thrust, torque, xx, yy, zz, lag."""
    craft = case.base.craft
    if any(isinstance(e, BatterySag) for e in effects):
        craft = with_battery(craft)
    frame = craft.airframe
    volts = frame.nominal_voltage or 1.0
    effects = [
        replace(e, nominal_voltage=volts) if isinstance(e, BatterySag) else e for e in effects
    ]
    lag = next((e.tau for e in effects if isinstance(e, MotorLag)), craft.lag)
    rest = [e for e in effects if not isinstance(e, MotorLag)]
    changed = replace(
        frame,
        mass=frame.mass * factors.get("mass", 1.0),
        inertia=tuple(j * factors.get(a, 1.0) for j, a in zip(frame.inertia, ("xx", "yy", "zz"))),
        thrust=tuple(c * factors.get("thrust", 1.0) for c in frame.thrust),
        torque=tuple(c * factors.get("torque", 1.0) for c in frame.torque),
    )
    lagging = MotorLag(tau=lag * factors.get("lag", 1.0))
    return Quadrotor(changed, [lagging, *rest], battery=craft.battery)


def readings(plant: Quadrotor, windows: Windows, **moved: Array) -> Array:
    """Noise-free readings (n, WINDOW, 16): gyro, accelerometer, quaternion, position, velocity.

    moved: changes of the start by name of the state; dx, dy, dz turn it [rad, body].
    """
    start = {n: v + moved.get(n, 0.0) for n, v in windows.start.items()}
    dx, dy, dz = (0.5 * moved.get(f"d{a}", np.zeros(windows.count)) for a in "xyz")
    w, x, y, z = (start[n] for n in ("qw", "qx", "qy", "qz"))
    attitude = (
        w - x * dx - y * dy - z * dz,
        x + w * dx + y * dz - z * dy,
        y + w * dy + z * dx - x * dz,
        z + w * dz + x * dy - y * dx,
    )
    nu = [start[f"nu{i + 1}"] for i in range(windows.commands.shape[2])]
    used: Array = np.zeros(windows.count)
    if plant.battery is not None:
        cell = plant.battery
        lost = cell.full - start["voltage"] - cell.resistance * cell.current(nu)
        used = lost * cell.capacity / (cell.full - cell.empty)
    plant.reset(
        range(windows.count),
        position=(start["x"], start["y"], start["z"]),
        velocity=(start["vx"], start["vy"], start["vz"]),
        attitude=attitude,
        rates=(start["p"], start["q"], start["r"]),
        charge_used=used,
        nu=nu,
        sent=[(SAMPLE_TIME * (k - LEAD), windows.commands[:, k]) for k in range(LEAD)],
    )
    columns = (*"pqr", "ax", "ay", "az", "qw", "qx", "qy", "qz", *"xyz", "vx", "vy", "vz")
    rows = []
    for k in range(WINDOW):
        plant.step(windows.commands[:, LEAD + k], SAMPLE_TIME)
        seen = plant.measure(noise=False)
        rows.append(np.stack([np.broadcast_to(seen[c], windows.count) for c in columns], axis=-1))
    return np.stack(rows, axis=1)


def difference(one: Array, other: Array) -> Array:
    """one - other as (..., WINDOW, 15): the attitude as a rotation [rad, body]."""
    q, r = other[..., 6:10], one[..., 6:10]
    vector = q[..., :1] * r[..., 1:] - r[..., :1] * q[..., 1:] - np.cross(q[..., 1:], r[..., 1:])
    turned = 2.0 * vector * np.sign(np.sum(q * r, axis=-1, keepdims=True))
    gap = one - other
    return np.concatenate([gap[..., :6], turned, gap[..., 10:]], axis=-1)


def whitener(case: Case, base: Array, sensors: SensorNoise) -> list[Array]:
    """Inverse Cholesky factor of each channel's noise in a window, (WINDOW, WINDOW), 15 of them."""
    realism = case.base.realism
    lags = SAMPLE_TIME * np.abs(np.subtract.outer(np.arange(WINDOW), np.arange(WINDOW)))
    speed = np.sqrt(np.mean(np.diff(base, axis=1) ** 2, axis=(0, 1))) / SAMPLE_TIME
    rates = np.sqrt(np.mean(base[..., :3] ** 2, axis=(0, 1)))
    moving = np.concatenate([np.zeros(6), rates, speed[10:16]])
    out = []
    for i in range(15):
        sigma = float(np.mean(vars(sensors)[CHANNELS[i // 3]]))
        cover = sigma**2 * np.eye(WINDOW)
        if realism is not None:
            lasting = realism.imu_time if i < 6 else realism.pose_time
            cover += (realism.colour * sigma) ** 2 * np.exp(-lags / lasting)
            own = realism.vibration * sigma if i < 6 else 0.0
            late = realism.jitter * SAMPLE_TIME / np.sqrt(12.0) * moving[i]
            cover += (own**2 + late**2) * np.eye(WINDOW)
        out.append(np.linalg.inv(np.linalg.cholesky(cover)))
    return out


def _file(case: Case) -> dict[str, float]:
    """Numbers of the vehicle file that are not exact, and their relative errors."""
    if case.file == "exact":
        return {}
    errors = {"mass": MASS_ERROR, "thrust": THRUST_ERROR, "torque": TORQUE_ERROR}
    errors |= dict.fromkeys(("xx", "yy", "zz"), INERTIA_ERROR)
    return errors | ({"lag": LAG_ERROR} if "motor_lag" in case.declared else {})


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """A case with its windows: what is read with everything hidden, and how noise is whitened."""

    case: Case
    windows: Windows
    base: Array
    white: list[Array]

    def seen(self, changed: Array) -> Array:
        """Whitened differences (n, rows) of readings from the base."""
        gap = difference(changed, self.base)
        kept = range(15) if self.case.columns == "full" else range(6)
        return np.concatenate([gap[..., i] @ self.white[i].T for i in kept], axis=-1)

    def constant(self, channel: int) -> Array:
        """The same for a bias of one gyro or accelerometer axis."""
        gap = np.zeros(self.base.shape)
        gap[..., channel] = 1.0
        return self.seen(self.base + gap)

    def many(self, plant: Quadrotor, times: int, **moved: Array) -> Array:
        """`seen` of so many members per window, (n, rows, times)."""
        wide = replace(self, base=np.repeat(self.base, times, axis=0))
        seen = wide.seen(readings(plant, self.windows.repeated(times), **moved))
        return np.moveaxis(seen.reshape(self.windows.count, times, -1), 1, 2)

    def starts(self) -> Array:
        """What twelve ways to move the start of a window do, (n, rows, 12), per unit."""
        names = (*"xyz", "vx", "vy", "vz", "dx", "dy", "dz", *"pqr")
        count = self.windows.count
        moved = {n: np.tile(TINY * (np.arange(12) == i), count) for i, n in enumerate(names)}
        return self.many(twin(self.case, self.case.effects), 12, **moved) / TINY

    def file(self) -> Array:
        """What the errors of the vehicle file do, one standard deviation each, (n, rows, k)."""
        errors = _file(self.case)
        count = self.windows.count
        if not errors:
            return np.zeros((count, self.seen(self.base).shape[1], 0))
        factors = {
            name: 1.0 + np.tile(TINY * (np.arange(len(errors)) == i), count)
            for i, name in enumerate(errors)
        }
        plant = twin(self.case, self.case.effects, **factors)
        return self.many(plant, len(errors)) * (np.array(list(errors.values())) / TINY)

    def gusts(self) -> Array:
        """What gusts of one standard deviation do, (n, rows, knots x 6); the square root of their
        covariance is in it."""
        air, frame = air_of(self.case), self.case.base.craft.airframe
        knots, n = WINDOW // KNOT, self.windows.count
        sizes = (*(air.push,) * 3, *(air.turn * float(j) for j in frame.inertia))
        unit = np.tile(np.diag(sizes), (1, knots * n))
        begin = np.tile(np.repeat(np.arange(knots) * KNOT * SAMPLE_TIME, 6), n)
        end = begin + KNOT * SAMPLE_TIME
        nudge = Nudge(force=unit[:3], moment=unit[3:], begin=begin, end=end)
        columns = self.many(twin(self.case, (*self.case.effects, nudge)), 6 * knots)
        along = np.arange(knots) * KNOT * SAMPLE_TIME
        cover = np.exp(-np.abs(np.subtract.outer(along, along)) / air.gust_time)
        return columns @ np.kron(np.linalg.cholesky(cover), np.eye(6))


def scene_of(case: Case, flights: Mapping[str, Mapping[str, Array]]) -> Scene:
    """The windows of a case and what is read in them."""
    windows = windows_of(flights)
    base = readings(twin(case, case.effects), windows)
    return Scene(
        case=case,
        windows=windows,
        base=base,
        white=whitener(case, base, case.base.sensors),
    )


def strengths(case: Case, flights: Mapping[str, Mapping[str, Array]]) -> dict[str, float]:
    """Hidden effect (outside ones by their own names) -> strength in the training flights."""
    scene = scene_of(case, flights)
    windows = scene.windows
    judged = [e for e in case.effects if not case.hidden or e.name in case.hidden]
    without = [[o for o in case.effects if o is not e] for e in judged]
    done = [scene.seen(readings(twin(case, rest), windows)) for rest in without]
    biases = [
        scene.constant(i) * (windows.flight == flight)[:, None] * LOOSE
        for flight in np.unique(windows.flight)
        for i in range(6)
    ]
    wide = np.concatenate([np.stack([*done, *biases], axis=-1), scene.file()], axis=-1)
    local = scene.starts()
    if case.gusts:
        local = np.concatenate([local, scene.gusts()], axis=-1)
    total = np.zeros((wide.shape[-1],) * 2)
    for b, a in zip(wide, local):
        inner = np.linalg.solve(np.eye(a.shape[1]) + a.T @ a, a.T @ b)
        total += (b.T @ b - b.T @ a @ inner) / windows.share
    prior = np.eye(len(total))
    prior[: len(judged), : len(judged)] /= LOOSE**2
    out = {}
    for j, effect in enumerate(judged):
        rest = [i for i in range(len(total)) if i != j]
        block, cross = (total + prior)[np.ix_(rest, rest)], total[rest, j]
        out[effect.name] = float(max(total[j, j] - cross @ np.linalg.solve(block, cross), 0.0))
    return out


def power(case: Case, flights: Mapping[str, Mapping[str, Array]]) -> dict[str, Any]:
    """`power` (whether all that is hidden can be seen; None where the oracle cannot say), and by
    effect whether it can (`able`) and its `strength`."""
    if not case.effects:
        return {"power": None, "able": {}, "strength": {}}
    found = strengths(case, flights)
    rows = sum(len(log["t"]) for name, log in flights.items() if name.startswith("train"))
    sizes = {e.name: max(len(e.parameters()), 1) for e in case.effects}
    if not case.hidden:
        sizes = dict.fromkeys(sizes, 1)
    enough = {n: s - sizes[n] * np.log(rows) > CLEAR for n, s in found.items()}
    return {
        "power": all(bool(v) for v in enough.values()),
        "able": {n: bool(v) for n, v in enough.items()},
        "strength": {n: round(s, 2) for n, s in found.items()},
    }
