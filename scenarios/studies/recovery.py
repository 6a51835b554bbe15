"""Do the error bars tell the truth? Known parameters, recovered from many seeded closed-loop
flights.

The plant is independent of greybox (NumPy), flies in closed loop with process noise and an excited
reference, and the vehicle file is off by ten per cent. Every run is one flight and one fit.
Reported: coverage of the 95 % intervals, pooled and per parameter (exact binomial test,
Bonferroni), and the normalised squared error against its chi-square band.

    python -m scenarios.studies.recovery --runs 200
"""

from __future__ import annotations

import argparse
import concurrent.futures
import multiprocessing
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats

from greybox.cores import cores
from greybox.excitation.injection import rich_excitation
from greybox.excitation.waypoints import RandomWaypoints
from greybox.plants import effects as plant_effects
from greybox.plants.flight_log import fly, member
from greybox.plants.presets import controller_for, nano
from greybox.plants.quadrotor import Quadrotor
from greybox.plants.vehicle_file import write_vehicle

EFFECTS = ("motor_lag", "command_delay", "rotor_drag", "rotational_damping")
BATCH = 50


def plant() -> Quadrotor:
    """The true vehicle: nano quadrotor with lag, delay, drag and damping."""
    return nano(
        [
            plant_effects.MotorLag(tau=0.05),
            plant_effects.CommandDelay(d=0.012),
            plant_effects.RotorDrag(k_x=2.0e-6, k_y=2.5e-6),
            plant_effects.RotationalDamping(d_p=2e-5, d_q=3e-5, d_r=1e-5),
        ]
    )


@dataclass(frozen=True, kw_only=True)
class Recovery:
    """Errors of all runs: names (k,), estimates, stds (runs, k), truth (k,), nees (runs,) over k
    parameters."""

    names: tuple[str, ...]
    truth: np.ndarray
    estimates: np.ndarray
    stds: np.ndarray
    nees: np.ndarray
    failed: int

    @property
    def inside(self) -> np.ndarray:
        """Whether the 95 % interval holds the truth, (runs, k)."""
        return np.abs(self.estimates - self.truth) <= scipy.stats.norm.ppf(0.975) * self.stds

    @property
    def pooled_coverage(self) -> float:
        """Share of all intervals that hold the truth."""
        return float(self.inside.mean())

    def p_values(self) -> np.ndarray:
        """Exact two-sided binomial test of 95 % coverage per parameter, (k,)."""
        runs = self.inside.shape[0]
        return np.array(
            [scipy.stats.binomtest(int(c), runs, 0.95).pvalue for c in self.inside.sum(axis=0)]
        )

    def nees_band(self, level: float = 0.99) -> tuple[float, float, float]:
        """(mean normalised squared error per parameter, lower, upper end of its chi-square
        band)."""
        runs, k = self.estimates.shape
        low, high = scipy.stats.chi2.ppf([(1 - level) / 2, (1 + level) / 2], runs * k) / (runs * k)
        return float(self.nees.mean() / k), float(low), float(high)

    def format(self) -> str:
        """A table and the three verdicts."""
        p = self.p_values()
        lines = [
            f"{'parameter':26s} {'truth':>11s} {'mean':>11s} {'bias/std':>9s} {'cover':>7s} "
            f"{'p':>8s}"
        ]
        for j, name in enumerate(self.names):
            bias = (self.estimates[:, j] - self.truth[j]).mean() / self.stds[:, j].mean()
            lines.append(
                f"{name:26s} {self.truth[j]:11.4g} {self.estimates[:, j].mean():11.4g} {bias:9.3f} "
                f"{self.inside[:, j].mean():7.3f} {p[j]:8.3g}"
            )
        mean, low, high = self.nees_band()
        runs = self.estimates.shape[0]
        lines.append(f"{runs} runs, {self.failed} not converged")
        lines.append(f"pooled coverage of the 95 % intervals: {100 * self.pooled_coverage:.2f} %")
        lines.append(
            f"smallest p-value x {len(self.names)} parameters: {p.min() * len(self.names):.3g} "
            "(0.001 rejects)"
        )
        lines.append(
            f"mean normalised squared error: {mean:.4f}, 99 % band {low:.4f} .. {high:.4f}"
        )
        return "\n".join(lines)


def _fit_one(vehicle_path: str, log: Mapping[str, np.ndarray]) -> dict[str, Any]:
    from greybox import build_model, dataset_from_arrays, fit, read_vehicle

    vehicle = read_vehicle(vehicle_path)
    t = log["t"]
    data = dataset_from_arrays(t, {k: v for k, v in log.items() if k != "t"}, name="run")
    result = fit(build_model(vehicle, data.channels, EFFECTS), data, initialisation="nominal")
    names = result.correlation_names
    return {
        "names": names,
        "values": [result[n].value for n in names],
        "stds": [result[n].std for n in names],
        "covariance": result.model.covariance,
        "converged": result.converged,
    }


def recover(
    runs: int, *, seconds: float = 20.0, first_seed: int = 1000, workers: int | None = None
) -> Recovery:
    """Fly and fit `runs` seeds. Deterministic: results do not depend on the number of workers."""
    true_plant = plant()
    truth = true_plant.truth()["parameters"]
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        vehicle = str(
            write_vehicle(
                Path(folder) / "vehicle.toml",
                true_plant,
                sigma={"inertia": 0.2, "thrust.c2": 0.2, "torque.c2": 0.3},
                errors={"inertia": 1.1, "thrust.c2": 0.9, "torque.c2": 1.1},
            )
        )
        context = multiprocessing.get_context("spawn")
        with concurrent.futures.ProcessPoolExecutor(workers or cores(), mp_context=context) as pool:
            for start in range(0, runs, BATCH):
                seeds = list(range(first_seed + start, first_seed + min(start + BATCH, runs)))
                log = fly(
                    true_plant,
                    controller_for(true_plant),
                    RandomWaypoints(),
                    rich_excitation(),
                    seconds,
                    seed=seeds,
                    warm_up=1.0,
                )
                jobs = [
                    pool.submit(
                        _fit_one,
                        vehicle,
                        {k: v for k, v in member(log, i).items() if not k.startswith("omega")},
                    )
                    for i in range(len(seeds))
                ]
                rows += [job.result() for job in jobs]
                print(f"{len(rows)} of {runs} runs done", flush=True)
    names = rows[0]["names"]
    good = [r for r in rows if r["converged"]]
    true_values = np.array([float(np.asarray(truth[n])) for n in names])
    nees = []
    for r in good:
        error = np.array(r["values"]) - true_values
        size = np.sqrt(np.diag(r["covariance"]))
        scaled = r["covariance"] / np.outer(size, size)
        nees.append(float((error / size) @ np.linalg.solve(scaled, error / size)))
    return Recovery(
        names=tuple(names),
        truth=true_values,
        estimates=np.array([r["values"] for r in good]),
        stds=np.array([r["stds"] for r in good]),
        nees=np.array(nees),
        failed=len(rows) - len(good),
    )


def main(argv: Sequence[str] | None = None) -> None:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=20.0)
    arguments = parser.parse_args(argv)
    print(recover(arguments.runs, seconds=arguments.seconds).format())


if __name__ == "__main__":
    main()
