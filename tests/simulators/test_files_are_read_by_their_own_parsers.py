"""Files that no simulator flies here, read by the parsers that their simulators use, where these
are Python packages: libsdformat (inside Drake), Pixar's USD and ArduPilot's pymavlink. What they
understand is the craft."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from greybox.model.example import example_vehicle
from greybox.simulators.change import changed
from greybox.simulators.craft import Craft
from greybox.simulators.make import twin
from greybox.simulators.targets import target_by_name
from tests.simulators.identified import AERODYNAMICS, Array, identified

NAME = 'né "<Craft> & 7"'


def written(target: str, folder: Path) -> Craft:
    """The craft as the target says it; its files are in the folder."""
    model = identified(AERODYNAMICS, replace(example_vehicle(), name=NAME))
    twin(model, [target], out=folder)
    craft = Craft.of(model)
    return changed(craft, [w.change for w in target_by_name(target).words(craft)])


@pytest.mark.parametrize("name", ["model.sdf", "model_classic.sdf"])
def test_libsdformat_reads_the_body_and_its_rotors(name: str, tmp_path: Path) -> None:
    parsing = pytest.importorskip("pydrake.multibody.parsing")
    plants = pytest.importorskip("pydrake.multibody.plant")
    craft = written("gazebo", tmp_path)
    plant = plants.MultibodyPlant(0.001)
    (model,) = parsing.Parser(plant).AddModels(str(tmp_path / "gazebo" / name))
    plant.Finalize()
    context = plant.CreateDefaultContext()
    bodies = plant.GetBodyIndices(model)
    assert len(bodies) == 1 + craft.count
    found = plant.CalcSpatialInertia(context, plant.world_frame(), bodies)
    np.testing.assert_allclose(found.get_mass(), craft.mass, rtol=1e-12)
    np.testing.assert_allclose(found.get_com(), craft.center_of_mass, atol=1e-12)
    about_centre = found.Shift(found.get_com()).CalcRotationalInertia().CopyToFullMatrix3()
    np.testing.assert_allclose(about_centre, craft.inertia, rtol=1e-9, atol=1e-12)
    hubs = [plant.get_body(b).EvalPoseInWorld(context).translation() for b in bodies[1:]]
    np.testing.assert_allclose(np.array(hubs) - craft.center_of_mass, craft.arms, atol=1e-12)


def test_usd_reads_the_body(tmp_path: Path) -> None:
    usd = pytest.importorskip("pxr.Usd")
    geometry, physics = pytest.importorskip("pxr.UsdGeom"), pytest.importorskip("pxr.UsdPhysics")
    craft = written("isaac", tmp_path)
    stage = usd.Stage.Open(str(tmp_path / "isaac" / f"{craft.name}.usda"))
    assert geometry.GetStageMetersPerUnit(stage) == 1.0 and geometry.GetStageUpAxis(stage) == "Z"
    (body,) = [p for p in stage.Traverse() if p.HasAPI(physics.RigidBodyAPI)]
    said = physics.MassAPI(body)
    assert said.GetMassAttr().Get() == pytest.approx(craft.mass, rel=1e-6)
    np.testing.assert_allclose(said.GetCenterOfMassAttr().Get(), craft.center_of_mass, atol=1e-8)
    axes = said.GetPrincipalAxesAttr().Get()
    turn = rotation(axes.GetReal(), *axes.GetImaginary())
    moments = np.diag(said.GetDiagonalInertiaAttr().Get())
    np.testing.assert_allclose(turn @ moments @ turn.T, craft.inertia, rtol=1e-5, atol=1e-8)


def rotation(w: float, x: float, y: float, z: float) -> Array:
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def test_pymavlink_reads_every_motor_parameter(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mavparm = pytest.importorskip("pymavlink.mavparm")
    written("ardupilot", tmp_path)
    path = tmp_path / "ardupilot" / "motors.parm"
    parameters = mavparm.MAVParmDict()
    assert parameters.load(str(path))
    assert "Invalid" not in capsys.readouterr().out
    rows = [r.split(",") for r in path.read_text().splitlines() if not r.startswith("#")]
    assert dict(parameters) == {name: float(value) for name, value in rows}
    assert all(len(name) <= 16 for name, _ in rows)  # what MAVLink carries
