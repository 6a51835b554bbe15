"""A model of one's own whose gain turns with the state: the fit and the verdict name the gain, not
the data and not the model, and the fit names the predictor that finds the truth."""

from __future__ import annotations

from functools import cache

import casadi as ca
import numpy as np

from greybox.data import Dataset, dataset_from_arrays
from greybox.estimation.fit import fit
from greybox.estimation.turning import turning_states
from greybox.model.dynamics import StateSpaceModel
from greybox.model.parameter import Parameter
from greybox.symbolic import Layout, Signal
from greybox.validation.advice import Symptom
from greybox.validation.validate import validate

TRUTH = {"k": 1.8, "tau": 0.25, "L": 0.42}
DT = 0.05


def rover(compass: bool) -> StateSpaceModel:
    """World position, heading, speed; the heading is measured with a compass alone."""
    names = ("px", "py", "psi", "v")
    seen = (*names[:2], "v", *(("psi",) if compass else ()))
    signal = {n: Signal(name=n, unit="m") for n in (*names, "thr", "steer")}
    return StateSpaceModel(
        name="rover",
        states=Layout([signal[n] for n in names]),
        inputs=Layout([signal["thr"], signal["steer"]]),
        outputs=Layout([signal[n] for n in seen]),
        parameters=(
            Parameter(name="k", unit="m/s", nominal=1.0, lower=0.1, scale=0.5),
            Parameter(name="tau", unit="s", nominal=0.5, lower=0.02, scale=0.2),
            Parameter(name="L", unit="m", nominal=0.3, lower=0.05, scale=0.1),
        ),
        dynamics=lambda t, x, u, p: [
            x[3] * ca.cos(x[2]),
            x[3] * ca.sin(x[2]),
            x[3] * ca.tan(u[1]) / p["L"],
            (p["k"] * u[0] - x[3]) / p["tau"],
        ],
        measurement=lambda t, x, u, p: [x[names.index(n)] for n in seen],
        noise_states=("psi", "v"),
        initial_sigma={"px": 0.1, "py": 0.1, "psi": 1.0, "v": 1.0},
    )


@cache
def drives(count: int, seed: int) -> Dataset:
    """Drives of 30 s with steps of throttle and steering."""
    rng, whole, n = np.random.default_rng(seed), None, 600
    for i in range(count):
        throttle, steer = (
            np.repeat(rng.uniform(low, high, n // 20), 20) for low, high in ((0.3, 1), (-0.4, 0.4))
        )
        x, rows = np.array([0.0, 0.0, rng.uniform(-1, 1), 0.0]), []
        for k in range(n):
            rows.append(x + [0.02, 0.02, 0.01, 0.02] * rng.standard_normal(4))
            for _ in range(20):
                turn = x[3] * np.tan(steer[k]) / TRUTH["L"]
                pull = (TRUTH["k"] * throttle[k] - x[3]) / TRUTH["tau"]
                x = x + DT / 20 * np.array([x[3] * np.cos(x[2]), x[3] * np.sin(x[2]), turn, pull])
            x = x + np.sqrt(DT) * np.array([0, 0, 0.02, 0.05]) * rng.standard_normal(4)
        columns = dict(zip(("px", "py", "psi", "v"), np.array(rows).T, strict=True))
        one = dataset_from_arrays(
            DT * np.arange(n), {"thr": throttle, "steer": steer, **columns}, name=f"drive{seed}{i}"
        )
        whole = one if whole is None else whole + one
    assert whole is not None
    return whole


def test_the_fit_blames_the_gain_and_names_what_finds_the_truth() -> None:
    found = fit(rover(compass=False), drives(2, 0))
    assert 'next: predictor="kalman"' in found.status.advice
    assert found.warnings[0] == found.status.advice
    assert not any("the data say nothing" in c.text for c in found.unidentifiable)
    better = fit(rover(compass=False), drives(2, 0), predictor="kalman")
    assert better.converged
    for name, value in TRUTH.items():
        assert abs(better[name].value - value) < 3 * better[name].std
    told = validate(better.model, drives(1, 9)).verdict
    assert told is not None and "the model itself is not judged" in told.sentence
    said = told.sentence
    assert Symptom.TURNING.anchor in said and "is missing in the model" not in said


def test_a_heading_that_is_measured_turns_nothing() -> None:
    found = fit(rover(compass=True), drives(2, 0), predictor="kalman")
    assert turning_states(found.model, drives(1, 9).segments) == ()
    told = validate(found.model, drives(1, 9)).verdict
    assert told is not None and told.line.startswith("useful")


def test_a_place_without_slopes_costs_no_verdict() -> None:
    """A tank that runs empty: the root of its level has no slope there."""
    level, pump = Signal(name="h", unit="m"), Signal(name="u", unit="V")
    model = StateSpaceModel(
        name="tank",
        states=Layout([level]),
        inputs=Layout([pump]),
        outputs=Layout([level]),
        parameters=(Parameter(name="c", unit="1", nominal=0.2, lower=0.01, scale=0.1),),
        dynamics=lambda t, x, u, p: [0.4 * u[0] - p["c"] * ca.sqrt(ca.fmax(x[0], 0))],
        measurement=lambda t, x, u, p: [x[0]],
        noise_states=("h",),
        initial_sigma={"h": 0.3},
    )

    def filled(name: str, seed: int, stops: int) -> Dataset:
        rng, n, dt = np.random.default_rng(seed), 200, 0.5
        u = np.where(np.arange(n) < stops, rng.uniform(0.4, 1.2, n // 20).repeat(20), 0.0)
        h, rows = 1.0, []
        for k in range(n):
            rows.append(h + 0.005 * rng.standard_normal())
            for _ in range(20):
                h = max(h + dt / 20 * (0.4 * u[k] - 0.25 * np.sqrt(max(h, 0.0))), 0.0)
        return dataset_from_arrays(dt * np.arange(n), {"u": u, "h": np.array(rows)}, name=name)

    found = fit(model, filled("full", 1, 200))
    empty = filled("empty", 2, 60)
    assert turning_states(found.model, [s for f in empty.flights for s in f.segments]) == ()
    assert validate(found.model, empty).verdict is not None
