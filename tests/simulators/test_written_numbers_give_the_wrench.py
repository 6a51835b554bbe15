"""The wrench recomputed from the written text with the simulator's published formulas is that of
our model as the statement says it: Gazebo, PX4 SIH, Pegasus and gym-pybullet-drones."""

from __future__ import annotations

import json
import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping

import numpy as np
import pytest

from greybox.errors import ModelError
from greybox.simulators.change import changed
from greybox.simulators.craft import Craft
from greybox.simulators.size import accelerations
from greybox.simulators.targets import target_by_name
from greybox.simulators.targets.gazebo import SLOWDOWN
from tests.simulators.identified import AERODYNAMICS, Array, identified

NO_COMMAND = {
    k: v for k, v in AERODYNAMICS.items() if not k.startswith(("command", "thrust_curve"))
}
MODEL = {**NO_COMMAND, "rotational_damping.d_p": 0.01, "rotor_drag.k_y": 3e-5}


def spoken(name: str, values: Mapping[str, float] = MODEL) -> tuple[Craft, Mapping[str, str]]:
    """The craft as the target says it, and its files."""
    target = target_by_name(name)
    craft = Craft.of(identified(values))
    said = changed(craft, [w.change for w in target.words(craft)])
    return said, target.files(said)


def states(craft: Craft, count: int = 20) -> dict[str, Array]:
    random = np.random.default_rng(5)
    q = random.standard_normal((4, count)) * 0.3 + np.array([[1.0], [0], [0], [0]])
    return {
        "attitude": q / np.linalg.norm(q, axis=0),
        "velocity": 3.0 * random.standard_normal((3, count)),
        "position": np.tile([[0.0], [0.0], [50.0]], count),
        "rate": random.standard_normal((3, count)),
        "inputs": craft.hover_nu + 0.1 * random.uniform(-1, 1, (len(craft.physics.inputs), count)),
    }


def rotation(q: Array) -> Array:
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def compare(
    craft: Craft, s: Mapping[str, Array], body: Mapping[str, Array], wrench: object
) -> None:
    """`wrench(k)` -> force and moment about the centre of mass, body axes, of state k."""
    ours = accelerations(craft, s)
    for k in range(s["rate"].shape[1]):
        force, moment = wrench(k)  # type: ignore[operator]
        rate, j = s["rate"][:, k], body["inertia"]
        alpha = np.linalg.solve(j, moment - np.cross(rate, j @ rate))
        np.testing.assert_allclose(force / body["mass"], ours[:3, k], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(alpha, ours[3:, k], rtol=1e-8, atol=1e-8)


def numbers(text: str | None) -> Array:
    return np.array([float(v) for v in str(text).split()])


def steiner(mass: float, arm: Array) -> Array:
    return mass * (float(arm @ arm) * np.eye(3) - np.outer(arm, arm))


@pytest.mark.parametrize("name", ["model.sdf", "model_classic.sdf"])
def test_gazebo(name: str) -> None:
    craft, files = spoken("gazebo")
    model = ElementTree.fromstring(files[name]).find("model")
    assert model is not None
    masses, places, inertias, rotors = [], [], [], []
    for link in model.findall("link"):
        origin = numbers(link.findtext("pose") or "0 0 0 0 0 0")[:3]
        own = numbers(link.findtext("inertial/pose") or "0 0 0 0 0 0")[:3]
        i = {e.tag: float(str(e.text)) for e in link.find("inertial/inertia") or ()}
        masses.append(float(str(link.findtext("inertial/mass"))))
        places.append(origin + own)
        inertias.append(
            np.array(
                [
                    [i["ixx"], i["ixy"], i["ixz"]],
                    [i["ixy"], i["iyy"], i["iyz"]],
                    [i["ixz"], i["iyz"], i["izz"]],
                ]
            )
        )
        rotors.append(origin)
    mass = sum(masses)
    com = sum(m * p for m, p in zip(masses, places, strict=True)) / mass
    inertia = sum(j + steiner(m, p - com) for m, p, j in zip(masses, places, inertias, strict=True))
    plugins = [{e.tag: e.text for e in p} for p in model.findall("plugin")]
    s = states(craft)
    wind = np.array([1.0, -0.5, 0.0])
    assert "<linear_velocity>1.0 -0.5 0.0</linear_velocity>" in files[name]

    def wrench(k: int) -> tuple[Array, Array]:
        turn = rotation(s["attitude"][:, k])
        force, moment = np.zeros(3), np.zeros(3)
        for i, p in enumerate(plugins):
            omega = craft.speed_max * s["inputs"][i, k]
            arm = rotors[i + 1] - com
            thrust = float(str(p["motorConstant"])) * omega**2
            air = turn.T @ (s["velocity"][:, k] - wind) + np.cross(s["rate"][:, k], arm)
            across = np.array([air[0], air[1], 0.0])
            hub = np.array([0, 0, thrust]) - omega * float(str(p["rotorDragCoefficient"])) * across
            way = 1.0 if p["turningDirection"] == "ccw" else -1.0
            force += hub
            moment += np.cross(arm, hub)
            moment[2] -= way * thrust * float(str(p["momentConstant"]))
            assert float(str(p["rotorVelocitySlowdownSim"])) == SLOWDOWN
        return force, moment

    compare(craft, s, {"mass": mass, "inertia": inertia}, wrench)


def test_px4() -> None:
    values = {k: v for k, v in MODEL.items() if not k.startswith("rotor_asymmetry")}
    craft, files = spoken("px4", values)
    rows = [line.split("\t") for line in files["sih.params"].splitlines() if line[0] != "#"]
    p = {r[2]: float(r[3]) for r in rows}
    j = np.array(
        [
            [p["SIH_IXX"], p["SIH_IXY"], p["SIH_IXZ"]],
            [p["SIH_IXY"], p["SIH_IYY"], p["SIH_IYZ"]],
            [p["SIH_IXZ"], p["SIH_IYZ"], p["SIH_IZZ"]],
        ]
    )
    flip = np.diag([1.0, -1.0, -1.0])  # FLU to FRD
    s = states(craft)
    c0, c1, c2 = craft.thrust
    spins = {tuple(np.sign(h[:2]).astype(int)): i for i, h in enumerate(craft.hubs)}
    order = [spins[1, -1], spins[-1, 1], spins[1, 1], spins[-1, -1]]

    def wrench(k: int) -> tuple[Array, Array]:
        nu = s["inputs"][:, k][order]
        u = (c0 + nu * (c1 + nu * c2)) / p["SIH_T_MAX"]  # the thrust that PX4 asks for
        turn = rotation(s["attitude"][:, k])
        north = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]])  # ENU to NED
        v = north @ s["velocity"][:, k]
        apparent = v + np.array([p["SIH_WIND_N"], p["SIH_WIND_E"], 0.0])
        drag = -p["SIH_KDV"] * apparent
        thrust = np.array([0, 0, -p["SIH_T_MAX"] * u.sum()])
        force = flip @ thrust + turn.T @ (north.T @ drag)
        moment = np.array(
            [
                p["SIH_L_ROLL"] * p["SIH_T_MAX"] * (-u[0] + u[1] + u[2] - u[3]),
                p["SIH_L_PITCH"] * p["SIH_T_MAX"] * (u[0] - u[1] + u[2] - u[3]),
                p["SIH_Q_MAX"] * (u[0] + u[1] - u[2] - u[3]),
            ]
        ) - p["SIH_KDW"] * (flip @ s["rate"][:, k])
        return force, flip @ moment

    compare(craft, s, {"mass": np.array(p["SIH_MASS"]), "inertia": flip @ j @ flip}, wrench)


def test_flightgoggles() -> None:
    yaml = pytest.importorskip("yaml")
    values = {k: v for k, v in MODEL.items() if not k.startswith("rotor_asymmetry")}
    craft, files = spoken("flightgoggles", values)
    p = yaml.safe_load(files["drone.yaml"])["flightgoggles_uav_dynamics"]
    s = states(craft)
    spins = {tuple(np.sign(h[:2]).astype(int)): i for i, h in enumerate(craft.hubs)}
    order = [spins[1, 1], spins[-1, 1], spins[-1, -1], spins[1, -1]]
    lever = p["moment_arm"] * p["thrust_coefficient"]
    inertia = np.array([p[f"vehicle_inertia_{a}"] for a in ("xx", "yy", "zz")])
    ours = accelerations(craft, s)
    for k in range(s["rate"].shape[1]):
        a, b, c, d = (craft.speed_max * s["inputs"][:, k][order]) ** 2
        turn, v = rotation(s["attitude"][:, k]), s["velocity"][:, k]
        lift = p["thrust_coefficient"] * (a + b + c + d) / p["vehicle_mass"]
        drag = -p["drag_coefficient"] * np.linalg.norm(v) * v
        force = turn.T @ drag + np.array([0.0, 0.0, lift])
        moment = [
            lever * (a + b - c - d),
            lever * (-a + b + c - d),
            p["torque_coefficient"] * (-a + b - c + d),
        ]
        np.testing.assert_allclose(force, ours[:3, k], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(np.array(moment) / inertia, ours[3:, k], rtol=1e-8, atol=1e-8)
    assert p["min_arming_thrust"] < 1.1 * craft.mass * craft.gravity


def test_pegasus() -> None:
    values = {k: v for k, v in MODEL.items() if not k.startswith("rotor_asymmetry")}
    craft, files = spoken("isaac", values)
    text = files["pegasus.yaml"]

    def row(key: str) -> Array:
        found = re.search(rf"{key}: \[([^]]*)\]", text)
        assert found is not None
        return np.array([float(v) for v in found.group(1).split(",")])

    usd = files[f"{craft.name}.usda"]

    def triple(key: str) -> Array:
        found = re.search(rf"{re.escape(key)} = \(([^)]*)\)", usd)
        assert found is not None
        return np.array([float(v) for v in found.group(1).split(",")])

    turn = rotation(triple("physics:principalAxes"))
    inertia = turn @ np.diag(triple("physics:diagonalInertia")) @ turn.T
    np.testing.assert_allclose(inertia, craft.inertia, atol=1e-12)
    com = triple("physics:centerOfMass")
    places = [
        np.array([float(v) for v in m.split(",")])
        for m in re.findall(r"xformOp:translate = \(([^)]*)\)", usd)
    ]
    constants, moments, way = (
        row(k) for k in ("rotor_constant", "rolling_moment_coefficient", "rot_dir")
    )
    drag, s = row("drag"), states(craft)

    def wrench(k: int) -> tuple[Array, Array]:
        omega = craft.speed_max * s["inputs"][:, k]
        thrust = constants * omega**2
        v = rotation(s["attitude"][:, k]).T @ s["velocity"][:, k]
        force = np.array([0, 0, thrust.sum()]) - drag * v
        moment = sum(np.cross(p - com, [0, 0, t]) for p, t in zip(places, thrust, strict=True))
        return force, moment + np.array([0.0, 0.0, np.sum(moments * omega**2 * way)])

    mass = re.search(r"physics:mass = (\S+)", usd)
    assert mass is not None
    compare(craft, s, {"mass": np.array(float(mass.group(1))), "inertia": inertia}, wrench)


def test_gym_pybullet_drones() -> None:
    values = {k: v for k, v in MODEL.items() if not k.startswith("rotor_asymmetry")}
    craft, files = spoken("pybullet", values)
    root = ElementTree.fromstring(files[f"{craft.name}.urdf"])
    # the reader of gym-pybullet-drones goes by position in the tree
    properties, base = root[0].attrib, root[1]
    mass = float(base[0][1].attrib["value"])
    i = {k: float(v) for k, v in base[0][2].attrib.items()}
    inertia = np.array(
        [
            [i["ixx"], i["ixy"], i["ixz"]],
            [i["ixy"], i["iyy"], i["iyz"]],
            [i["ixz"], i["iyz"], i["izz"]],
        ]
    )
    com = numbers(base[0][0].attrib["xyz"])
    assert float(base[2][1][0].attrib["length"]) > 0
    links = [e for e in root.findall("link") if e.attrib["name"].startswith("prop")]
    props = [numbers(e[0][0].attrib["xyz"]) for e in links]
    order = [int(np.argmin(np.linalg.norm(craft.hubs - p, axis=1))) for p in props]
    kf, km = float(properties["kf"]), float(properties["km"])
    xy, z = float(properties["drag_coeff_xy"]), float(properties["drag_coeff_z"])
    s = states(craft)

    def wrench(k: int) -> tuple[Array, Array]:
        rpm = 60 / (2 * math.pi) * craft.speed_max * s["inputs"][:, k][order]
        thrust, torque = kf * rpm**2, km * rpm**2
        factors = -np.array([xy, xy, z]) * np.sum(2 * math.pi * rpm / 60)
        drag = rotation(s["attitude"][:, k]).T @ (factors * s["velocity"][:, k])
        force = np.array([0, 0, thrust.sum()]) + drag
        moment = sum(np.cross(p - com, [0, 0, t]) for p, t in zip(props, thrust, strict=True))
        yaw = -torque[0] + torque[1] - torque[2] + torque[3]
        return force, moment + np.array([0.0, 0.0, yaw])

    compare(craft, s, {"mass": np.array(mass), "inertia": inertia}, wrench)


def test_a_layout_that_sih_does_not_have_is_refused() -> None:
    from greybox.model.example import example_vehicle

    plus = example_vehicle().to_dict()
    for rotor, place in zip(plus["rotor"], ((0.1, 0), (0, 0.1), (-0.1, 0), (0, -0.1)), strict=True):
        rotor["position"] = [*place, 0.0]
    vehicle = type(example_vehicle()).from_dict(plus)
    craft = Craft.of(identified({}, vehicle))
    with pytest.raises(ModelError, match="PX4 SIH cannot express the rotors"):
        target_by_name("px4").words(craft)


@pytest.mark.parametrize("further", [{}, {"thrust.c1": 1.5, "thrust_curve.f": 0.2}])
def test_ardupilot(further: Mapping[str, float]) -> None:
    values = {k: v for k, v in MODEL.items() if not k.startswith("rotor_asymmetry")} | further
    craft, files = spoken("ardupilot", values)
    f = json.loads(files["frame.json"])
    rho, g, n = 1.225, 9.80665, int(f["num_motors"])
    # Frame::init
    weight, tilt = f["mass"] * g, math.radians(f["refAngle"])
    momentum = (
        math.cos(tilt) ** 2
        * f["mdrag_coef"]
        * f["refSpd"]
        * math.sqrt(weight / math.cos(tilt) * rho * f["disc_area"])
    )
    area = (weight * math.tan(tilt) - momentum) / (0.5 * rho * f["refSpd"] ** 2)
    hover_out = 2 * f["refCurrent"] * f["refVoltage"] / weight
    effective = weight / (0.5 * rho * hover_out**2) / n
    fastest = hover_out / math.sqrt(f["hoverThrOut"])
    flip = np.diag([1.0, -1.0, -1.0])
    s = states(craft)
    wind = np.array([1.0, -0.5, 0.0])
    order = [
        int(np.argmin(np.linalg.norm(craft.arms - flip @ f[f"motor{i}_position"], axis=1)))
        for i in range(1, n + 1)
    ]

    def motion(k: int) -> tuple[Array, Array]:
        """Specific force and angular acceleration, body axes."""
        turn = rotation(s["attitude"][:, k])
        air = flip @ turn.T @ (s["velocity"][:, k] - wind)
        rate = flip @ s["rate"][:, k]
        force, torque = np.zeros(3), np.zeros(3)
        for i in range(n):
            u = s["inputs"][order[i], k]
            place = np.array(f[f"motor{i + 1}_position"])
            out = fastest * math.sqrt((1 - f["propExpo"]) * u + f["propExpo"] * u * u)
            pull = 0.5 * rho * effective * out**2  # less 1e-4 of it per (m/s)^2 of climb
            yaw = f[f"motor{i + 1}_yaw"] * u * 0.05 * f["diagonal_size"] * pull
            drag = f["mdrag_coef"] * math.sqrt(rho * f["disc_area"] / n * pull)
            push = np.array([0, 0, -pull]) - drag * (air - np.cross(place, rate))
            torque += np.cross(place, push) + np.array([0, 0, yaw])
            force += push
        force -= area * 0.5 * rho * air * np.abs(air)
        alpha = torque / f["moment_inertia"] - rate * math.radians(400.0) / f["refRotRate"]
        return flip @ force / f["mass"], flip @ alpha

    apart = [
        np.abs(np.concatenate(motion(k)) - ours) for k, ours in enumerate(accelerations(craft, s).T)
    ]
    p = dict(r.split(",") for r in files["motors.parm"].splitlines() if r[0] != "#")
    assert float(p["SIM_WIND_SPD"]) == pytest.approx(np.linalg.norm(wind))
    assert int(p["SIM_WIND_T"]) == 1, "0 would scale the wind by the root of height over 60 m"
    said = {
        w.effect: w.how for w in target_by_name("ardupilot").words(Craft.of(identified(values)))
    }
    assert "first 5 s" in said["steady_wind"]
    assert "air density" in said["thrust map"]
    # drag goes with the root of the thrust, which is the speed only where c1 = 0; the statement has
    # the yaw torque to second degree in the command, SITL to third
    forces = 1e-9 if not further else 0.02
    assert np.max(apart, axis=0)[:5].max() < forces
    assert np.max(apart, axis=0)[5] < 0.02


def test_a_layout_that_ardupilot_does_not_have_is_refused() -> None:
    from greybox.model.example import example_vehicle

    wrong = example_vehicle().to_dict()
    for rotor in wrong["rotor"]:
        rotor["spin"] = -rotor["spin"]
    craft = Craft.of(identified({}, type(example_vehicle()).from_dict(wrong)))
    with pytest.raises(ModelError, match="ArduPilot SITL cannot express the rotors"):
        target_by_name("ardupilot").words(craft)
