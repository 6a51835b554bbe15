"""The record of the paper's experiment, flown by an independent plant: commands, measurements,
truth, and noise floor.

Ghoul, Bousserhane and Boufeldja 2026 (IJCAS 24(8)) identify one closed-loop record of a
Duckiedrone-like quadrotor: 30 s at 100 Hz (N = 3000), y = [p, q, r, ax, ay, az], 0-20 s for
training, 20-25 s for validation, 25-30 s for the test; multi-sine chirps 0.1-20 Hz on motors and
collective, steps, doublets, coupled roll-pitch manoeuvres, hover; an actuator curve, battery sag,
blade flapping, ground effect, cross-axis coupling, and an IMU with noise, bias and scale errors.
Plant and data of the paper are not public: every number here is ours.

What may enter a prediction of y(t_k): measurements up to t_(k-1) and commands up to u_(k-1). u_k is
left out although it is "a command up to t": it cannot have moved y(t_k) (the rotors lag), and the
flight controller computed it from the measurements at t_k, so that it carries their noise. A
predictor that takes it beats the noise floor by looking.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from greybox.data import Dataset, dataset_from_arrays
from greybox.data.segment import Segment
from greybox.excitation import (
    Doublets,
    Excitation,
    Hover,
    Multichirp,
    RandomSteps,
    RotorForces,
    Total,
    Windowed,
)
from greybox.frames import numeric
from greybox.plants.flight_log import CLEAN, TRUTH, Log, fly
from greybox.plants.noise import ProcessNoise, SensorNoise, axes
from greybox.plants.presets import CALM, DUCKIEDRONE, EVERYDAY, MEMS, controller_for, duckiedrone
from greybox.plants.quadrotor import Quadrotor

Array = NDArray[np.float64]

OUTPUTS = ("p", "q", "r", "ax", "ay", "az")
COMMANDS = ("u1", "u2", "u3", "u4")
ATTITUDE = ("qw", "qx", "qy", "qz")
POSITION = ("x", "y", "z")
CHANNELS = (*COMMANDS, "vbat", *ATTITUDE, *POSITION, *OUTPUTS)
"""What was logged. Every method is given all of it; `record` also has roll, pitch and yaw [rad] of
the measured attitude. The paper does not say what its PEM model was given besides y and u; its GP
takes the Euler angles. Position is what a flight controller that holds it has at hand; without it
nobody could know the velocity, on which drag depends."""
EULER = ("roll", "pitch", "yaw")
TRAIN, VALIDATION, TEST = (0.0, 20.0), (20.0, 25.0), (25.0, 30.0)
"""Parts of the record [s]."""
SHORT = (15.0, 20.0)
"""A quarter of the training part, which holds the whole repertoire once: how much worse does a
method get on it?"""
DT = 0.01
BLOCK = 5.0
WARM_UP = 3.0


def excitation() -> RotorForces:
    """Every five seconds the same repertoire with other random numbers: hover, chirps, doublets,
    coupled roll and pitch."""

    def parts(offset: float, length: float) -> tuple[tuple[float, float], ...]:
        return tuple((WARM_UP + BLOCK * k + offset, length) for k in range(6))

    def doublet(size: float, start: float) -> Doublets:
        return Doublets(amplitude=size, width=0.12, period=BLOCK, start=WARM_UP + start)

    chirps, coupled = parts(0.5, 2.1), parts(3.5, 1.5)

    def both(rms: float, doublets: Doublets) -> Total:
        swing = Multichirp(rms=rms, low=0.5, high=5.0, count=3, sweep=1.5)
        return Total(signals=(doublets, Windowed(signal=swing, windows=coupled)))

    steps = RandomSteps(amplitude=1.2, shortest=0.7)
    return RotorForces(
        airframe=DUCKIEDRONE,
        rotors=(Windowed(signal=Multichirp(rms=0.3), windows=chirps),) * 4,
        rest=Excitation(
            mixer={
                "thrust": Total(
                    signals=(
                        Windowed(signal=Multichirp(rms=0.8), windows=chirps),
                        doublet(2.0, 3.0),
                    ),
                ),
                "roll": both(12.0, doublet(20.0, 2.6)),
                "pitch": both(12.0, doublet(20.0, 2.8)),
                "yaw": both(4.0, doublet(10.0, 3.2)),
            },
            setpoint={
                "x": steps,
                "y": steps,
                "z": replace(steps, amplitude=0.2),
                "yaw": replace(steps, amplitude=0.5),
            },
        ),
    )


def plant(*, noise: bool = True) -> Quadrotor:
    """The true vehicle; with noise=False neither sensors nor air are noisy."""
    if noise:
        return duckiedrone(EVERYDAY, sensors=MEMS, process=CALM)
    return duckiedrone(EVERYDAY, sensors=SensorNoise(), process=ProcessNoise())


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth:
    """What the record does not say. y (N, 6): the sensors' readings without noise; height (N,) [m];
    floors per output.

    sensor (6,): variance of the sensor noise, below which no mean squared error against
    measurements can fall. process (6,): variance of the part of y that white force and torque make
    unpredictable one step ahead. A predictor that knows plant and state exactly has mean squared
    error `process` against the truth and `floor` against the measurements; one that has to infer
    the state from noisy measurements has more.
    """

    y: Array
    height: Array
    sensor: Array
    process: Array

    @property
    def floor(self) -> Array:
        """sensor + process, (6,)."""
        return self.sensor + self.process


@dataclass(frozen=True, kw_only=True, eq=False)
class PaperData:
    """One record: everything that was logged, the channels that methods are given (`record`), and
    the truth."""

    seed: int
    log: Log
    record: Dataset
    truth: Truth

    @property
    def segment(self) -> Segment:
        """The whole record as one segment."""
        return self.record.flights[0].segments[0]

    def part(self, span: tuple[float, float]) -> Dataset:
        """The record between two times [s]."""
        flight = self.record.flights[0].between(span[0] - 0.5 * DT, span[1] - 0.5 * DT)
        assert flight is not None
        return Dataset(flights=(flight,))

    def rows(self, span: tuple[float, float]) -> slice:
        """The rows of a part."""
        return slice(round(span[0] / DT), round(span[1] / DT))


def paper_data(seed: int, *, noise: bool = True) -> PaperData:
    """Fly the experiment with this seed. Deterministic."""
    true_plant = plant(noise=noise)
    log = fly(
        true_plant,
        controller_for(true_plant),
        Hover(center=(0.0, 0.0, 0.35)),
        excitation(),
        TEST[1],
        DT,
        seed,
        warm_up=WARM_UP,
        record=("truth", "clean"),
    )
    angles = np.unwrap(
        numeric("euler", np.stack([log[name] for name in ATTITUDE], axis=-1)), axis=0
    )
    channels = {name: log[name] for name in CHANNELS} | dict(zip(EULER, angles.T))
    record = dataset_from_arrays(log["t"], channels, name=f"seed{seed}")
    frame, sensors, process = true_plant.airframe, true_plant.sensors, true_plant.process
    gyro, accelerometer = axes(sensors.gyro), axes(sensors.accelerometer)
    force = [level / np.sqrt(DT) / frame.mass for level in axes(process.force)]
    torque = [
        level * np.sqrt(DT) / moment for level, moment in zip(axes(process.torque), frame.inertia)
    ]
    truth = Truth(
        y=np.stack([log[CLEAN + name] for name in OUTPUTS], axis=-1),
        height=log[TRUTH + "z"],
        sensor=np.square([*gyro, *accelerometer], dtype=float),
        process=np.square([*torque, *force], dtype=float),
    )
    return PaperData(seed=seed, log=log, record=record, truth=truth)
