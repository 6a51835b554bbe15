"""`greybox mpc`: identify a plant from one flight, or take a model file, and fly it through the obstacle course.

The demo's controllers, all with the same solver and the same seeds, differ in what they know:

    nominal    what the data sheet says, noise levels from the training flight
    pem        physics with motor lag, rotor drag and centre of mass, fitted
    hybrid     pem and a Gaussian process, mean only
    tube       hybrid, limits tightened by the covariance of the closed loop
    constant   hybrid, every plane moved by one constant that training flights ask for
    cascade    a cascade of PID loops that knows the airframe

    make demo-mpc      (or: python -m scenarios.studies.demo_mpc --out demo_mpc_out)
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from greybox.data import dataset_from_arrays
from greybox.errors import MissingExtraError, ModelError
from greybox.estimation.fit import fit
from greybox.files import file_sha256, read_json, write_json
from greybox.model.identified import IdentifiedModel
from greybox.model.linear import SCHEMA as LINEAR
from greybox.model.model import build_model
from greybox.model.vehicle import read_vehicle
from greybox.residual.files import load_model, save_model
from greybox.residual.hybrid import HybridModel
from greybox.residual.learn import learn
from greybox.residual.noise_levels import refit_noise
from mpc_export.tube.stages import NEEDED
from scenarios.courses import JUDGING_SEEDS, TRAINING_SEEDS, vehicle
from scenarios.plants.flight_log import write_log
from scenarios.plants.vehicle_file import write_vehicle
from scenarios.studies.mpc_campaign import (
    NEAR,
    OBSTACLES,
    Campaign,
    Entry,
    Hangar,
    flights,
    make_folder,
    rehearsed,
    tuned,
    write_segments,
)
from scenarios.studies.mpc_flights import load_course, load_plant, natural_pace
from scenarios.studies.mpc_plant import real_disturbances
from scenarios.studies.tube_mpc import EFFECTS, ERRORS, HELD, SIGMA, training_log

Say = Callable[[str], None]
DEMO_PLANT = "scenarios.courses:vehicle"
SECONDS, POINTS = 40.0, 40
"""Length of the demo's training flight [s], support points of its Gaussian process: enough, and done in a minute."""
FEATURES = (
    "body_velocity.x", "body_velocity.y", "body_velocity.z", "p", "q", "r", "nu1", "nu2", "nu3", "nu4",
)  # fmt: skip
TEXTS = {
    "nominal": "the data sheet's model", "pem": "fitted physics, no tightening",
    "hybrid": "physics and Gaussian process, no tightening",
}  # fmt: skip
REHEARSED, REHEARSALS = (0.5, 1.0, 1.5), 12
"""Standard deviations that are rehearsed on the model itself, and flights for each."""
TUNING = 8
"""Training flights on which touched limits are counted and the constant back-off is chosen."""


def identify(out: Path, say: Say = print) -> dict[str, Path]:
    """Files of the demo's models, nominal, pem and hybrid, from one flight; those of an earlier run are taken as they are.

    Without PyTorch, which trains the Gaussian process, there is no hybrid. Also writes the vehicle file and the
    flight, so that `greybox fit` and `learn` can be run on them by hand.
    """
    files = {n: out / f"{n}.json" for n in ("nominal", "pem", "hybrid")}
    settings = {
        "schema": "greybox.study/1",
        "noise": "each",
        "seconds": SECONDS,
        "points": POINTS,
        "features": list(FEATURES),
    }
    done = out / "identified.json"
    if done.exists() and read_json(done) == settings and all(p.exists() for p in files.values()):
        return files
    plant = vehicle()
    say(f"flying the plant for {SECONDS:g} s, random waypoints with excitation in gusts")
    columns = training_log(SECONDS)
    make_folder(out)
    write_log(out / "training.csv", columns)
    data = dataset_from_arrays(columns.pop("t"), columns, name="training")
    card = read_vehicle(write_vehicle(out / "vehicle.toml", plant, sigma=SIGMA, errors=ERRORS))
    noise = ("force", "torque")
    say("noise levels of the data sheet's model")
    nominal = fit(build_model(card, data.channels, ()), data, initialisation="nominal", disturbance=noise, free=())
    save_model(nominal.model, files["nominal"])
    say("fitting the physics")
    fitted = fit(
        build_model(card, data.channels, EFFECTS), data, initialisation="nominal", disturbance=noise, fixed=HELD
    )
    save_model(fitted.model, files["pem"])
    say("learning what is left")
    try:
        learned = learn(fitted.model, data, features=FEATURES, points=POINTS, seed=0).model
        # the tube's noise is the filter's own: what is calibrated for horizons is so on the flight that was learned from
        save_model(replace(refit_noise(learned, data, each=True), horizon_noise=None), files["hybrid"])
    except MissingExtraError as error:
        say(f"the tube flies on the fitted physics: {error}")
        return {n: files[n] for n in ("nominal", "pem")}
    write_json(done, settings)
    return files


@dataclass(frozen=True, kw_only=True)
class Flown:
    """Everything that a report needs: the campaign's hangar, its controllers, what was tuned, and words about it."""

    hangar: Hangar
    entries: tuple[Entry, ...]
    tuning: dict[str, Any]
    what: dict[str, Any]
    seeds: tuple[int, ...]
    warnings: tuple[str, ...]


def prepare(
    subject: str, out: Path, *, plant: str | None = None, logs: Sequence[str] = (), course: str = OBSTACLES,
    pace: float | None = None, risk: str = "rehearsal",
    flights_: int = 20, level: float = 0.1, seed: int = 0, jobs: int = 1, say: Say = print,
) -> Flown:  # fmt: skip
    """Models, plant, controllers and tuned back-offs of `subject`: "demo" or a model file.

    plant: `module:attribute`; None flies the demo's plant, or the model itself under disturbances that are resampled from
    `logs` or else as identified. pace: how much slower the course is flown; None: 1 for the demo, and for a model what its
    training speeds ask for. risk: how the level becomes standard deviations, "rehearsal" or "boole" (see
    mpc_export/tube/risk.py).
    Raises `ModelError`, `PlantError`, `BuildError`, `FileFormatError`.
    """
    demo = subject == "demo"
    if demo and logs:
        raise ModelError("--log belongs to a model file", got="demo", fix="leave --log out, or name a model.json")
    if plant is not None and logs:
        raise ModelError(
            "--log says what disturbs an identified model", got=f"--plant {plant}", fix="leave one of them out"
        )
    load_course(course)
    if plant is not None:
        load_plant(plant)
    if demo:
        files = identify(out / "models", say)
        main = files.get("hybrid", files["pem"])
    else:
        main = Path(subject)
        files = {"model": main}
    model = _readable(main)
    kept = ""
    if logs:
        kept = str(out / "disturbances.npy")
        write_segments(Path(kept), _disturbances(model, logs))
    if pace is None:
        pace = 1.0 if demo else natural_pace(model, load_course(course))
    used = plant or (DEMO_PLANT if demo else "model")
    campaign = Campaign(out=out, plant=used, model=str(main), pace=pace, course=course, disturbances=kept)
    hangar = Hangar(campaign)
    plain = Entry(
        name=main.stem if demo else "mean",
        text=TEXTS[main.stem] if demo else "the model, no tightening",
        model=str(main),
    )
    say(f"counting touched limits on {TUNING} training flights")
    rows = flights(
        hangar,
        [plain],
        TRAINING_SEEDS[1 : 1 + TUNING],
        jobs=jobs,
        log="tuning.jsonl",
        near=NEAR,
        say=lambda text: say(f"training flights: {text}"),
    )
    tuning: dict[str, Any] = {**tuned(rows, level), "flights": TUNING, "rehearsed": []}
    tuning |= {"kappa": tuning["boole"], "risk": "boole"}
    warnings = []
    if risk == "rehearsal":
        say(f"rehearsing {REHEARSALS} flights at each of {len(REHEARSED)} back-offs against the model itself")
        try:
            found, tuning["rehearsed"] = rehearsed(
                hangar, plain, level, tried=REHEARSED, count=REHEARSALS, jobs=jobs, say=say
            )
            tuning |= {"kappa": found, "risk": "rehearsal"}
        except ModelError as error:
            warnings.append(f"Rehearsals do not bound the risk, so that Boole's inequality does: {error}")
    entries = [
        Entry(name="tube", text=f"{plain.name}, limits tightened by its tube, {100 * level:g} % a flight", model=str(main),
              kappa=tuning["kappa"]),
        Entry(name="constant", text=f"{plain.name}, limits moved by {1e3 * tuning['moved']:.1f} mm", model=str(main),
              moved=tuning["moved"]),
        Entry(name="cascade", text="cascade of PID loops", kind="cascade"),
    ]  # fmt: skip
    before = [Entry(name=n, text=TEXTS[n], model=str(f)) for n, f in files.items() if demo and f != main]
    what = {
        "mode": "demo" if demo else "plant" if plant else "model", "subject": subject, "plant": used, "plain": plain.name,
        "model": model.name, "model_sha256": file_sha256(main), "learned": list(_learned(model)),
        "trained_on": list(model.trained_on), "logs": [Path(p).name for p in logs],
        "mass": float(model.values["mass"]) if "mass" in model.values else None, "disturbed_by": _disturbed(used, logs),
    }  # fmt: skip
    first = JUDGING_SEEDS[0] * (1 + seed)
    return Flown(
        hangar=hangar, entries=(*before, plain, *entries), tuning=tuning, what=what,
        seeds=tuple(range(first, first + flights_)), warnings=tuple(warnings),
    )  # fmt: skip


def _learned(model: IdentifiedModel) -> tuple[str, ...]:
    """Channels of the learned part, in its order; none for physics alone."""
    return tuple(model.dynamics.posterior.outputs.names) if isinstance(model.dynamics, HybridModel) else ()


def _readable(path: Path) -> IdentifiedModel:
    if path.exists() and read_json(path).get("schema") == LINEAR:
        raise ModelError("the tube needs a model with position and attitude", got="a linear model", fix="greybox fit")
    model = load_model(path)
    states = model.dynamics.states.names
    missing = [n for n in NEEDED if not any(s.startswith(f"{n}.") for s in states)]
    if missing:
        raise ModelError(
            f"the tube needs a model with {', '.join(missing)}", got=model.name, fix="fit on flights with pose"
        )
    return model


def _disturbances(model: IdentifiedModel, logs: Sequence[str]) -> list[Any]:
    from greybox.data.logs import read_logs

    return real_disturbances(model, read_logs(list(logs), model.physics.vehicle, rate=1.0 / model.sample_time))


def _disturbed(plant: str, logs: Sequence[str]) -> str:
    if plant != "model":
        return "the plant's own gusts and sensor noise"
    if logs:
        return "force and torque that the smoother found in real flights, resampled in blocks, and the identified noise"
    return "the identified process and sensor noise"


def main(argv: Sequence[str] | None = None) -> int:
    """The short demo, through the command line that a user would type."""
    from greybox.cli import main as greybox

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="demo_mpc_out")
    parser.add_argument("--flights", default="6")
    parser.add_argument("--jobs", default="2")
    arguments = parser.parse_args(argv)
    return greybox(["mpc", "demo", "--flights", arguments.flights, "--jobs", arguments.jobs, "--out", arguments.out])


if __name__ == "__main__":
    raise SystemExit(main())
