"""Cells of the discovery grid: which effects hide in which vehicle, how large, and the flights that
show them.

Training flights go through random waypoints, test flights along a figure or a circle; the gains of
the flight controller change with the seed. A size is a multiple of the noise: the effect changes
the one-step errors by that many of their standard deviations (RMS over a flight, all channels),
measured on a development flight.
"""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

import greybox.plants.effects as hidden
from greybox.commands.missing_effect import ERRORS, SIGMA
from greybox.data import Dataset, dataset_from_arrays
from greybox.discovery.cause import offer
from greybox.discovery.evidence import Flights
from greybox.estimation.differences import with_candidate_sensitivities
from greybox.excitation.circle import Circle
from greybox.excitation.figure_eight import FigureEight
from greybox.excitation.injection import rich_excitation
from greybox.excitation.waypoints import RandomWaypoints
from greybox.model.vehicle import Vehicle, read_vehicle
from greybox.plants.airframe import Airframe
from greybox.plants.controller import Gains
from greybox.plants.flight_log import Reference, fly, member
from greybox.plants.noise import ProcessNoise
from greybox.plants.presets import (
    DEFAULT,
    DUCKIEDRONE,
    NANO,
    SOFT,
    STIFF,
    X250,
    controller_for,
    duckiedrone,
    nano,
    x250,
)
from greybox.plants.quadrotor import Quadrotor
from greybox.plants.vehicle_file import write_vehicle
from scenarios.plants.realistic_sensors import REALISTIC, realistic

SIGNS: tuple[tuple[int, ...], ...] = ((1, -1, 1), (-1, 1, -1), (1, 1, -1), (-1, -1, 1))
"""Which way inertia, thrust and torque coefficient are off; the seed chooses."""
OFF = 0.15
MAKERS = {"x250": x250, "nano": nano, "duckiedrone": duckiedrone}
FRAMES = {"x250": X250, "nano": NANO, "duckiedrone": DUCKIEDRONE}
GAINS: tuple[Gains, ...] = (DEFAULT, SOFT, STIFF)
TESTS: tuple[Reference, ...] = (FigureEight(climb=0.3, yaw_rate=0.4), Circle(climb=0.3))
SIZES = {"large": 1.0, "medium": 0.25, "near": 0.08}
LARGEST = 4.0
"""No effect is made larger than this many times the size at which it matters in flight."""
COLUMNS: dict[str, tuple[str, ...]] = {
    "full": ("omega",),
    "rotors": (),
    "pose": ("omega", "vx", "vy", "vz"),
    "mocap": ("omega", "p", "q", "r", "ax", "ay", "az"),
    "attitude": ("omega", "x", "y", "z", "vx", "vy", "vz"),
    "imu": ("omega", "x", "y", "z", "vx", "vy", "vz", "qw", "qx", "qy", "qz"),
}
"""What a log lacks: rotor speeds, nothing, velocity, the IMU, position and velocity, all but gyro
and accelerometer."""
PAIRS = (
    ("motor_lag", "rotor_drag"),
    ("steady_wind", "rotor_drag"),
    ("battery_sag", "rotor_drag"),
    ("blade_flapping", "rotational_damping"),
    ("center_of_mass_offset", "rotor_asymmetry"),
    ("accelerometer_bias", "parasitic_drag"),
    ("motor_lag", "command_delay"),
    ("gyro_bias", "accelerometer_scale"),
    ("products_of_inertia", "rotor_gyroscopic"),
    ("axial_inflow", "imu_misalignment"),
    ("motor_lag", "motor_lag_asymmetry"),
)
TRIPLES = (
    ("motor_lag", "rotor_drag", "rotational_damping"),
    ("battery_sag", "axial_inflow", "accelerometer_bias"),
    ("center_of_mass_offset", "blade_flapping", "gyro_bias"),
)
FIVES = (
    ("motor_lag", "battery_sag", "rotor_drag", "blade_flapping", "rotational_damping"),
    ("command_delay", "rotor_asymmetry", "accelerometer_bias", "gyro_scale", "axial_inflow"),
)


@dataclass(frozen=True, kw_only=True)
class Gusts:
    """RMS of a first-order Gauss-Markov force (share of the weight) and torque (as angular
    acceleration, `turn` [rad/s^2]) on every axis, and how long it lasts."""

    force: float
    turn: float
    seconds: float


GUSTS = Gusts(force=0.03, turn=2.0, seconds=0.3)


@dataclass(frozen=True, kw_only=True)
class Cell:
    """`hidden` effects at a `size` (a name of `SIZES`, or "flight": where it matters in flight),
    nominal values "exact" or "off", `noise` "white", "coloured" (that of the sensors) or "gusts"
    (of force and torque), `columns` one of `COLUMNS`, `rate` [Hz] of controller and log."""

    vehicle: str = "x250"
    hidden: tuple[str, ...] = ()
    size: str = "flight"
    nominal: str = "off"
    noise: str = "white"
    columns: str = "full"
    seconds: float = 16.0
    rate: float = 100.0

    @property
    def kind(self) -> str:
        """clean, single, pair, triple or five."""
        return {0: "clean", 1: "single", 2: "pair", 3: "triple"}.get(len(self.hidden), "five")

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self) | {"hidden": list(self.hidden)}


def cases(frame: Airframe) -> dict[str, list[hidden.PlantEffect]]:
    """Case name -> hidden effects at the size at which they matter in flight; it follows mass,
    inertia and rotor speed."""
    weight = float(frame.mass) * 9.81
    jx, jy, jz = (float(j) for j in frame.inertia)
    arm = float(max(abs(v) for r in frame.rotors for v in r.position[:2]))
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
        "command_saturation": [
            hidden.CommandSaturation(a_hi=0.2, u_min=frame.u_min, u_max=frame.u_max)
        ],
        "constant_force": [hidden.ConstantForce(f_x=0.04 * weight, f_y=-0.03 * weight)],
        "ground_effect": [hidden.GroundEffect(rotor_radius=frame.rotor_radius or 0.05, k=4.0)],
        "gyro_bias": [hidden.GyroBias(b_x=0.03, b_y=-0.02, b_z=0.02)],
        "gyro_scale": [hidden.GyroScale(s_x=0.03, s_y=-0.03, s_z=0.03)],
        "imu_misalignment": [hidden.ImuMisalignment(theta_x=0.03, theta_y=-0.02, theta_z=0.03)],
        "mocap_misalignment": [hidden.MocapMisalignment(theta_x=0.03, theta_y=-0.02, theta_z=0.03)],
        "linear_drag": [hidden.LinearDrag(d_x=0.03 * weight, d_y=0.04 * weight, d_z=0.02 * weight)],
        "motor_lag": [hidden.MotorLag(tau=0.04)],
        "parasitic_drag": [
            hidden.ParasiticDrag(c_x=0.03 * weight, c_y=0.03 * weight, c_z=0.03 * weight)
        ],
        "payload_mass": [hidden.PayloadMass(mu=0.2)],
        "pose_delay": [hidden.PoseDelay(d=0.02)],
        "products_of_inertia": [
            hidden.ProductsOfInertia(Jxy=0.1 * jx, Jxz=0.08 * jx, Jyz=-0.08 * jx)
        ],
        "rotational_damping": [hidden.RotationalDamping(d_p=1.5 * jx, d_q=1.5 * jy, d_r=1.0 * jz)],
        "rotor_asymmetry": [hidden.RotorAsymmetry(delta=(0.04, -0.02, 0.0, -0.02))],
        "rotor_drag": [hidden.RotorDrag(k_x=0.04 * weight / speed, k_y=0.05 * weight / speed)],
        "rotor_gyroscopic": [hidden.RotorGyroscopic(J_r=2e-3 * jx)],
        "sensor_delay": [hidden.SensorDelay(d=0.02)],
        "thrust_curve": [hidden.ThrustCurve(f=0.2)],
        "translational_lift": [hidden.TranslationalLift(k_h=0.005 * weight)],
    }


def effect_of(name: str, frame: Airframe) -> hidden.PlantEffect:
    """A hidden effect at the size at which it matters in flight."""
    if name == "steady_wind":
        return hidden.SteadyWind(w_x=1.5, w_y=-1.0)
    if name == "motor_lag_asymmetry":
        return hidden.MotorLagAsymmetry(a=0.3)
    return cases(frame)[name][0]


def scaled(effect: hidden.PlantEffect, factor: float) -> hidden.PlantEffect:
    """The effect with all of its parameters `factor` times as large."""
    if isinstance(effect, hidden.RotorAsymmetry):
        return hidden.RotorAsymmetry(delta=tuple(factor * float(d) for d in effect.delta))
    own = {key.split(".")[1] for key in effect.parameters()}
    names = [f.name for f in fields(effect) if f.name in own]  # type: ignore[arg-type]
    larger = {n: factor * getattr(effect, n) for n in names}
    return replace(effect, **larger)  # type: ignore[type-var]


@functools.cache
def in_noise(vehicle: str, seconds: float) -> dict[str, float]:
    """Case -> RMS change of the one-step errors in their standard deviations, at the size at which
    it matters in flight.

    To first order, from the information of a development flight (seed 1) of the vehicle without
    effects.
    """
    plant = MAKERS[vehicle]()
    data = flights(plant, (101,), seconds, "size")
    said = nominal(plant, "exact", 0)
    causes = offer(said, data.channels, sample_time=0.01)
    at = Flights(causes=causes, data=data).fit(())
    null = {p: m for c in causes.offered.values() for p, (m, _) in c.prior.items()}
    wide, theta = with_candidate_sensitivities(
        at.problem, at.theta, causes.built(causes.effects), data, null
    )
    value = wide.evaluate(theta)
    assert value.hessian is not None
    places: dict[str, list[int]] = {}
    for i, u in enumerate(wide.unknowns):
        places.setdefault(u.name, []).append(i)
    samples = sum(r.n for r in wide.records)
    out = {}
    for name, effects in cases(plant.airframe).items():
        if not effects or name not in causes.offered:
            continue
        direction = np.zeros(wide.n)
        for key, v in effects[0].parameters().items():
            for i in places.get(key, ()):
                direction[i] = float(v)
        out[name] = float(np.sqrt(max(float(direction @ value.hessian @ direction), 0.0) / samples))
    return out


def gusts(calm: Quadrotor) -> ProcessNoise:
    """Force and torque that come and go, on top of the noise of the `calm` vehicle: what every real
    vehicle feels and no effect of a catalogue explains."""
    frame, level = calm.airframe, (2 / GUSTS.seconds) ** 0.5
    twist = tuple(level * GUSTS.turn * float(j) for j in frame.inertia)
    return replace(
        calm.process,
        drift_force=level * GUSTS.force * float(frame.mass) * 9.81,
        drift_torque=(twist[0], twist[1], twist[2]),
        drift_time=GUSTS.seconds,
    )


def plant_of(cell: Cell) -> tuple[Quadrotor, float | None]:
    """(the plant with its hidden effects, the multiple of the noise that the size is; None where it
    was not asked for)."""
    frame, maker = FRAMES[cell.vehicle], MAKERS[cell.vehicle]
    chosen, size = [effect_of(n, frame) for n in cell.hidden], None
    if cell.size != "flight" and chosen:
        unit = in_noise(cell.vehicle, cell.seconds).get(cell.hidden[0], 0.0)
        factor = min(SIZES[cell.size] / unit, LARGEST) if unit > 0 else 1.0
        chosen, size = [scaled(chosen[0], factor)], factor * unit
    return maker(chosen, process=gusts(maker()) if cell.noise == "gusts" else None), size


def nominal(plant: Quadrotor, how: str, seed: int) -> Vehicle:
    """The vehicle file: "exact", or `OFF` with a sigma of that size (in the direction that the seed
    chooses)."""
    if how == "exact":
        return vehicle_of(plant, {}, {})
    signs = SIGNS[seed % len(SIGNS)]
    errors: dict[str, float] = {k: 1 + OFF * s for k, s in zip(SIGMA, signs, strict=True)}
    return vehicle_of(plant, {k: OFF / errors[k] for k in SIGMA}, errors)


def vehicle_of(
    plant: Quadrotor, sigma: dict[str, float] | None = None, errors: dict[str, float] | None = None
) -> Vehicle:
    """What the file says of the plant; by default ten per cent off, with honest sigmas."""
    with tempfile.TemporaryDirectory() as folder:
        path = write_vehicle(
            Path(folder) / "v.toml",
            plant,
            sigma=SIGMA if sigma is None else sigma,
            errors=ERRORS if errors is None else errors,
        )
        return read_vehicle(path)


def logs(
    plant: Quadrotor,
    seeds: Sequence[int],
    seconds: float,
    reference: Reference | None = None,
    gains: Gains | None = None,
    rate: float = 100.0,
) -> list[dict[str, Any]]:
    """One log per seed, flown side by side."""
    log = fly(
        plant,
        controller_for(plant, gains),
        reference or RandomWaypoints(),
        rich_excitation(),
        seconds,
        1 / rate,
        seed=list(seeds),
        warm_up=1.0,
    )
    return [member(log, i) for i in range(len(seeds))]


def dataset(
    columns: Sequence[dict[str, Any]], name: str, without: Sequence[str] = COLUMNS["full"]
) -> Dataset:
    """Logs as a data set, `without` columns of these names (or of these and a number)."""
    out: Dataset | None = None
    for i, log in enumerate(columns):
        one = {k: v for k, v in log.items() if k.rstrip("0123456789") not in without}
        t = one.pop("t")
        single = dataset_from_arrays(t, one, name=f"{name}{i}")
        out = single if out is None else out + single
    assert out is not None
    return out


def flights(plant: Quadrotor, seeds: Sequence[int], seconds: float, name: str) -> Dataset:
    """One flight through random waypoints per seed, without rotor speeds."""
    return dataset(logs(plant, seeds, seconds), name)


def flown(
    cell: Cell, seeds: Sequence[int]
) -> Iterator[tuple[int, Quadrotor, float | None, Dataset, Dataset]]:
    """(seed, plant, size in noise, training flights, test flight) for every seed; those with the
    same gains fly together.

    A test flight is half as long as a training flight.
    """
    plant, size = plant_of(cell)
    groups: dict[tuple[int, int], list[int]] = {}
    for s in seeds:
        groups.setdefault((s // len(SIGNS) % len(GAINS), s % len(TESTS)), []).append(s)
    for (g, which), mine in groups.items():
        train = logs(
            plant,
            [100 * s + k for s in mine for k in (1, 2)],
            cell.seconds,
            None,
            GAINS[g],
            cell.rate,
        )
        test = logs(
            plant,
            [100 * s + 51 for s in mine],
            0.5 * cell.seconds,
            TESTS[which],
            GAINS[g],
            cell.rate,
        )
        for n, seed in enumerate(mine):
            three = [train[2 * n], train[2 * n + 1], test[n]]
            three = [_sensed(cell, plant, log, 100 * seed + i) for i, log in enumerate(three)]
            without = COLUMNS[cell.columns]
            yield (
                seed,
                plant,
                size,
                dataset(three[:2], "train", without),
                dataset(three[2:], "test", without),
            )


def _sensed(cell: Cell, plant: Quadrotor, log: dict[str, Any], seed: int) -> dict[str, Any]:
    """The log as the cell's sensors give it."""
    return (
        realistic(log, plant.sensors, REALISTIC.only("colour"), seed)
        if cell.noise == "coloured"
        else log
    )
