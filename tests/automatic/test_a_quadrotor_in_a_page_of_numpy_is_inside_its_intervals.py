"""A quadrotor that shares no line with greybox, flown through gusts that nobody names: the plain
command's 95 % intervals hold the truth, and inertia comes out within a few percent."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import numpy as np
import pytest

from greybox.cli import main

MASS, INERTIA, THRUST, TORQUE, LAG, ARM = (
    0.5,
    np.array([2.5e-3, 2.8e-3, 4.4e-3]),
    3.2,
    0.05,
    0.04,
    0.12,
)
X, Y, SPIN = (
    np.array([1, -1, -1, 1]) * ARM,
    np.array([-1, -1, 1, 1]) * ARM,
    np.array([1, -1, 1, -1]),
)
SUBSTEPS, STEP, GRAVITY = 10, 0.01, 9.81
NOISE = {"p": 0.01, "q": 0.01, "r": 0.01, "ax": 0.05, "ay": 0.05, "az": 0.05}
COLUMNS = "t,u1,u2,u3,u4,x,y,z,vx,vy,vz,qw,qx,qy,qz,p,q,r,ax,ay,az"


def matrix(q: np.ndarray) -> np.ndarray:
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def slope(s: np.ndarray, u: np.ndarray, force: np.ndarray, torque: np.ndarray) -> np.ndarray:
    v, q, w, nu = s[3:6], s[6:10], s[10:13], s[13:17]
    lift = THRUST * nu**2
    push = matrix(q) @ (np.array([0, 0, lift.sum()]) + force) / MASS - [0, 0, GRAVITY]
    moment = np.array([Y @ lift, -X @ lift, -SPIN @ (TORQUE * nu**2)]) + torque
    turn = 0.5 * np.array([-q[1:] @ w, *(q[0] * w + np.cross(q[1:], w))])
    return np.concatenate(
        [v, push, turn, (moment - np.cross(w, INERTIA * w)) / INERTIA, (u - nu) / LAG]
    )


def command(s: np.ndarray, aim: np.ndarray, shake: np.ndarray) -> np.ndarray:
    turn = matrix(s[6:10])
    wanted = 2.5 * (aim - s[:3]) - 2.2 * s[3:6] + [0, 0, GRAVITY]
    tilt = turn.T @ (wanted / np.linalg.norm(wanted))
    spin = np.array([-8 * tilt[1], 8 * tilt[0], -2 * np.arctan2(turn[1, 0], turn[0, 0])])
    moment = INERTIA * (12.0 * (spin - s[10:13]) + shake)
    lift = MASS * max(wanted @ turn[:, 2], 2.0)
    mix = np.array([np.ones(4), Y, -X, -SPIN * TORQUE / THRUST])
    return np.sqrt(np.clip(np.linalg.solve(mix, np.array([lift, *moment])) / THRUST, 0.01, 1.0))


def flight(path: Path, seed: int, seconds: float = 20.0, random: float = 1.0) -> None:
    """`random` scales the noise of the sensors and the gusts."""
    rng = np.random.default_rng(seed)
    s = np.concatenate(
        [np.zeros(6), [1, 0, 0, 0], np.zeros(3), np.full(4, np.sqrt(MASS * GRAVITY / 4 / THRUST))]
    )
    force, torque, rows, aim = np.zeros(3), np.zeros(3), [], np.zeros(3)
    tones = rng.uniform(0.4, 6.0, (6, 3)), rng.uniform(0, 2 * np.pi, (6, 3))
    memory = np.exp(-STEP / 0.5)
    for k in range(round(seconds / STEP)):
        if k % 150 == 0:
            aim = rng.uniform(-1.2, 1.2, 3) * [1, 1, 0.5]
        shake = (
            np.array([5, 5, 1.5])
            * np.sin(2 * np.pi * tones[0] * k * STEP + tones[1]).sum(axis=0)
            / 2
        )
        u = command(s, aim, shake)
        around = np.add(slope(s, u, force, torque)[3:6], [0, 0, GRAVITY]) @ matrix(s[6:10])
        read = np.concatenate(
            [
                s[:3] + random * 0.002 * rng.normal(size=3),
                s[3:6] + random * 0.02 * rng.normal(size=3),
            ]
        )
        q = s[6:10] + random * 0.0015 * np.array([0, *rng.normal(size=3)])
        level = random * np.array(list(NOISE.values()))
        imu = np.concatenate([s[10:13], around]) + level * rng.normal(size=6)
        rows.append(np.concatenate([[k * STEP], u, read, q / np.linalg.norm(q), imu]))
        force = memory * force + random * 0.12 * np.sqrt(1 - memory**2) * rng.normal(size=3)
        torque = memory * torque + random * 0.002 * np.sqrt(1 - memory**2) * rng.normal(size=3)
        for _ in range(SUBSTEPS):
            h = STEP / SUBSTEPS
            a = slope(s, u, force, torque)
            b = slope(s + h / 2 * a, u, force, torque)
            c = slope(s + h / 2 * b, u, force, torque)
            d = slope(s + h * c, u, force, torque)
            s = s + h / 6 * (a + 2 * b + 2 * c + d)
            s[6:10] /= np.linalg.norm(s[6:10])
    np.savetxt(path, rows, delimiter=",", header=COLUMNS, comments="", fmt="%.9g")


def vehicle(path: Path, rng: np.random.Generator) -> None:
    wrong = np.exp(rng.normal(size=5) * [0.25, 0.25, 0.25, 0.15, 0.25])
    i = INERTIA * wrong[:3]
    i[2] = min(i[2], 0.98 * (i[0] + i[1]))
    rotors = "".join(
        f"[[rotor]]\nposition = [{x}, {y}, 0.0]\nspin = {n}\n"
        for x, y, n in zip(X, Y, SPIN, strict=True)
    )
    path.write_text(
        f"""schema = "greybox.vehicle/2"
name = "a page of numpy"
gravity = {GRAVITY}
mass = {MASS}
inertia = [[{i[0]:.4g}, 0.0, 0.0], [0.0, {i[1]:.4g}, 0.0], [0.0, 0.0, {i[2]:.4g}]]
center_of_mass_sigma = [0.0, 0.0, 0.0]
{rotors}
[actuator]
u_min = 0.0
u_max = 1.0
hold = "previous"
rotor_radius = 0.06
thrust = [0.0, 0.0, {THRUST * wrong[3]:.4g}]
torque = [0.0, 0.0, {TORQUE * wrong[4]:.4g}]
""",
        encoding="utf-8",
    )


TRUTH = {
    "inertia.xx": INERTIA[0],
    "inertia.yy": INERTIA[1],
    "inertia.zz": INERTIA[2],
    "thrust.c2": THRUST,
    "torque.c2": TORQUE,
    "motor_lag.tau": LAG,
}


def fitted(folder: Path, *words: str) -> dict[str, dict[str, float]]:
    out = folder / f"out{len(words)}"
    assert main(["fit", *words, "--out", str(out)]) == 0
    found: dict[str, dict[str, float]] = json.loads((out / "fit.json").read_text(encoding="utf-8"))[
        "parameters"
    ]
    return found


@pytest.mark.slow
def test_the_plain_fit_of_single_flights_in_gusts_holds_at_least_seventeen_of_eighteen(
    tmp_path: Path,
) -> None:
    inside, moments = 0, []
    for seed in (1, 2, 3):
        folder = tmp_path / str(seed)
        folder.mkdir()
        flight(folder / "a.csv", seed)
        vehicle(folder / "v.toml", np.random.default_rng(100 + seed))
        found = fitted(
            folder, "--vehicle", str(folder / "v.toml"), "--train", str(folder / "a.csv")
        )
        # The file's drag torque is up to 31 % wrong. The coupling of the axes tells it; held, it
        # bends thrust by 5 %.
        assert set(TRUTH) <= set(found)
        inside += sum(
            abs(found[n]["value"] - t) <= 1.96 * found[n]["std"] for n, t in TRUTH.items()
        )
        moments += [found[n]["value"] / TRUTH[n] - 1 for n in ("inertia.xx", "inertia.yy")]
        assert all(
            found[n]["std"] < 0.02 * TRUTH[n] for n in ("inertia.xx", "inertia.yy", "thrust.c2")
        )
        result = json.loads((folder / "out4" / "fit.json").read_text(encoding="utf-8"))
        assert [d["choice"] for d in result["decisions"] if d["about"] == "torque.c2"] == [
            "estimated"
        ]
        again = fitted(folder, *shlex.split(result["explicit"]["command"])[2:])
        assert {n: e["value"] for n, e in again.items()} == {
            n: e["value"] for n, e in found.items()
        }
    assert inside >= 17
    assert np.sqrt(np.mean(np.square(moments))) < 0.01


@pytest.mark.slow
def test_flights_without_any_noise_converge_to_the_truth_and_say_what_was_added(
    tmp_path: Path,
) -> None:
    for seed, name in enumerate("abc"):
        flight(tmp_path / f"{name}.csv", seed, 10.0, random=0.0)
    vehicle(tmp_path / "v.toml", np.random.default_rng(100))
    words = ["--vehicle", str(tmp_path / "v.toml"), "--test", str(tmp_path / "c.csv"), "--train"]
    found = fitted(tmp_path, *words, *(str(tmp_path / f"{n}.csv") for n in "ab"))
    result = json.loads((tmp_path / f"out{len(words) + 2}" / "fit.json").read_text("utf-8"))
    assert result["status"]["converged"]
    assert "noise" in next(d["choice"] for d in result["decisions"] if d["about"] == "sensors")
    assert all(n == "white" for n in noise_of_sensors(result))
    for n, truth in TRUTH.items():
        assert abs(found[n]["value"] - truth) <= max(3.0 * found[n]["std"], 0.002 * truth), n
    again = fitted(tmp_path, *shlex.split(result["explicit"]["command"])[2:])
    assert {n: e["value"] for n, e in again.items()} == {n: e["value"] for n, e in found.items()}


def noise_of_sensors(result: dict[str, list[dict[str, str]]]) -> list[str]:
    """What was decided of the noise of the pose and of the IMU."""
    about = ("noise of the pose", "noise of the IMU")
    return [d["choice"] for d in result["decisions"] if d["about"] in about]


@pytest.mark.slow
def test_a_parameter_that_somebody_holds_stays_held(tmp_path: Path) -> None:
    flight(tmp_path / "a.csv", 3)
    vehicle(tmp_path / "v.toml", np.random.default_rng(103))
    words = (
        "--vehicle",
        str(tmp_path / "v.toml"),
        "--train",
        str(tmp_path / "a.csv"),
        "--fixed",
        "torque.c2",
    )
    assert "torque.c2" not in fitted(tmp_path, *words)
