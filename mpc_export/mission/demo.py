"""The demo of `greybox mpc`: the craft of the obstacle course flies once, and three models are
identified from that flight.

    make demo-mpc      (or: python -m mpc_export.mission.demo --out demo_mpc_out)

The models differ in what they know:

    nominal    what the data sheet says, noise levels from the training flight
    pem        physics with motor lag, rotor drag and centre of mass, fitted
    hybrid     pem and a Gaussian process
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from greybox.data import Dataset, dataset_from_arrays
from greybox.estimation.fit import fit
from greybox.excitation.injection import rich_excitation
from greybox.excitation.waypoints import RandomWaypoints
from greybox.files import read_json, write_json
from greybox.model.identified import IdentifiedModel
from greybox.model.model import build_model
from greybox.model.vehicle import read_vehicle
from greybox.plants.flight_log import fly, write_log
from greybox.plants.presets import controller_for
from greybox.plants.vehicle_file import write_vehicle
from greybox.progress import TimeLeft
from greybox.residual.files import save_model
from greybox.residual.learn import learn
from greybox.residual.noise_levels import refit_noise
from greybox.symbolic import FloatArray
from mpc_export.mission import TRAINING_SEEDS
from mpc_export.mission.campaign import make_folder
from mpc_export.mission.craft import vehicle

PLANT = "mpc_export.mission.craft:vehicle"
SECONDS, POINTS = 40.0, 40
"""Length of the demo's training flight [s], support points of its Gaussian process: enough, and
done in a minute."""
FEATURES = (
    "body_velocity.x",
    "body_velocity.y",
    "body_velocity.z",
    "p",
    "q",
    "r",
    "nu1",
    "nu2",
    "nu3",
    "nu4",
)
EFFECTS = ("motor_lag", "rotor_drag", "center_of_mass_offset")
HELD = ("center_of_mass_offset.c_z",)
"""A moment along the speed is flapping or a vertical offset: an offset is found on a balance, so it
stays at zero here."""
SIGMA = {"inertia": 0.2, "thrust.c2": 0.2, "torque.c2": 0.3}
ERRORS = {"inertia": 1.1, "thrust.c2": 0.92, "torque.c2": 1.1}


def training_log(seconds: float) -> dict[str, FloatArray]:
    """Columns of one log: random waypoints at up to 4.5 m/s with excitation, in the gusts of the
    course."""
    plant = vehicle()
    path = RandomWaypoints(box=(2.0, 2.0, 0.4), speed=4.5, shortest=0.9, longest=1.8, yaw_swing=1.0)
    log = fly(
        plant,
        controller_for(plant),
        path,
        rich_excitation(0.4),
        seconds,
        seed=TRAINING_SEEDS[0],
        warm_up=1.0,
    )
    return {n: v for n, v in log.items() if not n.startswith("omega")}


def identify(out: Path, say: Callable[[str], None] = print) -> dict[str, Path]:
    """Files of the demo's models, nominal, pem and hybrid, from one flight; those of an earlier run
    are taken as they are.

    Also writes the vehicle file and the flight, so that `greybox fit` and `learn` can be run on
    them by hand.
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
    nominal = fit(
        build_model(card, data.channels, ()),
        data,
        initialisation="nominal",
        disturbance=noise,
        free=(),
    )
    save_model(nominal.model, files["nominal"])
    say("fitting the physics")
    fitted = fit(
        build_model(card, data.channels, EFFECTS),
        data,
        initialisation="nominal",
        disturbance=noise,
        fixed=HELD,
    )
    save_model(fitted.model, files["pem"])
    save_model(_learned(fitted.model, data, say), files["hybrid"])
    write_json(done, settings)
    return files


def _learned(model: IdentifiedModel, data: Dataset, say: Callable[[str], None]) -> IdentifiedModel:
    """The fitted physics with a Gaussian process on what is left."""
    say("learning what is left")
    left = TimeLeft()

    def learning(text: str, share: float) -> None:
        say(f"{100 * share:3.0f} %  {text}{left.after(share)}")

    learned = learn(model, data, features=FEATURES, points=POINTS, seed=0, progress=learning).model
    say("noise levels of what was learned")
    # the tube's noise is the filter's own: what is calibrated for horizons is so on the flight
    # that was learned from
    return replace(refit_noise(learned, data, each=True), horizon_noise=None)


def main(argv: Sequence[str] | None = None) -> int:
    """The short demo, through the command line that a user would type."""
    from greybox.cli import main as greybox

    parser = argparse.ArgumentParser(
        description="The demo of `greybox mpc`: the craft of the obstacle course flies once, three "
        "models are identified from that flight (data sheet, fitted physics, physics with a "
        "Gaussian process) and each flies the course."
    )
    parser.add_argument("--out", default="demo_mpc_out")
    parser.add_argument("--flights", default="6")
    parser.add_argument("--jobs", default="2")
    arguments = parser.parse_args(argv)
    return greybox(
        [
            "mpc",
            "demo",
            "--flights",
            arguments.flights,
            "--jobs",
            arguments.jobs,
            "--out",
            arguments.out,
        ]
    )


if __name__ == "__main__":
    raise SystemExit(main())
