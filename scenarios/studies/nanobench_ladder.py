"""A hand-made ladder of models for the NanoBench flights: what each further effect buys, beside a
model of greybox.

    python -m scenarios.studies.nanobench_ladder [MODEL.json ...] [--leave-one-type-out]

Least squares on measured and smoothed signals: the way one would explore the data by hand. Rates by
their changes over 0.05 to 0.5 s (linear in gains, moments and biases; damping, lag and delay by a
grid), forces by the derivative of the smoothed velocity in the axes of the motion-capture attitude.
Trained on the nine training flights; on each test flight the first 5 s give the biases of that
flight, origins start after them. Every origin starts from the measured state, smoothed velocity
included (the rows of greybox start from its filter, which knows no later sample). RMSE of the
vector norm, all steps of 10 ms. The rows, cumulative:

    persistence               the measured value, held
    k u^2                     specific force (0, 0, k S), S = sum of u^2; rate dot = G M, M = (roll, pitch, yaw) sums
                              of u^2 that the geometry gives; one gain per axis; u delayed and
                              lagged
    + per-flight biases       thrust scale, horizontal force biases, angular acceleration biases of each flight
    + battery                 u V / 3.7 instead of u
    + linear drag             horizontal specific force -k v_body
    + velocity moment         roll acceleration + c v_y, pitch acceleration + c v_x
    + rate damping            angular acceleration - d omega, per axis
    + torque disturbance      Kalman filter of (rate, torque) per axis, torque fading; from the gyro alone
    dead reckoning            measured rate and specific force integrated, biases from the first 5 s

Delay and lag of the commands, and the noise ratio of the Kalman filter, are those with the least
squared error on the training flights.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.signal import lfilter, savgol_filter

from greybox.data import Dataset, Flight
from greybox.data.logs import read_logs
from greybox.examples import NANOBENCH_TEST, flight_paths, vehicle_path
from greybox.frames import numeric
from greybox.model.identified import IdentifiedModel
from greybox.model.vehicle import read_vehicle
from greybox.symbolic import FloatArray
from greybox.validation.groups import GROUPS
from greybox.validation.horizon import HorizonAccumulator
from greybox.validation.horizon_table import HorizonTable
from greybox.validation.validate import validate

DT = 0.01
STEPS = 50
ADAPT = 5.0
HORIZONS = (5, 10, 20, 50)
"""Changes of the rate over these horizons are regressed: time stamps err too much for
derivatives."""
DAMPINGS = (0.0, 1.0, 2.0, 3.0, 4.5, 6.0, 8.0, 10.0, 13.0)
"""Rate damping that is tried [1/s]."""
UP = np.array([0.0, 0.0, 9.81])
FADE = float(np.exp(-DT / 0.3))
"""What a step leaves of a torque disturbance: it fades within some tenths of a second."""
WINDOW = 7
"""Savitzky-Golay window (quadratic) for the derivative that biases come from [samples]."""
LAGS = (0.0, 0.02, 0.035, 0.05)
DELAYS = (0.0, 0.01, 0.02, 0.03)
RATIOS = (0.0, 0.1, 0.3, 1.0, 3.0)
ROWS = (
    "k u^2",
    "+ per-flight biases",
    "+ battery",
    "+ linear drag",
    "+ velocity moment",
    "+ rate damping",
    "+ torque disturbance",
)
MIX = np.array([[-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0], [1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]) * [
    1.0,
    -1.0,
    1.0,
]
"""Rows: rotors (front right, rear right, rear left, front left); columns: y, -x, -spin of the
rotor."""


@dataclass(frozen=True, kw_only=True)
class Signals:
    """Arrays (N, .) of one flight without missing samples (interpolated; they are a handful per
    flight)."""

    name: str
    position: FloatArray
    velocity: FloatArray
    attitude: FloatArray
    rate: FloatArray
    force: FloatArray
    u: FloatArray
    voltage: FloatArray
    body_velocity: FloatArray
    alpha: FloatArray
    seen: Any

    @property
    def n(self) -> int:
        """Samples."""
        return len(self.u)


@dataclass(frozen=True, kw_only=True)
class Ladder:
    """One rung. `gain` (3,), `moment` (3,), `damping` (3,), `drag` (2,), `thrust`; zeros where the
    rung has none."""

    row: str
    lag: float = 0.0
    delay: float = 0.0
    thrust: float = 0.0
    gain: FloatArray
    drag: FloatArray
    moment: FloatArray
    damping: FloatArray
    ratio: float = 0.0

    def has(self, row: str) -> bool:
        """Whether this rung includes that row."""
        return ROWS.index(self.row) >= ROWS.index(row)


def signals(flight: Flight) -> Signals:
    """Columns of a flight."""
    segment = flight.segments[0]

    def take(names: Sequence[str]) -> FloatArray:
        columns = segment.matrix(names)
        index = np.arange(segment.n)
        for c in columns.T:
            good = np.isfinite(c)
            c[~good] = np.interp(index[~good], index[good], c[good])
        return columns

    q, velocity, rate = (take(GROUPS[g].columns) for g in ("rotation", "velocity", "rate"))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    return Signals(
        name=flight.name,
        position=take(GROUPS["position"].columns),
        velocity=velocity,
        attitude=q,
        rate=rate,
        body_velocity=numeric("rotate_inverse", q, velocity),
        alpha=savgol_filter(rate, WINDOW, 2, deriv=1, delta=DT, axis=0),
        force=numeric(
            "rotate_inverse", q, savgol_filter(velocity, WINDOW, 2, deriv=1, delta=DT, axis=0) + UP
        ),
        u=take(("u1", "u2", "u3", "u4")),
        voltage=savgol_filter(take(("vbat",))[:, 0], 51, 1),
        seen=np.isfinite(
            segment.matrix((*GROUPS["position"].columns, *GROUPS["rate"].columns))
        ).all(axis=1),
    )


def drive(s: Signals, rung: Ladder) -> tuple[FloatArray, FloatArray]:
    """(sum (N,), moments (N, 3)) of the squared, delayed and lagged commands."""
    nu = s.u * (s.voltage[:, None] / 3.7 if rung.has("+ battery") else 1.0)
    clock = np.arange(s.n)
    nu = np.column_stack([np.interp(clock - rung.delay / DT, clock, c) for c in nu.T])
    if rung.lag > 0:
        a = np.exp(-DT / rung.lag)
        nu = nu[0] + lfilter([0.0, 1.0 - a], [1.0, -a], nu - nu[0], axis=0)
    return (nu**2).sum(axis=1), nu**2 @ MIX


def response(x: FloatArray, damping: float, h: int) -> FloatArray:
    """What h steps of d(rate)/dt = x - damping rate add to the rate at their end, (N - h, .), from
    a rate of zero."""
    a, b = decay(damping)
    y = lfilter([0.0, b], [1.0, -a], x, axis=0)
    return y[h:] - a**h * y[:-h]


def decay(damping: float) -> tuple[float, float]:
    """(a, b) of rate+ = a rate + b x over one step."""
    a = float(np.exp(-damping * DT))
    return a, (1.0 - a) / damping if damping else DT


def fit_axis(flights: Sequence[Signals], rung: Ladder, axis: int) -> tuple[float, FloatArray]:
    """(squared error over its variance, (gain, moment, damping)) of one axis at the rung's lag and
    delay.

    Changes of the rate over several horizons, linear in gain, moment and bias at a given damping;
    damping by a grid.
    """
    own, flap = rung.has("+ per-flight biases"), rung.has("+ velocity moment") and axis < 2
    drives = [drive(s, rung)[1][:, axis] for s in flights]
    best = (np.inf, np.zeros(3))
    for damping in DAMPINGS if rung.has("+ rate damping") else (0.0,):
        rows, targets = [], []
        for h in HORIZONS:
            a, _ = decay(damping)
            size = np.sqrt(
                np.mean(
                    np.concatenate([s.rate[h:, axis] - s.rate[:-h, axis] for s in flights]) ** 2
                )
            )
            for s, m in zip(flights, drives, strict=True):
                y = s.rate[h:, axis] - a**h * s.rate[:-h, axis]
                x = np.column_stack([m, s.body_velocity[:, 1 - axis]] if flap else [m])
                x = response(x, damping, h)
                if own:
                    x, y = x - x.mean(axis=0), y - y.mean()
                rows.append(x / size)
                targets.append(y / size)
        x, y = np.concatenate(rows), np.concatenate(targets)
        c = np.linalg.lstsq(x, y, rcond=None)[0]
        error = float(np.sum((y - x @ c) ** 2))
        if error < best[0]:
            best = error, np.array([c[0], c[1] if flap else 0.0, -damping])
    return best


def fit_rung(row: str, flights: Sequence[Signals]) -> Ladder:
    """Least squares over the training flights, delay and lag by the smallest error in roll and
    pitch."""
    zero = Ladder(
        row=row, gain=np.zeros(3), drag=np.zeros(2), moment=np.zeros(3), damping=np.zeros(3)
    )
    found = []
    for lag in LAGS:
        for delay in DELAYS:
            rung = replace(zero, lag=lag, delay=delay)
            axes = [fit_axis(flights, rung, axis) for axis in range(3)]
            c = np.stack([v for _, v in axes])
            rung = replace(rung, gain=c[:, 0], moment=c[:, 1], damping=c[:, 2])
            found.append((axes[0][0] + axes[1][0], rung))
    _, rung = min(found, key=lambda f: f[0])
    sums = np.concatenate([drive(s, rung)[0] for s in flights])
    vertical = np.concatenate([s.force[:, 2] for s in flights])
    drag = np.zeros(2)
    if rung.has("+ linear drag"):
        force = np.concatenate([s.force[:, :2] - s.force[:, :2].mean(axis=0) for s in flights])
        body = np.concatenate(
            [s.body_velocity[:, :2] - s.body_velocity[:, :2].mean(axis=0) for s in flights]
        )
        drag = (body * force).sum(axis=0) / (body**2).sum(axis=0)
    return replace(rung, thrust=float(sums @ vertical / (sums @ sums)), drag=drag)


@dataclass(frozen=True, kw_only=True)
class Biases:
    """Of one flight: factor on the thrust, horizontal specific force (2,), angular acceleration
    (3,)."""

    scale: float
    force: FloatArray
    alpha: FloatArray


def acceleration(s: Signals, rung: Ladder) -> FloatArray:
    """Angular acceleration (N, 3) along the measured flight, without biases."""
    _, moments = drive(s, rung)
    v = s.body_velocity
    return (
        moments * rung.gain
        + np.column_stack([v[:, 1], v[:, 0], 0 * v[:, 0]]) * rung.moment
        + s.rate * rung.damping
    )


def biases(s: Signals, rung: Ladder) -> Biases:
    """From the first seconds of the flight."""
    if not rung.has("+ per-flight biases"):
        return Biases(scale=1.0, force=np.zeros(2), alpha=np.zeros(3))
    first = slice(0, round(ADAPT / DT))
    total, _ = drive(s, rung)
    alpha = s.alpha - acceleration(s, rung)
    return Biases(
        scale=float(
            (total[first] @ s.force[first, 2]) / (total[first] @ total[first]) / rung.thrust
        ),
        force=(s.force[first, :2] - rung.drag * s.body_velocity[first, :2]).mean(axis=0),
        alpha=alpha[first].mean(axis=0),
    )


def observe(s: Signals, rung: Ladder, own: Biases) -> tuple[FloatArray, FloatArray]:
    """(rate, torque disturbance) (N, 3) at every sample; the measured rate and zero without the
    Kalman filter."""
    if not rung.ratio:
        return s.rate, np.zeros((s.n, 3))
    a, c = np.array([[1.0, DT], [0.0, FADE]]), np.array([1.0, 0.0])
    q, p = np.diag([1e-3, rung.ratio**2]), np.eye(2)
    r = 0.02**2
    for _ in range(2000):
        k = p @ c / (c @ p @ c + r)
        p = a @ (p - np.outer(k, c @ p)) @ a.T + q
    expected = acceleration(s, rung) + own.alpha
    rate, torque = np.zeros((s.n, 3)), np.zeros((s.n, 3))
    x = np.stack([s.rate[0], np.zeros(3)])
    for t in range(s.n):
        e = s.rate[t] - x[0]
        x = x + k[:, None] * e
        rate[t], torque[t] = x
        x = a @ x + np.stack([DT * expected[t], np.zeros(3)])
    return rate, torque


def simulate(s: Signals, rung: Ladder, origins: FloatArray) -> dict[str, FloatArray]:
    """Predictions (m, 50, .) per group, from the measured state at the origins (rate and torque
    from `observe`)."""
    own = biases(s, rung)
    total, moments = drive(s, rung)
    rate, torque = observe(s, rung, own)
    p, v, q = s.position[origins], s.velocity[origins], s.attitude[origins]
    w, d = rate[origins], torque[origins]
    out = {
        g: np.zeros((len(origins), STEPS, GROUPS[g].dimension))
        for g in ("position", "velocity", "rotation", "rate")
    }
    for h in range(STEPS):
        at = origins + h
        body = numeric("rotate_inverse", q, v)
        alpha = moments[at] * rung.gain + own.alpha + d
        alpha += (
            np.column_stack([body[:, 1], body[:, 0], 0 * body[:, 0]]) * rung.moment
            + w * rung.damping
        )
        f = np.column_stack(
            [own.force + rung.drag * body[:, :2], own.scale * rung.thrust * total[at]]
        )
        a = numeric("rotate", q, f) - UP
        p = p + DT * v + 0.5 * DT * DT * a
        v = v + DT * a
        q = numeric("multiply", q, numeric("exp", DT * (w + 0.5 * DT * alpha)))
        w, d = w + DT * alpha, FADE * d
        for g, value in zip(out, (p, v, q, w), strict=True):
            out[g][:, h] = value
    return out


def origins_of(s: Signals) -> FloatArray:
    """Samples after the adaptation that have all their steps, none of them missing."""
    first = np.arange(round(ADAPT / DT), s.n - STEPS)
    total = np.concatenate([[0], np.cumsum(s.seen)])
    return first[total[first + STEPS + 1] - total[first] == STEPS + 1]


def judge(
    rung: Ladder, flights: Sequence[Signals], table: HorizonAccumulator | None = None
) -> HorizonAccumulator:
    """Errors of one rung on flights."""
    table = table or HorizonAccumulator(label=rung.row, sample_time=DT)
    for s in flights:
        at = origins_of(s)
        references = {
            "position": s.position,
            "velocity": s.velocity,
            "rotation": s.attitude,
            "rate": s.rate,
        }
        table.add(s.name, simulate(s, rung, at), references, at)
    return table


def build(flights: Sequence[Signals]) -> list[Ladder]:
    """All rungs from the training flights."""
    rungs = [fit_rung(row, flights) for row in ROWS]
    # The Kalman filter belongs to the last rung: its noise ratio by the rate error at 0.1 s on the
    # training flights.
    tried = [replace(rungs[-1], ratio=r) for r in RATIOS]
    few = flights[::2]
    errors = [float(judge(t, few).table().groups["rate"].rmse[9]) for t in tried]
    rungs[-1] = tried[int(np.argmin(errors))]
    return rungs


def line(label: str, table: HorizonTable) -> str:
    """One row as in the ladder: p50, v10, v50, R10, R50 [deg], rate 1, 10, 50."""
    g = table.groups
    cells = [
        f"{g[n].rmse[h - 1] * (180 / np.pi if n == 'rotation' else 1.0):8.4f}"
        if n in g
        else f"{'-':>8}"
        for n, h in (
            ("position", 10),
            ("position", 50),
            ("velocity", 10),
            ("velocity", 50),
            ("rotation", 10),
            ("rotation", 50),
            ("rate", 1),
            ("rate", 10),
            ("rate", 50),
        )
    ]
    return f"{label:32s}" + "".join(cells)


HEAD = f"{'RMSE of the norm':32s}" + "".join(
    f"{h:>8}" for h in ("p10", "p50", "v10", "v50", "R10deg", "R50deg", "w1", "w10", "w50")
)


def describe(rung: Ladder) -> str:
    """The numbers of a rung in one line."""
    return (
        f"{rung.row:24s} lag {rung.lag:g} s, delay {rung.delay:g} s, k {rung.thrust:.2f}, gains "
        f"{np.round(rung.gain, 1)}, drag {np.round(rung.drag, 3)}, moment "
        f"{np.round(rung.moment, 1)}, damping {np.round(rung.damping, 2)}, ratio {rung.ratio:g}"
    )


def read() -> Dataset:
    """All fourteen flights."""
    return read_logs(flight_paths("nanobench"), read_vehicle(vehicle_path("nanobench")))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the ladder and the models' rows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "model", nargs="*", help="model files of greybox, judged on the test flights"
    )
    parser.add_argument(
        "--leave-one-type-out", action="store_true", help="every type of trajectory held out once"
    )
    options = parser.parse_args(arguments)
    data = read()
    flights = {f.name: signals(f) for f in data}
    print(HEAD)
    if options.leave_one_type_out:
        tables = [HorizonAccumulator(label=row, sample_time=DT) for row in ROWS]
        for kind in sorted({n.split("_")[0] for n in flights}):
            rungs = build([s for n, s in flights.items() if not n.startswith(kind)])
            for rung, table in zip(rungs, tables, strict=True):
                judge(rung, [s for n, s in flights.items() if n.startswith(kind)], table)
        for table in tables:
            print(line(table.label, table.table()))
        return
    rungs = build([s for n, s in flights.items() if n not in NANOBENCH_TEST])
    for rung in rungs:
        print(line(rung.row, judge(rung, [flights[n] for n in NANOBENCH_TEST]).table()))
    test = data.select(NANOBENCH_TEST)
    for i, path in enumerate(options.model):
        result = validate(IdentifiedModel.load(path), test, adapt=ADAPT, measured_start=True)
        if result.table is not None and result.measured_start is not None:
            print(line(path[-31:], result.table))
            print(line("   from the measured state", result.measured_start))
        if i == len(options.model) - 1:
            for other in (result.persistence, result.dead_reckoning):
                if other is not None:
                    print(line(other.label, other))
    print()
    for rung in rungs:
        print(describe(rung))


if __name__ == "__main__":
    main()
