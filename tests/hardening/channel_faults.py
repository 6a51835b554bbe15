"""Faults of channels as readers and users make them: units, frames, scales, clocks, sensors,
motors.

A fault takes a raw log (clock of one rate) and gives a broken copy. `needs` are the channel groups
that it touches.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from greybox.data import RawLog
from greybox.frames import numeric

Numbers = npt.NDArray[np.float64]
Q, P, V, W, A = "qw qx qy qz", "x y z", "vx vy vz", "p q r", "ax ay az"
SWAP = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
NED = SWAP @ np.diag([1.0, 1.0, -1.0])


@dataclass(frozen=True, kw_only=True)
class Fault:
    """One fault: its class, what it needs in the log, and what it does."""

    kind: str
    needs: str
    make: Callable[[RawLog], RawLog]
    harmless: str = ""


def block(raw: RawLog, names: str) -> Numbers:
    """The channels (N, k)."""
    return np.column_stack([raw.channels[n] for n in names.split()])


def put(raw: RawLog, names: str, values: Numbers) -> RawLog:
    """With these channels (N, k)."""
    new = {n: values[:, i] for i, n in enumerate(names.split())}
    return replace(raw, channels={**raw.channels, **new})


def have(raw: RawLog, names: str) -> bool:
    """Whether all of them are in the log."""
    return all(n in raw.channels for n in names.split())


def times(names: str, factor: float) -> Callable[[RawLog], RawLog]:
    """Scaled."""
    return lambda r: put(r, names, factor * block(r, names))


def linear(matrix: Numbers, *groups: str) -> Callable[[RawLog], RawLog]:
    """Groups that the log has through a matrix."""

    def make(raw: RawLog) -> RawLog:
        for names in groups:
            if have(raw, names):
                raw = put(raw, names, block(raw, names) @ matrix.T)
        return raw

    return make


def yaw(degrees: float) -> Numbers:
    """Rotation about z."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def through(how: str, names: str) -> Callable[[RawLog], RawLog]:
    """Vectors turned by the attitude."""

    def make(raw: RawLog) -> RawLog:
        q, v = block(raw, Q), block(raw, names)
        known = np.isfinite(q).all(axis=1) & np.isfinite(v).all(axis=1)
        out = np.full_like(v, np.nan)
        out[known] = numeric(how, q[known], v[known])
        return put(raw, names, out)

    return make


def tilted(vector: Sequence[float], *, left: bool) -> Callable[[RawLog], RawLog]:
    """The attitude turned in the world (left) or in the body."""

    def make(raw: RawLog) -> RawLog:
        q = block(raw, Q)
        turn = np.broadcast_to(numeric("exp", np.array([vector]))[0], q.shape)
        known = np.isfinite(q).all(axis=1)
        out = np.full_like(q, np.nan)
        pair = (turn[known], q[known]) if left else (q[known], turn[known])
        out[known] = numeric("multiply", *pair)
        return put(raw, Q, out)

    return make


def reordered(order: str, names: str) -> Callable[[RawLog], RawLog]:
    """Columns in another order."""
    return lambda r: put(r, names, block(r, order))


def signs(names: str) -> Callable[[RawLog], RawLog]:
    """Negated."""
    return times(names, -1.0)


def rows(raw: RawLog, keep: npt.NDArray[np.int64]) -> RawLog:
    """These rows."""
    return replace(
        raw,
        t=raw.t[keep],
        rows=raw.rows[keep],
        channels={k: v[keep] for k, v in raw.channels.items()},
        extra={},
    )


def step(raw: RawLog) -> float:
    """Sample time [s]."""
    return float(np.median(np.diff(raw.t)))


def closed(raw: RawLog, keep: npt.NDArray[np.int64]) -> RawLog:
    """These rows on a clock that knows nothing of it."""
    out = rows(raw, keep)
    return replace(
        out, t=raw.t[0] + step(raw) * np.arange(keep.size), rows=np.arange(1, keep.size + 1)
    )


def cut(seconds: float) -> Callable[[RawLog], RawLog]:
    """Rows lost in the middle, the clock closed up."""

    def make(raw: RawLog) -> RawLog:
        k, m = raw.n // 2, round(seconds / step(raw))
        return closed(raw, np.r_[0:k, k + m : raw.n])

    return make


def again(seconds: float) -> Callable[[RawLog], RawLog]:
    """A stretch that comes twice."""

    def make(raw: RawLog) -> RawLog:
        k, m = raw.n // 2, round(seconds / step(raw))
        return closed(raw, np.r_[0:k, k - m : raw.n])

    return make


def late(seconds: float, *groups: str) -> Callable[[RawLog], RawLog]:
    """Groups that come late."""

    def make(raw: RawLog) -> RawLog:
        for names in groups:
            if have(raw, names):
                raw = put(
                    raw, names, np.roll(block(raw, names), round(seconds / step(raw)), axis=0)
                )
        return raw

    return make


def clock(rate: float) -> Callable[[RawLog], RawLog]:
    """A clock of another rate."""
    return lambda r: replace(r, t=r.t[0] + rate * (r.t - r.t[0]))


def held(names: str, start: float, seconds: float) -> Callable[[RawLog], RawLog]:
    """Channels that keep their value from a share of the log on."""

    def make(raw: RawLog) -> RawLog:
        values, k = block(raw, names), int(start * raw.n)
        values[k : k + round(seconds / step(raw))] = values[k]
        return put(raw, names, values)

    return make


def lone(names: str, size: float, count: int = 1) -> Callable[[RawLog], RawLog]:
    """Single samples that stand apart."""

    def make(raw: RawLog) -> RawLog:
        values = block(raw, names)
        at = np.linspace(0.4, 0.7, count) * raw.n
        values[at.astype(int), 0] += size
        return put(raw, names, values)

    return make


def lost(names: str, value: float, count: int) -> Callable[[RawLog], RawLog]:
    """Single samples in which the sensor says a fixed number."""

    def make(raw: RawLog) -> RawLog:
        values = block(raw, names)
        values[(np.linspace(0.4, 0.7, count) * raw.n).astype(int)] = value
        return put(raw, names, values)

    return make


def jump(names: str, size: Sequence[float]) -> Callable[[RawLog], RawLog]:
    """A step that stays."""

    def make(raw: RawLog) -> RawLog:
        values = block(raw, names)
        values[raw.n // 2 :] += np.array(size)
        return put(raw, names, values)

    return make


def missing(seconds: float) -> Callable[[RawLog], RawLog]:
    """A gyro that says nothing for a while."""

    def make(raw: RawLog) -> RawLog:
        values, k = block(raw, W), raw.n // 2
        values[k : k + round(seconds / step(raw))] = np.nan
        return put(raw, W, values)

    return make


def turned_from_the_middle(raw: RawLog) -> RawLog:
    """The attitude jumps by 20 deg of yaw and stays there."""
    other = tilted((0.0, 0.0, 0.35), left=True)(raw)
    values = block(raw, Q)
    values[raw.n // 2 :] = block(other, Q)[raw.n // 2 :]
    return put(raw, Q, values)


def spikes(raw: RawLog) -> RawLog:
    """0.5 % of the gyro's samples are 30 rad/s."""
    hit = np.random.default_rng(7).random((raw.n, 3)) < 0.005
    return put(raw, W, np.where(hit, 30.0, block(raw, W)))


def back(raw: RawLog) -> RawLog:
    """Time set back by half a second in the middle."""
    return replace(raw, t=raw.t - 0.5 * (np.arange(raw.n) > raw.n // 2))


def commands(raw: RawLog) -> str:
    """Names of the commands."""
    return " ".join(sorted(n for n in raw.channels if n[0] == "u" and n[1:].isdigit()))


def of_commands(change: Callable[[Numbers], Numbers]) -> Callable[[RawLog], RawLog]:
    """All commands changed."""
    return lambda r: put(r, commands(r), change(block(r, commands(r))))


def ordered(*order: int) -> Callable[[RawLog], RawLog]:
    """Commands in another order, from 1."""
    return of_commands(lambda u: u[:, [k - 1 for k in order]])


def frames() -> dict[str, Fault]:
    """Axes and frames."""
    position = f"{P}"
    pose = f"{P} {Q}"

    def f(needs: str, make: Callable[[RawLog], RawLog]) -> Fault:
        return Fault(kind="axes and frames", needs=needs, make=make)

    out = {
        "velocity in body axes": f(f"{V} {Q}", through("rotate_inverse", V)),
        "x and y of position and velocity swapped": f(pose, linear(SWAP, P, V)),
        "x and y of the position swapped": f(position, linear(SWAP, P)),
        "x and y of the velocity swapped": f(V, linear(SWAP, V)),
        "y of the velocity negated": f(V, signs("vy")),
        "motion capture mirrored in y": f(pose, linear(np.diag([1.0, -1.0, 1.0]), P, V)),
        "z down": f(pose, linear(np.diag([1.0, 1.0, -1.0]), P, V)),
        "position and velocity in NED": f(pose, linear(NED, P, V)),
        "position in NED, velocity in ENU": f(f"{P} {V}", linear(NED, P)),
        "y up": f(pose, linear(Y_UP, P, V)),
        "accelerometer in world axes": f(f"{A} {Q}", through("rotate", A)),
        "gyro in world axes": f(f"{W} {Q}", through("rotate", W)),
        "attitude world to body": f(Q, signs("qx qy qz")),
        "scalar last": f(Q, reordered("qx qy qz qw", Q)),
        "scalar first, named last": f(Q, reordered("qz qw qx qy", Q)),
        "gyro forward, right, down": f(W, linear(np.diag([1.0, -1.0, -1.0]), W)),
        "accelerometer forward, right, down": f(A, linear(np.diag([1.0, -1.0, -1.0]), A)),
        "IMU forward, right, down": f(f"{W} {A}", linear(np.diag([1.0, -1.0, -1.0]), W, A)),
        "IMU turned by 90 deg": f(f"{W} {A}", linear(yaw(90.0), W, A)),
        "IMU turned by 45 deg": f(f"{W} {A}", linear(yaw(45.0), W, A)),
        "accelerometer x and z swapped": f(A, reordered("az ay ax", A)),
        "accelerometer negated": f(A, signs(A)),
        "gravity taken out": f(A, jump_free_fall),
    }
    for degrees in (15.0, 30.0, 90.0, 180.0):
        out[f"motion capture yawed by {degrees:g} deg"] = f(pose, linear(yaw(degrees), P, V))
    for degrees in (10.0, 20.0):
        angle = np.radians(degrees)
        out[f"attitude tilted by {degrees:g} deg in the world"] = f(
            f"{Q} {A}", tilted((angle, 0, 0), left=True)
        )
        out[f"attitude tilted by {degrees:g} deg in the body"] = f(
            f"{Q} {A}", tilted((0, angle, 0), left=False)
        )
    out["attitude yawed by 40 deg in the world"] = f(pose, tilted((0, 0, 0.7), left=True))
    out["attitude yawed by 40 deg in the body"] = f(f"{Q} {W}", tilted((0, 0, 0.7), left=False))
    for a, b, order in (("p", "q", "q p r"), ("p", "r", "r q p"), ("q", "r", "p r q")):
        out[f"{a} and {b} swapped"] = f(W, reordered(order, W))
    for name in W.split():
        out[f"{name} negated"] = f(W, signs(name))
    return out


def jump_free_fall(raw: RawLog) -> RawLog:
    """Specific force without the 9.81 of z."""
    return put(raw, "az", block(raw, "az") - 9.81)


def units_and_scales() -> dict[str, Fault]:
    """Units and factors."""

    def u(names: str, factor: float, kind: str = "units") -> Fault:
        return Fault(kind=kind, needs=names, make=times(names, factor))

    s = "factors"
    return {
        "gyro in deg/s": u(W, 57.29578),
        "gyro scaled from deg/s twice": u(W, 1 / 57.29578),
        "gyro in mrad/s": u(W, 1e3),
        "accelerometer in g": u(A, 1 / 9.80665),
        "accelerometer scaled from g twice": u(A, 9.80665),
        "accelerometer in mg": u(A, 1e3 / 9.80665),
        "accelerometer in cm/s^2": u(A, 100.0),
        "position in mm": u(P, 1e3),
        "position in cm": u(P, 100.0),
        "position in km": u(P, 1e-3),
        "position in feet": u(P, 3.28084),
        "velocity in mm/s": u(V, 1e3),
        "velocity in cm/s": u(V, 100.0),
        "velocity in km/h": u(V, 3.6),
        "velocity in feet/s": u(V, 3.28084),
        "battery in mV": u("vbat", 1e3),
        "rotor speeds in rpm": u("omega1 omega2 omega3 omega4", 60 / (2 * np.pi)),
        "commands in percent": Fault(
            kind="units", needs="u1", make=of_commands(lambda x: 100.0 * x)
        ),
        "commands in PWM of 1000 to 2000": Fault(
            kind="units", needs="u1", make=of_commands(lambda x: 1e3 * (1 + x))
        ),
        "commands from -1 to 1": Fault(
            kind="units", needs="u1", make=of_commands(lambda x: 2.0 * x - 1.0)
        ),
        "time in ms": Fault(kind="units", needs="u1", make=clock(1e3)),
        "time in us": Fault(kind="units", needs="u1", make=clock(1e6)),
        "gyro times 2": u(f"{W}", 2.0, s),
        "gyro times 1.2": u(W, 1.2, s),
        "gyro times 0.8": u(W, 0.8, s),
        "p times 1.3": u("p", 1.3, s),
        "accelerometer times 1.2": u(A, 1.2, s),
        "accelerometer times 1.1": u(A, 1.1, s),
        "position times 1.08": u(P, 1.08, s),
        "velocity times 1.1": u(V, 1.1, s),
        "height times 1.2": u("z", 1.2, s),
        "quaternion of length 2": u(Q, 2.0, s),
    }


def of_time() -> dict[str, Fault]:
    """Clocks and delays."""

    def f(needs: str, make: Callable[[RawLog], RawLog], harmless: str = "") -> Fault:
        return Fault(kind="time", needs=needs, make=make, harmless=harmless)

    random = np.random.default_rng(7)
    pose = f"{P} {Q}"
    return {
        "clock 10 % slow": f(f"{P} {V}", clock(1.1)),
        "clock 10 % fast": f(f"{P} {V}", clock(0.9)),
        "clock of half the rate": f(f"{P} {V}", clock(2.0)),
        "2 s cut out, clock closed up": f(pose, cut(2.0)),
        "1 s cut out, clock closed up": f(pose, cut(1.0)),
        "1 s comes twice": f("u1", again(1.0)),
        "3 s come twice": f("u1", again(3.0)),
        "2 s lost": f(
            "u1", lambda r: rows(r, np.r_[0 : r.n // 2, r.n // 2 + round(2 / step(r)) : r.n])
        ),
        "40 % lost": f("u1", lambda r: rows(r, np.r_[0 : int(0.3 * r.n), int(0.7 * r.n) : r.n])),
        "10 % of the rows lost": f(
            "u1", lambda r: rows(r, np.flatnonzero(random.random(r.n) > 0.1))
        ),
        "time set back by 0.5 s": f("u1", back),
        "time runs backward": f("u1", lambda r: rows(r, np.arange(r.n)[::-1])),
        "rows in any order": f("u1", lambda r: rows(r, np.random.default_rng(7).permutation(r.n))),
        "an hour's jump": f(
            "u1", lambda r: replace(r, t=r.t + 3600.0 * (np.arange(r.n) > r.n // 2))
        ),
        "stamps off by 3 ms": f(
            "u1", lambda r: replace(r, t=r.t + np.random.default_rng(7).uniform(-3e-3, 3e-3, r.n))
        ),
        "one stamp for two rows": f("u1", lambda r: replace(r, t=np.repeat(r.t[::2], 2)[: r.n])),
        "IMU 120 ms late": f(f"{W} {A} {Q}", late(0.12, W, A)),
        "pose 100 ms late": f(f"{Q} {W}", late(0.1, P, V, Q)),
        "velocity 100 ms late": f(f"{P} {V}", late(0.1, V)),
        "position 100 ms late": f(f"{P} {V}", late(0.1, P)),
        "attitude 80 ms late": f(f"{Q} {W}", late(0.08, Q)),
        "commands 200 ms early": f("u1", lambda r: late(-0.2, commands(r))(r)),
        "commands 150 ms late": f("u1", lambda r: late(0.15, commands(r))(r)),
    }


def of_sensors() -> dict[str, Fault]:
    """Sensors that stop, clip, jump or lie."""

    def f(needs: str, make: Callable[[RawLog], RawLog], harmless: str = "") -> Fault:
        return Fault(kind="sensors", needs=needs, make=make, harmless=harmless)

    clip = lambda v, top: np.clip(v, -top, top)  # noqa: E731
    return {
        "gyro stands still for 6 s": f(W, held(W, 0.4, 6.0)),
        "gyro stands still for 0.5 s": f(W, held(W, 0.4, 0.5)),
        "accelerometer stands still for 3 s": f(A, held(A, 0.4, 3.0)),
        "position stands still for 1 s": f(P, held(P, 0.4, 1.0)),
        "attitude stands still for 1 s": f(Q, held(Q, 0.4, 1.0)),
        "r is 0": f(W, times("r", 0.0)),
        "p is 0": f(W, times("p", 0.0)),
        "az is constant": f(A, lambda r: put(r, "az", np.full((r.n, 1), 9.81))),
        "gyro is 0": f(W, times(W, 0.0)),
        "spikes in the gyro": f(W, spikes),
        "one sample of the gyro": f(W, lone(W, 60.0)),
        "one sample of the accelerometer": f(A, lone(A, 150.0)),
        "one sample of the position": f(P, lone(P, 2.0)),
        "one sample of the velocity": f(V, lone(V, 30.0)),
        "one sample of the attitude": f(Q, lost(Q, 0.5, 1)),
        "five rotor speeds of 33000 rad/s": f("omega1", lost("omega1", 33000.0, 5)),
        "five rotor speeds of 0": f("omega1", lost("omega1", 0.0, 5)),
        "battery of 0 V for five samples": f("vbat", lost("vbat", 0.0, 5)),
        "position of 0 for five samples": f(P, lost(P, 0.0, 5)),
        "infinite samples": f(W, lost(W, 1e30, 3)),
        "NaN for 0.6 s": f(W, missing(0.6), "missing cells are no measurements"),
        "gyro clips at half its range": f(
            W, lambda r: put(r, W, clip(block(r, W), 0.5 * np.nanmax(np.abs(block(r, W)))))
        ),
        "accelerometer clips": f(
            A, lambda r: put(r, A, clip(block(r, A), np.nanpercentile(block(r, A)[:, 2], 70)))
        ),
        "gyro in steps of 0.02 rad/s": f(
            W, lambda r: put(r, W, 0.02 * np.round(block(r, W) / 0.02)), "noise of 0.006 rad/s"
        ),
        "quaternion of 5 digits": f(
            Q, lambda r: put(r, Q, np.round(block(r, Q), 5)), "noise of 1e-5"
        ),
        "accelerometer bias of 3 m/s^2": f(f"{A} {Q}", jump_all("ax", 3.0)),
        "position jumps by 0.5 m": f(P, jump(P, (0.5, 0.0, 0.0))),
        "attitude jumps by 20 deg": f(Q, turned_from_the_middle),
        "velocity jumps by 2 m/s": f(V, jump(V, (2.0, 0.0, 0.0))),
    }


def jump_all(name: str, size: float) -> Callable[[RawLog], RawLog]:
    """A constant added."""
    return lambda r: put(r, name, block(r, name) + size)


def of_motors() -> dict[str, Fault]:
    """Commands of four rotors in the wrong places."""

    def f(make: Callable[[RawLog], RawLog]) -> Fault:
        return Fault(kind="motors", needs="u4 p", make=make)

    pairs = {(1, 2): (2, 1, 3, 4), (1, 3): (3, 2, 1, 4), (1, 4): (4, 2, 3, 1), (2, 3): (1, 3, 2, 4)}
    pairs |= {(2, 4): (1, 4, 3, 2), (3, 4): (1, 2, 4, 3)}
    out = {f"motors {a} and {b} swapped": f(ordered(*order)) for (a, b), order in pairs.items()}
    out["motors numbered round the other way"] = f(ordered(4, 3, 2, 1))
    out["motors one place on"] = f(ordered(2, 3, 4, 1))
    out["motors two places on"] = f(ordered(3, 4, 1, 2))
    out["commands upside down"] = f(of_commands(lambda u: 1.0 - u))
    return out


CHANNEL_FAULTS: dict[str, Fault] = {
    **frames(),
    **units_and_scales(),
    **of_time(),
    **of_sensors(),
    **of_motors(),
}
"""Name -> fault."""
