"""Coverage: do simulated flights of drawn craft hold the real one, and how wide are they?

From instants of flights that no fit saw, all draws fly on under the recorded commands, in the very
module that is written (simulate.py): own parameters, own pushes, own sensor noise, started from the
filter's state within its covariance. The band holds the central 95 % of them: once for a new
flight, whose own parameters are drawn from the spread between flights, and once after its first
seconds, which these were adapted on. Beside it stand the customary box, every parameter of the
craft evenly within 30 % of its value and no pushes, and the width that would hold 95 % of the real
values about the middle of ours: no band is honest below it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypedDict, cast

import numpy as np

from greybox.data import Dataset, Flight, Segment
from greybox.errors import DataError
from greybox.estimation.filtering import Filter, Filtered
from greybox.files import Json
from greybox.model.identified import IdentifiedModel
from greybox.model.noise import disturbances, gauss_markov
from greybox.simulators.draws import Draws
from greybox.simulators.targets.numpy_module import NumPyModule
from greybox.symbolic import FloatArray, IntArray
from greybox.validation.adapt import Adaptation, adapt_to_flight

HORIZONS = (0.1, 0.5, 1.0)
"""Seconds ahead."""
LEVEL, BOX = 0.95, 0.3
FEWEST_DRAWS = 20
"""Below this number of craft, the outermost ones are no band of 95 %."""
SPACING, START = 2.0, 5.0
"""Seconds between the instants from which simulations start, and before the first of them."""
_Sums = dict[tuple[str, float], dict[str, list[FloatArray]]]
"""(group, horizon) -> flight -> inside and width of the band, inside and width of the box, distance
of the real value from the middle of the band; one number per instant and axis."""
GROUPS: Mapping[str, tuple[str, ...]] = {
    "position": ("x", "y", "z"),
    "velocity": ("vx", "vy", "vz"),
    "rotation": ("qw", "qx", "qy", "qz"),
    "rate": ("p", "q", "r"),
}
UNITS = {"position": "m", "velocity": "m/s", "rotation": "rad", "rate": "rad/s"}


@dataclass(frozen=True, kw_only=True)
class Covered:
    """One group at one horizon [s]: share of real values inside the band, of `count` (instants
    times axes); mean width of the band and of that of the box, in the group's unit; `needed`: the
    width that holds 95 % of the real values about the band's middle. `adapted`: whether the
    flight's own parameters were adapted on its first seconds. `by_flight`: the share of each
    flight; `share_error`: the standard error of `share` by how flights differ, None of one."""

    adapted: bool
    group: str
    seconds: float
    share: float
    share_error: float | None
    by_flight: Mapping[str, float]
    count: int
    width: float
    box_width: float
    box_share: float
    needed: float

    def to_dict(self) -> dict[str, Json]:
        """Plain values."""
        return dict(vars(self))


def format_table(rows: tuple[Covered, ...]) -> str:
    """For people."""
    lines = [f"95 % band of simulated flights, real values inside it; box: +-{100 * BOX:.0f} %"]
    for adapted in (False, True):
        own = [r for r in rows if r.adapted is adapted]
        if not own:
            continue
        what = f"after its first {START:g} s" if adapted else "a new flight"
        head = "   ahead     inside        of   width     needed          box inside  box width   "
        lines.append(f"  {what:20}{head}box/band  box/needed")
        for r in own:
            error = "" if r.share_error is None else f"+- {100 * r.share_error:.1f}"
            lines.append(
                f"  {r.group:20} {r.seconds:4g} s {100 * r.share:6.1f} {error:7} % {r.count:5d}   "
                f"{r.width:<9.3g} {r.needed:<9.3g} {UNITS[r.group]:6}{100 * r.box_share:6.1f} %   "
                f"{r.box_width:<9.3g}  {r.box_width / r.width:<8.1f}  {r.box_width / r.needed:.1f}"
            )
        held = {n: np.mean([r.by_flight[n] for r in own if n in r.by_flight]) for n in _names(own)}
        said = ", ".join(
            f"{n} {100 * v:.0f} %" for n, v in sorted(held.items(), key=lambda i: i[1])
        )
        lines.append(f"  {'of each flight':20} {said}")
    return "\n".join(lines)


def _names(rows: list[Covered]) -> list[str]:
    return list(dict.fromkeys(n for r in rows for n in r.by_flight))


def coverage(
    model: IdentifiedModel, draws: Draws, flights: Dataset, *, seed: int = 0
) -> tuple[Covered, ...]:
    """Coverage of `draws` on flights that no fit saw. Raises `DataError` where the flights are too
    short, draws too few, or the model does not carry position, velocity, attitude and rate."""
    module = module_of(model, draws)
    nominal = np.asarray(module["VALUES"])
    box = _box(draws, seed, nominal)
    new: _Sums = {}
    known: _Sums = {}
    for flight in flights:
        found, adapted = starts(model, flight)
        own = adapted_draws(draws, adapted, seed)
        for start in found:
            for values, sums in ((draws.values, new), (own, known)):
                if values is None:
                    continue
                wide = box if sums is new else _box(draws, seed, values.mean(axis=0))
                for which, craft, levels in ((0, values, draws.levels), (1, wide, None)):
                    for seen in ahead(model, module, craft, levels, start, seed):
                        _keep(sums, seen, which, flight.name)
    if not new:
        raise DataError(
            "no flight is long enough to check",
            expected=f"more than {START + max(HORIZONS):g} s in one piece",
        )
    return _rows(new, False) + _rows(known, True)


def adapted_draws(draws: Draws, adapted: Adaptation | None, seed: int) -> FloatArray | None:
    """The draws (n, n_p) with the flight's own parameters as its first seconds left them."""
    if adapted is None:
        return None
    random = np.random.default_rng([seed, 3])
    values = draws.values.copy()
    for k, name in enumerate(draws.names):
        if name in adapted.values:
            sigma = adapted.std.get(name, 0.0)
            values[:, k] = adapted.values[name] + sigma * random.standard_normal(len(draws))
    return np.asarray(values)


class Simulate(TypedDict):
    """Names of a written simulate.py; states (..., n_x), values (..., n_p)."""

    STATES: Sequence[str]
    OUTPUTS: Sequence[str]
    VALUES: Sequence[float]
    NOISE: Sequence[float]
    PAST: int
    FUTURE: int
    step: Callable[..., FloatArray]
    output: Callable[..., FloatArray]


def module_of(model: IdentifiedModel, draws: Draws) -> Simulate:
    """The written module, loaded. Raises `DataError` for too few draws, and where the model does
    not carry position, velocity, attitude and rate."""
    if len(draws) < FEWEST_DRAWS:
        raise DataError(
            "too few draws for bands",
            expected=f"{FEWEST_DRAWS} or more",
            got=str(len(draws)),
            fix="add --draws 200",
        )
    space: dict[str, object] = {"__name__": "simulate"}
    exec(compile(NumPyModule().files(draws.craft)["simulate.py"], "simulate.py", "exec"), space)
    module = cast(Simulate, space)
    states = tuple(model.dynamics.states.names)
    if states != tuple(module["STATES"]):
        raise DataError(
            "the model does not carry the whole motion",
            expected="states of position, velocity, attitude and rate",
            got=", ".join(s for s in module["STATES"] if s not in states) + " missing",
            fix="check on a model that was fitted with motion capture",
        )
    return module


def _box(draws: Draws, seed: int, about: FloatArray) -> FloatArray:
    """As many craft from the customary box about values (n_p,): what the body has, not what its
    sensors have."""
    random = np.random.default_rng([seed, 1])
    physics = draws.craft.physics
    sensors = {e.name for e in physics.effects if e.stage == "sensor"}
    own = set(draws.craft.values)
    values = np.tile(about, (len(draws), 1))
    for k, name in enumerate(draws.names):
        if name in own and name.split(".")[0] not in sensors:
            values[:, k] *= 1.0 + BOX * random.uniform(-1.0, 1.0, len(draws))
    return np.asarray(values)


@dataclass(frozen=True, kw_only=True, eq=False)
class Start:
    """Instants of one segment: states (m, n_x), rows (m,) of the record, its covariance."""

    segment: Segment
    filtered: Filtered
    rows: IntArray
    spread: FloatArray


def starts(model: IdentifiedModel, flight: Flight) -> tuple[list[Start], Adaptation | None]:
    """Where simulations of a flight begin, and what its first seconds said of its own parameters:
    the filter has these, as for any new flight."""
    filter_ = Filter(model)
    adapted: Adaptation | None = None
    if model.flight_spread and flight.duration > 3.0 * START:
        adapted = adapt_to_flight(model, flight, START, riccati=filter_.riccati)
    values = {} if adapted is None else adapted.values
    out = []
    for segment in flight.segments:
        run = filter_.run(segment, model.parameter_vector(values))
        dt = run.record.dt
        last = run.record.n - round(max(HORIZONS) / dt) - 2
        rows = np.arange(round(START / dt), last, round(SPACING / dt))
        if len(rows):
            out.append(Start(segment=segment, filtered=run, rows=rows, spread=run.state_covariance))
    return out, adapted


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """A sensor group `seconds` ahead: what drawn craft see (m, n, axes) and what was `real` (m,
    axes); attitudes as Euler angles."""

    group: str
    seconds: float
    craft: FloatArray
    real: FloatArray

    def about_the_middle(self) -> tuple[FloatArray, FloatArray]:
        """Distances of the craft (m, n, axes) and of the real values (m, axes) from the median of
        the craft; of angles, around it."""
        middle = np.median(self.craft, axis=1)
        off, away = self.craft - middle[:, None], self.real - middle
        if self.group == "rotation":
            off, away = (np.arctan2(np.sin(v), np.cos(v)) for v in (off, away))
        return off, away


def ahead(
    model: IdentifiedModel,
    module: Simulate,
    values: FloatArray,
    levels: FloatArray | None,
    start: Start,
    seed: int,
) -> Iterator[Seen]:
    """Fly craft with `values` (n, n_p) from all instants of `start`, pushed about with `levels` (n,
    n_w), or not at all."""
    random = np.random.default_rng([seed, 2])
    record, n = start.filtered.record, len(values)
    x = _first_states(model, start, n, random, levels)
    step = module["step"]
    past, future = module["PAST"], module["FUTURE"]
    sigma = dict(zip(model.dynamics.innovations.names, model.sensor_noise, strict=True))
    ends = {round(h / record.dt): h for h in HORIZONS}
    # state k + 1 is the filter's; the step from there takes the command of k + 1
    for k in range(1, max(ends) + 1):
        at = start.rows + k
        window = _window(record.inputs, at, past + 1 + future)
        w = None
        if levels is not None:
            w = levels * random.standard_normal((len(start.rows), *levels.shape))
        x = step(x, window[:, None], values[None], w)
        if k in ends:
            seen = _seen(x, _window(record.inputs, at + 1, past + 1 + future), values, module)
            for g in GROUPS:
                real = _real(start.segment, g, at + 1)
                if real is not None:
                    noise = _noise(g, sigma, random, seen[g].shape)
                    yield Seen(group=g, seconds=ends[k], craft=seen[g] + noise, real=real)


def _window(inputs: FloatArray, at: IntArray, size: int) -> FloatArray:
    """Commands that the step from samples `at` (m,) looks at, (m, size, n_u); the record is padded
    in front by the earlier ones."""
    return np.stack([inputs[at + i] for i in range(size)], axis=1)


def _first_states(
    model: IdentifiedModel,
    start: Start,
    n: int,
    random: np.random.Generator,
    levels: FloatArray | None,
) -> FloatArray:
    """(m, n, n_x): the filter's states with its errors; disturbances anew, as no simulator knows
    those of the flight."""
    names = model.dynamics.states.names
    centre = start.filtered.states[start.rows + 1]
    errors = model.dynamics.error_states.names
    root = np.linalg.cholesky(start.spread + 1e-15 * np.eye(len(errors)))
    d = random.standard_normal((len(centre), n, len(errors))) @ root.T
    x = np.repeat(centre[:, None], n, axis=1)
    turn = _rotation(centre[:, 6:10])
    for rows in (slice(0, 3), slice(3, 6)):
        x[..., rows] += np.einsum("mij,mnj->mni", turn, d[..., rows])
    x[..., 6:10] = _turned(x[..., 6:10], d[..., 6:9])
    x[..., 10:13] += d[..., 9:12]
    x[..., 13:] += d[..., 12:]
    for part in disturbances(model.dynamics):
        time = float(model.values[f"{part.name}.T"])
        share = gauss_markov.renewed(time, model.sample_time)
        for i, name in enumerate(names):
            if name.startswith(f"{part.name}."):
                j = model.dynamics.noises.names.index(name)
                size = 0.0 if levels is None else levels[:, j] / math.sqrt(share)
                x[..., i] = size * random.standard_normal(x.shape[:2])
    return np.asarray(x)


def _seen(
    x: FloatArray, window: FloatArray, values: FloatArray, module: Simulate
) -> dict[str, FloatArray]:
    """Group -> sensor values (m, n, axes); attitudes as Euler angles."""
    y = module["output"](x, window[:, None], values[None])
    places = {name: i for i, name in enumerate(module["OUTPUTS"])}
    out = {}
    for group, columns in GROUPS.items():
        value = y[..., [places[c] for c in columns]]
        out[group] = _euler(value) if group == "rotation" else value
    return out


def _real(segment: Segment, group: str, rows: IntArray) -> FloatArray | None:
    columns = GROUPS[group]
    if not all(c in segment.channels for c in columns):
        return None
    value = np.stack([segment.column(c)[rows] for c in columns], axis=-1)
    return _euler(value) if group == "rotation" else np.asarray(value)


def _noise(
    group: str, sigma: Mapping[str, float], random: np.random.Generator, shape: tuple[int, ...]
) -> FloatArray:
    names = {
        "position": [f"position.{a}" for a in "xyz"],
        "velocity": [f"velocity.{a}" for a in "xyz"],
        "rotation": [f"attitude.{a}" for a in "xyz"],
        "rate": ["p", "q", "r"],
    }[group]
    level = np.array([float(sigma.get(n, 0.0)) for n in names])
    return np.asarray(level * random.standard_normal(shape))


def _keep(sums: _Sums, seen: Seen, which: int, flight: str) -> None:
    """Share inside and width of the band about its median."""
    off, away = seen.about_the_middle()
    low, high = np.quantile(off, ((1 - LEVEL) / 2, (1 + LEVEL) / 2), axis=1)
    good = np.isfinite(away)
    inside = ((away >= low) & (away <= high))[good]
    entry = sums.setdefault((seen.group, seen.seconds), {}).setdefault(flight, [np.zeros(0)] * 5)
    if which == 0:
        entry[4] = np.concatenate([entry[4], np.abs(away[good])])
    entry[2 * which] = np.concatenate([entry[2 * which], inside.astype(float)])
    entry[2 * which + 1] = np.concatenate([entry[2 * which + 1], (high - low)[good]])


def _rows(sums: _Sums, adapted: bool) -> tuple[Covered, ...]:
    rows = []
    for (g, h), flights in sorted(
        sums.items(), key=lambda i: (list(GROUPS).index(i[0][0]), i[0][1])
    ):
        inside, width, box_inside, box_width, away = (
            np.concatenate(parts) for parts in zip(*flights.values(), strict=True)
        )
        if not inside.size:
            continue
        rows.append(
            Covered(
                adapted=adapted,
                needed=2.0 * float(np.quantile(away, LEVEL)),
                group=g,
                seconds=h,
                share=float(inside.mean()),
                share_error=share_error([e[0] for e in flights.values()]),
                by_flight={n: float(e[0].mean()) for n, e in flights.items() if e[0].size},
                count=len(inside),
                width=float(width.mean()),
                box_width=float(box_width.mean()),
                box_share=float(box_inside.mean()),
            )
        )
    return tuple(rows)


def share_error(inside: list[FloatArray]) -> float | None:
    """Standard error of the share of all values (n,) of several flights, which are the samples: the
    values of one flight go together (Cochran 1977, Sampling Techniques, eq. 2.39: a ratio). None
    for one flight."""
    inside = [i for i in inside if i.size]
    n, count = len(inside), sum(len(i) for i in inside)
    if n < 2:
        return None
    share = sum(float(i.sum()) for i in inside) / count
    off = [float(i.sum()) - share * len(i) for i in inside]
    return math.sqrt(n / (n - 1) * sum(v * v for v in off)) / count


# ---------------------------------------------------------------- rotations of whole batches


def _rotation(q: FloatArray) -> FloatArray:
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def _turned(q: FloatArray, d: FloatArray) -> FloatArray:
    """q * exp(d/2)."""
    size = np.linalg.norm(d, axis=-1, keepdims=True)
    e = np.concatenate([np.cos(size / 2), 0.5 * d * np.sinc(size / (2 * np.pi))], axis=-1)
    a, b, c, f = np.moveaxis(q, -1, 0)
    w, x, y, z = np.moveaxis(e, -1, 0)
    return np.stack(
        [
            a * w - b * x - c * y - f * z,
            a * x + b * w + c * z - f * y,
            a * y - b * z + c * w + f * x,
            a * z + b * y - c * x + f * w,
        ],
        axis=-1,
    )


def _euler(q: FloatArray) -> FloatArray:
    """Roll, pitch, yaw."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    return np.stack(
        [
            np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
            np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)),
            np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
        ],
        axis=-1,
    )
