"""Unannounced shocks in flight: what the tube does that calibrates and learns on the craft, and
what others do.

    python -m scenarios.foreign.draw --seed 25 --simulator rotorpy --out DIR
    greybox fit --vehicle DIR/vehicle.toml --train DIR/train?.csv --test DIR/test?.csv --out DIR/fit
    python -m scenarios.studies.shocks DIR --seeds 1 2 3 --out rows.jsonl
    python -m scenarios.studies.shocks --out rows.jsonl --summary

The plant is a craft of RotorPy or MuJoCo that was drawn by seed (DIR/truth.json, which only the
plant reads), the model what the plain command made of its flights. The path swings along x exactly
in the corner of a wall (y <= 0) and a floor (z >= 1.5 m), so that both limits bind all the time; a
controller has to know how far it must keep off. The true place counts. LEVEL of the time may be
beyond (half for each). A second or so after T0 the shock comes, and stays:

    none; payload: +20 % mass; rotor: one gives 15 % less; wind: 5 m/s toward the wall; battery: 85
    % of the voltage, which the speed of all rotors follows; delay: commands 10 ms later; mocap: no
    pose and velocity for 0.5 s; gusts: 2 m/s more

Controllers: `aware` the tube that calibrates and learns the mass; `tube` the same without; `zoro`
zero-order robust optimisation on acados (the folder of GREYBOX_ACADOS) behind the same filter;
`nominal` the same model, not tightened; `pid` the cascade that flew the training flights, which
knows the true craft before the shock. All but `pid` estimate constant disturbances. Seeds below
1000 develop, those from 1000 on judge.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from time import thread_time
from typing import Any

import numpy as np

from greybox.files import append_json_line, file_sha256, read_json
from greybox.plants.controller import CascadeController, Setpoint
from greybox.residual.files import load_model
from greybox.symbolic import FloatArray
from mpc_export.acados import session
from mpc_export.feedback import Weights
from mpc_export.mission.course import SampledPath
from mpc_export.promise import exact
from mpc_export.tube.controller import TubeController
from mpc_export.tube.on_acados import ZeroOrder
from mpc_export.tube.problem import TubeProblem
from scenarios.foreign.craft import Craft
from scenarios.foreign.draw import draw, plant_of
from scenarios.foreign.flights import gains_for
from scenarios.foreign.plant import ForeignPlant
from scenarios.studies.rows import open_ended, read_rows

DT, SECONDS, T0 = 0.01, 11.0, 4.0
WINDOW = 0.5
"""Rows keep the share of time beyond a limit in windows of this length after the shock [s], and
before it."""
WINDOWS = round((SECONDS - T0 - 1.0) / WINDOW)
"""So many of them, whenever the shock comes."""
SWING, PERIOD, HEIGHT = 1.0, 4.0, 1.5
LEVEL = 0.05
KAPPA = 1.96
"""Standard deviations of either limit: 2.5 % of a Gaussian are beyond."""
LOST = 1.5
"""Farther from the path than this a flight is lost [m]."""
MASS = 0.1
"""Standard deviation of the mass that `aware` allows for, as a share."""
BACK = 3.0
"""Seconds after the shock by which a controller should be back at its level."""
POSE = ("x", "y", "z", "vx", "vy", "vz", "qw", "qx", "qy", "qz")
PLANES = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, -1.0, -HEIGHT]])


class Corner:
    """The path: a swing along x in the corner, from rest; and its limits."""

    def sample(self, time: FloatArray) -> SampledPath:
        """At the times (n,) [s]."""
        t, w = np.maximum(np.asarray(time, dtype=float), 0.0), 2.0 * math.pi / PERIOD
        phase, speed, push = w * (t - 1.0 + np.exp(-t)), w * (1.0 - np.exp(-t)), w * np.exp(-t)
        place, velocity, acceleration = (np.zeros((t.size, 3)) for _ in range(3))
        place[:, 0], place[:, 2] = SWING * np.sin(phase), HEIGHT
        velocity[:, 0] = SWING * speed * np.cos(phase)
        acceleration[:, 0] = SWING * (push * np.cos(phase) - speed**2 * np.sin(phase))
        zero = np.zeros(t.size)
        return SampledPath(
            position=place, velocity=velocity, acceleration=acceleration, yaw=zero, yaw_rate=zero
        )

    def __call__(self, time: FloatArray) -> FloatArray:
        """(n, 2, 4): wall and floor."""
        return np.tile(PLANES, (len(time), 1, 1))


def heavier(craft: Craft, rotor: int) -> Craft:
    """A fifth more mass at the centre of mass."""
    return replace(craft, airframe=replace(craft.airframe, mass=1.2 * float(craft.airframe.mass)))


def weaker(craft: Craft, rotor: int) -> Craft:
    """One rotor gives 15 % less thrust and torque."""
    return replace(craft, uneven=tuple(v - 0.15 * (i == rotor) for i, v in enumerate(craft.uneven)))


def blown(craft: Craft, rotor: int) -> Craft:
    """Wind toward the wall."""
    x, y, z = craft.air.wind
    return replace(craft, air=replace(craft.air, wind=(x, y + 5.0, z)))


def drained(craft: Craft, rotor: int) -> Craft:
    """All rotors at 85 % of their speed."""
    return replace(craft, uneven=tuple(0.85**2 * (1.0 + v) - 1.0 for v in craft.uneven))


def later(craft: Craft, rotor: int) -> Craft:
    """Commands come 10 ms later."""
    return replace(craft, delay=craft.delay + 0.01)


def gusty(craft: Craft, rotor: int) -> Craft:
    """Gusts of 2 m/s more than before on every axis, and a swirl."""
    air = craft.air
    return replace(craft, air=replace(air, gusts=air.gusts + 2.0, swirl=air.swirl + 2.0))


SHOCKS: dict[str, Callable[[Craft, int], Craft] | None] = {
    "none": None,
    "payload": heavier,
    "rotor": weaker,
    "wind": blown,
    "battery": drained,
    "delay": later,
    "mocap": None,
    "gusts": gusty,
}
DROPPED = 0.5
"""Length of the drop-out [s]."""


@dataclass(frozen=True, kw_only=True)
class Kind:
    """How a tube controller is set: tightened by `kappa`, and what it does in flight."""

    kappa: float = KAPPA
    calibrate: bool = False
    learn: bool = False


TUBES = {"aware": Kind(calibrate=True, learn=True), "tube": Kind(), "nominal": Kind(kappa=0.0)}
TUBES["zoro"] = TUBES["tube"]
CONTROLLERS = (*TUBES, "pid")
SLOWEST = 5
"""So many of the longest answers of a flight are kept: its 99.9th percentile is among them."""


class Pid:
    """The cascade of the training flights behind the tube's interface. What is not measured stays
    as it was."""

    def __init__(self, craft: Craft) -> None:
        self.inner, self.path = CascadeController(craft.airframe, gains_for(craft)), Corner()
        self.start()

    def start(self) -> None:
        """Forget everything."""
        self.inner.reset()
        self.u = np.full(len(self.inner.airframe.rotors), float(self.inner.airframe.hover_speed))
        self._seen: dict[str, float] = {}

    def sample(self, time: float, measured: Mapping[str, float]) -> FloatArray:
        """The command from the next sample on."""
        self._seen |= measured
        goal = self.path.sample(np.array([time + DT]))
        place, velocity, acceleration = (
            tuple(v[0].tolist()) for v in (goal.position, goal.velocity, goal.acceleration)
        )
        setpoint = Setpoint(position=place, velocity=velocity, acceleration=acceleration)
        self.u = np.array(self.inner(self._seen, setpoint, DT, (0.0, 0.0, 0.0, 0.0)), dtype=float)
        return self.u


def pilot_of(name: str, folder: Path, craft: Craft, stay: ExitStack) -> Any:
    """The controller of a name for a craft of a folder; `stay` closes what acados needs."""
    if name == "pid":
        return Pid(craft)
    kind, model = TUBES[name], load_model(folder / "fit" / "model.json")
    problem = TubeProblem(
        dt=0.02, horizon=20, planes=len(PLANES), tilt_max=0.8, ancillary=Weights(position=64.0)
    )
    pilot = TubeController(
        model=model,
        problem=problem,
        reference=Corner(),
        planes=Corner(),
        kappa=(kind.kappa,) * (len(PLANES) + 1),
        kappa_u=min(kind.kappa, 1.0),
        calibrate=kind.calibrate,
        adapt={"mass": MASS * model.values["mass"]} if kind.learn else None,
    )
    if name == "zoro":
        home = stay.enter_context(session(os.environ["GREYBOX_ACADOS"]))
        work = Path(stay.enter_context(tempfile.TemporaryDirectory()))
        own: Any = ZeroOrder(pilot.solver, PLANES, kind.kappa, home, work)
        pilot.solver = own
        pilot.start()
    return pilot


def fly(pilot: Any, plant: ForeignPlant, shock: str, seed: int) -> dict[str, Any]:
    """One flight as a row: lost, descended, when the shock came, how far beyond a limit the true
    place was per window."""
    path, craft = Corner(), plant.craft
    random = np.random.default_rng([seed, 7])
    at, rotor = T0 + random.uniform(0.0, 1.0), int(random.integers(len(craft.airframe.rotors)))
    plant.reset(seed, position=(0.0, -0.05, HEIGHT + 0.05))
    pilot.start()
    u, beyond, away, within, changed = np.array(pilot.u), [], [], [], False
    spent: list[float] = []
    steps = round(SECONDS / DT)
    goal = path.sample(np.asarray(DT * np.arange(steps), dtype=float))
    for k in range(steps):
        now = DT * k
        change = SHOCKS[shock]
        if change is not None and not changed and now >= at:
            plant, changed = plant.goes_on_as(change(craft, rotor)), True
        seen = plant.measure()
        if shock == "mocap" and at <= now < at + DROPPED:
            seen = {n: v for n, v in seen.items() if n not in POSE}
        began = thread_time()
        after = np.array(pilot.sample(now, seen))
        spent.append(1e3 * (thread_time() - began))
        within.append(_within(pilot))
        true = plant.states()
        place = np.array([true[n] for n in "xyz"])
        beyond.append(float(np.max(PLANES[:, :3] @ place - PLANES[:, 3])))
        away.append(float(np.linalg.norm(place - goal.position[k])))
        # who lands has left the path on purpose; the limits still count
        if not away[-1] < LOST and not _lands(pilot):
            break
        plant.step(u.tolist(), DT)
        u = after
    return (
        row_of(np.array(beyond), np.array(away), at, steps)
        | coverage(np.array(within), at)
        | {
            "shock": shock,
            "seed": seed,
            "at": at,
            "descended": _lands(pilot),
            "step_ms": round(float(np.median(spent)), 2),
            "slowest_ms": np.round(np.sort(spent)[-SLOWEST:], 2).tolist(),
        }
    )


def _lands(pilot: Any) -> bool:
    return isinstance(pilot, TubeController) and pilot.descending


def _within(pilot: Any) -> tuple[float, float, int]:
    """Errors of forecasts due at this sample: how many are inside calibrated and inside stated
    intervals, of all."""
    own = pilot.estimator.calibrated if isinstance(pilot, TubeController) else None
    if own is None:
        return 0.0, 0.0, 0
    return (
        float(np.nansum(own.held)),
        float(np.nansum(own.stated)),
        int(np.isfinite(own.held).sum()),
    )


def coverage(within: FloatArray, at: float) -> dict[str, Any]:
    """Shares of errors up to 0.5 s ahead inside 95 % intervals, from rows (n, 3) of `_within`:
    before and per window after the shock, calibrated (`held`) and as the model states them
    (`stated`); none where nothing is calibrated."""
    if not within[:, 2].any():
        return {}
    first, size = round(at / DT), round(WINDOW / DT)
    parts = [within[round(1.0 / DT) : first]]
    parts += [within[k : k + size] for k in range(first, len(within) - size + 1, size)]
    held, stated = (
        [round(float(p[:, i].sum() / max(p[:, 2].sum(), 1.0)), 4) for p in parts if p[:, 2].any()]
        for i in (0, 1)
    )
    return {"held": held, "stated": stated}


def row_of(beyond: FloatArray, away: FloatArray, at: float, steps: int) -> dict[str, Any]:
    """What a row says of distances beyond the limits and from the path (n,) [m]; n < steps: lost,
    beyond from then on."""
    lost = len(beyond) < steps
    first, size = round(at / DT), round(WINDOW / DT)
    bad = np.concatenate([beyond > 0.0, np.ones(steps - len(beyond))])
    windows = [bad[k : k + size] for k in range(first, first + WINDOWS * size, size)]
    settled = bad[round(2.0 / DT) : first]
    return {
        "lost": lost,
        "before": round(float(settled.mean()), 4),
        "after": [round(float(w.mean()), 4) for w in windows],
        "deepest": round(1e3 * float(max(beyond[first:].max(initial=0.0), 0.0)), 1),
        "away": round(1e3 * float(np.mean(away[round(2.0 / DT) :])), 1),
    }


def back(rows: Sequence[Mapping[str, Any]]) -> float:
    """Seconds after the shock from which on the mean share beyond in all later windows together
    keeps LEVEL; infinite: never."""
    share = np.mean([r["after"][:WINDOWS] for r in rows], axis=0)
    for k in range(len(share)):
        if share[k] <= LEVEL and share[k:].mean() <= LEVEL:
            return WINDOW * k
    return math.inf


def summary(rows: Sequence[Mapping[str, Any]]) -> str:
    """The table in Markdown: one line per shock and controller."""
    lines = [
        f"| shock | controller | flights | lost, landing | beyond before | 0 to {BACK:g} s after | "
        "later | flights above the level later (95 %) | back after | deepest | from the path | "
        f"errors inside calibrated and stated 95 %, 0 to {BACK:g} s after | later |",
        "|" + "---|" * 13,
    ]
    for shock in SHOCKS:
        for name in CONTROLLERS:
            mine = [r for r in rows if r["shock"] == shock and r["controller"] == name]
            if not mine:
                continue
            cut = round(BACK / WINDOW)
            early, late = (
                np.array([np.mean(r["after"][s]) for r in mine])
                for s in (slice(0, cut), slice(cut, WINDOWS))
            )
            bad = int(np.sum(late > LEVEL))
            low, high = exact(bad, len(mine))
            when = back(mine)
            lines.append(
                f"| {shock} | {name} | {len(mine)} | {sum(r['lost'] for r in mine)}, "
                f"{sum(r['descended'] for r in mine)} | "
                f"{100 * np.mean([r['before'] for r in mine]):.1f} % | {100 * early.mean():.1f} % "
                f"| {100 * late.mean():.1f} % | {bad} ({100 * low:.0f} to {100 * high:.0f} %) | "
                f"{f'{when:g} s' if math.isfinite(when) else 'never'} | "
                f"{max(r['deepest'] for r in mine):.0f} mm | "
                f"{np.mean([r['away'] for r in mine]):.0f} mm | {_shares(mine, slice(1, 1 + cut))} "
                f"| {_shares(mine, slice(1 + cut, None))} |"
            )
    return "\n".join(lines)


def _shares(rows: Sequence[Mapping[str, Any]], windows: slice) -> str:
    """Mean shares inside calibrated and stated intervals in these windows; a dash where nothing is
    calibrated."""
    both = [
        [np.mean(r[n][windows]) for r in rows if r.get(n, [])[windows]] for n in ("held", "stated")
    ]
    return ", ".join(f"{100 * np.mean(v):.1f}" for v in both) + " %" if both[0] else "-"


def run(
    folder: Path, shocks: Sequence[str], names: Sequence[str], seeds: Sequence[int], out: Path
) -> None:
    """Fly what `out` has no row of yet, and keep a row of every flight."""
    truth, model = read_json(folder / "truth.json"), file_sha256(folder / "fit" / "model.json")[:12]
    drawn = draw(int(truth["seed"]), truth["simulator"], truth["hidden"])
    plant = plant_of(drawn)
    if not isinstance(plant, ForeignPlant):
        raise SystemExit(f"{folder}: flown by {truth['simulator']}; expected rotorpy or mujoco")
    which = {"craft": drawn.seed, "simulator": drawn.simulator, "model": model}
    there = {
        (r["craft"], r["model"], r["shock"], r["controller"], r["seed"]) for r in read_rows(out)
    }
    pilots: dict[str, Any] = {}
    with ExitStack() as stay:
        for seed in seeds:
            for shock in shocks:
                for name in names:
                    if (drawn.seed, model, shock, name, seed) in there:
                        continue
                    pilots[name] = pilots.get(name) or pilot_of(name, folder, drawn.craft, stay)
                    row: dict[str, Any] = (
                        which | {"controller": name} | fly(pilots[name], plant, shock, seed)
                    )
                    append_json_line(out, row)
                    late = np.mean(row["after"][round(BACK / WINDOW) :])
                    print(
                        f"{shock:8} {name:8} flight {seed}: {100 * row['before']:5.1f} % beyond "
                        f"before, {100 * late:5.1f} % "
                        f"later, deepest {row['deepest']:.0f} mm{', lost' if row['lost'] else ''}",
                        flush=True,
                    )


def main(argv: Sequence[str] | None = None) -> None:
    """Fly and keep rows, or sum them up."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "folder", type=Path, nargs="?", help="a drawn craft with fit/model.json in it"
    )
    parser.add_argument("--shocks", nargs="+", choices=tuple(SHOCKS), default=tuple(SHOCKS))
    parser.add_argument("--controllers", nargs="+", choices=CONTROLLERS, default=CONTROLLERS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[1])
    parser.add_argument("--out", type=Path, required=True, metavar="rows.jsonl")
    parser.add_argument("--summary", action="store_true", help="sum up the rows that are there")
    options = parser.parse_args(argv)
    if not options.summary:
        open_ended(options.out, parser)
        if options.folder is None:
            parser.error("name the folder of a drawn craft, or --summary")
        if "zoro" in options.controllers and "GREYBOX_ACADOS" not in os.environ:
            parser.error("zoro needs acados: set GREYBOX_ACADOS to its folder, or leave zoro out")
        for needed in ("truth.json", "fit/model.json"):
            if not (options.folder / needed).is_file():
                parser.error(
                    f"{options.folder} has no {needed}: draw the craft and fit it first, as --help "
                    "says"
                )
        run(options.folder, options.shocks, options.controllers, options.seeds, options.out)
    print(summary(read_rows(options.out)))


if __name__ == "__main__":
    main()
