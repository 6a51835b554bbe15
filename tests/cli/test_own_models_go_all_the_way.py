"""Claim: models of the user's own go through fit, validate, discover, learn, export and a model
predictive controller by the commands of docs/own_model.md alone. The DC motor is that page; here
are two tanks whose lower one leaks with the square of its level, and a rover that a propeller of
fixed pitch pushes, with a drag that its model does not have. Both are simulated in NumPy."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from greybox.cli import main
from greybox.symbolic import FloatArray

HEAD = """
import casadi as ca
from greybox.model.dynamics import StateSpaceModel
from greybox.model.parameter import Parameter
from greybox.symbolic import Layout, Signal
"""
TANKS = """
def outflow(level):
    return ca.sqrt(ca.fmax(level, 0) + 1e-4)

LEVELS = Layout([Signal(name="upper", unit="m"), Signal(name="lower", unit="m")])

def build():
    return StateSpaceModel(
        name="two_tanks", states=LEVELS, outputs=LEVELS,
        inputs=Layout([Signal(name="pump", unit="V")]),
        parameters=(
            Parameter(name="gain", unit="m/(V s)", nominal=2e-3, lower=1e-5, scale=1e-3),
            Parameter(name="hole1", unit="m^0.5/s", nominal=8e-3, lower=1e-5, scale=4e-3),
            Parameter(name="hole2", unit="m^0.5/s", nominal=8e-3, lower=1e-5, scale=4e-3),
        ),
        dynamics=lambda t, x, u, p: [
            p["gain"] * u[0] - p["hole1"] * outflow(x[0]),
            p["hole1"] * outflow(x[0]) - p["hole2"] * outflow(x[1]),
        ],
        measurement=lambda t, x, u, p: [x[0], x[1]],
        noise_states=("upper", "lower"),
        initial_sigma={"upper": 0.1, "lower": 0.1}, sensor_sigma={"upper": 2e-3, "lower": 2e-3},
    )
"""
ROVER = """
MOTION = Layout([Signal(name="speed", unit="m/s"), Signal(name="turn", unit="rad/s")])

def build():
    return StateSpaceModel(
        name="rover", states=MOTION, outputs=MOTION,
        inputs=Layout([Signal(name="throttle", unit="1"), Signal(name="rudder", unit="rad")]),
        parameters=(
            Parameter(name="thrust", unit="m/s^2", nominal=4.0, lower=0.1, scale=2.0),
            Parameter(name="pitch", unit="1/s", nominal=0.5, lower=0.0, scale=0.3),
            Parameter(name="roll", unit="1/s", nominal=0.2, lower=0.0, scale=0.1),
            Parameter(name="wash", unit="1/s^2", nominal=5.0, lower=0.1, scale=3.0),
            Parameter(name="damping", unit="1/s", nominal=2.0, lower=0.1, scale=1.0),
        ),
        dynamics=lambda t, x, u, p: [
            p["thrust"] * u[0] ** 2 - p["pitch"] * u[0] * x[0] - p["roll"] * x[0],
            p["wash"] * u[0] ** 2 * ca.sin(u[1]) - p["damping"] * x[1],
        ],
        measurement=lambda t, x, u, p: [x[0], x[1]],
        noise_states=("speed", "turn"),
        initial_sigma={"speed": 1.0, "turn": 0.5}, sensor_sigma={"speed": 0.02, "turn": 0.01},
    )
"""


@dataclass(frozen=True, kw_only=True)
class Own:
    """A program, the truth of its machine as derivative (x, u), what the program lacks, and what a
    controller is asked for: the first output at `target`, inputs within `ranges`."""

    program: str
    names: tuple[str, ...]
    ranges: tuple[tuple[float, float], ...]
    truth: Callable[[FloatArray, FloatArray], FloatArray]
    start: tuple[float, ...]
    noise: tuple[float, ...]
    dt: float
    hold: int
    law: str
    on: str
    target: float


def _tanks(x: FloatArray, u: FloatArray) -> FloatArray:
    flow = 1.1e-2 * np.sqrt(max(x[0], 0.0)), 9e-3 * np.sqrt(max(x[1], 0.0))
    return np.array([1.5e-3 * u[0] - flow[0], flow[0] - flow[1] - 1e-2 * x[1] ** 2])


def _rover(x: FloatArray, u: FloatArray) -> FloatArray:
    drag = 0.1 * x[0] + 0.6 * x[0] * abs(x[0])
    return np.array(
        [6.0 * u[0] ** 2 - 0.4 * u[0] * x[0] - drag, 8.0 * u[0] ** 2 * np.sin(u[1]) - 3.0 * x[1]]
    )


MACHINES = {
    "two tanks": Own(
        program=TANKS,
        names=("pump", "upper", "lower"),
        ranges=((1.0, 10.0),),
        truth=_tanks,
        start=(0.3, 0.3),
        noise=(1e-3, 1e-3),
        dt=1.0,
        hold=100,
        law="lower",
        on="lower",
        target=0.5,
    ),
    "rover": Own(
        program=ROVER,
        names=("throttle", "rudder", "speed", "turn"),
        ranges=((0.05, 1.0), (-0.5, 0.5)),
        truth=_rover,
        start=(1.0, 0.0),
        noise=(0.01, 0.005),
        dt=0.05,
        hold=25,
        law="speed |speed|",
        on="speed",
        target=2.0,
    ),
}


def record(own: Own, path: Path, seed: int, n: int = 1000) -> None:
    """A log of held random inputs."""
    rng, x, rows = np.random.default_rng(seed), np.array(own.start), []
    low, high = np.array(own.ranges).T
    inputs = np.repeat(rng.uniform(low, high, (n // own.hold + 1, len(low))), own.hold, axis=0)
    for k, u in enumerate(inputs[:n]):
        rows.append([k * own.dt, *u, *(x + np.array(own.noise) * rng.standard_normal(2))])
        for _ in range(20):
            x = x + own.dt / 20 * own.truth(x, u)
    header = ",".join(("t", *own.names))
    np.savetxt(path, rows, delimiter=",", header=header, comments="")


class Machine:
    """The machine itself as a plant."""

    def __init__(self, name: str) -> None:
        self.own = MACHINES[name]

    def reset(self, seed: int) -> None:
        self.rng, self.x = np.random.default_rng(seed), np.array(self.own.start)

    def step(self, u: FloatArray, dt: float) -> None:
        for _ in range(20):
            self.x = self.x + dt / 20 * self.own.truth(self.x, u)

    def truth(self, u: FloatArray) -> dict[str, float]:
        return dict(zip(self.own.names[-2:], self.x.tolist(), strict=True))

    def measure(self, u: FloatArray) -> dict[str, float]:
        noise = np.array(self.own.noise) * self.rng.standard_normal(2)
        return dict(zip(self.own.names[-2:], (self.x + noise).tolist(), strict=True))


def two_tanks() -> Machine:
    return Machine("two tanks")


def rover() -> Machine:
    return Machine("rover")


@pytest.mark.slow
@pytest.mark.parametrize("name", MACHINES)
def test_it_is_fitted_judged_searched_learned_exported_and_controlled(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = MACHINES[name]
    monkeypatch.chdir(tmp_path)
    Path("own.py").write_text(HEAD + own.program)
    for i, log in enumerate(("a", "b", "c", "d")):
        record(own, Path(f"{log}.csv"), i)
    flights = ["--train", "a.csv", "b.csv", "--test", "c.csv"]
    assert main(["--quiet", "fit", "--model-file", "own.py:build", *flights, "--out", "fit"]) == 0
    assert main(["validate", "fit/model.json", "--log", "d.csv", "--json", "seen.json"]) == 0
    assert main(["discover", "--model-file", "own.py:build", *flights, "--out", "found"]) == 0
    found = json.loads(Path("found/discovery.json").read_text())
    (left,) = [u for u in found["unnamed"] if u["file"]]
    assert left["channel"] == own.on and own.on in left["depends_on"], left
    closed = [r for r in found["gap"] if r["group"] == own.on and r["horizon_s"] > 10 * own.dt]
    assert closed and all(r["with_proposals"] > 0.5 for r in closed), closed
    learn = ["learn", "fit/model.json", *flights, "--points", "12", "--inputs", own.on]
    assert main([*learn, "--out", "hybrid"]) == 0
    judged = json.loads(Path("hybrid/learn.json").read_text())["validation"]
    before, after = (
        judged[k]["horizons"][-1]["groups"][own.on]["mae"] for k in ("before", "after")
    )
    assert after < before
    assert main(["export", "hybrid/hybrid.json", "--out", "bundle"]) == 0
    assert main(["export", "found/model_with_laws.json", "--out", "lawful"]) == 0
    hold = ["--hold", f"{own.names[-2]}={own.target},{0.8 * own.target}"]
    limits = ["--limit", f"{own.names[-2]}=-inf,{1.1 * own.target}", "--flights", "2"]
    plant = ["--plant", f"{__name__}:{name.replace(' ', '_')}"]
    ranges = ["--range", *(f"{n}={a},{b}" for n, (a, b) in zip(own.names, own.ranges))]
    for file in ("hybrid/hybrid.json", "found/model_with_laws.json"):
        for of, extra in (("model", []), ("machine", plant)):
            out = f"{of}_{Path(file).stem}"
            assert main(["mpc", file, *hold, *limits, *ranges, *extra, "--out", out]) == 0
            content = json.loads(Path(out, "mpc_own.json").read_text())
            assert content["plant"] == (plant[1] if extra else "model")
            tube = content["controllers"]["tube"]
            assert tube["settled"][own.names[-2]] < 0.05 * own.target, (out, tube)
            assert tube["beyond"]["count"] == 0 == tube["failures"], (out, tube)
