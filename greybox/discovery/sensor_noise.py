"""Sensor noise: which sensors are not white, and how; compared like effects, before anything that is left is called physics.

Every kind of `greybox.model.noise` is a model of its own, fitted through the predictor. Noise of a sensor stays in
its channel; a force or torque reaches every channel that the motion couples. Noise states of all sensors and Gauss-Markov
force and torque are fitted together, so that neither takes the other's place; a part stays where BIC is worse by more than
10 without it. Whether the IMU filters what it measures is asked in `greybox.discovery.imu_filter`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.stats

from greybox.data import Dataset
from greybox.discovery.candidates import Candidates
from greybox.discovery.nested import Nest, NestedFit
from greybox.estimation.fit import Fit, fit, noise_of
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt
from greybox.model.dynamics import Dynamics
from greybox.model.identified import IdentifiedModel
from greybox.model.noise import (
    Augmented,
    Coloured,
    Drift,
    Line,
    SensorPart,
    disturbances,
    sensor_parts,
    with_white_sensors,
)
from greybox.model.noise import with_parts as augmented
from greybox.model.sensors import SENSORS, on_clock
from greybox.statistics.evidence import CLEAR
from greybox.validation.whiteness import ChannelWhiteness, whiteness

START = {s.name: s.colour_time for s in SENSORS if s.colour_time is not None}
"""Sensors whose noise may be coloured: start values of correlation times [s]."""
WITNESS = {s.name: s.witnesses for s in SENSORS if s.witnesses}
"""Sensors whose colour cannot be told from force or torque unless one of these sees the motion too."""
PREDICTABLE = 0.005
"""Share of an innovation's variance that its own past must explain for its sensor to be suspected."""
WHITE = 1e-4
"""Level of the test of whiteness, per channel."""
LAGS = 20
LINE, SHARP = 1.0, 1e-6
"""Start value of a line's decay time [s]; probability of so high a peak of the periodogram by chance."""
SILENT = 7.0
"""Logarithm by which a level falls where a part is tried without."""
TOLERANCE = 1e-3
"""Where the fit of noise levels stops: they are compared, not reported, to a hundredth of a standard error."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Suspected:
    """Chosen noise `parts` (start values = estimates) with `gains` part name -> BIC without - BIC with, and the levels
    `noise` that they were found with."""

    parts: tuple[SensorPart, ...]
    gains: Mapping[str, float]
    noise: Mapping[str, float]


def with_parts(nest: Nest, parts: Iterable[SensorPart]) -> Nest:
    """The same candidates on a model with these parts of its sensors and no others. Time constants of filters are free in
    every fit, those of noise stay at the start values of its part."""
    chosen = tuple(parts)
    offered: Candidates = nest.candidates
    filters = tuple(f"{p.name}.{q}" for p in chosen if p.filters for q in p.quantities)
    before = {f"{p.name}.{q}" for p in sensor_parts(offered.model) for q in p.quantities}
    core = (*(n for n in offered.core if n not in before), *filters)
    every, physics = (*chosen, *disturbances(offered.model)), offered.physics
    model = Augmented(core=physics, parts=every) if every else physics
    return replace(nest, candidates=replace(offered, model=model, core=core))


def coloured_sensors(lean: Fit, data: Dataset) -> Suspected | None:
    """The noise that the sensors of `lean` (the model of what was named so far) clearly need; None where they are white.

    Physics is held at its estimates. Gains are those of a part at its level against white noise of the same variance,
    the other levels held: an upper bound. Parts that it does not settle are fitted without.
    """
    had = sensor_parts(lean.model.dynamics)
    if not suspicious(lean):
        return None
    physics = lean.model.physics
    there = physics.sensor_names
    sensors = [s.name for s in physics.sensors if s.name in START and WITNESS.get(s.name, there) & there]
    parts: tuple[SensorPart, ...] = tuple(Coloured(sensor=s, time=START[s]) for s in sensors)
    if "gyro" in sensors:
        parts = (*parts, Drift(sensor="gyro"))
    lines = {s: _line(lean, s) for s in sensors}
    parts += tuple(Line(sensor=s, time=LINE, frequency=f) for s, f in lines.items() if f is not None)
    best = _coloured(had, parts, data, lean, lean)
    gains = {p.name: _gain(best, p) for p in parts}
    while parts and min(gains.values()) <= CLEAR:
        # The bound says that they are not needed. Of several on one sensor one stays for now: it may do the others' work.
        strongest = {p.sensor: max(gains[o.name] for o in parts if o.sensor == p.sensor) for p in parts}
        several = {p.sensor for p in parts if sum(o.sensor == p.sensor for o in parts) > 1}
        parts = tuple(
            p for p in parts
            if gains[p.name] > CLEAR or (p.sensor in several and gains[p.name] == strongest[p.sensor] > 0)
        )  # fmt: skip
        if not parts:
            return None
        best = _coloured(had, parts, data, lean, best)
        gains = {p.name: _gain(best, p) for p in parts}
    found = tuple(p.estimated(best.model.values) for p in parts)
    levels = {n: v for n, v in noise_of(best.model).items() if not n.startswith("noise.process.disturbance.")}
    return Suspected(parts=(*had, *found), gains=gains, noise=levels)


def dressed(nest: Nest, at: NestedFit, noise: Suspected) -> tuple[Nest, NestedFit]:
    """The candidates and the fit `at` with the chosen noise, started from the levels that it was chosen with."""
    again = with_parts(nest, noise.parts)
    task = again.task(at.effects, start=at)
    levels = {(n, None): float(np.log(v)) for n, v in noise.noise.items()}
    starts = tuple(dict(known) | levels for known in task.starts)
    return again, again.settle(again.refits([replace(task, starts=starts)])[0])


def plain_model(found: Fit, data: Dataset) -> IdentifiedModel:
    """The model of `found` with white sensors, as model files hold it: its estimates, and levels fitted for them."""
    own = found.model.dynamics
    if not sensor_parts(own):
        return found.model
    dynamics = with_white_sensors(own)
    there = {d.name for d in dynamics.parameters}
    per_flight = [n for n in found.settings["per_flight"] if n in there]
    free = [n for n in found.model.flight_spread if n in there]
    result = fit(
        dynamics, data, free=free, per_flight=per_flight, values=_known(found, dynamics), initialisation="noise",
        solver=LevenbergMarquardt(tolerance=TOLERANCE), estimate_noise=found.settings["estimate_noise"],
    ).model  # fmt: skip
    keep = [i for i, n in enumerate(found.model.covariance_names) if n in there]
    return replace(
        result, covariance_names=tuple(found.model.covariance_names[i] for i in keep),
        covariance=found.model.covariance[np.ix_(keep, keep)], trained_on=found.model.trained_on,
        data_hash=found.model.data_hash, source=found.model.source,
    )  # fmt: skip


def tested(fitted: Fit) -> dict[str, ChannelWhiteness]:
    """Innovation component -> test of its whiteness, of those that can be tested."""
    names = fitted.model.dynamics.innovations.names
    records = [e for es in fitted.innovations.values() for e in es if len(e) > 4 * LAGS]
    live = [j for j in range(len(names)) if any(np.isfinite(e[:, j]).any() for e in records)]
    if not records or not live:
        return {}
    test = whiteness([e[:, live] for e in records], names=[names[j] for j in live], max_lag=LAGS)
    return {c.name: c for c in test.channels}


def coloured(channel: ChannelWhiteness) -> bool:
    """Whether the component is clearly not white."""
    return channel.test.p_value < WHITE and channel.predictable > PREDICTABLE


def suspicious(fitted: Fit) -> tuple[str, ...]:
    """Innovation components that are clearly not white."""
    return tuple(n for n, c in tested(fitted).items() if coloured(c))


def sensor_table(fitted: Fit, gains: Mapping[str, float]) -> list[dict[str, Any]]:
    """One entry per channel and kind, as in discovery.json: {channel, kind, parameters, delta_bic}.

    `parameters`: `sigma` of the white part; `sigma` (standard deviation of the noise) and `T` of a coloured one; the same
    and `frequency` [Hz] of a line; `sigma` (after one second) of a drift; `T`, `cutoff` [Hz] and `sigma` (noise in front of
    it) of a low-pass; `delay` [s] of sensor_delay and pose_delay, which are named effects as well. `delta_bic` is that of
    the whole part (all channels of its sensor; a filter's is that of gyro and accelerometer together), None for white.
    """
    noise = {n: v for n, (v, _, _) in fitted.noise.items()}
    values, dt = fitted.model.values, fitted.model.sample_time
    out: list[dict[str, Any]] = []
    physics, parts = fitted.model.physics, sensor_parts(fitted.model.dynamics)
    for sensor in physics.sensors:
        channels = [s.name for s in sensor.innovation_signals(physics.vehicle)]
        for c in channels:
            out.append(_entry(c, "white", {"sigma": noise.get(f"noise.sensor.{c}")}, None))
        for part in parts:
            if part.sensor != sensor.name:
                continue
            for c in channels:
                level = noise.get(f"noise.process.{part.name}.c.{c.split('.')[-1]}", 0.0)
                out.append(_entry(c, part.kind, part.described(level, values, dt), gains.get(part.name)))
    for effect, late in (
        ("pose_delay", on_clock("pose")),
        ("sensor_delay", on_clock("imu")),
    ):
        if effect not in {e.name for e in physics.effects}:
            continue
        for sensor in physics.sensors:
            if sensor.name in late:
                for s in sensor.innovation_signals(physics.vehicle):
                    numbers = {"delay": float(values[f"{effect}.d"])}
                    out.append(_entry(s.name, "delay", numbers, gains.get(effect)))
    return out


def _entry(channel: str, kind: str, parameters: Mapping[str, float | None], gain: float | None) -> dict[str, Any]:
    return {"channel": channel, "kind": kind, "parameters": dict(parameters), "delta_bic": gain}


def _coloured(had: Sequence[SensorPart], parts: Sequence[SensorPart], data: Dataset, lean: Fit, start: Fit) -> Fit:
    """Levels and time constants of `parts` and of Gauss-Markov force and torque, physics held at `lean`."""
    physics = lean.model.physics
    dynamics = augmented(physics, (*had, *parts))
    groups = tuple(g for g in ("force", "torque") if any(n.startswith(g + ".") for n in physics.noises.names))
    free = [f"disturbance.{g}.T" for g in groups]
    free += [f"{p.name}.{q}" for q in ("T", "f") for p in parts if q in p.quantities]
    names = {f"noise.process.{n}" for n in dynamics.noises.names}
    names |= {f"noise.process.disturbance.{n}" for n in dynamics.noises.names if n.split(".")[0] in groups}
    known = {n: v for n, v in noise_of(start.model).items() if n.startswith("noise.sensor.") or n in names}
    values = dict(lean.model.values) | {n: v for n, v in start.model.values.items() if n in free}
    there = {d.name for d in dynamics.parameters} | {f"disturbance.{g}.T" for g in groups}
    return fit(
        dynamics, data, disturbance=groups, free=free, values={n: v for n, v in values.items() if n in there},
        noise=known, initialisation="nominal", solver=LevenbergMarquardt(tolerance=TOLERANCE),
    )  # fmt: skip


def _known(start: Fit, dynamics: Dynamics) -> dict[str, float]:
    there = {d.name for d in dynamics.parameters}
    return {n: float(v) for n, v in start.model.values.items() if n in there}


def _components(fitted: Fit, name: str) -> list[str]:
    """Innovation components of the sensor of that name."""
    physics = fitted.model.physics
    return [
        s.name for sensor in physics.sensors if sensor.name == name
        for s in sensor.innovation_signals(physics.vehicle)
    ]  # fmt: skip


def _line(fitted: Fit, sensor: str) -> float | None:
    """Frequency [Hz] of a peak that stands out of the periodogram of the sensor's innovations, relative to its neighbours.

    Periodogram ordinates of a smooth spectrum are exponential about their local mean (Fisher 1929, Proc. Royal Society A
    125); those of the sensor's components and of all records are added.
    """
    names = list(fitted.model.dynamics.innovations.names)
    rows = [names.index(n) for n in _components(fitted, sensor)]
    records = [np.nan_to_num(e[:, rows]) for es in fitted.innovations.values() for e in es]
    length = min((len(e) for e in records if len(e) > 4 * LAGS), default=0)
    records = [e[:length] for e in records if length and len(e) >= length]
    if not records:
        return None
    power = sum((np.abs(np.fft.rfft(e, axis=0)[1:]) ** 2 / np.sum(e * e, axis=0)).sum(axis=1) for e in records)
    count = len(records) * len(rows)
    local = np.array([np.median(power[max(0, i - LAGS) : i + LAGS + 1]) for i in range(len(power))])
    shape = scipy.stats.gamma(count)
    relative = power / local * shape.median()
    best = int(np.argmax(relative))
    if len(power) * shape.sf(relative[best]) > SHARP:
        return None
    return float((best + 1) / (length * fitted.model.sample_time))


def _gain(fitted: Fit, part: SensorPart) -> float:
    """How much BIC loses when the part's noise is white instead, or is not there at all, whichever is better."""
    problem, theta = fitted.problem, fitted.theta
    silent, whitened = theta.copy(), theta.copy()
    renewed, count = part.renewed(fitted.model.values, problem.dt), 0
    for component in _components(fitted, part.sensor):
        end = component.split(".")[-1]
        levels = [problem.place(f"noise.process.{part.name}.{letter}.{end}") for letter in ("c", "s")]
        plain = problem.place(f"noise.sensor.{component}")
        for at in levels:
            if at is None:
                continue
            count += 1
            for trial in (silent, whitened):
                trial[at] = max(problem.lower[at], theta[at] - SILENT)
        own = levels[0]
        if plain is not None and own is not None:
            variance = np.exp(2 * theta[own]) / renewed
            whitened[plain] = 0.5 * np.log(np.exp(2 * theta[plain]) + variance)
    free = count + len(part.quantities)
    best = min(problem.evaluate(t, 0).likelihood for t in (silent, whitened))
    return float(2 * (best + fitted.loglik) - free * np.log(max(fitted.n_samples, 1)))
