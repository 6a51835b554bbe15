"""Do errors on recorded flights tell which model is right? Commands of a flight with feedback answer
the gusts, and so tell of them.

    python -m scenarios.studies.feedback_tells [--seed 1] [--network]

A simulated nano quadrotor in gusts (torque and force that last, Gauss-Markov) flies between
waypoints under a cascade of feedback. Predictors of the second after an instant, given the commands
of that second:

    zero          rates of zero, the attitude of the start
    the craft     the simulator itself, from its true state, gusts of the instant fading: the best
                  that physics can do
    TCN           with --network: the temporal convolution of `greybox compare`, trained on eight such
                  flights of 30 s (two minutes)

Judged twice from the same instants: on what was flown ("as flown"), and on what the same commands do
to the same craft in other gusts that come after the instant ("other gusts"). Only the second is
what a controller asks that chooses its commands. Mean norm of the errors.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np

from greybox.baselines.kinematics import (
    BODY_VELOCITY,
    GRAVITY_DIRECTION,
    IMU,
    black_box_view,
    motion,
)
from greybox.baselines.tcn import TCNModel, TCNSettings, train_tcn
from greybox.data import Segment, dataset_from_arrays
from greybox.excitation.waypoints import RandomWaypoints
from greybox.plants import effects as plant_effects
from greybox.plants.flight_log import Log, fly, member
from greybox.plants.noise import ProcessNoise
from greybox.plants.presets import NANO, controller_for, nano
from greybox.plants.quadrotor import Quadrotor
from greybox.symbolic import FloatArray
from greybox.validation.groups import error_norms

DT, STEPS, SHOWN = 0.01, 100, (0.1, 0.2, 0.5, 1.0)
FLIGHTS, HELD_BACK, LEARNED, JUDGED, SECONDS = 8, 2, 30.0, 8, 20.0
TURNING, PUSHING, LASTING = 6.0, 0.3, 0.2
"""Gusts: standard deviations of angular [rad/s^2] and linear acceleration [m/s^2], seconds."""
FIRST, SPACING = 3.0, 1.0
"""First instant of a flight and time between instants [s]."""
OUTPUTS = (*IMU, *BODY_VELOCITY, *GRAVITY_DIRECTION)
RATES, ATTITUDE = ("p", "q", "r"), ("qw", "qx", "qy", "qz")


def craft() -> Quadrotor:
    """Lag, delay, drag and damping, in gusts."""
    step = (2.0 / LASTING) ** 0.5
    return nano(
        [
            plant_effects.MotorLag(tau=0.06),
            plant_effects.CommandDelay(d=0.012),
            plant_effects.RotorDrag(k_x=2.0e-6, k_y=2.5e-6),
            plant_effects.RotationalDamping(d_p=6e-5, d_q=6e-5, d_r=6e-5),
        ],
        process=ProcessNoise(
            drift_torque=tuple(step * TURNING * float(i) for i in NANO.inertia[:3]),
            drift_force=step * PUSHING * float(NANO.mass),
            drift_time=LASTING,
        ),
    )


def view(log: Log, name: str) -> Segment:
    """One log as black boxes see it."""
    own = {k: v for k, v in log.items() if not k.startswith("omega")}
    (segment,) = dataset_from_arrays(own.pop("t"), own, name=name).segments
    return black_box_view(segment)


class Branches:
    """A plant that is flown, and at some instants goes on by itself with the commands that follow:
    in other gusts, and in none."""

    def __init__(self, plant: Quadrotor, seed: int) -> None:
        self.plant, self.seed, self.count = plant, seed, 0
        self.live: list[tuple[Quadrotor, list[FloatArray]]] = []
        self.kept: list[tuple[int, str, list[FloatArray]]] = []
        self.at = {round(k / DT) for k in np.arange(FIRST, SECONDS - 1.5, SPACING)}

    def __getattr__(self, name: str) -> object:
        return getattr(self.plant, name)

    def step(self, u: FloatArray, dt: float) -> None:
        """As of the plant; the command begins at the present sample."""
        if self.count in self.at:
            members = [self.seed + self.count * 1000 + i for i in range(int(self.plant.batch or 1))]
            for label, branch in (
                ("other gusts", self.plant.branch(members)),
                ("the craft", self.plant.branch(None)),
            ):
                rows: list[FloatArray] = []
                self.live.append((branch, rows))
                self.kept.append((self.count, label, rows))
        self.plant.step(u, dt)
        for branch, rows in self.live:
            branch.step(u, dt)
            told = branch.states()
            rows.append(np.stack([np.asarray(told[n]) for n in (*RATES, *ATTITUDE)], axis=-1))
        self.live = [(b, r) for b, r in self.live if len(r) < STEPS]
        self.count += 1


def trained(seed: int) -> TCNModel:
    """The network."""
    plant = craft()
    seeds = [1000 * seed + i for i in range(FLIGHTS + HELD_BACK)]
    log = fly(plant, controller_for(plant), RandomWaypoints(), None, LEARNED, DT, seeds)
    views = [view(member(log, i), f"run{i}") for i in range(len(seeds))]
    return train_tcn(
        views[:FLIGHTS],
        views[FLIGHTS:],
        outputs=OUTPUTS,
        inputs=("u1", "u2", "u3", "u4", "vbat"),
        settings=TCNSettings(batch=256, epochs=60, patience=10, unroll=25),
        seed=seed,
    )


def study(seed: int, network: TCNModel | None) -> str:
    """The table."""
    judged = Branches(craft(), seed)
    flown = fly(
        judged,  # type: ignore[arg-type]
        controller_for(judged.plant),
        RandomWaypoints(),
        None,
        SECONDS,
        DT,
        [1000 * seed + 500 + i for i in range(JUDGED)],
        record=("truth",),
    )
    errors: dict[tuple[str, str, str], list[FloatArray]] = {}
    origins = np.array(sorted(judged.at))
    later = origins[:, None] + 1 + np.arange(STEPS)
    for i in range(JUDGED):
        truth = np.stack([flown[f"true.{n}"][:, i] for n in (*RATES, *ATTITUDE)], axis=-1)
        branch = {
            label: np.stack(
                [np.stack(rows)[:, i] for k, name, rows in judged.kept if name == label]
            )
            for label in ("other gusts", "the craft")
        }
        still = np.zeros((len(origins), STEPS, 7))
        still[..., 3:] = truth[origins][:, None, 3:]
        predictors = {"zero": still, "the craft": branch["the craft"]}
        if network is not None:
            one = view(member(flown, i), f"judged{i}")
            mean, variance = network.free_run(one, origins, STEPS)
            told, _ = motion(one, origins, OUTPUTS, mean, variance, gravity=9.81)
            predictors["TCN"] = np.concatenate([told["rate"], told["rotation"]], axis=-1)
        for where, reached in (("as flown", truth[later]), ("other gusts", branch["other gusts"])):
            for label, p in predictors.items():
                for g, part in (("rate", slice(0, 3)), ("rotation", slice(3, 7))):
                    errors.setdefault((g, where, label), []).append(
                        error_norms(g, p[..., part], reached[..., part])
                    )
    lines = [f"{'':28}" + "".join(f"{f'{h:g} s':>8}" for h in SHOWN)]
    for (g, where, label), e in sorted(errors.items()):
        norms = np.concatenate(e).mean(axis=0)
        cells = "".join(f"{norms[round(h / DT) - 1]:8.3f}" for h in SHOWN)
        lines.append(f"{f'{g}, {where}, {label}':28}{cells}")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--network", action="store_true", help="also train the convolution")
    options = parser.parse_args(arguments)
    print(study(options.seed, trained(options.seed) if options.network else None))


if __name__ == "__main__":
    main()
