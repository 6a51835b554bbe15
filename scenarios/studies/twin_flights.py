"""Exported simulators on real flights that no fit saw, beside our own model and the Crazyflies that
ship with them.

    python -m scenarios.studies.twin_flights MODEL.json LOG... [--targets
    rotorpy,mujoco,drone-models,pybullet]
        [--start smoothed] [--out F]

From instants of each flight (every `SPACING` seconds, after the first five, on which the flight's
own parameters are adapted) the recorded commands are flown for half a second: by our model, by each
simulator on the files of `greybox twin` (with and without rest.py, and with the present push by
pushes.py) and by RotorPy's and drone-models' own Crazyflie. All start from the same state; sensor
errors (bias, misalignment, delay) are taken as our model has them, for everybody. Shipped craft get
our command map and delay, scaled so that they hover at our hover command: more than their files
say.

The filter knows the start by the samples before it. `--start smoothed` begins from what the whole
flight says of it, so that what remains is the simulators' own; the row `the start alone` is how far
our model flies apart from the two starts: about the least that a perfect simulator would be off by
from the filtered one.
"""

from __future__ import annotations

import argparse
import functools
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from greybox.data import Flight
from greybox.data.logs import read_logs
from greybox.estimation.filtering import Filter
from greybox.estimation.smoothing import smooth
from greybox.files import write_json
from greybox.model.identified import IdentifiedModel
from greybox.residual.files import load_model
from greybox.simulators.make import twin
from greybox.symbolic import FloatArray
from greybox.validation.adapt import adapt_to_flight
from scenarios.foreign.plant import MissingSimulator
from scenarios.twins.written import FLYERS, SHIPPED, Start, load

SPACING, ADAPT, SECONDS = 1.0, 5.0, 0.5
HORIZONS = (0.1, 0.5)
PUSHED = ("rotorpy", "mujoco", "drone-models", "crazyflow", "pybullet")
"""Simulators that take the present push as pushes.py has it."""
OURS, START = "our model", "the start alone"
UNITS = {"position": "m", "velocity": "m/s", "rotation": "rad", "rate": "rad/s"}
IntArray = npt.NDArray[np.int64]
Errors = dict[str, dict[str, list[FloatArray]]]
"""Who flew -> group -> squared errors (instants, steps), one array per stretch."""


def study(
    model: IdentifiedModel,
    flights: Sequence[Flight],
    targets: Sequence[str],
    say: Callable[[str], None],
    *,
    smoothed: bool = False,
) -> Errors:
    """Squared errors of everybody, from the filter's states or from `smoothed` ones."""
    errors: Errors = {}
    for flight in flights:
        filter_ = Filter(model)
        values = (
            adapt_to_flight(model, flight, ADAPT, riccati=filter_.riccati).values
            if model.flight_spread
            else {}
        )
        own = replace(model, values=model.values.replace(values))
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder)
            twin(own, ("numpy", *targets), out=place, even_so=True)
            (module,) = load(place / "numpy", "simulate")
            (commands,) = load(place / targets[0], "commands")
            for segment in flight.segments:
                run = filter_.run(segment.without(flight.noncausal), p=own.parameter_vector())
                dt, steps = run.record.dt, round(SECONDS / run.record.dt)
                rows = np.arange(round(ADAPT / dt), run.record.n - steps - 2, round(SPACING / dt))
                if not len(rows):
                    continue
                real = {
                    g: segment.matrix(c, missing_ok=True)
                    for g, c in _columns(segment.channels).items()
                }
                inputs, best = run.record.inputs, smooth(filter_, run).states[rows]
                starts = best if smoothed else run.states[rows]
                flown = _flown(module, commands, place, targets, starts, inputs, rows, steps, dt)
                seen = {
                    who: _seen(module, states, inputs, rows, real) for who, states in flown.items()
                }
                truth = {
                    g: np.stack([v[rows + 1 + k] for k in range(steps)], axis=1)
                    for g, v in real.items()
                }
                for who, outputs in seen.items():
                    for group, value in outputs.items():
                        errors.setdefault(who, {}).setdefault(group, []).append(
                            _squared(group, value, truth[group])
                        )
                if not smoothed:
                    apart = _seen(
                        module, _ours(module, best, inputs, rows, steps), inputs, rows, real
                    )
                    for group, value in apart.items():
                        there = np.where(np.isfinite(truth[group]), seen[OURS][group], np.nan)
                        errors.setdefault(START, {}).setdefault(group, []).append(
                            _squared(group, value, there)
                        )
        say(f"{flight.name}: {', '.join(errors)}")
    return errors


def _columns(channels: Any) -> dict[str, tuple[str, ...]]:
    groups = {
        "position": ("x", "y", "z"),
        "velocity": ("vx", "vy", "vz"),
        "rotation": ("qw", "qx", "qy", "qz"),
        "rate": ("p", "q", "r"),
    }
    return {g: c for g, c in groups.items() if all(n in channels for n in c)}


def _flown(
    module: Any,
    commands: Any,
    place: Path,
    targets: Sequence[str],
    starts: FloatArray,
    inputs: FloatArray,
    rows: IntArray,
    steps: int,
    dt: float,
) -> dict[str, FloatArray]:
    """Who -> states (instants, steps, n_x) of our model's layout; disturbances of others are
    zero."""
    past, names = int(module.PAST), module.STATES
    rotors = [i for i, n in enumerate(names) if n.startswith("rotor.")]
    pushes = [i for i, n in enumerate(names) if n.startswith("disturbance.")]
    forgotten = starts.copy()
    forgotten[:, pushes] = 0.0
    out = {OURS: _ours(module, starts, inputs, rows, steps)}
    out[f"{OURS}, pushes forgotten"] = _ours(module, forgotten, inputs, rows, steps)
    count = len(rotors)
    flyers: dict[str, Any] = {}
    for name in targets:
        flyers[name] = (FLYERS[name], place / name, {}, False)
        further, with_ = {}, "with"
        if (place / name / "rest.py").is_file():
            further, with_ = {"rest": True}, "with rest.py,"
            flyers[f"{name} with rest.py"] = (FLYERS[name], place / name, further, False)
        if name in PUSHED and pushes:
            flyers[f"{name} {with_} pushes.py"] = (FLYERS[name], place / name, further, True)
    flyers |= {
        f"shipped: {n}": (fly, commands, {}, False) for n, fly in SHIPPED.items() if n in targets
    }
    for who, (fly, first, further, pushed) in flyers.items():
        flights = []
        for x, s in zip(starts, rows, strict=True):
            start = Start(
                position=x[:3],
                velocity=x[3:6],
                attitude=x[6:10] / np.linalg.norm(x[6:10]),
                rate=x[10:13],
                rotors=x[rotors],
                push=_push(names, x) if pushed else None,
            )
            window = inputs[s : s + past + steps]
            volt = window[past:, count] if inputs.shape[1] > count else None
            flights.append(
                fly(first, start, window[past:, :count], window[:past, :count], dt, volt, **further)
            )
        states = np.zeros((len(rows), steps, len(names)))
        found = np.array(flights)
        states[..., :13] = found[..., :13]
        states[..., rotors] = found[..., 13:]
        out[who] = states
    return out


def _push(names: Sequence[str], x: FloatArray) -> FloatArray:
    """Force and moment (6,) that push a craft in state x (n_x,); zero where the model has none."""
    state = dict(zip(names, x.tolist(), strict=True))
    return np.array(
        [state.get(f"disturbance.{g}.{a}", 0.0) for g in ("force", "torque") for a in "xyz"]
    )


def _ours(
    module: Any, starts: FloatArray, inputs: FloatArray, rows: IntArray, steps: int
) -> FloatArray:
    past, x, states = int(module.PAST), starts, []
    for k in range(steps):
        window = np.stack([inputs[rows + k + i] for i in range(past + 1)], axis=1)
        x = module.step(x, window)
        states.append(x)
    return np.stack(states, axis=1)


def _seen(
    module: Any,
    states: FloatArray,
    inputs: FloatArray,
    rows: IntArray,
    real: Mapping[str, FloatArray],
) -> dict[str, FloatArray]:
    """Group -> what its sensor says (instants, steps, axes)."""
    past, steps = int(module.PAST), states.shape[1]
    out: dict[str, list[FloatArray]] = {g: [] for g in real}
    for k in range(steps):
        window = np.stack([inputs[rows + k + 1 + i] for i in range(past + 1)], axis=1)
        y = module.output(states[:, k], window)
        columns = dict(zip(module.OUTPUTS, y.T, strict=True))
        columns |= {f"v{a}": states[:, k, 3 + i] for i, a in enumerate("xyz")}
        for group, names in _columns(columns).items():
            if group in out:
                out[group].append(np.stack([columns[n] for n in names], axis=-1))
    return {g: np.stack(v, axis=1) for g, v in out.items()}


def _squared(group: str, seen: FloatArray, real: FloatArray) -> FloatArray:
    if group != "rotation":
        return np.asarray(np.sum((seen - real) ** 2, axis=-1))
    product = (
        np.abs(np.sum(seen * real, axis=-1))
        / np.linalg.norm(seen, axis=-1)
        / np.linalg.norm(real, axis=-1)
    )
    return np.asarray((2.0 * np.arccos(np.minimum(1.0, product))) ** 2)


def table(errors: Errors, dt: float) -> list[dict[str, Any]]:
    """One row per flyer, group and horizon: root mean square error, and over ours."""
    rows = []
    for who, groups in errors.items():
        for group in groups:
            for h in HORIZONS:
                k = round(h / dt) - 1
                both = [np.concatenate([p[:, k] for p in e[group]]) for e in (groups, errors[OURS])]
                good = np.isfinite(both[0]) & np.isfinite(both[1])
                error, ours = (float(np.sqrt(e[good].mean())) for e in both)
                rows.append(
                    {
                        "who": who,
                        "group": group,
                        "seconds": h,
                        "rmse": error,
                        "over_ours": error / ours,
                        "count": int(good.sum()),
                    }
                )
    return rows


def format_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Errors, and in brackets their ratio to those of our model."""
    columns = list(dict.fromkeys((r["group"], r["seconds"]) for r in rows))
    lines = ["  ".join([f"{'':28}", *(f"{g} {h:g} s [{UNITS[g]}]".ljust(22) for g, h in columns)])]
    for who in dict.fromkeys(r["who"] for r in rows):
        cells = {
            (r["group"], r["seconds"]): f"{r['rmse']:.4f} ({r['over_ours']:.3f})"
            for r in rows
            if r["who"] == who
        }
        lines.append("  ".join([f"{who:28}", *(cells[c].ljust(22) for c in columns)]))
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Fly, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("model", metavar="MODEL.json")
    parser.add_argument("logs", nargs="+", metavar="LOG")
    parser.add_argument("--targets", default="rotorpy,mujoco,drone-models")
    parser.add_argument("--start", choices=("filtered", "smoothed"), default="filtered")
    parser.add_argument("--out", metavar="F.json")
    options = parser.parse_args(arguments)
    model = load_model(options.model)
    flights = read_logs(options.logs, model.physics.vehicle, rate=1.0 / model.sample_time)
    targets = options.targets.split(",")
    try:
        say = functools.partial(print, flush=True)
        errors = study(model, list(flights), targets, say, smoothed=options.start == "smoothed")
    except MissingSimulator as missing:
        raise SystemExit(str(missing)) from None
    rows = table(errors, model.sample_time)
    print(format_table(rows))
    if options.out:
        write_json(options.out, {"model": options.model, "start": options.start, "rows": rows})


if __name__ == "__main__":
    main()
