"""Where the errors of open-loop predictions come from: each cause is taken away, and what is left
is measured.

    python -m scenarios.studies.error_budget MODEL.json [--refitted R.json ...] [--figure F.svg]

The model is fitted to nothing here. On every test flight the values of the flight come from its
first five seconds, as in `greybox validate --adapt 5`; origins start after them. Rows use knowledge
that a predictor cannot have, so that the distance to the first row is the most that mending this
cause can gain; only the two that are corrected use what a predictor has:

    the model                 state from the filter, measurements up to the origin
    start: pose and rates     position, velocity, attitude and rates of the start from the smoother (whole flight)
    start: everything         rotors and discrepancy of the start from the smoother too
    commands shifted          per two seconds the shift of the commands, up to 30 ms to either side, that predicts the
                              rates there best: clocks that wander, commands between samples
    torque of the flight      the discrepancy fades towards its mean over the whole flight instead of towards nothing
    torque, mean ahead        the mean of the smoothed torque over the coming half second, from its first sample on
    corrected by the past     what ridge regression on the start and on the commands of 0.3 s before the origin makes of
                              the model's own errors, learned on the training flights
    corrected by commands     the same with the commands up to the predicted sample. In closed loop these tell of the
                              pushes that they answer: a predictor of recorded flights may use that,
                              a controller that chooses its commands may not
    torque throughout         the smoothed torque at every step: all that pushes the rotation, whatever its name
    force throughout          the smoothed force at every step
    both throughout           what remains is the start and what no push can mend
    rates measured            rates from the smoother at every step: the rotation is only integrated
    thrust of each motor      trim, strength of every motor and the start from the whole judged flight
    refitted, N effects       --refitted: models that were fitted to the judged flights themselves; what more
                              effects gain there is the most that this form of the model lacks
    smoothed                  the smoothed state itself: noise and clock of the reference
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from greybox.data import Dataset, Flight
from greybox.data.logs import read_logs
from greybox.estimation.ahead import run_ahead
from greybox.estimation.filtering import Filter, Filtered
from greybox.estimation.smoothing import Smoothed, smooth
from greybox.examples import NANOBENCH_TEST, NANOBENCH_TRAIN, flight_paths, vehicle_path
from greybox.frames import numeric
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import physics_of
from greybox.model.vehicle import read_vehicle
from greybox.symbolic import FloatArray
from greybox.validation.adapt import adapt_to_flight
from greybox.validation.groups import error_vectors
from greybox.validation.horizon import HorizonAccumulator
from greybox.validation.horizon_table import HorizonTable
from greybox.validation.open_loop import GroupReader, IntArray

ADAPT = 5.0
"""Seconds of a flight that its own values come from."""
STEPS = 100
AHEAD = 0.5
"""Seconds over which the coming torque is averaged."""
BLOCK = 2.0
SHIFTS = range(-3, 4)
BEFORE, ASKED = 0.3, 12
"""Seconds before the origin from which commands enter the regression, and about how many of them
after it."""
RIDGE = 0.1
"""Ridge of the regression on features of unit variance, per sample."""
STRENGTH = 0.1
"""How far the motors of a flight may stand from those of the training flights, relative."""
GROUPS = ("position", "velocity", "rotation", "rate")
LISTED = (2, 10, 50, 100)
DRAWN = (
    "the model",
    "start: everything",
    "corrected by commands",
    "torque, mean ahead",
    "torque throughout",
    "rates measured",
)
"""Rows of the figure."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Replay:
    """One segment that was filtered and smoothed, and where its states stand."""

    name: str
    filtered: Filtered
    smoothed: Smoothed
    references: Mapping[str, FloatArray]
    origins: IntArray
    inputs: FloatArray


def replay(
    runner: Filter, reader: GroupReader, flight: Flight, every: int, known: float | None = ADAPT
) -> Replay:
    """Filter and smooth the first segment of a flight, whose own values come from its first `known`
    seconds (None: from the fit, which saw the flight)."""
    model, segment = runner.model, flight.segments[0]
    own = adapt_to_flight(model, flight, known or ADAPT, riccati=runner.riccati)
    values = own.values if known else {**own.values, **model.per_flight.get(flight.name, {})}
    filtered = runner.run(
        segment.without(flight.noncausal),
        p=model.parameter_vector(values),
        x0=own.x0,
        x0_sigma=own.x0_sigma,
    )
    references = {
        g: segment.matrix(reader.table[g].columns)
        for g in GROUPS
        if g in reader.judged(flight.channels)
    }
    there = np.all([np.isfinite(r).all(axis=1) for r in references.values()], axis=0)
    first = np.arange(round(ADAPT / segment.dt), segment.n - STEPS - 1, every)
    total = np.concatenate([[0], np.cumsum(there)])
    complete = total[first + STEPS + 1] - total[first] == STEPS + 1
    smoothed = smooth(runner, filtered)
    inputs = np.concatenate(
        [filtered.record.inputs, np.repeat(filtered.record.inputs[-1:], STEPS + 1, axis=0)]
    )
    return Replay(
        name=flight.name,
        filtered=filtered,
        smoothed=smoothed,
        references=references,
        origins=first[complete],
        inputs=inputs,
    )


def with_own_motors(model: IdentifiedModel) -> IdentifiedModel:
    """The model where the strength of every motor belongs to the flight, not to the craft."""
    strengths = {
        d.name: (model.values[d.name], STRENGTH * (abs(d.nominal) or 1.0))
        for d in model.dynamics.parameters
        if d.name == "thrust.c2" or d.name.startswith("rotor_asymmetry.")
    }
    return replace(model, flight_spread={**model.flight_spread, **strengths})


def asked(reader: GroupReader, r: Replay, past: int, h: int, ahead: bool) -> FloatArray:
    """What the error h samples ahead of every origin is regressed on, (m, .): body velocity, rates,
    direction of gravity, discrepancy, squared commands and voltage up to the predicted sample, or
    (not `ahead`) to the origin."""
    x = r.filtered.states[r.origins + 1]
    velocity, attitude, rate = (
        x[:, reader.state_rows(b)] for b in ("velocity", "attitude", "rate")
    )
    own = numeric("rotate_inverse", attitude, velocity)
    down = numeric("rotate_inverse", attitude, np.tile([0.0, 0.0, -1.0], (len(x), 1)))[:, :2]
    pushes = x[:, [i for g in ("torque", "force") for i in reader.state_rows(f"disturbance.{g}")]]
    h = h if ahead else 0
    lags = np.arange(-h, round(BEFORE / r.filtered.record.dt), max(1, h // ASKED))
    at = np.clip(r.origins[:, None] + past - lags, 0, len(r.inputs) - 1)
    return np.column_stack(
        [own, own * np.abs(own), rate, down, pushes, (r.inputs[at] ** 2).reshape(len(x), -1)]
    )


def regression(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(centre (m,), scale (m,), coefficients (m + 1, .)) of ridge regression on standardised
    features."""
    centre, scale = x.mean(axis=0), x.std(axis=0) + 1e-9
    z = np.column_stack([np.ones(len(x)), (x - centre) / scale])
    ridge = RIDGE * len(x) * np.eye(z.shape[1])
    ridge[0, 0] = 0.0
    return centre, scale, np.linalg.solve(z.T @ z + ridge, z.T @ y)


def regressed(x: FloatArray, found: tuple[FloatArray, FloatArray, FloatArray]) -> FloatArray:
    """What it says at features (n, m), (n, .)."""
    centre, scale, c = found
    return np.column_stack([np.ones(len(x)), (x - centre) / scale]) @ c


class Budget:
    """Rolls the rows of the table out and adds up their errors."""

    def __init__(self, model: IdentifiedModel) -> None:
        self.model, self.runner, self.reader = model, Filter(model), GroupReader(model)
        self.dt = model.sample_time
        self.torque, self.force = (
            self.reader.state_rows(f"disturbance.{g}") for g in ("torque", "force")
        )
        self.fade = float(np.exp(-self.dt / model.values["disturbance.torque.T"]))
        self.rows: dict[str, HorizonAccumulator] = {}
        self.learned: dict[tuple[int, bool], tuple[FloatArray, FloatArray, FloatArray]] = {}

    def roll(
        self,
        r: Replay,
        starts: FloatArray,
        overwritten: Mapping[int, FloatArray] | None = None,
        shift: int = 0,
        origins: IntArray | None = None,
        steps: int = STEPS,
    ) -> dict[str, FloatArray]:
        """Group -> (m, steps, dimension) from states (m, n_x) one sample after the origins.

        `overwritten`: state -> what it is at each step, (m, steps). `shift`: samples by which the
        commands come later.
        """
        told = overwritten or {}

        def written(h: int, x: FloatArray) -> FloatArray:
            for i, value in told.items():
                x[:, i] = value[:, h]
            return x

        return self.reader.read(
            run_ahead(
                self.runner.engine,
                starts=written(0, starts.copy()),
                rows=(r.origins if origins is None else origins) + 1,
                steps=steps,
                inputs=np.roll(r.inputs, shift, axis=0),
                p=r.filtered.p,
                dt=self.dt,
                want_states=True,
                between=(lambda h, _, following: written(h + 1, following)) if told else None,
            )
        )

    def add(self, label: str, r: Replay, predicted: Mapping[str, FloatArray]) -> None:
        """Errors of one row on one flight."""
        row = self.rows.setdefault(
            label, HorizonAccumulator(label=label, sample_time=self.dt, steps=STEPS)
        )
        row.add(r.name, {g: predicted[g] for g in r.references}, r.references, r.origins)

    def learn(self, seen: Sequence[Replay]) -> None:
        """What start and commands tell of the errors of these flights, for every horizon."""
        plain = [self.roll(r, r.filtered.states[r.origins + 1]) for r in seen]
        for h in range(1, STEPS + 1):
            y = np.concatenate(
                [
                    np.column_stack(
                        [
                            error_vectors(g, p[g][:, h - 1], r.references[g][r.origins + h])
                            for g in GROUPS
                        ]
                    )
                    for r, p in zip(seen, plain, strict=True)
                ]
            )
            for ahead in (False, True):
                x = np.concatenate(
                    [asked(self.reader, r, self.runner.engine.past, h, ahead) for r in seen]
                )
                self.learned[h, ahead] = regression(x, y)

    def corrected(
        self, r: Replay, plain: Mapping[str, FloatArray], ahead: bool
    ) -> dict[str, FloatArray]:
        """The predictions `plain` moved by what was learned."""
        out = {g: plain[g].copy() for g in GROUPS}
        for h in range(1, STEPS + 1):
            x = asked(self.reader, r, self.runner.engine.past, h, ahead)
            parts = np.split(regressed(x, self.learned[h, ahead]), len(GROUPS), axis=1)
            for g, moved in zip(GROUPS, parts, strict=True):
                value = out[g][:, h - 1]
                turned = (
                    numeric("multiply", value, numeric("exp", moved))
                    if g == "rotation"
                    else value + moved
                )
                out[g][:, h - 1] = turned
        return out

    def flight(self, r: Replay) -> None:
        """All rows on one flight."""
        causal, best, rows = (
            r.filtered.states[r.origins + 1],
            r.smoothed.states[r.origins + 1],
            r.origins + 1,
        )
        ahead = rows[:, None] + np.arange(STEPS)
        truth = r.smoothed.states
        plain = self.roll(r, causal)
        self.add("the model", r, plain)
        moved = causal.copy()
        for block in ("position", "velocity", "attitude", "rate"):
            at = self.reader.state_rows(block)
            moved[:, at] = best[:, at]
        self.add("start: pose and rates", r, self.roll(r, moved))
        self.add("start: everything", r, self.roll(r, best))
        self.add("commands shifted", r, self.shifted(r, causal))

        torque = truth[:, self.torque]
        mean = torque[round(ADAPT / self.dt) :].mean(axis=0)
        self.add(
            "torque of the flight",
            r,
            self.roll(r, causal, self.pulled(causal, np.broadcast_to(mean, torque.shape), ahead)),
        )
        coming = np.stack(
            [
                torque[np.minimum(k + np.arange(round(AHEAD / self.dt)), len(torque) - 1)].mean(
                    axis=0
                )
                for k in rows
            ]
        )
        held = {
            i: np.repeat(coming[:, j : j + 1], STEPS, axis=1) for j, i in enumerate(self.torque)
        }
        self.add("torque, mean ahead", r, self.roll(r, causal, held))
        self.add("corrected by the past", r, self.corrected(r, plain, False))
        self.add("corrected by commands", r, self.corrected(r, plain, True))

        def along(places: Sequence[int]) -> dict[int, FloatArray]:
            return {i: truth[np.minimum(ahead, len(truth) - 1), i] for i in places}

        self.add("torque throughout", r, self.roll(r, causal, along(self.torque)))
        self.add("force throughout", r, self.roll(r, causal, along(self.force)))
        self.add("both throughout", r, self.roll(r, causal, along([*self.torque, *self.force])))
        self.add("rates measured", r, self.roll(r, causal, along(self.reader.state_rows("rate"))))
        self.add("smoothed", r, self.roll(r, causal, along(range(truth.shape[1]))))

    def pulled(
        self, causal: FloatArray, towards: FloatArray, ahead: IntArray
    ) -> dict[int, FloatArray]:
        """Torque states that fade from the filter's towards `towards` (n, 3) along the flight."""
        target = towards[np.minimum(ahead, len(towards) - 1)]
        left = self.fade ** np.arange(ahead.shape[1])
        return {
            i: target[:, :, j] + (causal[:, i] - target[:, 0, j])[:, None] * left
            for j, i in enumerate(self.torque)
        }

    def shifted(self, r: Replay, causal: FloatArray) -> dict[str, FloatArray]:
        """Per block the shift of the commands with the least error of the rates 0.1 s ahead."""
        tried = [self.roll(r, causal, shift=s) for s in SHIFTS]
        at = r.origins[:, None] + 1 + np.arange(STEPS)
        errors = np.stack(
            [
                np.square(p["rate"][:, :10] - r.references["rate"][at[:, :10]]).sum(axis=(1, 2))
                for p in tried
            ]
        )
        block = r.origins * self.dt // BLOCK
        chosen = np.zeros(len(r.origins), dtype=np.intp)
        for b in np.unique(block):
            chosen[block == b] = int(np.argmin(errors[:, block == b].sum(axis=1)))
        return {
            g: np.stack([p[g] for p in tried])[chosen, np.arange(len(chosen))] for g in tried[0]
        }


def run(
    model: IdentifiedModel,
    train: Dataset,
    test: Dataset,
    every: int,
    refitted: Sequence[IdentifiedModel] = (),
) -> dict[str, HorizonAccumulator]:
    """Label -> errors over the flights of `test`; what corrects them was learned on `train`, and
    `refitted` on `test` itself."""
    budget = Budget(model)
    others: dict[str, tuple[Budget, float | None]] = {
        "thrust of each motor": (Budget(with_own_motors(model)), float("inf"))
    }
    others |= {f"refitted, {effects_of(m)} effects": (Budget(m), None) for m in refitted}
    seen = [replay(budget.runner, budget.reader, f, every) for f in train]
    budget.learn(seen)
    for flight in test:
        print(f"  {flight.name}", flush=True)
        budget.flight(replay(budget.runner, budget.reader, flight, every))
        for label, (other, known) in others.items():
            r = replay(other.runner, other.reader, flight, every, known)
            budget.add(label, r, other.roll(r, r.filtered.states[r.origins + 1]))
    return budget.rows


def effects_of(model: IdentifiedModel) -> int:
    """How many effects a model of a vehicle has."""
    physics = physics_of(model.dynamics)
    return 0 if physics is None else len(physics.effects)


def short(value: float) -> str:
    """Three digits without the zero before the point."""
    digits = 2 - int(np.floor(np.log10(value))) if value > 0 else 0
    return f"{value:.{min(max(digits, 2), 4)}f}".removeprefix("0")


def listed(tables: Mapping[str, HorizonTable], dt: float) -> str:
    """RMSE of the norm of every group at `LISTED`, a line per row."""
    ahead = ", ".join(f"{h * dt:g}" for h in LISTED)
    lines = [f"{f'{ahead} s':26s}" + "".join(f"{g:24s}" for g in GROUPS).rstrip()]
    for label, table in tables.items():
        cells = (
            " ".join(f"{short(float(table.groups[g].rmse[h - 1])):5s}" for h in LISTED)
            for g in GROUPS
        )
        lines.append(f"{label:26s}" + " ".join(cells).rstrip())
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table; with --figure also draw it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "model",
        metavar="MODEL.json",
        help="a model of the NanoBench training flights with disturbance states",
    )
    parser.add_argument(
        "--refitted",
        nargs="+",
        default=(),
        metavar="R.json",
        help="models of the judged flights themselves",
    )
    parser.add_argument("--every", type=int, default=2, help="samples between origins (2)")
    parser.add_argument(
        "--figure", metavar="FILE", help="draw rotation and rates against the horizon"
    )
    options = parser.parse_args(arguments)
    vehicle, model = read_vehicle(vehicle_path("nanobench")), IdentifiedModel.load(options.model)
    data = read_logs(flight_paths("nanobench"), vehicle)
    refitted = [IdentifiedModel.load(f) for f in options.refitted]
    train, test = data.select(NANOBENCH_TRAIN), data.select(NANOBENCH_TEST)
    rows = run(model, train, test, options.every, refitted)
    tables = {label: row.table() for label, row in rows.items()}
    print(listed(tables, model.sample_time))
    if options.figure:
        draw(
            {k: {g: t.groups[g].rmse for g in GROUPS} for k, t in tables.items()},
            model.sample_time,
            Path(options.figure),
        )


def draw(errors: Mapping[str, Mapping[str, FloatArray]], dt: float, path: Path) -> None:
    """Rotation and rates against the horizon, one line per row of the table."""
    import matplotlib
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.0), layout="constrained")
    axes = figure.subplots(1, 2)
    for axis, (g, unit, factor) in zip(
        axes, (("rotation", "deg", 180 / np.pi), ("rate", "rad/s", 1.0)), strict=True
    ):
        for label, row in ((k, errors[k]) for k in DRAWN):
            style = (
                {"color": "black", "linewidth": 2.0} if label == "the model" else {"linewidth": 1.0}
            )
            axis.plot(dt * np.arange(1, STEPS + 1), factor * row[g], label=label, **style)
        axis.set(xlabel="seconds ahead", ylabel=f"{g}, RMSE [{unit}]", ylim=(0, None))
        axis.grid(alpha=0.3)
    axes[1].legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    path.parent.mkdir(parents=True, exist_ok=True)
    with matplotlib.rc_context({"svg.hashsalt": "error budget"}):
        figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)


if __name__ == "__main__":
    main()
