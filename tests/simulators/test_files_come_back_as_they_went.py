"""A vehicle file made of a simulator's file gives the same simulator's file again, number by
number; shipped models of others are read too."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from greybox.cli import main
from greybox.errors import VehicleError
from greybox.model.vehicle import read_vehicle
from greybox.simulators.change import changed
from greybox.simulators.craft import Craft
from greybox.simulators.data_sheet import model_of
from greybox.simulators.sources import read_craft
from greybox.simulators.targets import target_by_name
from tests.simulators.identified import AERODYNAMICS, identified

NUMBER = re.compile(r"-?\d+\.?\d*(?:e[-+]?\d+)?")
VALUES = {
    k: v
    for k, v in AERODYNAMICS.items()
    if not k.startswith(("command", "thrust_curve", "rotor_asymmetry", "steady_wind", "payload"))
}
FILES = {
    "rotorpy": "vehicle.py",
    "crazyflow": "params.toml",
    "drone-models": "params.toml",
    "pybullet": "example.urdf",
    "gazebo": "model.sdf",
    "mujoco": "model.xml",
    "px4": "sih.params",
}

GRAVITY = {"px4": 9.80665, "gazebo": 9.80665}
"""Where the file does not hold it: what its simulator, or the reader, takes [m/s^2]."""


def written(target: str, craft: Craft) -> Mapping[str, str]:
    one = target_by_name(target)
    return one.files(changed(craft, [w.change for w in one.words(craft)]))


@pytest.mark.parametrize("target", FILES)
def test_there_and_back(target: str, tmp_path: Path) -> None:
    gravity = GRAVITY.get(target, 9.81)
    craft = Craft.of(identified(VALUES, gravity=gravity))
    name = FILES[target]
    first = written(target, craft)[name]
    (tmp_path / name).write_text(first)
    vehicle = tmp_path / "v.toml"
    source = ["--from", str(tmp_path / name), "--set", "name=example"]
    assert main(["vehicle", "new", *source, "--out", str(vehicle)]) == 0
    found = read_vehicle(vehicle)
    effects = {n: q for own in found.effects.values() for n, q in own.items()}
    for name_, q in {**found.quantities, **effects}.items():
        assert q.sigma > 0 or q.value == 0.0, (
            f"a file of a simulator says nothing of the error of {name_}"
        )
    again = written(target, Craft.of(model_of(found)))
    second = next(t for n, t in again.items() if Path(n).suffix == Path(name).suffix)
    # noise and the size of the domain are not in these files
    kept = ("noise", "stddev", "max_speed_kmh", "IMU", '"rI"', "<pose>0.0 0.0 0.0 0 0 0</pose>")
    rows = [
        [r for r in text.splitlines() if not any(k in r for k in kept)] for text in (first, second)
    ]
    if target == "pybullet":
        rows = [
            [re.sub(r'max_speed_kmh="[^"]*"', "", r) for r in t.splitlines()]
            for t in (first, second)
        ]
    old, new = ([float(v) for r in part for v in NUMBER.findall(r)] for part in rows)
    assert len(old) == len(new)
    np.testing.assert_allclose(new, old, rtol=1e-9, atol=1e-12)


def test_shipped_parameters_of_rotorpy_are_read() -> None:
    params = pytest.importorskip("rotorpy.vehicles.crazyflie_params")
    found = read_craft(str(params.__file__))
    assert found.mass == params.quad_params["mass"]
    np.testing.assert_allclose(found.hubs, list(params.quad_params["rotor_pos"].values()))
    assert found.effects["motor_lag.tau"] == params.quad_params["tau_m"]


def test_shipped_parameters_of_drone_models_are_read() -> None:
    import importlib.util

    spec = importlib.util.find_spec("drone_models")
    if spec is None or spec.origin is None:
        pytest.skip("drone-models comes with the extra judge")
    path = Path(spec.origin).parent / "data" / "params.toml"
    found = read_craft(str(path), "cf2x_L250")
    assert found.mass == 0.0319
    with pytest.raises(VehicleError, match="which craft"):
        read_craft(str(path))


@pytest.mark.parametrize(
    ("name", "text", "line"),
    [
        ("a.sdf", "<sdf><model name='x'/></sdf>", "no motor plugin"),
        ("a.sdf", "<sdf>", "not valid XML"),
        ("a.sdf", "<!DOCTYPE x [<!ENTITY y 'z'>]><sdf/>", "document type"),
        ("a.urdf", "<robot name='x'><link name='y'/></robot>", "no rotors"),
        ("a.xml", "<mujoco><worldbody/></mujoco>", "no rotors"),
        ("a.py", "quad_params = {'mass': open('x')}", "quad_params computes open"),
        ("a.py", "x = 1", "no dictionary quad_params"),
        ("a.toml", "[x]\nmass = 1.0", "which craft"),
        ("a.params", "1 1 SIH_MASS one 9", "not a parameter"),
        ("a.params", "1\t1\tSIH_MASS\t1.0\t9", "no SIH_IXX"),
        ("a.params", "1\t1\tSIH_MASS\t1,5\t9", "not a parameter"),
    ],
)
def test_what_is_no_craft_is_refused_in_one_line(
    name: str, text: str, line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / name
    path.write_text(text)
    assert main(["vehicle", "new", "--from", str(path)]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert line in said[-1] and len(said) == 1


def test_a_rotor_that_falls_by_its_drag_alone_has_a_lag(tmp_path: Path) -> None:
    """drone-models' fits of nano quadrotors: linear rates up, quadratic rates down [1/(rpm s)]."""
    craft = Craft.of(identified({"motor_lag.tau": 0.05}))
    text = written("drone-models", craft)["params.toml"]
    rpm = craft.hover_nu * craft.speed_max * 60.0 / (2.0 * np.pi)
    coefficients = [8.0, 0.0, 0.0, 12.0 / (2.0 * rpm)]
    (tmp_path / "p.toml").write_text(
        re.sub(r"rotor_dyn_coef = .*", f"rotor_dyn_coef = {coefficients}", text)
    )
    found = read_craft(str(tmp_path / "p.toml")).effects
    assert found["motor_lag.tau"] == pytest.approx(0.5 * (1 / 8.0 + 1 / 12.0))
    assert found["motor_lag_asymmetry.a"] == pytest.approx((1 / 12 - 1 / 8) / (1 / 12 + 1 / 8))
    assert found["motor_lag_speed.s"] == pytest.approx(0.5)
