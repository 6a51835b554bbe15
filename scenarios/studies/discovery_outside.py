"""What discover says about effects that its catalogue does not have, and about known families in
another form.

    python -m scenarios.studies.discovery_outside [--seeds 1001 1002] [--only magnet,wall] [--learn]
    [--report] [--out F]

Five of the effects were invented by somebody who did not know the search (`UNSEEN`).

Training flights of 16 s and one test flight of a 250 mm vehicle, closed loop, inertia, thrust and
torque coefficients ten per cent off with honest sigmas. Seeds below 1000 were used for development,
results are those of seeds from 1000 on. Per case one line in the file as soon as it is done, so
that a study that was stopped goes on where it was:

    names      effects that were named and survived; of an outside effect every one is wrong, of a relative those that
               are not of its family are
    flagged    the axes of force and torque that are called unnamed; right if one of them is an axis that the effect acts on
    closed     share of the gap 0.5 s ahead on the test flight that names and proposals closed together, in the group of
               channels that the effect moves most: that whose error is largest against the one of
               the same vehicle without the effect, which is the least that a model can reach
    learned    with --learn: the same share with a Gaussian process that learned what names and written laws leave
               (`greybox learn model_with_laws.json --place`, extra gp)
"""

from __future__ import annotations

import argparse
import functools
import importlib.util
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from greybox.data import Dataset
from greybox.data.lead import without_lead_in
from greybox.discovery.cause import offer
from greybox.discovery.evidence import Flights
from greybox.discovery.result import Discovery
from greybox.discovery.workflow import discover
from greybox.errors import GreyboxError
from greybox.excitation.waypoints import RandomWaypoints
from greybox.files import append_json_line
from greybox.plants.effects import PlantEffect
from greybox.plants.presets import x250
from greybox.plants.quadrotor import Quadrotor
from greybox.validation.gap import NOTHING, predict_ahead
from scenarios.plants import outside
from scenarios.studies.discovery_cells import dataset, logs, vehicle_of
from scenarios.studies.discovery_oracle import AHEAD, ahead
from scenarios.studies.rows import open_ended, read_rows


@dataclass(frozen=True, kw_only=True)
class Case:
    """A hidden effect, the axes it acts on, and the catalogue's names of its family (none: outside
    the catalogue)."""

    hidden: PlantEffect
    axes: tuple[str, ...]
    family: tuple[str, ...] = ()


LATERAL = ("force.x", "force.y")
ROLL_PITCH = ("torque.x", "torque.y")
TURNS = (*ROLL_PITCH, "torque.z")
CASES = {
    "magnet": Case(hidden=outside.Magnet(m=3e-3), axes=TURNS),
    "sloshing_mass": Case(hidden=outside.SloshingMass(mass=0.03), axes=(*LATERAL, *ROLL_PITCH)),
    "thrust_gap": Case(hidden=outside.ThrustGap(depth=0.2), axes=("force.z", *TURNS)),
    "wall": Case(hidden=outside.Wall(pull=0.6, arm=0.01), axes=(*LATERAL, *ROLL_PITCH)),
    "warm_motors": Case(hidden=outside.WarmMotors(fade=0.1), axes=("force.z",)),
    "tether": Case(hidden=outside.Tether(stiffness=0.1, weight=0.15), axes=(*LATERAL, "force.z")),
    "power_drag": Case(
        hidden=outside.PowerDrag(c=0.12),
        axes=(*LATERAL, "force.z"),
        family=("parasitic_drag", "linear_drag", "rotor_drag"),
    ),
    "quadratic_damping": Case(
        hidden=outside.QuadraticDamping(d=4e-3), axes=TURNS, family=("rotational_damping",)
    ),
    "exponential_ground": Case(
        hidden=outside.ExponentialGround(a=0.4), axes=("force.z",), family=("ground_effect",)
    ),
    "relaxing_drag": Case(
        hidden=outside.RelaxingDrag(k=0.25),
        axes=(*LATERAL, "force.z"),
        family=("rotor_drag", "linear_drag", "parasitic_drag"),
    ),
    "hysteretic_damping": Case(
        hidden=outside.HystereticDamping(d=3e-3), axes=TURNS, family=("rotational_damping",)
    ),
    "munk_moment": Case(hidden=outside.MunkMoment(k=4e-3), axes=("torque.y", "torque.z")),
    "air_outlet": Case(hidden=outside.AirOutlet(loss=0.2), axes=("force.z", *ROLL_PITCH)),
    "plate_in_wake": Case(hidden=outside.PlateInWake(load=0.09), axes=("force.z", *ROLL_PITCH)),
    "loose_arm": Case(hidden=outside.LooseArm(tilt=0.03), axes=(*LATERAL, "torque.z")),
    "returning_wake": Case(hidden=outside.ReturningWake(push=0.6), axes=(*LATERAL, "force.z")),
}
UNSEEN = ("munk_moment", "air_outlet", "plate_in_wake", "loose_arm", "returning_wake")
"""Invented by another hand, and flown for the first time when the search was finished."""


def flights(plant: Quadrotor, seeds: Sequence[int], seconds: float, name: str) -> Dataset:
    """One flight per seed through random waypoints that also turn, without rotor speeds."""
    return dataset(logs(plant, seeds, seconds, RandomWaypoints(yaw_swing=1.5)), name)


@functools.cache
def least(seed: int, seconds: float = 16.0) -> dict[str, float]:
    """Group -> RMSE half a second ahead of the vehicle without any effect, fitted to and judged on
    flights of the seed."""
    first = 1000 * seed
    train, test = (
        flights(x250(), [first + k for k in ks], seconds, name)
        for ks, name in (((1, 2), "a"), ((101,), "b"))
    )
    causes = offer(vehicle_of(x250()), train.channels, sample_time=0.01)
    searched = Flights(causes=causes, data=without_lead_in(train))
    return ahead(predict_ahead(searched.settled(searched.fit(causes.base)).model, test))


def learned(found: Discovery, train: Dataset, test: Dataset, seed: int) -> dict[str, Any]:
    """Group -> RMSE half a second ahead on `test` of what was found, laws included, with what was
    learned of the rest."""
    from greybox.residual.learn import learn

    try:
        result = learn(found.lawful or found.model, train, place=True, seed=seed)
        errors = predict_ahead(result.model, test).own
    except GreyboxError as error:  # what was searched for minutes is kept
        return {"rmse": {}, "chosen": None, "error": str(error)}
    rmse = {
        g: float(np.sqrt(np.concatenate(rows).mean()))
        for (g, s), rows in errors.items()
        if s == AHEAD
    }
    return {
        "rmse": rmse,
        "chosen": None if result.null else result.chosen,
        "seconds": result.seconds,
    }


def affected(
    gap: Sequence[Mapping[str, Any]], least: Mapping[str, float]
) -> tuple[str, float] | None:
    """(group that the effect moves most, share of its excess over the `least` error that was
    closed), from gap rows."""
    rows = [
        r
        for r in gap
        if r["closed"] is not None
        and r["before"] ** 2 > NOTHING * least.get(r["group"], np.inf) ** 2
    ]
    row = max(rows, key=lambda r: r["before"] / least[r["group"]], default=None)
    if row is None:
        return None
    share = max(row["closed"], row.get("with_proposals") or row["closed"])
    gained = share * (row["before"] ** 2 - (row["floor"] or 0.0) ** 2)
    return row["group"], gained / (row["before"] ** 2 - least[row["group"]] ** 2)


def by_learning(row: Mapping[str, Any], least: Mapping[str, float]) -> float | None:
    """`affected` for the errors with a learned rest; None for a row without."""
    group = (affected(row["gap"], least) or (None,))[0]
    rmse = row.get("learned", {}).get("rmse", {})
    if group is None or group not in rmse:
        return None
    before = next(r["before"] for r in row["gap"] if r["group"] == group)
    return float((before**2 - rmse[group] ** 2) / (before**2 - least[group] ** 2))


def judge(found: Discovery, case: Case) -> dict[str, Any]:
    """Names, flags and shares as plain values."""
    content = found.to_dict()
    names = [e["name"] for e in content["effects"]]
    flagged = [u["channel"] for u in content["unnamed"]]
    half = [r for r in content["gap"] if r["horizon_s"] == AHEAD]
    return {
        "verdict": found.verdict,
        "names": names,
        "traces": [t["name"] for t in content["traces"]],
        "wrong": [n for n in names if n not in case.family],
        "ambiguous": [[c["name"] for c in a["candidates"]] for a in content["ambiguous"]],
        "flagged": flagged,
        "right_axis": any(a in case.axes for a in flagged),
        "unnamed": content["unnamed"],
        "gap": half,
        "seconds": found.seconds,
        "warnings": content["warnings"],
    }


def run(name: str, seed: int, seconds: float = 16.0, *, learn: bool = False) -> dict[str, Any]:
    """One case; with what is left learned, if asked."""
    case = CASES[name]
    plant = x250([case.hidden])
    first = 1000 * seed
    train = flights(plant, (first + 1, first + 2), seconds, "train")
    test = flights(plant, (first + 101,), seconds, "test")
    found = discover(vehicle_of(x250()), train, test, seed=seed)
    row = {"case": name, "seed": seed, **judge(found, case)}
    return row | {"learned": learned(found, train, test, seed)} if learn else row


def report(rows: Sequence[dict[str, Any]]) -> str:
    """Rates per case and over all."""
    lines = [
        f"{'case':20s} {'runs':>4s} {'wrong name':>10s} {'flagged':>8s} {'right axis':>10s} "
        f"{'closed: median, worst':>22s}{'with a learned rest (n)':>26s}"
    ]
    for name in [*CASES, "outside", "relatives", "unseen", "all"]:
        own = [
            r
            for r in rows
            if r["case"] == name
            or name == "all"
            or (name == "outside" and not CASES[r["case"]].family)
            or (name == "relatives" and CASES[r["case"]].family)
            or (name == "unseen" and r["case"] in UNSEEN)
        ]
        if not own:
            continue
        named = [a[1] for r in own if (a := affected(r["gap"], least(r["seed"]))) is not None]
        taught = [s for r in own if (s := by_learning(r, least(r["seed"]))) is not None]
        lines.append(
            f"{name:20s} {len(own):4d} {sum(bool(r['wrong']) for r in own):10d} "
            f"{sum(bool(r['flagged']) for r in own):8d} {sum(r['right_axis'] for r in own):10d} "
            f"{_spread(named):>22s}{_spread(taught):>20s} ({len(taught):3d})"
        )
    return "\n".join(lines)


def _spread(shares: Sequence[float]) -> str:
    """Median and worst."""
    return f"{median(shares):.3f}, {min(shares):5.3f}" if shares else "-"


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what is not in the file yet, then print the table."""
    parser = argparse.ArgumentParser(description="discover on effects outside its catalogue.")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--only", default=None, help="comma-separated cases")
    parser.add_argument("--out", default="discovery_outside.jsonl")
    parser.add_argument("--report", action="store_true", help="only print the table of the file")
    parser.add_argument(
        "--learn", action="store_true", help="also learn what names and laws leave (extra gp)"
    )
    options = parser.parse_args(arguments)
    path = Path(options.out)
    if not options.report:
        open_ended(path, parser)
    rows = read_rows(path)
    if options.learn and importlib.util.find_spec("gpytorch") is None:
        parser.error("--learn needs the extra gp")
    done = {(r["case"], r["seed"]) for r in rows if not options.learn or "learned" in r}
    wanted = options.only.split(",") if options.only else list(CASES)
    for seed in () if options.report else options.seeds:
        for name in wanted:
            if (name, seed) in done:
                continue
            row = run(name, seed, learn=options.learn)
            rows.append(row)
            append_json_line(path, row)
            laws = "; ".join(u["proposal"] or u["channel"] for u in row["unnamed"])
            print(
                f"{seed:5d} {name:18s} {row['verdict']:16s} {', '.join(row['names']) or '-':30s} | "
                f"{laws or '-'} ({row['seconds']:.0f} s)",
                flush=True,
            )
    print(report(list({(r["case"], r["seed"]): r for r in rows}.values())))


if __name__ == "__main__":
    main()
