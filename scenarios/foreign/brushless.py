"""A craft that logs its rotor speeds and no commands: draw it, fit it with the plain command, hold
the result to the truth.

    python -m scenarios.foreign.brushless --seeds 1 4 --out DIR
    python -m scenarios.foreign.brushless --rows scenarios/results/brushless_1001.jsonl.gz

The craft is the Crazyflie 2.1 Brushless as the nano-drone benchmark describes it (Busetto, Cereda,
Forgione, Maroni, Piga and Palossi 2026, Nonlinear system identification for a nano-drone benchmark,
Control Engineering Practice 172, arXiv:2512.14450): 45 g, arms of 35 mm along x and y, the
published inertia and thrust per squared speed, speeds from its speed controllers at 100 Hz. Its
rotors' drag torque is taken as 6 mm times the thrust, which is usual for this size. RotorPy flies
it in gusts that push and turn. What telemetry does to the speeds is drawn: all come late, each has
a factor and an offset, some samples are lost and five are impossible. DIR/rows.jsonl keeps one row
per seed, which a second run does not repeat; --rows sums up a file of them. Seeds from 1000 on
judge.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from greybox.plants.airframe import Airframe, x_layout
from greybox.plants.flight_log import Log, write_log
from greybox.plants.noise import SensorNoise
from scenarios.foreign.campaign import (
    DEVIATIONS,
    NOT_USABLE,
    USABLE,
    deviations,
    fit_plainly,
    seconds_of_children,
)
from scenarios.foreign.craft import Air, Craft
from scenarios.foreign.flights import DURATION, TEST, TRAIN, fly_plan
from scenarios.foreign.naming import read_rows
from scenarios.foreign.stranger import Knowledge, vehicle_text

MASS, ARM, SPEED_MAX = 0.045, 0.0353, 2600.0
INERTIA = (2.3951e-5, 2.3951e-5, 3.2347e-5)
THRUST = 3.72e-8
"""Published: [kg], [m], [kg m^2], [N s^2]; `SPEED_MAX` [rad/s] lifts 2.3 times the weight."""
TORQUE = 0.006 * THRUST
LAG = 0.035
"""Time constant of the rotors [s]: typical of this size, and not felt where speeds are measured."""
SENSORS = SensorNoise(
    gyro=0.02,
    accelerometer=0.1,
    attitude=0.002,
    position=0.001,
    velocity=0.01,
    voltage=0.005,
    rotor_speed=3.0,
)
IMPOSSIBLE, WILD = 5, 33000.0
"""So many speeds of a set of flights are so high [rad/s]: a frame that was read wrongly."""
LOST = 0.002
"""Share of speeds that are missing."""
HORIZON = 0.5
PUBLISHED = 0.2268 / 0.3041
"""Best share in rotation of the benchmark's own methods on its real flights: MLP over naive [rad],
mean absolute geodesic angle 0.5 s ahead."""
NAMES = tuple(f"omega{i}" for i in range(1, 5))


@dataclass(frozen=True, kw_only=True)
class Telemetry:
    """What a log does to rotor speeds: `late` [s], `factor` (4,) and `offset` (4,) [rad/s] of each."""

    late: float
    factor: tuple[float, ...]
    offset: tuple[float, ...]

    @classmethod
    def of(cls, seed: int) -> Telemetry:
        """Drawn: 0 to 25 ms late, factors 1 % and offsets 5 rad/s apart."""
        random = np.random.default_rng([seed, 200])
        return cls(
            late=float(random.uniform(0.0, 0.025)),
            factor=tuple((1.0 + 0.01 * random.standard_normal(4)).tolist()),
            offset=tuple((5.0 * random.standard_normal(4)).tolist()),
        )

    def logged(self, log: Log, random: np.random.Generator, spikes: int) -> Log:
        """The log without commands, its speeds as telemetry keeps them."""
        t = log["t"]
        out = {n: v for n, v in log.items() if not (n.startswith(("u", "true.")))}
        for name, factor, offset in zip(NAMES, self.factor, self.offset):
            seen = factor * np.interp(t - self.late, t, log[name]) + offset
            seen = np.round(seen)
            seen[random.random(t.size) < LOST] = np.nan
            out[name] = seen
        for _ in range(spikes):
            out[NAMES[random.integers(4)]][random.integers(t.size)] = WILD
        return out


def craft_of(seed: int) -> Craft:
    """The published craft in drag and gusts of this seed."""
    random = np.random.default_rng([seed, 201])
    frame = Airframe(
        name="brushless nano quadrotor",
        mass=MASS,
        inertia=INERTIA,
        rotors=x_layout(ARM, ARM),
        thrust=(0.0, 0.0, THRUST * SPEED_MAX**2),
        torque=(0.0, 0.0, TORQUE * SPEED_MAX**2),
        speed_max=SPEED_MAX,
        rotor_radius=0.0275,
        gravity=9.81,
    )
    per_rotor = MASS / (4.0 * SPEED_MAX * float(frame.hover_speed))
    air = Air(
        rotor_drag=per_rotor * random.uniform(0.1, 0.4),
        inflow=per_rotor * random.uniform(0.1, 0.4),
        gusts=random.uniform(0.3, 1.0),
        swirl=random.uniform(0.5, 2.0),
        gust_time=random.uniform(0.4, 1.5),
    )
    return Craft(airframe=frame, lag=LAG, air=air)


def write(seed: int, out: Path, *, duration: float = DURATION) -> None:
    """The folder of a seed: vehicle.toml, train1..3.csv, test1..2.csv, truth.json."""
    from scenarios.foreign.rotorpy_plant import RotorPyPlant

    out.mkdir(parents=True, exist_ok=True)
    craft, telemetry = craft_of(seed), Telemetry.of(seed)
    plant = RotorPyPlant(craft, sensors=SENSORS)
    plans = [("train", p) for p in TRAIN] + [("test", p) for p in TEST]
    random = np.random.default_rng([seed, 202])
    spikes = np.bincount(random.integers(len(plans), size=IMPOSSIBLE), minlength=len(plans))
    for k, (kind, plan) in enumerate(plans):
        log = fly_plan(plant, craft, plan, 10 * seed + k, duration=duration)
        number = k + 1 if kind == "train" else k + 1 - len(TRAIN)
        write_log(
            out / f"{kind}{number}.csv", telemetry.logged(log, random, int(spikes[k])), drop=()
        )
    knowledge = Knowledge.of(craft.airframe, np.random.default_rng([seed, 203]))
    text = vehicle_text(craft.airframe, knowledge, SENSORS)
    (out / "vehicle.toml").write_text(text, encoding="utf-8")
    truth = {n: v for n, v in craft.parameters().items() if n != "motor_lag.tau"}
    stated = {"parameters": truth, "telemetry": asdict(telemetry), "air": asdict(craft.air)}
    (out / "truth.json").write_text(json.dumps(stated, indent=2) + "\n", encoding="utf-8")


def fitted(seed: int, out: Path) -> dict[str, Any]:
    """Fit a folder by the plain command; the row of its seed.

    `share`: of the error of holding the last value, by group, half a second ahead. `late`: found,
    its standard error, true [s]. `z`: deviations from the truth in standard errors.
    """
    train, test = (sorted(out.glob(f"{kind}?.csv")) for kind in ("train", "test"))
    before = seconds_of_children()
    run = fit_plainly(out / "vehicle.toml", train, test, out, ())
    seconds = seconds_of_children() - before
    if run.returncode not in (USABLE, NOT_USABLE):
        raise RuntimeError(f"seed {seed}: {run.stderr.strip().splitlines()[-1:]}")
    fit = json.loads((out / "fit" / "fit.json").read_text(encoding="utf-8"))
    judged = json.loads((out / "fit" / "validate.json").read_text(encoding="utf-8"))
    truth = json.loads((out / "truth.json").read_text(encoding="utf-8"))
    z, _ = deviations(fit["parameters"], truth["parameters"])
    lag = fit["effective_lag"]
    return {
        "seed": seed,
        "code": run.returncode,
        "seconds": round(seconds, 1),
        "said": run.stdout.splitlines()[0] if run.stdout else "",
        "share": shares(judged),
        "late": [-lag["value"], lag["std"], truth["telemetry"]["late"]],
        "z": z,
    }


def shares(judged: dict[str, Any]) -> dict[str, float]:
    """Error of the model over that of holding the last value, by group, `HORIZON` seconds ahead."""
    found = {}
    for row, rival in zip(judged["horizons"], judged["persistence"]["horizons"], strict=True):
        if math.isclose(row["seconds"], HORIZON):
            found = {
                g: errors["mae"] / rival["groups"][g]["mae"] for g, errors in row["groups"].items()
            }
    return found


def summary(rows: Sequence[dict[str, Any]]) -> str:
    """The table of all rows."""
    z = np.array([v for r in rows for v in r["z"].values()])
    off = np.array([1e3 * abs(r["late"][0] - r["late"][2]) for r in rows])
    groups = list(rows[0]["share"])
    lines = [
        f"{len(rows)} craft: usable {sum(r['code'] == USABLE for r in rows)}; 95 % intervals hold "
        f"{int((abs(z) <= DEVIATIONS).sum())} of {z.size}; lateness found to "
        f"{np.median(off):.2f} ms (at most {off.max():.2f}); median "
        f"{np.median([r['seconds'] for r in rows]):.0f} s of CPU",
        f"share of the last value's error {HORIZON:g} s ahead, median (highest): "
        + ", ".join(
            f"{g} {np.median([r['share'][g] for r in rows]):.2f} "
            f"({max(r['share'][g] for r in rows):.2f})"
            for g in groups
        )
        + f"; best published in rotation, on real flights, {PUBLISHED:.2f}",
    ]
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Fly, fit and sum up."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs=2, metavar=("FIRST", "LAST"))
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for logs and rows.jsonl")
    parser.add_argument("--rows", type=Path, metavar="F", help="rows to sum up, nothing is run")
    arguments = parser.parse_args(argv)
    if (arguments.out is None) == (arguments.rows is None):
        parser.error("--out DIR to run, or --rows F to sum up")
    store = arguments.rows or arguments.out / "rows.jsonl"
    rows = read_rows([store])
    if arguments.seeds and not arguments.rows:
        for seed in range(arguments.seeds[0], arguments.seeds[1] + 1):
            if any(r["seed"] == seed for r in rows):
                continue
            folder = arguments.out / str(seed)
            write(seed, folder)
            rows.append(fitted(seed, folder))
            with store.open("a", encoding="utf-8") as out:
                out.write(json.dumps(rows[-1]) + "\n")
            print(f"seed {seed}: {rows[-1]['said']}", flush=True)
    if not rows:
        parser.error("no rows: --seeds FIRST LAST")
    print(summary(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
