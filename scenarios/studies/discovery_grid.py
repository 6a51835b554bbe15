"""One hidden effect at a time: what does discover say? The confusion matrix on simulated flights.

    python -m scenarios.studies.discovery_grid [--vehicle x250] [--seeds 1] [--only a,b] [--out F.jsonl]

Two training flights of 16 s at 100 Hz through random waypoints with rich excitation, white noise, inertia, thrust and torque
coefficients ten per cent off with honest sigmas. Sizes are such that the effect matters in flight (some per cent of the
weight, some rad/s^2, some ten milliseconds). Every case is written as one line as soon as it is done, so that a study
that was stopped goes on where it was. Verdicts per case:

    right      the hidden effect, and nothing else, has a name
    group      a group of candidates that holds the hidden effect, and no false name
    extra      the hidden effect has its name, and so has something that is not there
    missed     no name at all
    wrong      something else has a name

`clean` hides nothing: right is "nothing missing".
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import scenarios.plants.effects as hidden
from greybox.data import Dataset, dataset_from_arrays
from greybox.discovery.workflow import Discovery, discover
from greybox.model.vehicle import Vehicle, read_vehicle
from scenarios.excitation.injection import rich_excitation
from scenarios.excitation.waypoints import RandomWaypoints
from scenarios.plants.airframe import Airframe
from scenarios.plants.flight_log import fly, member
from scenarios.plants.presets import NANO, X250, controller_for, nano, x250
from scenarios.plants.quadrotor import Quadrotor
from scenarios.plants.vehicle_file import write_vehicle

SIGMA = {"inertia": 0.2, "thrust.c2": 0.2, "torque.c2": 0.3}
ERRORS = {"inertia": 1.1, "thrust.c2": 0.9, "torque.c2": 1.1}
VERDICTS = ("right", "group", "extra", "missed", "wrong")
MAKERS = {"x250": x250, "nano": nano}


def cases(frame: Airframe) -> dict[str, list[hidden.PlantEffect]]:
    """Case name -> hidden effects; the sizes follow the vehicle's mass, inertia and rotor speed."""
    weight = float(frame.mass) * 9.81
    jx, jy, jz = (float(j) for j in frame.inertia)
    arm = float(frame.rotors[0].position[0])
    assert frame.speed_max is not None
    speed = 4 * 0.6 * frame.speed_max
    return {
        "clean": [],
        "accelerometer_bias": [hidden.AccelerometerBias(b_x=0.1, b_y=-0.08, b_z=0.1)],
        "accelerometer_lever_arm": [hidden.AccelerometerLeverArm(r_x=0.02, r_y=-0.015, r_z=0.01)],
        "accelerometer_scale": [hidden.AccelerometerScale(s_x=0.03, s_y=-0.03, s_z=0.03)],
        "axial_inflow": [hidden.AxialInflow(k_z=0.05 * weight / speed)],
        "battery_sag": [hidden.BatterySag(nominal_voltage=frame.nominal_voltage or 1.0, c_V=1.0)],
        "blade_flapping": [hidden.BladeFlapping(k_flap=3.0 * jx / speed)],
        "center_of_mass_offset": [hidden.CenterOfMassOffset(c_x=0.04 * arm, c_y=-0.03 * arm)],
        "command_delay": [hidden.CommandDelay(d=0.02)],
        "command_saturation": [hidden.CommandSaturation(a_hi=0.2, u_min=frame.u_min, u_max=frame.u_max)],
        "constant_force": [hidden.ConstantForce(f_x=0.04 * weight, f_y=-0.03 * weight)],
        "ground_effect": [hidden.GroundEffect(rotor_radius=frame.rotor_radius or 0.05, k=4.0)],
        "gyro_bias": [hidden.GyroBias(b_x=0.03, b_y=-0.02, b_z=0.02)],
        "gyro_scale": [hidden.GyroScale(s_x=0.03, s_y=-0.03, s_z=0.03)],
        "imu_misalignment": [hidden.ImuMisalignment(theta_x=0.03, theta_y=-0.02, theta_z=0.03)],
        "mocap_misalignment": [hidden.MocapMisalignment(theta_x=0.03, theta_y=-0.02, theta_z=0.03)],
        "motor_lag": [hidden.MotorLag(tau=0.04)],
        "parasitic_drag": [hidden.ParasiticDrag(c_x=0.03 * weight, c_y=0.03 * weight, c_z=0.03 * weight)],
        "payload_mass": [hidden.PayloadMass(mu=0.2)],
        "pose_delay": [hidden.PoseDelay(d=0.02)],
        "products_of_inertia": [hidden.ProductsOfInertia(Jxy=0.1 * jx, Jxz=0.08 * jx, Jyz=-0.08 * jx)],
        "rotational_damping": [hidden.RotationalDamping(d_p=1.5 * jx, d_q=1.5 * jy, d_r=1.0 * jz)],
        "rotor_asymmetry": [hidden.RotorAsymmetry(delta=(0.04, -0.02, 0.0, -0.02))],
        "rotor_drag": [hidden.RotorDrag(k_x=0.04 * weight / speed, k_y=0.05 * weight / speed)],
        "rotor_gyroscopic": [hidden.RotorGyroscopic(J_r=2e-3 * jx)],
        "sensor_delay": [hidden.SensorDelay(d=0.02)],
        "thrust_curve": [hidden.ThrustCurve(f=0.2)],
        "translational_lift": [hidden.TranslationalLift(k_h=0.005 * weight)],
    }


def vehicle_of(plant: Quadrotor) -> Vehicle:
    """What the file says of the plant: ten per cent off, with honest sigmas."""
    with tempfile.TemporaryDirectory() as folder:
        return read_vehicle(write_vehicle(Path(folder) / "v.toml", plant, sigma=SIGMA, errors=ERRORS))


def flights(plant: Quadrotor, seeds: Sequence[int], seconds: float, name: str) -> Dataset:
    """One flight per seed, without rotor speeds."""
    log = fly(
        plant, controller_for(plant), RandomWaypoints(), rich_excitation(), seconds, seed=list(seeds), warm_up=1.0
    )
    out: Dataset | None = None
    for i in range(len(seeds)):
        one = {k: v for k, v in member(log, i).items() if not k.startswith("omega")}
        t = one.pop("t")
        single = dataset_from_arrays(t, one, name=f"{name}{i}")
        out = single if out is None else out + single
    assert out is not None
    return out


def judge(found: Discovery, truth: Sequence[str]) -> str:
    """One of `VERDICTS`."""
    names = {e["name"] for e in found.effects()} if found.fit is not None else set()
    groups = [{n for c in a.rivals for n in c.split("+")} for a in found.additions if a.rivals]
    wanted = set(truth)
    in_group = {t for t in wanted for g in groups if t in g}
    if not wanted:
        return "right" if found.verdict == "nothing_missing" else "missed" if not names else "wrong"
    if names == wanted and not groups:
        return "right"
    if wanted <= names | in_group and names <= wanted and all(g & wanted for g in groups):
        return "group"
    if wanted <= names:
        return "extra"
    return "wrong" if names - wanted else "missed"


def run(vehicle: str, case: str, seed: int, seconds: float = 16.0) -> dict[str, Any]:
    """One case as plain values."""
    frame = {"x250": X250, "nano": NANO}[vehicle]
    plant = MAKERS[vehicle](cases(frame)[case])
    first = 1000 * seed
    train = flights(plant, (first + 1, first + 2), seconds, "train")
    test = flights(plant, (first + 101,), seconds, "test")
    found = discover(vehicle_of(plant), train, test)
    content = found.to_dict()
    closed = [r["closed"] for r in content["gap"] if r["horizon_s"] == 0.5 and r["closed"] is not None]
    return {
        "vehicle": vehicle, "case": case, "seed": seed, "judged": judge(found, [e.name for e in plant.effects]),
        "verdict": found.verdict,
        "effects": {e["name"]: {n: [p["value"], p["std"]] for n, p in e["parameters"].items()} for e in content["effects"]},
        "truth": {k: float(v) for e in plant.effects for k, v in e.parameters().items()},
        "delta_bic": [e["delta_bic"] for e in content["effects"]],
        "rivals": [e["delta_bic_rival"] for e in content["effects"]],
        "ambiguous": [{c["name"]: c["weight"] for c in a["candidates"]} for a in content["ambiguous"]],
        "unnamed": [u["proposal"] for u in content["unnamed"]], "deficiency": content["deficiency"],
        "not_judged": content["not_judged"], "faults": content["faults"], "warnings": content["warnings"],
        "detectable": {n: content["minimum_detectable"].get(n) for n in [e.name for e in plant.effects]},
        "closed": closed, "seconds": found.seconds,
    }  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what is not in the file yet, then print the table."""
    parser = argparse.ArgumentParser(description="The confusion matrix of discover on simulated flights.")
    parser.add_argument("--vehicle", choices=tuple(MAKERS), nargs="+", default=["x250"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--only", default=None, help="comma-separated cases")
    parser.add_argument("--out", default="discovery_grid.jsonl")
    options = parser.parse_args(arguments)
    path = Path(options.out)
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    done = {(r["vehicle"], r["case"], r["seed"]) for r in rows}
    wanted = options.only.split(",") if options.only else list(cases(X250))
    for seed in options.seeds:
        for vehicle in options.vehicle:
            for case in wanted:
                if (vehicle, case, seed) in done:
                    continue
                row = run(vehicle, case, seed)
                rows.append(row)
                with path.open("a") as stream:
                    stream.write(json.dumps(row) + "\n")
                said = (
                    ", ".join(row["effects"]) or " | ".join(" or ".join(a) for a in row["ambiguous"]) or row["verdict"]
                )
                print(
                    f"{vehicle:5s} {seed:3d} {case:24s} {row['judged']:7s} {said} ({row['seconds']:.0f} s)", flush=True
                )
    counts = Counter(r["judged"] for r in rows)
    print(", ".join(f"{v} {counts[v]}" for v in VERDICTS), f"of {len(rows)}")


if __name__ == "__main__":
    main()
