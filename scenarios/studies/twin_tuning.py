"""Gains searched in a twin, flown on a plant that nobody fitted them to: the identified twin, the
numbers of the vehicle file, a box of +-30 % about these, and both again with a motor lag as the
vehicle templates have it (a vehicle file of a stranger has none, which alone may lose a craft).

    python -m scenarios.studies.twin_tuning DIR [DIR ...] [--out F.json]

Each DIR is a craft of `python -m scenarios.foreign.campaign` (vehicle.toml as a stranger wrote it,
fit/model.json of the plain command, truth.json that only the plant reads). The same cascade of six
gains is searched with the same random candidates and the same seed in each twin, then flies the
foreign plant (gusts and all) on paths it was not tuned on. Feedback is the true state for
everybody, so that nothing but the twin differs. A controller knows mass, inertia and thrust as its
twin does.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from greybox.files import read_json, write_json
from greybox.model.identified import IdentifiedModel
from greybox.model.vehicle import read_vehicle
from greybox.model.vehicle_parts import Quantity
from greybox.residual.files import load_model
from greybox.simulators.coverage import BOX
from greybox.simulators.craft import Craft
from greybox.simulators.data_sheet import model_of
from greybox.simulators.draws import draw
from greybox.simulators.targets.numpy_module import NumPyModule
from greybox.symbolic import FloatArray
from scenarios.foreign.draw import draw as draw_plant
from scenarios.foreign.draw import plant_of

DT, SECONDS, CANDIDATES, DRAWS, ROUNDS = 0.01, 8.0, 48, 6, 3
RADIUS, CLIMB, CENTER = 1.2, 0.3, np.array([0.0, 0.0, 1.5])
TUNED, FLOWN = (3.6,), (3.2, 4.5, 5.5)
"""Periods [s] of the figure eights that gains are searched on, and of those flown."""
LAG = Quantity(value=0.04, sigma=0.02)
"""Motor lag [s] of the templates `x` and `plus` of `greybox vehicle new`."""
LOST = 3.0
"""Distance from the path [m] from which on a flight is lost; it counts as so far."""
FIRST = np.array([4.0, 3.0, 8.0, 12.0, 3.0, 3.0])
"""Middle of the search: position, velocity, attitude, rate, yaw, yaw rate; first spread by a factor
of e^0.7."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Known:
    """What a controller believes of its craft."""

    mass: float
    inertia: FloatArray
    arms: FloatArray
    spins: FloatArray
    thrust: FloatArray
    ratio: float
    curve: float
    gravity: float

    @classmethod
    def of(cls, craft: Craft) -> Known:
        """From an identified model or a data sheet."""
        nu = craft.hover_nu
        pull = float(np.polyval(craft.thrust[::-1], nu))
        return cls(
            mass=craft.mass,
            inertia=np.diag(craft.inertia),
            arms=craft.arms,
            spins=craft.spins,
            thrust=craft.thrust,
            ratio=float(np.polyval(craft.torque[::-1], nu)) / pull,
            curve=craft.get("thrust_curve.f"),
            gravity=craft.gravity,
        )


def path(t: float, period: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Position, velocity and acceleration (3,) of a figure eight that begins at rest over two
    seconds."""
    w, h = 2 * math.pi / period, 1e-3

    def at(s: float) -> FloatArray:
        a = w * (s - 1.0 + math.exp(-s))
        return CENTER + np.array(
            [RADIUS * math.sin(a), 0.5 * RADIUS * math.sin(2 * a), CLIMB * math.sin(a)]
        )

    before, here, after = at(t - h), at(t), at(t + h)
    return here, (after - before) / (2 * h), (after - 2 * here + before) / h**2


def command(known: Known, gains: FloatArray, x: FloatArray, t: float, period: float) -> FloatArray:
    """Commands (m, n) of craft in states x (m, 13), gains (m, 6): cascade of position, attitude and
    rate (Lee, Leok and McClamroch 2010, CDC, with the thrust direction alone)."""
    place, velocity, acceleration = path(t, period)
    k = gains.T
    up = k[0][:, None] * (place - x[:, :3]) + k[1][:, None] * (velocity - x[:, 3:6]) + acceleration
    up = up + np.array([0.0, 0.0, known.gravity])
    q, rate = x[:, 6:10], x[:, 10:13]
    z = np.stack(
        [
            2 * (q[:, 1] * q[:, 3] + q[:, 0] * q[:, 2]),
            2 * (q[:, 2] * q[:, 3] - q[:, 0] * q[:, 1]),
            1 - 2 * (q[:, 1] ** 2 + q[:, 2] ** 2),
        ],
        axis=-1,
    )
    pull = known.mass * np.clip(np.sum(up * z, axis=-1), 0.3 * known.gravity, 2.0 * known.gravity)
    wanted = up / np.linalg.norm(up, axis=-1, keepdims=True)
    tilt = np.cross(z, wanted)  # world; into body axes
    error = _into_body(q, tilt)
    yaw = np.arctan2(
        2 * (q[:, 0] * q[:, 3] + q[:, 1] * q[:, 2]), 1 - 2 * (q[:, 2] ** 2 + q[:, 3] ** 2)
    )
    goal = np.stack([k[2] * error[:, 0], k[2] * error[:, 1], -k[4] * yaw], axis=-1)
    moment = known.inertia * np.stack([k[3], k[3], k[5]], axis=-1) * (goal - rate)
    n = len(known.spins)
    matrix = np.stack([np.ones(n), known.arms[:, 1], -known.arms[:, 0], -known.spins * known.ratio])
    force = np.concatenate([pull[:, None], moment], axis=-1) @ np.linalg.pinv(matrix).T
    c0, c1, c2 = known.thrust
    need = np.maximum(force - c0, 0.0)
    nu = (np.sqrt(c1 * c1 + 4 * c2 * need) - c1) / (2 * c2) if c2 else need / c1
    f = known.curve
    u = nu if f == 0 else (np.sqrt((1 - f) ** 2 + 4 * f * nu) - (1 - f)) / (2 * f)
    return np.clip(u, 0.0, 1.0)


def _into_body(q: FloatArray, v: FloatArray) -> FloatArray:
    w, u = q[:, :1], -q[:, 1:]
    return np.asarray(v + 2 * np.cross(u, np.cross(u, v) + w * v))


def in_twin(
    module: dict[str, Any], values: FloatArray, known: Known, gains: FloatArray, period: float
) -> FloatArray:
    """Root mean square distance from the path (m,) of each craft, which has its values (m, n_p) and
    gains (m, 6)."""
    x0 = np.array(module["START"])
    x0[:3] = path(0.0, period)[0]
    sim = module["Simulator"](craft=len(values), parameters=values, x=x0)
    square, extra = np.zeros(len(values)), len(module["INPUTS"]) - len(known.spins)
    volt = (
        np.tile(np.array(module["HOVER"])[len(known.spins) :], (len(values), 1))
        if extra
        else np.zeros((len(values), 0))
    )
    lost = np.zeros(len(values), dtype=bool)
    for k in range(round(SECONDS / DT)):
        u = command(known, gains, sim.x[:, :13], k * DT, period)
        x = sim.step(np.hstack([u, volt]))
        off = np.linalg.norm(x[:, :3] - path((k + 1) * DT, period)[0], axis=-1)
        bad = ~np.isfinite(off) | (off > LOST)
        lost |= bad
        sim.x[bad] = x0  # flies on from somewhere; its count stays
        square += np.where(lost, LOST, off) ** 2
    return np.asarray(np.sqrt(square / round(SECONDS / DT)))


def search(module: dict[str, Any], values: FloatArray, known: Known, seed: int) -> FloatArray:
    """Gains (6,) with the least mean distance over the craft `values` (d, n_p): random candidates,
    narrowed twice."""
    random = np.random.default_rng(seed)
    best, width, least = FIRST, 0.7, math.inf
    for _ in range(ROUNDS):
        tried = best * np.exp(width * random.standard_normal((CANDIDATES, len(FIRST))))
        tried[0] = best
        each = np.repeat(tried, len(values), axis=0)
        errors = np.mean(
            [in_twin(module, np.tile(values, (CANDIDATES, 1)), known, each, p) for p in TUNED],
            axis=0,
        )
        mean = errors.reshape(CANDIDATES, -1).mean(axis=1)
        if mean.min() < least:
            least, best = float(mean.min()), tried[int(mean.argmin())]
        width *= 0.5
    return best


def on_plant(plant: Any, known: Known, gains: FloatArray, period: float, seed: int) -> float:
    """Root mean square distance [m] of the foreign plant from the path; `LOST` once it is lost."""
    plant.reset(seed, position=tuple(float(v) for v in path(0.0, period)[0]))
    square, lost = 0.0, False
    for k in range(round(SECONDS / DT)):
        if not lost:
            s = plant.states()
            x = np.array([[*(s[n] for n in STATES)]])
            plant.step([float(v) for v in command(known, gains[None], x, k * DT, period)[0]], DT)
            s = plant.states()
            off = float(
                np.linalg.norm(np.array([s[n] for n in STATES[:3]]) - path((k + 1) * DT, period)[0])
            )
            lost = not off < LOST
        square += LOST**2 if lost else off**2
    return math.sqrt(square / round(SECONDS / DT))


STATES = ("x", "y", "z", "vx", "vy", "vz", "qw", "qx", "qy", "qz", "p", "q", "r")


def study(folder: Path, seed: int) -> dict[str, Any]:
    """One craft: error [m] on the plant by twin and period, and the gains."""
    vehicle, fitted = (
        read_vehicle(folder / "vehicle.toml"),
        load_model(folder / "fit" / "model.json"),
    )
    sheet = model_of(vehicle)
    lagging = model_of(replace(vehicle, effects={**vehicle.effects, "motor_lag": {"tau": LAG}}))
    truth = read_json(folder / "truth.json")
    rows: dict[str, Any] = {}
    for name, model, values in (
        ("vehicle file", sheet, None),
        (f"vehicle file, box of {100 * BOX:.0f} %", sheet, _box(sheet, seed)),
        ("vehicle file with a lag", lagging, None),
        (f"with a lag, box of {100 * BOX:.0f} %", lagging, _box(lagging, seed)),
        ("twin", fitted, None),
        ("twin, calibrated draws", fitted, draw(fitted, DRAWS, seed).values),
    ):
        craft = Craft.of(model)
        space: dict[str, Any] = {"__name__": "simulate"}
        exec(compile(NumPyModule().files(craft)["simulate.py"], "simulate.py", "exec"), space)
        if abs(space["DT"] - DT) > 1e-9:
            raise SystemExit(f"{folder}: the model's samples last {space['DT']} s, not {DT}")
        known = Known.of(craft)
        gains = search(
            space, np.array(space["VALUES"])[None] if values is None else values, known, seed
        )
        plant = plant_of(draw_plant(int(truth["seed"]), truth["simulator"]))
        errors = {f"{p:g}": [on_plant(plant, known, gains, p, s) for s in (1, 2)] for p in FLOWN}
        rows[name] = {"gains": gains.tolist(), "errors": errors}
        mean = {p: float(np.mean(e)) for p, e in errors.items()}
        print(
            f"{folder.name:16} {name:26} "
            + "  ".join(f"{p} s {1e3 * e:6.0f} mm" for p, e in mean.items())
            + "   gains "
            + " ".join(f"{g:.1f}" for g in gains),
            flush=True,
        )
    return rows


def _box(model: IdentifiedModel, seed: int) -> FloatArray:
    """Craft (d, n_p) from the box about a data sheet: what the body has."""
    random = np.random.default_rng([seed, 1])
    craft = Craft.of(replace(model))
    names = [d.name for d in model.dynamics.parameters]
    sensors = {e.name for e in craft.physics.effects if e.stage == "sensor"}
    values = np.tile([float(model.values[n]) for n in names], (DRAWS, 1))
    free = [n.split(".")[0] not in sensors for n in names]
    values[:, free] *= 1.0 + BOX * random.uniform(-1.0, 1.0, (DRAWS, sum(free)))
    return np.asarray(values)


def main(arguments: Sequence[str] | None = None) -> None:
    """Search, fly, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", nargs="+", metavar="DIR")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", metavar="F.json")
    options = parser.parse_args(arguments)
    rows = {Path(f).name: study(Path(f), options.seed) for f in options.folders}
    for name in next(iter(rows.values())):
        errors = [e for r in rows.values() for part in r[name]["errors"].values() for e in part]
        print(
            f"{name:28} mean {1e3 * float(np.mean(errors)):6.0f} mm, median "
            f"{1e3 * float(np.median(errors)):6.0f} mm, "
            f"lost {sum(e > 0.5 * LOST for e in errors)} of {len(errors)}"
        )
    if options.out:
        write_json(options.out, rows)


if __name__ == "__main__":
    main()
