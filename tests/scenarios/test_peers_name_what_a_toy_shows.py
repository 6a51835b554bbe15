"""The peers of the league table: terms are those of the catalogue, and toys are named."""

from __future__ import annotations

import functools
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from greybox.excitation.injection import rich_excitation
from greybox.excitation.waypoints import RandomWaypoints
from greybox.model.vehicle import read_vehicle
from greybox.plants import effects as hidden
from greybox.plants.flight_log import fly, write_log
from greybox.plants.noise import SensorNoise
from greybox.plants.presets import X250, controller_for
from greybox.plants.quadrotor import Quadrotor
from greybox.plants.vehicle_file import write_vehicle
from scenarios.foreign.naming import read_rows
from scenarios.studies import league
from scenarios.studies.league_terms import Regression, read_columns, regression

QUIET = SensorNoise(gyro=1e-4, accelerometer=1e-3, attitude=1e-5, position=1e-5, velocity=1e-4)
RESULTS = Path(league.__file__).parents[1] / "results"
LAG = hidden.MotorLag(tau=0.04)


def folder_of(path, *effects, flights=("train1", "train2", "test1")):
    """Flights of a 250 mm craft with these effects, and a file that knows its lag alone."""
    path.mkdir(exist_ok=True)
    plant = Quadrotor(X250, [LAG, *effects], sensors=QUIET)
    write_vehicle(path / "vehicle.toml", plant, known=["motor_lag"])
    for seed, name in enumerate(flights):
        log = fly(
            plant, controller_for(plant), RandomWaypoints(), rich_excitation(), 6.0, seed=seed
        )
        write_log(path / f"{name}.csv", log, drop=("omega",))
    return path


seldom = functools.partial(pytest.param, marks=pytest.mark.slow)
"""A term whose kind another row has."""


@pytest.mark.parametrize(
    ("effect", "size"),
    [
        (hidden.RotorDrag(k_x=4e-5, k_y=6e-5), (4e-5, 6e-5)),
        (hidden.AxialInflow(k_z=5e-5), (5e-5,)),
        (hidden.RotationalDamping(d_p=4e-3, d_q=3e-3, d_r=4e-3), (4e-3, 3e-3, 4e-3)),
        seldom(hidden.RotorAsymmetry(delta=(0.04, -0.02, 0.0, -0.02)), (0.04, -0.02, 0.0)),
        (hidden.ThrustCurve(f=0.2), (0.2,)),
        seldom(hidden.RotorGyroscopic(J_r=4e-6), (4e-6,)),
        (hidden.ProductsOfInertia(Jxy=2e-4, Jxz=-1e-4, Jyz=1e-4), (2e-4, -1e-4, 1e-4)),
        seldom(hidden.BladeFlapping(k_flap=1e-6), (1e-6,)),
        (hidden.ConstantForce(f_x=0.2, f_y=-0.1), (0.2, -0.1, 0.0)),
        seldom(hidden.TranslationalLift(k_h=0.03), (0.03,)),
        (hidden.ParasiticDrag(c_x=0.02, c_y=0.03, c_z=0.02), (0.02, 0.03, 0.02)),
        seldom(hidden.PayloadMass(mu=0.1), (0.1,)),
        (hidden.CenterOfMassOffset(c_x=0.01, c_y=-0.008), (0.01, -0.008)),
        seldom(hidden.AccelerometerBias(b_x=0.2, b_y=-0.1, b_z=0.2), (0.2, -0.1, 0.2)),
        (hidden.GyroBias(b_x=0.03, b_y=-0.02, b_z=0.01), (0.03, -0.02, 0.01)),
        seldom(hidden.GyroScale(s_x=0.05, s_y=-0.05, s_z=0.04), (0.05, -0.05, 0.04)),
        seldom(hidden.AccelerometerScale(s_z=0.04), (0.0, 0.0, 0.04)),
        (hidden.AccelerometerLeverArm(r_x=0.03, r_y=-0.02, r_z=0.02), (0.03, -0.02, 0.02)),
        seldom(
            hidden.ImuMisalignment(theta_x=0.04, theta_y=-0.03, theta_z=0.04), (0.04, -0.03, 0.04)
        ),
        seldom(
            hidden.MocapMisalignment(theta_x=0.04, theta_y=-0.03, theta_z=0.04), (0.04, -0.03, 0.04)
        ),
        (hidden.PoseLeverArm(r_x=0.04, r_y=-0.03, r_z=0.04), (0.04, -0.03, 0.04)),
        seldom(hidden.PoseDelay(d=0.02), (0.02,)),
        (hidden.SensorDelay(d=0.015), (0.015,)),
    ],
)
def test_the_coefficient_of_a_term_is_the_parameter_of_its_effect(effect, size, tmp_path):
    folder = folder_of(tmp_path, effect, flights=("train1",))
    found = regression(read_vehicle(folder / "vehicle.toml"), read_columns(folder / "train1.csv"))
    height = np.array([1.0, 1.0, 1.0, 20.0, 20.0, 20.0])  # angular accelerations are rougher
    height = np.append(height, [0.05, 0.05, 0.05, 0.5, 0.5, 0.5])  # pose less IMU
    y = (found.y / height).reshape(-1)
    x = (found.terms[effect.name] / height[:, None]).reshape(len(y), -1)
    value = np.linalg.lstsq(x, y, rcond=None)[0]
    assert value[: len(size)] == pytest.approx(size, rel=0.25, abs=0.1 * max(map(abs, size)))


def toy(seed=0, size=0.5):
    """400 rows in which the two columns of `a` matter."""
    random = np.random.default_rng(seed)
    owner = ["a", "a", "b", "c|d", "e"]

    def part():
        x = random.standard_normal((400, len(owner)))
        return size * (x[:, 0] - x[:, 1]) + 0.5 * random.standard_normal(400), x

    parts = [part(), part()]
    whole = tuple(np.concatenate(p) for p in zip(*parts))
    return league.Problem(parts=parts, train=whole, test=part(), owner=owner)


@pytest.mark.parametrize("peer", list(league.PEERS))
def test_a_peer_names_what_a_toy_shows_and_nothing_else(peer):
    if peer not in league.present():
        pytest.skip(f"{league.NEEDS[peer]} comes with the extra judge")
    assert league.PEERS[peer](toy(), 0) == {"a"}


def test_a_split_f_test_of_noise_names_nothing():
    assert sum(bool(league.split_f(toy(seed, 0.0), 0)) for seed in range(20)) <= 2


def test_a_term_of_several_effects_is_a_set():
    found = league.said({"a", "b|c"})
    assert found.named == {"a"} and found.sets == [[frozenset("b"), frozenset("c")]]


def test_of_equally_good_models_the_smallest_is_chosen():
    random = np.random.default_rng(0)
    noise = random.standard_normal(1000)
    left = [noise + 1.0, 1.001 * noise, noise + 0.01 * random.standard_normal(1000)]
    assert league.sparsest(left, [0, 2, 1]) == 2
    ups_and_downs = np.repeat(np.resize([0.99, 1.0099], 10), 100)
    assert league.sparsest([noise, ups_and_downs * noise], [0, 1]) == 0


def test_gusts_that_last_are_made_white_and_the_files_doubts_kept():
    random = np.random.default_rng(1)
    gust = lfilter([1.0], [1.0, -0.9], random.standard_normal((4000, 2)), axis=0)
    x, core = random.standard_normal((2, 4000, 2, 1))
    some = Regression(
        y=2.0 * x[..., 0] + 0.3 * core[..., 0] + gust,
        terms={"a": x},
        core=core,
        known={"mass": (0.1, 10.0)},
    )
    white, off = league.Whitening.of([some])
    assert white.keep == pytest.approx([0.9, 0.9], abs=0.02)
    assert white.scale == pytest.approx([1.0, 1.0], abs=0.05)
    assert off["mass"] == pytest.approx(0.1 + 0.3, abs=0.05)
    _, sure = league.Whitening.of([replace(some, known={"mass": (0.0, 1e-6)})])
    assert sure["mass"] == pytest.approx(0.0, abs=1e-3)


def test_a_number_of_the_file_is_fitted_before_terms_are_asked(tmp_path):
    folder = folder_of(tmp_path, flights=("train1", "train2", "test1"))
    text = (folder / "vehicle.toml").read_text(encoding="utf-8")
    mass = read_vehicle(folder / "vehicle.toml").mass.value
    wrong = re.sub(r"(?m)^mass = .*$", f"mass = {{ value = {1.3 * mass}, sigma = {mass} }}", text)
    assert wrong != text
    (folder / "vehicle.toml").write_text(wrong, encoding="utf-8")
    assert "payload_mass" not in league.split_f(league.problem(folder), 0)


def test_what_the_file_declares_is_no_discrepancy(tmp_path):
    drag = hidden.RotorDrag(k_x=8e-5, k_y=8e-5)
    folder = folder_of(tmp_path, drag)
    assert "rotor_drag" in league.split_f(league.problem(folder), 0)
    with (folder / "vehicle.toml").open("a", encoding="utf-8") as stream:
        stream.write("\n[effects.rotor_drag]\n")
        stream.writelines(f"{k} = {{ value = 8e-5, sigma = 0.0 }}\n" for k in ("k_x", "k_y"))
    found = league.problem(folder)
    assert "rotor_drag" not in found.owner
    assert not league.split_f(found, 0) & {"axial_inflow", "parasitic_drag", "constant_force"}


def test_quaternions_that_change_sign_are_one_attitude(tmp_path):
    folder = folder_of(tmp_path, flights=("train1",))
    lines = (folder / "train1.csv").read_text(encoding="utf-8").splitlines()
    at = [lines[0].split(",").index(n) for n in ("qw", "qx", "qy", "qz")]
    for k in range(200, 400):
        row = lines[k].split(",")
        for i in at:
            row[i] = str(-float(row[i]))
        lines[k] = ",".join(row)
    (folder / "turned.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    one, other = (read_columns(folder / f"{n}.csv") for n in ("train1", "turned"))
    assert other["qx"] == pytest.approx(one["qx"], abs=1e-9)


def test_a_folder_is_compared_and_counted(tmp_path):
    folder = folder_of(tmp_path / "drag", hidden.RotorDrag(k_x=8e-5, k_y=8e-5))
    truth = {"cell": "single:rotor_drag", "seed": 1, "hidden": ["rotor_drag"], "sensors": "ideal"}
    (folder / "truth.json").write_text(json.dumps(truth), encoding="utf-8")
    rows = league.compared(folder)
    assert [r["peer"] for r in rows] == league.present()
    assert all("rotor_drag" in r["named"] for r in rows)
    asked = {"asked": "single:rotor_drag", "seed": 1, "power": None}
    said = league.table([{**asked, **r, "judged": "right"} for r in rows])
    line = next(x for x in said.splitlines() if x.startswith("| one effect"))
    assert line.count("1/1<br>2.5-100.0 %") == len(league.present())
    assert "clean: a false name | - " in said


def test_without_its_package_a_peer_is_left_out_and_said(monkeypatch, tmp_path, capsys):
    (tmp_path / "rows.jsonl").write_text("", encoding="utf-8")
    monkeypatch.setattr(league.importlib.util, "find_spec", lambda name: None)
    assert league.present() == ["split F"]
    assert league.main(["--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "without pyoperon, which comes with: pip install greybox-sysid[judge]" in said


def kept(pattern):
    return read_rows(sorted(RESULTS.glob(pattern)))


def test_judged_rows_draw_the_log_that_was_judged(tmp_path):
    folder = tmp_path / "there"
    folder.mkdir()
    (folder / "truth.json").write_text("{}", encoding="utf-8")
    rows = kept("naming_1355.jsonl.gz")
    assert all(league.flown(row, folder) == folder for row in rows)
    with pytest.raises(ValueError, match="drawn otherwise today: simulator"):
        league.flown({**rows[0], "simulator": "another"}, folder)


def test_the_page_shows_the_table_of_the_rows_that_are_kept(capsys):
    page = (RESULTS.parents[1] / "docs" / "discovery_judged.md").read_text(encoding="utf-8")
    (command,) = re.findall(r"scenarios\.studies\.league --summary (\S+)", page)
    assert league.main(["--summary", str(RESULTS.parents[1] / command)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "| | greybox | SINDy | E-SINDy | split F | Operon |"
    assert all(line in page for line in lines)


def test_greybox_stands_in_the_table_as_it_was_judged():
    rows = {(r["asked"], r["seed"]): r for r in kept("naming_1[23]*.jsonl.gz")}
    own = [r for r in kept("league_*.jsonl.gz") if r["peer"] == "greybox"]
    assert len(own) > 100
    for row in own:
        assert row["judged"] == rows[row["asked"], row["seed"]]["judged"]
