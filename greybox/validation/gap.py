"""Gap: how far simulation and measurement are apart, per channel group and horizon, before and
after; with the floor.

E(h) is the RMSE of the open-loop prediction h ahead from the filtered state, pooled over all
origins of the test flights; the floor E0(h) is dead reckoning with the measured IMU (no model that
sees commands alone can do better). The share that was closed is 1 - (E_after^2 - E0^2)/(E_before^2
- E0^2), with a block bootstrap (blocks of one second, whole flights where there are at least four;
Kunsch 1989, Annals of Statistics 17(3)).
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NotRequired, TypedDict

import numpy as np

from greybox.data import Dataset, Flight, Segment
from greybox.data.segment import START_SECONDS
from greybox.errors import DataError
from greybox.estimation.filtering import Filter, Filtered
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import physics_of
from greybox.model.noise import sensor_parts
from greybox.model.sensors import SENSORS
from greybox.statistics.blocks import clearly
from greybox.symbolic import FloatArray, IntArray
from greybox.validation.adapt import adapt_to_flight
from greybox.validation.against import TRACE
from greybox.validation.baselines import ImuBias, bias_at_start, has_groups
from greybox.validation.floor import reckoned_from
from greybox.validation.groups import GROUPS, Groups, error_norms
from greybox.validation.horizon import strided
from greybox.validation.open_loop import GroupReader, predict_from

SECONDS = (0.0, 0.1, 0.5, 1.0)
"""Horizons [s]; 0 stands for one sample."""
TENTH = 0.1
"""Share of the gap by which written laws must make it worse to be called that, and of the error by
which names must for a word before all others."""
ALL = 0.995
"""A share that rounds to all of it."""
NOTHING = 1.2
"""Below this ratio of before^2 to floor^2 there is no gap to close."""
START = 2.0
"""Seconds that tell with which velocity, tilt and rates a log begins that does not measure them;
they are not judged."""
STRIDE = 0.05
"""Seconds between origins."""
SAMPLES = (10, 50, 100)
"""Samples ahead that a model of the user's own is asked for, besides one: nobody knows how fast it
is, and at 100 Hz these are `SECONDS`."""
UNITS = {n: g.unit for n, g in GROUPS.items()}
Start = tuple[FloatArray | None, FloatArray | None]
Squares = dict[tuple[str, float], list[FloatArray]]


class GapDocument(TypedDict):
    """A `GapRow` as in discovery.json; files of earlier versions lack the last."""

    group: str
    unit: str
    horizon_s: float
    before: float
    after: float
    floor: float | None
    closed: float | None
    ci95: list[float] | None
    with_proposals: NotRequired[float | None]
    attainable: NotRequired[float | None]
    filtered: NotRequired[float | None]
    opened: NotRequired[bool]


@dataclass(frozen=True, kw_only=True, eq=False)
class GapRow:
    """One group and horizon: RMSE before and after, the floor (None without an IMU or attitude),
    share closed (None where there was no gap) and its 95 % interval; the share that the proposed
    laws close together with the names, and the share that a learned part closes without a name (the
    attainable line). `filtered`: RMSE after, where force and torque without a name fade from what
    the filter sees. `opened`: whether what was at the floor is clearly beyond it now."""

    group: str
    unit: str
    horizon_s: float
    before: float
    after: float
    floor: float | None
    closed: float | None
    ci95: tuple[float, float] | None
    with_proposals: float | None = None
    attainable: float | None = None
    filtered: float | None = None
    opened: bool = False

    @property
    def worse(self) -> bool:
        """Whether it clearly got worse, by more than a trace."""
        felt = self.after**2 > (1 + TRACE) * self.before**2
        return self.opened or (felt and self.ci95 is not None and self.ci95[1] < 0)

    @property
    def opposed(self) -> bool:
        """Whether that is mended by force and torque without a name: a name stands against them."""
        return self.worse and self.filtered is not None and self.filtered < self.before

    @property
    def doubtful(self) -> bool:
        """Whether that is so, and much."""
        return self.opposed and self.after > (1 + TENTH) * self.before

    def to_dict(self) -> GapDocument:
        """As in discovery.json."""
        return {
            "group": self.group,
            "unit": self.unit,
            "horizon_s": self.horizon_s,
            "before": self.before,
            "after": self.after,
            "floor": self.floor,
            "closed": self.closed,
            "ci95": None if self.ci95 is None else list(self.ci95),
            "with_proposals": self.with_proposals,
            "attainable": self.attainable,
            "filtered": self.filtered,
            "opened": self.opened,
        }


def closed_in_words(share: float, before: float, floor: float | None) -> str:
    """How much of the gap between an error (RMSE) `before` and its `floor` (None: zero) was closed,
    as a share of squares.

    All of it, or more, is being at the floor, and so is an error a tenth above it: what lies below
    is the noise of the sensors that the floor was made with.
    """
    if share < ALL:
        return f"{100 * share:.0f} %"
    base = floor or 0.0
    after = math.sqrt(max(before**2 - share * (before**2 - base**2), 0.0))
    if not floor:
        return "all of it"
    if after <= (1.0 + TENTH) * base:
        return "all of it: at the floor"
    return f"{math.floor(1e4 * share) / 100:.4g} %: {after / base:.2g} times the floor, {base:.2g}"


def closing(rows: Iterable[GapRow]) -> list[str]:
    """A line per group and horizon of 0.1 and 0.5 s (one's own model: all): errors before and after,
    and how much of the gap was closed."""
    out = []
    for r in rows:
        own = r.group not in GROUPS
        untold = r.closed is None and not r.opened
        if untold or (r.horizon_s == 0 if own else r.horizon_s not in (0.1, 0.5)):
            continue
        errors = f"  {r.group} {r.horizon_s:g} s ahead: {r.before:.4g} -> {r.after:.4g} {r.unit}"
        if r.closed is None:
            out.append(f"{errors} (it was at the floor: worse)")
            continue
        laws = r.with_proposals
        more = (
            "" if laws is None else f"; with the laws: {closed_in_words(laws, r.before, r.floor)}"
        )
        out.append(
            f"{errors} (of the gap closed: {closed_in_words(r.closed, r.before, r.floor)}{more})"
        )
    return out


def outgrown(
    before: HeldOutErrors | None, named: HeldOutErrors | None, lawful: HeldOutErrors | None
) -> list[str]:
    """Groups and horizons in which names and laws close clearly less (a tenth of the gap, and more
    than one reading and chance) than the names alone, beyond one sample, which is the sensors' and
    the filter's; a word where one of them foretells nothing (None)."""
    if before is None or named is None or lawful is None:
        return ["nothing is foretold"]
    sides = (before.own, before.floor), (named.own, named.floor)
    return [
        f"{r.group} {r.horizon_s:g} s ahead"
        for r in gap(*sides, units=named.units, proposals=lawful.own, draws=0)
        if r.horizon_s > 0
        and r.closed is not None
        and r.with_proposals is not None
        and r.with_proposals < min(r.closed, 1.0) - TENTH  # below the floor all is closed
        and _felt(named, lawful, (r.group, r.horizon_s), lost=r.with_proposals < 0)
    ]


def _felt(
    named: HeldOutErrors, lawful: HeldOutErrors, key: tuple[str, float], *, lost: bool
) -> bool:
    """Whether errors grow by more than the squared error of one reading, as a name has to remove,
    and by more than chance: a tenth of a gap that is next to nothing is nothing. What is `lost`,
    worse than without any name, no chance excuses: a second that diverges hides in its own
    spread."""
    old, new = ([b.sum() for b in side.own[key]] for side in (named, lawful))
    grown = np.array(new) - np.array(old)
    size = sum(b.size for b in named.own[key])
    return (lost or clearly(grown)) and float(grown.sum()) > size * named.reading.get(key[0], 0.0)


def doubt(rows: Iterable[GapRow]) -> str:
    """The beginning of a sentence that says what the names leave worse than it was without them and
    the filter mends, and what to do; empty where there is nothing of the kind."""
    groups = ", ".join(dict.fromkeys(r.group for r in rows if r.doubtful))
    said = (
        f"USE WITH ITS FILTER ONLY (alone it foretells {groups} worse than before; `greybox fit "
        "--from` its model fits numbers by errors ahead). "
    )
    return said if groups else ""


def worsened(rows: Iterable[GapRow]) -> list[str]:
    """Why groups and horizons clearly got worse, in words. What lasts and has no name may stand
    against a name: with what the filter sees of it errors fall. Else the commands of a feedback
    answer what comes in between, which nobody foretells, and a model that follows them adds the
    answers up (`scenarios.studies.feedback_tells`)."""
    out = []
    for r in rows:
        if not r.worse:
            continue
        said = f"{r.group} {f'{r.horizon_s:g} s' if r.horizon_s else 'one sample'} ahead: "
        if r.opposed:
            out.append(
                f"{said}worse by physics alone, {r.filtered:.4g} {r.unit} with the force and "
                "torque without a name that the filter sees: a name stands against these, or "
                "commands of a feedback answer them"
            )
        elif r.filtered is None:
            out.append(f"{said}worse than without the names")
        else:
            out.append(
                f"{said}worse: commands of a feedback may answer what comes in between, and a "
                "model that follows them adds the answers up"
            )
    return out


@dataclass(frozen=True, kw_only=True)
class Ahead:
    """How far a model is asked to foretell, and how often: `steps` maps horizons [s], 0 for one
    sample, to samples; times in units of `second` [s]."""

    steps: Mapping[float, int]
    second: float

    @classmethod
    def of(cls, model: IdentifiedModel) -> Ahead:
        """Seconds for a vehicle, for any other model hundreds of samples."""
        dt = model.sample_time
        if physics_of(model.dynamics) is not None:
            return cls(steps={s: max(1, round(s / dt)) for s in SECONDS}, second=1.0)
        return cls(steps={0.0: 1, **{n * dt: n for n in SAMPLES}}, second=100 * dt)

    @property
    def longest(self) -> int:
        """Samples of the longest horizon."""
        return max(self.steps.values())


@dataclass(frozen=True, kw_only=True, eq=False)
class HeldOutErrors:
    """(group, horizon) -> one array of squared errors per second of flight, in order; the same of
    the `floor`. `reading`: group -> mean squared error of one reading of its sensor, as the model
    knows it. `second`: the second of these blocks [s], which a model of the user's own has of its
    own. `units`: of the groups."""

    own: Squares
    floor: Squares
    reading: Mapping[str, float] = field(default_factory=dict)
    second: float = 1.0
    units: Mapping[str, str] = field(default_factory=lambda: UNITS)


def unknown_start(model: IdentifiedModel) -> bool:
    """Whether readings do not tell with which velocity or rates a flight begins: no position and no
    velocity, or no gyro."""
    shown = {
        block: {s.name for s in SENSORS if s.shows == block}
        for block in ("position", "velocity", "rate")
    }
    if not model.sensors:
        return False
    return (
        not (shown["position"] | shown["velocity"]) & model.sensors
        or not shown["rate"] & model.sensors
    )


def predict_ahead(
    model: IdentifiedModel, data: Dataset, *, adapt: float = 0.0, unnamed: bool = False
) -> HeldOutErrors:
    """Open-loop errors of `model` at all origins of `data`; per-flight parameters are adapted on
    the first `adapt` s (0: not).

    Physics alone foretells: force and torque that nobody named are zero from every origin on, or
    (`unnamed`) fade from what the filter sees there. Where
    readings do not tell with which velocity or rates a segment begins, its first `START` s do. A
    model of the user's own is asked at `SAMPLES`.
    Raises `DataError` where no flight is long enough, `FitError` where a prediction is not finite.
    """
    runner, reader = Filter(model), GroupReader(model)
    dt = model.sample_time
    groups = reader.judged(data.any_channels)
    ahead = Ahead.of(model)
    steps, longest, second = ahead.steps, ahead.longest, ahead.second
    blind = unknown_start(model)
    own: Squares = {(g, s): [] for g in groups for s in steps}
    floor: Squares = {(g, s): [] for g in groups for s in steps}
    states = model.dynamics.states.names
    silent = [i for i, n in enumerate(states) if n.startswith("disturbance.") and not unnamed]
    for flight in data:
        p, bias = _adapted(model, flight, adapt, runner), _imu_bias(model, flight, adapt)
        # The same seconds are judged whether this model has something to adapt or not.
        begin = float(flight.segments[0].t[0]) + adapt
        for segment in flight.segments:
            # What was commanded before a segment is not known, nor is its state.
            known = max(begin, float(segment.t[0]) + (_start(segment) if blind else 0.0))
            late = np.flatnonzero(segment.t >= known + START_SECONDS * second)
            references = {
                g: segment.matrix(reader.table[g].columns, missing_ok=True) for g in groups
            }
            every = max(1, round(STRIDE * second / dt))
            origins = strided(late[late < segment.n - longest - 1], every, references.values())
            if not origins.size:
                continue
            x0, sigma = _begun(model, flight, segment, runner) if blind else (None, None)
            filtered = runner.run(segment.without(flight.noncausal), p=p, x0=x0, x0_sigma=sigma)
            begun = filtered.states.copy()
            begun[:, silent] = 0.0
            filtered = replace(filtered, states=begun)
            predicted = predict_from(runner.engine, reader, filtered, origins, steps=longest)
            block = np.asarray((segment.t[origins] - segment.t[0]) // second, dtype=int)
            _collect(own, predicted, references, origins, steps, block, reader.table)
            dead = _floor(model, segment, filtered, reader, origins, longest, references, bias)
            if dead is not None:
                _collect(floor, dead, references, origins, steps, block, reader.table)
    if not any(own.values()):
        raise DataError(
            "no flight is long enough for multi-step errors", expected=f"over {longest} samples"
        )
    return HeldOutErrors(
        own=own,
        floor=floor,
        reading=readings(model),
        second=second,
        units={g: reader.table[g].unit for g in groups},
    )


def _adapted(model: IdentifiedModel, flight: Flight, adapt: float, runner: Filter) -> FloatArray:
    """p of a flight, with what differs from flight to flight adapted on its first `adapt` s."""
    if not adapt or not model.flight_spread:
        return model.flight_vector(flight.name)
    found = adapt_to_flight(model, flight, adapt, riccati=runner.riccati)
    return model.parameter_vector(found.values)


def _imu_bias(model: IdentifiedModel, flight: Flight, seconds: float) -> ImuBias:
    with contextlib.suppress(DataError):
        if (physics := physics_of(model.dynamics)) is not None:
            return bias_at_start(flight, seconds, float(physics.vehicle.gravity))
    return ImuBias.zero()


def readings(model: IdentifiedModel) -> dict[str, float]:
    """Group -> mean squared error of one reading, over all of its channels: white noise and what
    lasts of it."""
    physics = physics_of(model.dynamics)
    white = dict(zip(model.dynamics.innovations.names, model.sensor_noise.tolist(), strict=True))
    if physics is None:
        table = GroupReader(model).table
        return {n: sum(white.get(c, 0.0) ** 2 for c in g.columns) for n, g in table.items()}
    driven = dict(zip(model.dynamics.noises.names, model.process_noise.tolist(), strict=True))
    out: dict[str, float] = {}
    for sensor in physics.sensors:
        names = [s.name for s in sensor.innovation_signals(physics.vehicle)]
        total = sum(white[n] ** 2 for n in names if n in white)
        for part in (p for p in sensor_parts(model.dynamics) if p.sensor == sensor.name):
            levels = [driven.get(f"{part.name}.c.{n.split('.')[-1]}", 0.0) for n in names]
            total += sum(
                part.described(v, model.values, model.sample_time).get("sigma", 0.0) ** 2
                for v in levels
                if v
            )
        out[sensor.group] = total
    return out


def _begun(model: IdentifiedModel, flight: Flight, segment: Segment, runner: Filter) -> Start:
    alone, steady = replace(flight, segments=(segment,)), replace(model, flight_spread={})
    found = adapt_to_flight(steady, alone, _start(segment), riccati=runner.riccati)
    return found.x0, found.x0_sigma


def _start(segment: Segment) -> float:
    """`START`, of short segments a third."""
    return min(START, (segment.n - 1) * segment.dt / 3)


def _collect(
    into: Squares,
    predicted: dict[str, FloatArray],
    references: dict[str, FloatArray],
    origins: IntArray,
    steps: Mapping[float, int],
    second: IntArray,
    table: Groups,
) -> None:
    for (g, s), rows in into.items():
        if g not in predicted:
            continue
        h = steps[s]
        target = references[g][origins + h]
        norms = error_norms(table[g], predicted[g][:, h - 1], target)
        for block in np.unique(second):
            value = norms[second == block]
            rows.append(value[np.isfinite(value)] ** 2)


def _floor(
    model: IdentifiedModel,
    segment: Segment,
    filtered: Filtered,
    reader: GroupReader,
    origins: IntArray,
    steps: int,
    references: dict[str, FloatArray],
    bias: ImuBias,
) -> dict[str, FloatArray] | None:
    there = has_groups(segment.channels, "rate", "specific_force") and "rotation" in references
    if not there or physics_of(model.dynamics) is None:
        return None
    return reckoned_from(
        segment,
        filtered,
        reader,
        references,
        origins,
        past=model.dynamics.window[0],
        steps=steps,
        bias=bias,
        gravity=float(model.physics.vehicle.gravity),
    )


def gap(
    before: tuple[Squares, Squares],
    after: tuple[Squares, Squares],
    *,
    units: Mapping[str, str] = UNITS,
    proposals: Squares | None = None,
    attainable: Squares | None = None,
    filtered: Squares | None = None,
    draws: int = 500,
    seed: int = 0,
) -> list[GapRow]:
    """Rows for every group and horizon that both models predict, own and floor of `predict_ahead`;
    `proposals` and `attainable` are squared errors of the model with the proposed laws and of the
    one with a learned part, `filtered` those of the model that keeps what has no name."""
    rng = np.random.default_rng(seed)
    out = []
    for key, blocks in before[0].items():
        own, floor = after[0].get(key, []), after[1].get(key, [])
        if not blocks or len(own) != len(blocks):
            continue
        sums = [np.array([(b.sum(), b.size) for b in bs]) for bs in (blocks, own)]
        floors = np.array([(b.sum(), b.size) for b in floor]) if len(floor) == len(blocks) else None
        total = [_mean(s) for s in sums]
        base = None if floors is None else _mean(floors)
        closed, interval = None, None
        others: list[float | None] = [None, None]
        if total[0] > NOTHING * (base or 0.0) and total[0] > 0:
            closed = _closed(total[0], total[1], base or 0.0)
            others = [
                _other(o, key, len(blocks), total[0], base or 0.0) for o in (proposals, attainable)
            ]
            drawn = []
            for _ in range(draws):
                pick = rng.integers(0, len(blocks), len(blocks))
                b, a = (_mean(s[pick]) for s in sums)
                f = 0.0 if floors is None else _mean(floors[pick])
                if b > f:
                    drawn.append(_closed(b, a, f))
            if drawn:
                interval = (float(np.quantile(drawn, 0.025)), float(np.quantile(drawn, 0.975)))
        out.append(
            GapRow(
                group=key[0],
                unit=units[key[0]],
                horizon_s=key[1],
                before=float(np.sqrt(total[0])),
                after=float(np.sqrt(total[1])),
                floor=None if base is None else float(np.sqrt(base)),
                closed=closed,
                ci95=interval,
                with_proposals=others[0],
                attainable=others[1],
                filtered=_rmse(filtered, key),
                opened=closed is None and _opened(sums, base, draws, seed),
            )
        )
    return out


def _opened(sums: Sequence[FloatArray], floor: float | None, draws: int, seed: int) -> bool:
    """Whether errors that were at the floor are beyond it now, and clearly grew: (sum, number) of
    their squares per block, before and after."""
    if floor is None or _mean(sums[1]) <= NOTHING * floor:
        return False
    rng, n = np.random.default_rng(seed), len(sums[0])
    picks = [rng.integers(0, n, n) for _ in range(draws)]
    grown = [_mean(sums[1][pick]) - _mean(sums[0][pick]) for pick in picks]
    return bool(grown) and bool(np.quantile(grown, 0.025) > 0)


def _rmse(squares: Squares | None, key: tuple[str, float]) -> float | None:
    blocks = [] if squares is None else squares.get(key, [])
    values = np.concatenate(blocks) if blocks else np.zeros(0)
    return float(np.sqrt(values.mean())) if values.size else None


def _mean(sums: FloatArray) -> float:
    return float(sums[:, 0].sum() / max(sums[:, 1].sum(), 1.0))


def _other(
    squares: Squares | None, key: tuple[str, float], count: int, before: float, floor: float
) -> float | None:
    """Share that another model closes; None where it did not predict the same."""
    blocks = (squares or {}).get(key, [])
    if len(blocks) != count:
        return None
    return _closed(before, _mean(np.array([(b.sum(), b.size) for b in blocks])), floor)


def _closed(before: float, after: float, floor: float) -> float:
    return float(1 - (after - floor) / (before - floor))


def groups_of(rows: Sequence[GapRow]) -> tuple[str, ...]:
    """The groups in the order of the table."""
    return tuple(dict.fromkeys(r.group for r in rows))
