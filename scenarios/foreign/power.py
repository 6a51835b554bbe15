"""Oracle of power: can anybody see in these logs what is hidden in them?

The flights are cut into windows of a second. In every window the plant of `greybox.plants` with
all hidden effects flies the recorded commands from the true state; so does the plant without one of
them. The difference of their noise-free readings, D, is what the effect does to the log. Against it
stand the sensors' noise (white, coloured, vibration and jitter of real ones) and everything that
its size could hide behind, each by its own change of the readings: the start of the window, gusts
as a Gauss-Markov force and moment that goes on from window to window, biases of the IMU, the
numbers of the vehicle file within their errors, the density of the air, which no file knows, the
sizes of the other hidden effects. All of that is Gaussian to first order, so that

    strength = D' (noise + hiding places)^-1 D

is twice the log likelihood ratio that the best of all methods gains on average by knowing the
effect (Neyman and Pearson 1933). Nobody knows how long gusts last, and slow ones look steady: the
strength is the least over slower ones, each plus twice the divergence (Kullback and Leibler 1951)
of the gusts from it. An effect of d parameters has power where strength - d ln(rows)
exceeds 10, the step of BIC that is taken as clear (Schwarz 1978; Kass and Raftery 1995), in the
flights that teach, which must propose it, and in those that judge, which must confirm it: a limit
that a calm flight never meets cannot be confirmed there. What a simulator does in a form of its own
has no twin here, and no statement.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from greybox.plants.effects import BatterySag, MotorLag
from greybox.plants.effects.base import Body, PlantEffect
from greybox.plants.noise import SensorNoise
from greybox.plants.quadrotor import Quadrotor
from greybox.plants.vectors import Vector, apply_transposed
from scenarios.foreign.flights import SAMPLE_TIME
from scenarios.foreign.hidden import with_battery
from scenarios.foreign.naming_cells import LAG_ERROR, Case, air_of, scaled
from scenarios.foreign.stranger import INERTIA_ERROR, MASS_ERROR, THRUST_ERROR, TORQUE_ERROR

Array = NDArray[np.float64]
CLEAR = 10.0
"""Difference of BIC that counts as clear."""
WINDOW = 100
"""Rows of a window."""
SLOWER = (1.0, 1.5, 2.5, 4.0, 8.0, 16.0)
"""What may be taken for the time of the gusts, in units of it, first the truth. Their variance
grows along, so that over a short time they do as much."""
AIR = 0.03
"""Share by which all rotors are stronger or weaker than any file can know: the density of the air
over 10 K (ISO 2533), as `greybox discover` believes."""
KNOT = 5
"""Rows over which a gust is constant."""
LEAD = 4
"""Rows before a window whose commands may still be on their way."""
TINY = 1e-3
"""Step of finite differences: m, m/s, rad, rad/s, shares of a parameter, shares of a gust."""
LITTLE = 0.01
"""Share of an effect that is little."""
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
    """Starts and commands of windows that follow each other: states by name (n,), commands
    (n, LEAD + WINDOW, rotors), flight of each (n,)."""

    start: dict[str, Array]
    commands: Array
    flight: NDArray[np.int64]

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
        )


def windows_of(flights: Mapping[str, Mapping[str, Array]]) -> Windows:
    """Windows of flights."""
    start: dict[str, list[float]] = {}
    commands, flight = [], []
    for index, name in enumerate(sorted(flights)):
        log = flights[name]
        u = np.stack([log[c] for c in log if c[0] == "u" and c[1:].isdigit()], axis=-1)
        for first in range(LEAD, len(u) - WINDOW, WINDOW):
            commands.append(u[first - LEAD : first + WINDOW])
            flight.append(index)
            for column in log:
                if column.startswith("true."):
                    start.setdefault(column[5:], []).append(float(log[column][first]))
    return Windows(
        start={n: np.array(v) for n, v in start.items()},
        commands=np.array(commands),
        flight=np.array(flight),
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


def _file(case: Case) -> list[tuple[tuple[str, ...], float]]:
    """What no file knows (the air scales thrust and torque), and numbers of the vehicle file that
    are not exact: (factors of `twin` that move together, relative error)."""
    air: list[tuple[tuple[str, ...], float]] = [(("thrust", "torque"), AIR)]
    if case.file == "exact":
        return air
    errors = {"mass": MASS_ERROR, "thrust": THRUST_ERROR, "torque": TORQUE_ERROR}
    errors |= dict.fromkeys(("xx", "yy", "zz"), INERTIA_ERROR)
    errors |= {"lag": LAG_ERROR} if "motor_lag" in case.declared else {}
    return [*air, *(((name,), error) for name, error in errors.items())]


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

    def without(self, effect: PlantEffect, part: float) -> Array:
        """The same for an effect, by the change that taking away a `part` of it makes."""
        less = [scaled(effect, 1.0 - part)] if part < 1.0 else []
        rest = [*(o for o in self.case.effects if o is not effect), *less]
        return self.seen(readings(twin(self.case, rest), self.windows)) / part

    def many(self, plant: Quadrotor, times: int, **moved: Array) -> Array:
        """`seen` of so many members per window, (n, rows, times)."""
        wide = replace(self, base=np.repeat(self.base, times, axis=0))
        seen = wide.seen(readings(plant, self.windows.repeated(times), **moved))
        return np.moveaxis(seen.reshape(self.windows.count, times, -1), 1, 2)

    def starts(self) -> Array:
        """What every way to move the start of a window does, (n, rows, 12 + rotors), per unit. The
        rotors turn as the commands before told them, and that is part of what hides."""
        rotors = [f"nu{i + 1}" for i in range(self.windows.commands.shape[2])]
        names = (*"xyz", "vx", "vy", "vz", "dx", "dy", "dz", *"pqr", *rotors)
        count, k = self.windows.count, len(names)
        moved = {n: np.tile(TINY * (np.arange(k) == i), count) for i, n in enumerate(names)}
        return self.many(twin(self.case, self.case.effects), k, **moved) / TINY

    def file(self) -> Array:
        """What errors of the vehicle file and the air do, one standard deviation each,
        (n, rows, k)."""
        errors, count = _file(self.case), self.windows.count
        factors: dict[str, Array] = {}
        for i, (names, _) in enumerate(errors):
            step = np.tile(TINY * (np.arange(len(errors)) == i), count)
            factors |= {n: factors.get(n, 1.0) + step for n in names}
        single = {n: v.item() if v.size == 1 else v for n, v in factors.items()}
        plant = twin(self.case, self.case.effects, **single)
        return self.many(plant, len(errors)) * (np.array([e for _, e in errors]) / TINY)

    def gusts(self) -> Array:
        """What gusts of one standard deviation do in every window, (n, rows, knots x 6)."""
        air, frame = air_of(self.case), self.case.base.craft.airframe
        knots, n = WINDOW // KNOT, self.windows.count
        sizes = (*(air.push,) * 3, *(air.turn * float(j) for j in frame.inertia))
        unit = np.tile(np.diag(sizes), (1, knots * n))
        begin = np.tile(np.repeat(np.arange(knots) * KNOT * SAMPLE_TIME, 6), n)
        end = begin + KNOT * SAMPLE_TIME
        end[end > (WINDOW - 0.5) * SAMPLE_TIME] = np.inf  # the last reading feels the last of them
        nudge = Nudge(force=unit[:3], moment=unit[3:], begin=begin, end=end)
        return self.many(twin(self.case, (*self.case.effects, nudge)), 6 * knots)

    def lasting(self, windows: int, slower: float) -> Array:
        """Square root of the covariance of one axis of gusts over so many windows in a row."""
        along = np.arange(windows * (WINDOW // KNOT)) * KNOT * SAMPLE_TIME
        gaps = np.abs(np.subtract.outer(along, along)) / (slower * air_of(self.case).gust_time)
        return np.asarray(np.linalg.cholesky(slower * np.exp(-gaps)), dtype=np.float64)


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


def _beside(scene: Scene, wide: Array) -> list[tuple[Array, float]]:
    """Information (k, k) on what the columns (n, rows, k) stand for, beside starts and gusts, and
    what these gusts cost; for each of `SLOWER`, or once in still air."""
    local = scene.starts()
    gusts = scene.gusts() if scene.case.gusts else np.zeros((*wide.shape[:2], 0))
    every, width = np.concatenate([gusts, wide], axis=-1), gusts.shape[-1]
    crossed = np.einsum("nra,nrb->nab", local, every)
    blocks = np.eye(local.shape[-1]) + np.einsum("nra,nrb->nab", local, local)
    seen = np.einsum("nra,nrb->nab", every, every)
    seen -= np.einsum("nca,ncb->nab", crossed, np.linalg.solve(blocks, crossed))
    total = seen[:, width:, width:].sum(axis=0)
    if not width:
        return [(total, 0.0)]
    out = []
    for slower in SLOWER:
        told, cost = total.copy(), 0.0
        for flight in np.unique(scene.windows.flight):
            hidden, spent = _hidden(scene, seen[scene.windows.flight == flight], width, slower)
            told, cost = told - hidden, cost + spent
        out.append((told, cost))
    return [(told, cost - out[0][1]) for told, cost in out]


def _hidden(scene: Scene, seen: Array, width: int, slower: float) -> tuple[Array, float]:
    """Of one flight: the information (k, k) that gusts which are so much slower take, and twice
    their expected negative log likelihood of what gusts did, up to a constant."""
    axes, n = np.eye(6), len(seen) * width
    true, root = (scene.lasting(len(seen), factor) for factor in (1.0, slower))
    whole = np.kron(root, axes)
    told = scipy.linalg.block_diag(*seen[:, :width, :width])
    beside = scipy.linalg.cho_factor(np.eye(n) + whole.T @ told @ whole)
    shared = whole.T @ seen[:, :width, width:].reshape(n, -1)
    moved = np.kron(scipy.linalg.solve_triangular(root, true, lower=True), axes)
    spread = moved @ moved.T - np.eye(n)
    cost = np.trace(spread) - np.trace(scipy.linalg.cho_solve(beside, spread))
    cost += 2.0 * np.log(np.diag(beside[0])).sum()
    return shared.T @ scipy.linalg.cho_solve(beside, shared), float(cost)


def strengths(case: Case, flights: Mapping[str, Mapping[str, Array]]) -> dict[str, float]:
    """Hidden effect (outside ones by their own names) -> strength in some flights: the smaller of
    two, by all that it does and by what a little less of it changes. Where it moves the craft far,
    the first counts bends as news that a hiding place would follow."""
    scene = scene_of(case, flights)
    judged = [e for e in case.effects if not case.hidden or e.name in case.hidden]
    flight, k = scene.windows.flight, len(judged)
    done = [scene.without(e, part) for part in (1.0, LITTLE) for e in judged]
    biases = [
        scene.constant(i) * (flight == one)[:, None] * LOOSE
        for one in np.unique(flight)
        for i in range(6)
    ]
    wide = np.concatenate([np.stack([*done, *biases], axis=-1), scene.file()], axis=-1)
    prior = np.eye(wide.shape[-1])
    prior[: 2 * k, : 2 * k] /= LOOSE**2
    out = np.full(k, np.inf)
    for total, paid in _beside(scene, wide):
        for first in (0, k):
            kept = [*range(first, first + k), *range(2 * k, len(prior))]
            told = (total + prior)[np.ix_(kept, kept)]
            for j in range(k):
                rest = [i for i in range(len(told)) if i != j]
                hidden = told[j, rest] @ np.linalg.solve(told[np.ix_(rest, rest)], told[rest, j])
                out[j] = min(out[j], max(told[j, j] - hidden, 0.0) + paid)
    return {e.name: float(v) for e, v in zip(judged, out)}


def power(case: Case, flights: Mapping[str, Mapping[str, Array]]) -> dict[str, Any]:
    """`power` (whether all that is hidden can be seen; None where the oracle cannot say), and by
    effect whether it can (`able`), its `strength` in the training flights and `confirmed` in the
    test flights."""
    if not case.effects:
        return {"power": None, "able": {}, "strength": {}, "confirmed": {}}
    sizes = {e.name: max(len(e.parameters()), 1) for e in case.effects}
    if not case.hidden:
        sizes = dict.fromkeys(sizes, 1)
    able = dict.fromkeys(sizes, True)
    out: dict[str, dict[str, float]] = {}
    for kind, key in (("train", "strength"), ("test", "confirmed")):
        some = {n: log for n, log in flights.items() if n.startswith(kind)}
        found, rows = strengths(case, some), sum(len(log["t"]) for log in some.values())
        out[key] = {n: round(v, 2) for n, v in found.items()}
        able = {n: able[n] and v - sizes[n] * np.log(rows) > CLEAR for n, v in found.items()}
    return {"power": all(able.values()), "able": {n: bool(v) for n, v in able.items()}, **out}
