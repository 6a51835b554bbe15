"""Angular acceleration of the ARPL Crazyflie from its motor commands: fitted on one half of a
flight, judged on the other.

    python -m scenarios.studies.arpl_rates [--log log15] [--rate 200]

The rate model (rotors with lag and delay, damping, torque trims) is fitted by multi-step errors on
the first half. On the second half rotors run from the commands alone and the torque disturbance is
off; the measured rate enters the modelled angular acceleration only through damping and gyroscopic
coupling, the velocity (felt by the accelerometer through drag) only through the flapping moment.
The centrally differenced gyro and the model pass the same zero-phase 30 Hz Butterworth filter; R^2
of the two is printed per axis, with motor lag and delay and their 95 % intervals.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
from scipy.signal import butter, sosfiltfilt

from greybox.data import Dataset, Segment
from greybox.data.logs import read_logs
from greybox.estimation.ahead import run_ahead
from greybox.estimation.engine import engine_for
from greybox.estimation.filtering import Filter
from greybox.estimation.fit import Fit, fit
from greybox.estimation.predictors.multi_step import MultiStep
from greybox.estimation.record import Record, hold_missing
from greybox.examples import flight_path, vehicle_path
from greybox.model.effects import effect_by_name
from greybox.model.model import PhysicsModel, sensors_for
from greybox.model.vehicle import read_vehicle
from greybox.symbolic import FloatArray
from greybox.validation.metrics import r_squared

EFFECTS = (
    "motor_lag",
    "command_delay",
    "rotational_damping",
    "rotor_asymmetry",
    "rotor_gyroscopic",
    "rotor_drag",
    "blade_flapping",
)
HORIZONS = (0.02, 0.03, 0.04, 0.06, 0.08, 0.12)
"""Horizons of the fit [s]."""
CUTOFF = 30.0
"""Of the filter that both sides pass [Hz]."""
TARGET = {"roll": 0.89, "pitch": 0.91}


def fit_half(data: Dataset, use: Sequence[str] = EFFECTS) -> Fit:
    """Multi-step errors of gyro and accelerometer, from a filter that carries a slowly varying
    torque."""
    vehicle = read_vehicle(vehicle_path("arpl_crazyflie"))
    dt = data.flights[0].dt
    model = PhysicsModel(
        vehicle=vehicle,
        sensors=sensors_for(("p", "q", "r", "ax", "ay", "az"), vehicle),
        sample_time=dt,
        effects=tuple(effect_by_name(n) for n in use),
    )
    steps = [max(1, round(h / dt)) for h in HORIZONS]
    return fit(
        model,
        data,
        disturbance=("torque",),
        predictor=MultiStep(horizons=tuple(steps), stride=max(1, round(0.04 / dt))),
        values={"motor_lag.tau": 0.03, "command_delay.d": 0.008},
        initialisation="innovation",
        estimate_noise="process",
        noise={
            "noise.sensor.p": 0.03,
            "noise.sensor.q": 0.03,
            "noise.sensor.r": 0.03,
            "noise.sensor.ax": 0.3,
            "noise.sensor.ay": 0.3,
            "noise.sensor.az": 0.5,
        },
        fixed=("thrust.c0", "thrust.c1", "thrust.c2", "disturbance.torque.T"),
    )


def from_commands(result: Fit, segment: Segment) -> tuple[FloatArray, FloatArray]:
    """(measured rate, model's angular acceleration) (N, 3) and (N - 1, 3).

    Rotors run from the commands alone and the torque disturbance is zero, so that the filter says
    nothing about torques; the measured rate enters through damping and gyroscopic coupling, and the
    velocity (which the accelerometer feels through drag) through the flapping moment.
    """
    dynamics, engine = result.model.dynamics, engine_for(result.model.dynamics, ())
    filtered, p = Filter(result.model).run(segment), result.model.parameter_vector()
    record = filtered.record
    gyro, _ = hold_missing(record.outputs[:, [dynamics.outputs[c] for c in "pqr"]])

    def run(starts: FloatArray, rows: npt.NDArray[np.int_], horizon: int) -> FloatArray:
        ahead = run_ahead(
            engine,
            starts=starts,
            rows=rows,
            steps=horizon,
            inputs=record.inputs,
            p=p,
            dt=record.dt,
            want_states=True,
        )
        assert ahead.states is not None
        return ahead.states

    names = dynamics.states.names
    rate = [dynamics.states[f"rate.{a}"] for a in "xyz"]
    rotors = [i for i, n in enumerate(names) if n.startswith("rotor.")]
    disturbance = [i for i, n in enumerate(names) if n.startswith("disturbance.")]
    begin = filtered.states.copy()
    begin[:, rotors] = rotor_states(run, record, rotors)
    begin[:, rate] = gyro
    begin[:, disturbance] = 0.0
    after = run(begin[:-1], np.arange(record.n - 1), 2)[:, 1]
    return gyro, (after[:, rate] - gyro[:-1]) / record.dt


def rotor_states(
    run: Callable[[FloatArray, npt.NDArray[np.int_], int], FloatArray],
    record: Record,
    rotors: Sequence[int],
) -> FloatArray:
    """Rotor states (N, n) that follow the commands, simulated in stretches so that the rest cannot
    run away."""
    x, out = record.x0.copy(), np.zeros((record.n, len(rotors)))
    stretch = 100
    for at in range(0, record.n, stretch):
        length = min(stretch, record.n - at)
        states = run(x[None], np.array([at]), min(length + 1, record.n - at))[0]
        out[at : at + length] = states[:length][:, rotors]
        x = record.x0.copy()
        x[list(rotors)] = states[-1][list(rotors)]
    return out


def judge(result: Fit, data: Dataset, after: float) -> dict[str, float]:
    """R^2 per axis at log times t >= `after` [s]; the filter runs from the start of the flight."""
    measured, modelled = [], []
    for segment in data.segments:
        gyro, alpha = from_commands(result, segment)
        low = butter(2, CUTOFF, fs=1 / segment.dt, output="sos")
        late = segment.t[1:-1] >= after
        measured.append(sosfiltfilt(low, (gyro[2:] - gyro[:-2]) / (2 * segment.dt), axis=0)[late])
        # The central difference is the mean of two steps.
        modelled.append(sosfiltfilt(low, (alpha[1:] + alpha[:-1]) / 2, axis=0)[late])
    y, x = np.concatenate(measured), np.concatenate(modelled)
    return {n: r_squared(y[:, i], x[:, i]) for i, n in enumerate(("roll", "pitch", "yaw"))}


def main(arguments: Sequence[str] | None = None) -> None:
    """Fit, judge, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--log", default="log15")
    parser.add_argument("--rate", type=float, default=200.0, help="Hz")
    options = parser.parse_args(arguments)
    vehicle = read_vehicle(vehicle_path("arpl_crazyflie"))
    data = read_logs([flight_path("arpl_crazyflie", options.log)], vehicle, rate=options.rate)
    first, second = data.split_by_time(0.5)
    result = fit_half(first)
    print(result.summary())
    print(
        f"\n{options.log}, second half, central-differenced gyro, zero-phase {CUTOFF:g} Hz on both "
        "sides: R^2"
    )
    for axis, value in judge(result, data, float(second.segments[0].t[0])).items():
        goal = f"  (to beat: {TARGET[axis]})" if axis in TARGET else ""
        print(f"  {axis:6s} {value:.3f}{goal}")
    for name in ("motor_lag.tau", "command_delay.d"):
        e = result[name]
        low, high = 1e3 * (e.value - 1.96 * e.std), 1e3 * (e.value + 1.96 * e.std)
        print(f"  {name}: {1e3 * e.value:.2f} ms, 95 % interval {low:.2f} .. {high:.2f} ms")


if __name__ == "__main__":
    main()
