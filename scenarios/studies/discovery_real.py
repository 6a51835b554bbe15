"""The discovery on real flights: NanoBench from the bare core, split by flight; ARPL from IMU and
commands alone.

    python -m scenarios.studies.discovery_real [--set nanobench] [--seconds 10] [--out DIR]

NanoBench. The bare core is a rigid body with thrust k u^2. What differs from flight to flight
(thrust scale, trim of the rotors, biases of gyro and accelerometer, the frame of the motion-capture
markers) is known to differ and adapted per flight, on the first 5 s of a test flight; all that
holds for every flight has to be found. Searched in nine flights (an excerpt of `--seconds` each,
from the third second on), the gap is judged on the five that were left out, whole. Attitude and
position come from another clock than gyro, accelerometer and commands and drift against them by
some 10 ms, hence noise on the attitude kinematics, and sensors' levels held at the vehicle file's.

ARPL. log15 alone, IMU and commands on one clock, trims and biases known to be there: `--seconds` of
the first half searched, the second half judged.

"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from greybox.data import Dataset
from greybox.data.checks import check
from greybox.data.logs import read_logs
from greybox.discovery.result import Discovery
from greybox.discovery.workflow import discover
from greybox.examples import (
    NANOBENCH_TEST,
    NANOBENCH_TRAIN,
    flight_path,
    flight_paths,
    vehicle_path,
)
from greybox.files import write_json
from greybox.model.vehicle import Vehicle, read_vehicle
from greybox.model.vehicle_parts import Quantity
from greybox.report.discover_report import discover_report

HORIZONS = (0.0, 0.1, 0.5)
NUISANCE: Mapping[str, tuple[tuple[str, ...], float]] = {
    "accelerometer_bias": (("b_x", "b_y", "b_z"), 0.5),
    "gyro_bias": (("b_x", "b_y", "b_z"), 0.05),
    "rotor_asymmetry": (("delta_1", "delta_2", "delta_3"), 0.05),
    "mocap_misalignment": (("theta_x", "theta_y", "theta_z"), 0.05),
}
"""Effects that are known to differ from flight to flight: parameters and their sigma."""
PER_FLIGHT = ("thrust.c2", *(f"{e}.{p}" for e, (ps, _) in NUISANCE.items() for p in ps))
FOUND_BY_HAND = (
    "battery_sag",
    "rotor_drag",
    "blade_flapping",
    "rotational_damping",
    "motor_lag",
    "command_delay",
)
ADDS_NOTHING = ("ground_effect", "axial_inflow", "rotor_gyroscopic")


def with_nuisance(vehicle: Vehicle, names: Iterable[str] = NUISANCE) -> Vehicle:
    """The vehicle that knows what differs between flights: the effects `names` of `NUISANCE`."""
    known = {
        e: {p: Quantity(value=0.0, sigma=NUISANCE[e][1]) for p in NUISANCE[e][0]} for e in names
    }
    return replace(vehicle, effects={**vehicle.effects, **known})


def excerpt(data: Dataset, seconds: float) -> Dataset:
    """`seconds` of every flight: one half from its third second on, the other up to 4 s before its
    end (an emptier pack)."""
    cut = []
    for flight in data:
        start, end = float(flight.segments[0].t[0]), float(flight.segments[-1].t[-1])
        half = seconds / 2
        parts = [
            flight.between(start + 3, start + 3 + half),
            flight.between(end - 4 - half, end - 4),
        ]
        cut.append(
            replace(flight, segments=tuple(s for p in parts if p is not None for s in p.segments))
        )
    return Dataset(flights=tuple(cut))


def nanobench(seconds: float, every: int = 1, **options: Any) -> Discovery:
    """What was found in excerpts of every `every`-th training flight."""
    vehicle = with_nuisance(read_vehicle(vehicle_path("nanobench")))
    data = read_logs(flight_paths("nanobench"), vehicle)
    train, test = data.select(NANOBENCH_TRAIN[::every]), data.select(NANOBENCH_TEST)
    return discover(
        vehicle,
        excerpt(train, seconds),
        test,
        faults=check(train + test, vehicle),
        adapt=5.0,
        kinematic_noise=True,
        per_flight=PER_FLIGHT,
        fixed=("mass",),
        hold_sensor_noise=True,
        **options,
    )


def arpl(seconds: float, every: int = 1, **options: Any) -> Discovery:
    """The same for the ARPL log: `seconds` of its first half are searched (there is one flight,
    whatever `every`)."""
    trims = ("accelerometer_bias", "gyro_bias", "rotor_asymmetry")
    vehicle = with_nuisance(read_vehicle(vehicle_path("arpl_crazyflie")), trims)
    data = read_logs([flight_path("arpl_crazyflie", "log15")], vehicle, rate=100.0)
    first, second = data.split_by_time(0.5)
    return discover(
        vehicle, excerpt(first, seconds), second, faults=check(data, vehicle), **options
    )


SETS = {"nanobench": nanobench, "arpl": arpl}


def main(arguments: Sequence[str] | None = None) -> None:
    """Search, print the steps; with --out also write discovery.json and report.html."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--set", choices=tuple(SETS), default="nanobench")
    parser.add_argument("--seconds", type=float, default=10.0, help="of every training flight")
    parser.add_argument(
        "--every", type=int, default=1, metavar="N", help="only every N-th training flight"
    )
    parser.add_argument("--max-effects", type=int, default=12)
    parser.add_argument("--out", metavar="DIR")
    options = parser.parse_args(arguments)

    def say(text: str, share: float) -> None:
        print(f"  {100 * share:3.0f} % {text}", flush=True)

    found = SETS[options.set](
        options.seconds, options.every, max_effects=options.max_effects, progress=say
    )
    print(found.summary())
    names = [e["name"] for e in found.effects()]
    print(
        "found by hand and found here:", ", ".join(n for n in FOUND_BY_HAND if n in names) or "none"
    )
    print(
        "adds nothing there and named:", ", ".join(n for n in ADDS_NOTHING if n in names) or "none"
    )
    print(f"{found.seconds:.0f} s")
    if options.out:
        folder = Path(options.out)
        write_json(folder / "discovery.json", found.to_dict())
        (folder / "report.html").write_text(discover_report(found.to_dict()), encoding="utf-8")


if __name__ == "__main__":
    main()
