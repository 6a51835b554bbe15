"""Draw a craft by seed and hand it out as a stranger would: a vehicle file that is not quite right,
and flights.

    python -m scenarios.foreign.draw --seed 7 --out DIR [--simulator rotorpy] [--hidden delay ...]

DIR gets vehicle.toml, train1..3.csv, test1..2.csv and truth.json; only truth.json says what is
true. Seeds below 1000 are for development; those from 1000 on judge, and one that was looked at is
spent.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from greybox.plants.airframe import Airframe, plus_layout, x_layout
from greybox.plants.flight_log import Log, write_log
from greybox.plants.noise import SensorNoise
from greybox.plants.quadrotor import Quadrotor
from scenarios.foreign.craft import Air, Craft
from scenarios.foreign.flights import DURATION, TEST, TRAIN, fly_plan
from scenarios.foreign.hidden import with_battery
from scenarios.foreign.in_house import in_house_plant
from scenarios.foreign.plant import ForeignPlant, MissingSimulator
from scenarios.foreign.stranger import Knowledge, nominal_values, vehicle_text
from scenarios.plants.realistic_sensors import Realism, realistic

SIMULATORS = ("plants", "rotorpy", "mujoco", "drone_models")
ON_REQUEST = ("pybullet",)
"""Simulators that are never drawn: a seed stays the craft that it was."""
HIDDEN = ("delay", "center_of_mass", "uneven_rotors", "battery", "wind")
"""What can be hidden in every simulator besides lag, drag and gusts."""
ROTOR_LAW = "rotor_law"
"""Hidden in drone_models only: rotors that follow commands by the law fitted to a Crazyflie."""
SMALLEST, LARGEST = 0.025, 3.0
"""Mass [kg]."""
GRAVITY = 9.81
FIRST_JUDGING_SEED = 1000
QUATERNION_DIGITS = 5
"""Digits after the point that real logs keep of a quaternion."""
FLIGHT_SEEDS = 10
"""Flight k of seed s is flown with the seed 10 s + k."""


@dataclass(frozen=True, kw_only=True)
class Draw:
    """A craft as drawn: who flies it, what is true, how it is measured, and what its owner
    believes.

    realism: None means ideal sensors (white noise). fitted: whose rotors a drone-models craft with
    `rotor_law` has.
    rotor_speeds: whether the logs have them.
    """

    seed: int
    simulator: str
    craft: Craft
    gusts: bool
    sensors: SensorNoise
    realism: Realism | None
    fitted: str | None
    rotor_speeds: bool
    knowledge: Knowledge
    hidden: tuple[str, ...] = ()


def draw(seed: int, simulator: str | None = None, hidden: Sequence[str] = ()) -> Draw:
    """The craft of this seed; `simulator` overrules who flies it and leaves the rest as it was.

    Raises ValueError for a name that is not in SIMULATORS, ON_REQUEST or HIDDEN, and for
    `rotor_law` in another simulator than drone_models.
    """
    choices = (
        ((simulator,) if simulator else (), (*SIMULATORS, *ON_REQUEST)),
        (hidden, (*HIDDEN, ROTOR_LAW)),
    )
    for names, known in choices:
        unknown = sorted(set(names) - set(known))
        if unknown:
            raise ValueError(f"no such choice: {', '.join(unknown)}; there are {', '.join(known)}")
    random = np.random.default_rng([seed, 100])
    drawn = str(random.choice(SIMULATORS))
    chosen = simulator or drawn
    if ROTOR_LAW in hidden and chosen != "drone_models":
        raise ValueError(f"only drone_models can hide {ROTOR_LAW}; seed {seed} flies in {chosen}")
    gusts, real, rotor_speeds = random.random() < 0.5, random.random() < 0.5, random.random() < 0.25
    frame = draw_airframe(np.random.default_rng([seed, 101]), curved=chosen == "drone_models")
    mass = float(frame.mass)
    random = np.random.default_rng([seed, 102])
    lag = float(
        np.clip(0.03 * (mass / 0.03) ** 0.15 * np.exp(0.25 * random.standard_normal()), 0.015, 0.09)
    )
    air = draw_air(frame, np.random.default_rng([seed, 103]), gusts)
    craft = hide(
        Craft(airframe=frame, lag=lag, air=air), hidden, np.random.default_rng([seed, 104])
    )
    sensors = draw_sensors(craft.speed_max, np.random.default_rng([seed, 105]))
    random = np.random.default_rng([seed, 106])
    realism = draw_realism(random)
    fitted = str(random.choice(["cf2x_L250", "cf2x_P250", "cf2x_T350", "cf21B_500"]))
    random = np.random.default_rng([seed, 107])
    return Draw(
        seed=seed,
        simulator=chosen,
        craft=craft,
        gusts=gusts,
        sensors=sensors,
        realism=realism if real else None,
        fitted=fitted if ROTOR_LAW in hidden else None,
        rotor_speeds=rotor_speeds,
        knowledge=Knowledge.of(frame, random),
        hidden=tuple(hidden),
    )


def draw_sensors(speed_max: float, random: np.random.Generator) -> SensorNoise:
    """Sensors that are all better or worse than usual by one factor; speed_max [rad/s]."""
    worse = float(np.exp(0.3 * random.standard_normal()))
    return SensorNoise(
        gyro=0.012 * worse,
        accelerometer=0.08 * worse,
        attitude=0.002 * worse,
        position=0.002 * worse,
        velocity=0.015 * worse,
        voltage=0.005,
        rotor_speed=0.002 * speed_max,
    )


def draw_realism(random: np.random.Generator) -> Realism:
    """What sensors, clocks and links of a real craft do besides white noise."""
    return Realism(
        colour=random.uniform(0.4, 1.2),
        vibration=random.uniform(0.0, 1.0),
        low_pass=random.uniform(25.0, 45.0),
        pose_delay=random.uniform(0.0, 0.02),
        jitter=random.uniform(0.3, 1.0),
        command_step=1e-3,
        lost=random.uniform(0.0, 0.02),
        drift=random.uniform(0.0, 0.3),
    )


def draw_airframe(random: np.random.Generator, *, curved: bool = False) -> Airframe:
    """A quadrotor between 25 g and 3 kg whose other numbers grow with its mass as they do in data
    sheets.

    Anchors: Crazyflie 2 (28 g, arm 46 mm, J 1.4e-5, 2500 rad/s) and AscTec Hummingbird (0.5 kg,
    0.17 m, 3.7e-3, 1500 rad/s). curved: thrust and torque have a linear term, as drone-models'
    fitted rotors do.
    """
    mass = float(np.exp(random.uniform(np.log(SMALLEST), np.log(LARGEST))))
    size = mass / 0.028
    arm = 0.046 * size**0.38 * float(np.exp(0.08 * random.standard_normal()))
    radius = arm * random.uniform(0.45, 0.6)
    tip_speed = min(58.0 * size**0.25, 150.0) * random.uniform(0.9, 1.1)
    xx = mass * arm**2 * random.uniform(0.2, 0.38)
    yy = xx * random.uniform(1.0, 1.25)
    zz = (xx + yy) * random.uniform(0.75, 0.95)
    strongest = mass * GRAVITY / 4.0 * random.uniform(1.8, 3.2)
    ratio = radius * random.uniform(0.16, 0.28)
    stretch = random.uniform(1.0, 1.3)
    if random.random() < 0.2:
        rotors = plus_layout(arm)
    else:
        half = arm / np.sqrt(2.0)
        rotors = x_layout(float(half / stretch**0.5), float(half * stretch**0.5))
    height = 0.1 * arm * random.uniform(0.0, 1.0)
    rotors = tuple(replace(r, position=(r.position[0], r.position[1], height)) for r in rotors)
    # last, so that a craft of another simulator keeps everything else
    bend = random.uniform(-0.12, -0.03) if curved else 0.0
    thrust = (0.0, bend * strongest, (1.0 - bend) * strongest)
    return Airframe(
        name=f"quadrotor of {1000.0 * mass:.0f} g",
        mass=mass,
        inertia=(xx, yy, zz),
        rotors=rotors,
        thrust=thrust,
        torque=(0.0, ratio * thrust[1], ratio * thrust[2]),
        speed_max=tip_speed / radius,
        rotor_radius=radius,
        gravity=GRAVITY,
    )


def draw_air(frame: Airframe, random: np.random.Generator, gusts: bool) -> Air:
    """Drag of 0.1 to 0.4 1/s at hover, body drag of a tenth of the square of the arm, gusts of 0.5
    to 1.5 m/s."""
    hover = float(frame.hover_speed) * float(frame.speed_max or 1.0)
    per_rotor = float(frame.mass) / (len(frame.rotors) * hover)
    arm = max(np.hypot(*rotor.position[:2]) for rotor in frame.rotors)
    side = 0.5 * 1.2 * 0.1 * arm**2 * random.uniform(0.5, 1.5)
    drag, inflow = random.uniform(0.1, 0.4), random.uniform(0.1, 0.4)
    wind, swirl, time = random.uniform(0.5, 1.5), random.uniform(0.5, 2.0), random.uniform(0.4, 1.5)
    air = Air(
        rotor_drag=per_rotor * drag,
        inflow=per_rotor * inflow,
        parasitic=(side, side, 2.0 * side),
        gust_time=time,
    )
    return replace(air, gusts=wind, swirl=swirl) if gusts else air


def hide(craft: Craft, hidden: Sequence[str], random: np.random.Generator) -> Craft:
    """The craft with more that its file does not say; every choice draws its own numbers whether it
    is asked or not."""
    frame = craft.airframe
    arm = max(float(np.hypot(*rotor.position[:2])) for rotor in frame.rotors)
    delay = float(random.uniform(0.005, 0.02))
    shift = arm * random.uniform(-0.08, 0.08, 3)
    deltas = random.uniform(-0.08, 0.08, len(frame.rotors))
    deltas -= deltas.mean()
    sag, angle, wind = (
        random.uniform(0.6, 1.2),
        random.uniform(0.0, 2.0 * np.pi),
        random.uniform(2.0, 6.0),
    )
    if "delay" in hidden:
        craft = replace(craft, delay=delay)
    if "center_of_mass" in hidden:
        center = (float(shift[0]), float(shift[1]), 0.5 * float(shift[2]))
        craft = replace(craft, airframe=replace(craft.airframe, center_of_mass=center))
    if "uneven_rotors" in hidden:
        craft = replace(craft, uneven=tuple(deltas.tolist()))
    if "battery" in hidden:
        craft = with_battery(replace(craft, sag=float(sag)))
    if "wind" in hidden:
        blowing = (float(wind * np.cos(angle)), float(wind * np.sin(angle)), 0.0)
        craft = replace(craft, air=replace(craft.air, wind=blowing))
    return craft


def plant_of(drawn: Draw) -> ForeignPlant | Quadrotor:
    """The plant that flies the draw. Raises MissingSimulator when its package is not installed."""
    if drawn.simulator == "rotorpy":
        from scenarios.foreign.rotorpy_plant import RotorPyPlant

        return RotorPyPlant(drawn.craft, sensors=drawn.sensors)
    if drawn.simulator == "mujoco":
        from scenarios.foreign.mujoco_plant import MuJoCoPlant

        return MuJoCoPlant(drawn.craft, sensors=drawn.sensors)
    if drawn.simulator == "pybullet":
        from scenarios.foreign.pybullet_plant import PyBulletPlant

        return PyBulletPlant(drawn.craft, sensors=drawn.sensors)
    if drawn.simulator == "drone_models":
        from scenarios.foreign.drone_models_plant import DroneModelsPlant

        return DroneModelsPlant(drawn.craft, sensors=drawn.sensors, fitted=drawn.fitted)
    return in_house_plant(drawn.craft, sensors=drawn.sensors)


def flights_of(drawn: Draw, *, duration: float = DURATION) -> dict[str, Log]:
    """The logs of the draw by name (train1 to train3, test1, test2), as its sensors keep them, true
    states included."""
    plant = plant_of(drawn)
    plans = {f"train{k}": plan for k, plan in enumerate(TRAIN, 1)} | {
        f"test{k}": p for k, p in enumerate(TEST, 1)
    }
    return {
        name: fly_plan(plant, drawn.craft, plan, FLIGHT_SEEDS * drawn.seed + k, duration=duration)
        for k, (name, plan) in enumerate(plans.items())
    }


def logged(drawn: Draw, log: Log, flight: int) -> Log:
    """The log as the draw's sensors keep it."""
    if drawn.realism is None:
        return log
    kept = realistic(log, drawn.sensors, drawn.realism, FLIGHT_SEEDS * drawn.seed + flight)
    return kept | {
        name: np.round(kept[name], QUATERNION_DIGITS) for name in ("qw", "qx", "qy", "qz")
    }


def write(drawn: Draw, out: Path, *, duration: float = DURATION) -> dict[str, Log]:
    """Write the folder of a draw and return its logs before the sensors' faults. `out` is made if
    it is missing."""
    out.mkdir(parents=True, exist_ok=True)
    logs = flights_of(drawn, duration=duration)
    left_out = () if drawn.rotor_speeds else ("omega",)
    for k, (name, log) in enumerate(logs.items()):
        write_log(out / f"{name}.csv", logged(drawn, log, k), drop=left_out)
    text = vehicle_text(drawn.craft.airframe, drawn.knowledge, drawn.sensors)
    (out / "vehicle.toml").write_text(text, encoding="utf-8")
    (out / "truth.json").write_text(json.dumps(truth_of(drawn), indent=2) + "\n", encoding="utf-8")
    return logs


def truth_of(drawn: Draw) -> dict[str, object]:
    """What truth.json says: `parameters` exact by catalogue name, `near` where a simulator's form
    is another, `file`."""
    plant = plant_of(drawn)
    parameters = {name: float(value) for name, value in plant.parameters().items()}
    center = drawn.craft.airframe.center_of_mass
    if any(center):
        # the file says that the centre of mass is the body origin
        parameters |= {
            f"center_of_mass_offset.c_{axis}": float(v) for axis, v in zip("xyz", center)
        }
    near = plant.near if isinstance(plant, ForeignPlant) else {}
    return {
        "schema": "scenarios.foreign/1",
        "seed": drawn.seed,
        "simulator": drawn.simulator,
        "fitted": drawn.fitted,
        "gusts": drawn.gusts,
        "sensors": "ideal" if drawn.realism is None else "real",
        "realism": None if drawn.realism is None else asdict(drawn.realism),
        "rotor_speeds": drawn.rotor_speeds,
        "sigmas": drawn.knowledge.sigmas,
        "noise": drawn.knowledge.noise,
        "hidden": list(drawn.hidden),
        "parameters": parameters,
        "near": near,
        "air": asdict(drawn.craft.air),
        "file": nominal_values(drawn.craft.airframe, drawn.knowledge),
        "sensor_noise": asdict(drawn.sensors),
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Draw one craft and write its folder; exit code 2 when the simulator is not installed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument(
        "--simulator",
        choices=(*SIMULATORS, *ON_REQUEST),
        help="overrules the draw of the simulator",
    )
    parser.add_argument(
        "--hidden",
        nargs="*",
        choices=(*HIDDEN, ROTOR_LAW),
        default=[],
        help="what else the file does not say",
    )
    arguments = parser.parse_args(argv)
    try:
        drawn = draw(arguments.seed, arguments.simulator, arguments.hidden)
        write(drawn, arguments.out)
    except ValueError as error:
        parser.error(str(error))
    except MissingSimulator as error:
        print(f"error: {error}; or choose another --simulator: plants needs nothing")
        return 2
    if arguments.seed < FIRST_JUDGING_SEED:
        sensors = "ideal" if drawn.realism is None else "real"
        air = "gusts" if drawn.gusts else "still air"
        what = f"{drawn.craft.airframe.name} in {drawn.simulator}, {air}, {sensors} sensors"
        print(f"{what}: {arguments.out}")
    else:
        print(f"seed {arguments.seed}: {arguments.out}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
