"""Simulators of others fly the files that `greybox twin` wrote: one function per simulator, all of
one form.

    states = FLYERS["rotorpy"](folder, Start(...), commands, before, dt, voltage)

States are (steps, 13 + n): position and velocity of the centre of mass (world ENU), attitude (w, x,
y, z), rate (body FLU), then the rotors' speeds nu. Nothing here knows the model: numbers and
callbacks come from the folder.
"""

from __future__ import annotations

import importlib.util
import math
import re
import sys
import tomllib
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from greybox.symbolic import FloatArray
from scenarios.foreign.plant import MissingSimulator

STEP = 0.002
"""Longest step of the simulators that are stepped here [s]."""
PER_MINUTE = 60.0 / (2.0 * math.pi)


@dataclass(frozen=True, kw_only=True, eq=False)
class Start:
    """Position, velocity (world), attitude (w, x, y, z), rate (body) of the centre of mass, speeds
    nu (n,) of the rotors. `push`: force [N] and moment [N m] (6,) in body axes that push it now and
    fade as pushes.py says; None without."""

    position: FloatArray
    velocity: FloatArray
    attitude: FloatArray
    rate: FloatArray
    rotors: FloatArray
    push: FloatArray | None = None


Flyer = Callable[..., FloatArray]
"""(folder, start, commands (steps, n), those sent before (past, n), dt, battery voltages (steps,),
rest=False) -> states; `rest`: also with the forces of rest.py."""


def load(folder: Path, *names: str) -> tuple[ModuleType, ...]:
    """Modules of these names in `folder`, which may import each other."""
    sys.path.insert(0, str(folder))
    kept: dict[str, ModuleType | None] = {n: sys.modules.pop(n, None) for n in (*names, "commands")}
    try:
        found = []
        for name in names:
            spec = importlib.util.spec_from_file_location(name, folder / f"{name}.py")
            assert spec is not None and spec.loader is not None
            module = importlib.util.module_from_spec(spec)
            sys.modules[name] = module
            spec.loader.exec_module(module)
            found.append(module)
        return tuple(found)
    finally:
        sys.path.remove(str(folder))
        for name, before in kept.items():
            sys.modules.pop(name, None)
            if before is not None:
                sys.modules[name] = before


def rotation(q: FloatArray) -> FloatArray:
    """Body to world, of (w, x, y, z)."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _arriving(
    commands: Any, u: FloatArray, before: FloatArray, dt: float, voltage: FloatArray | None
) -> Iterator[list[tuple[float, FloatArray]]]:
    """Per step the speeds nu that reach the motors, with how long each lasts [s]."""
    first = before[0] if len(before) else np.full(u.shape[1], commands.HOVER_COMMAND)
    line = commands.DelayLine(first)
    for sent in before:
        line.pieces(sent, dt)
    for k, sent in enumerate(u):
        volt = None if voltage is None else float(voltage[k])
        yield [(s, commands.normalised_speed(held, volt)) for s, held in line.pieces(sent, dt)]


def _fading(folder: Path, start: Start, steps: int, dt: float) -> FloatArray:
    """Force and moment (steps, 6) of the start's push in every step, body axes."""
    if start.push is None:
        return np.zeros((steps, 6))
    (module,) = load(folder, "pushes")
    pushes = module.Pushes(force=start.push[:3], moment=start.push[3:])
    return np.array([np.concatenate(pushes.step(dt)) for _ in range(steps)])


def fly_rotorpy(
    folder: Path,
    start: Start,
    u: FloatArray,
    before: FloatArray,
    dt: float,
    voltage: FloatArray | None = None,
    *,
    rest: bool = False,
) -> FloatArray:
    """RotorPy's Multirotor with the written dictionary."""
    commands, vehicle = load(folder, "commands", "vehicle")
    multirotor = _multirotor()
    if rest:
        (sys.modules["rest"],) = load(folder, "rest")
        sys.modules["commands"] = commands
        try:
            multirotor = vehicle.with_rest(multirotor)
        finally:
            del sys.modules["rest"], sys.modules["commands"]
    return _rotorpy(
        multirotor,
        vehicle.quad_params,
        commands,
        vehicle.WIND,
        vehicle.STRENGTH,
        commands.SPEED_MAX,
        start,
        u,
        before,
        dt,
        voltage,
        _fading(folder, start, len(u), dt),
    )


def _multirotor() -> Any:
    try:
        from rotorpy.vehicles.multirotor import Multirotor
    except ImportError as missing:
        raise MissingSimulator("rotorpy") from missing
    return Multirotor


def _rotorpy(
    multirotor: Any,
    params: Mapping[str, Any],
    commands: Any,
    wind: FloatArray,
    strength: FloatArray,
    scale: float,
    start: Start,
    u: FloatArray,
    before: FloatArray,
    dt: float,
    voltage: FloatArray | None,
    pushes: FloatArray | None = None,
) -> FloatArray:
    class Pushed(multirotor):
        """Pushed by the force and moment `push` (6,), body axes."""

        push = np.zeros(6)

        def _s_dot_fn(self, t: float, s: FloatArray, cmd_rotor_speeds: FloatArray) -> FloatArray:
            out = super()._s_dot_fn(t, s, cmd_rotor_speeds)
            turn = rotation(s[[9, 6, 7, 8]] / np.linalg.norm(s[6:10]))
            out[3:6] += turn @ self.push[:3] / self.mass
            out[10:13] += self.inv_inertia @ self.push[3:]
            return np.asarray(out)

    w, x, y, z = start.attitude
    speeds = scale * np.sqrt(strength)
    state = {
        "x": start.position,
        "v": start.velocity,
        "q": np.array([x, y, z, w]),
        "w": start.rate,
        "wind": np.asarray(wind, dtype=float),
        "rotor_speeds": speeds * start.rotors,
    }
    craft = Pushed(dict(params), state, integrator_kwargs={"rtol": 1e-5, "atol": 1e-7})
    rows = []
    for k, pieces in enumerate(_arriving(commands, u, before, dt, voltage)):
        if pushes is not None:
            craft.push = pushes[k]
        for seconds, nu in pieces:
            state = craft.step(state, {"cmd_motor_speeds": speeds * nu}, seconds)
        x, y, z, w = state["q"]
        rows.append(
            [*state["x"], *state["v"], w, x, y, z, *state["w"], *(state["rotor_speeds"] / speeds)]
        )
    return np.array(rows)


def fly_mujoco(
    folder: Path,
    start: Start,
    u: FloatArray,
    before: FloatArray,
    dt: float,
    voltage: FloatArray | None = None,
    *,
    rest: bool = False,
) -> FloatArray:
    """MuJoCo with the written MJCF and its callback."""
    try:
        import mujoco
    except ImportError as missing:
        raise MissingSimulator("mujoco") from missing
    commands, callback = load(folder, "commands", "callback")
    model = mujoco.MjModel.from_xml_path(str(folder / "model.xml"))
    data = mujoco.MjData(model)
    com, n = np.asarray(callback.COM), u.shape[1]
    turn = rotation(start.attitude)
    data.qpos[:3] = start.position - turn @ com
    data.qpos[3:7] = start.attitude
    data.qvel[:3] = start.velocity - turn @ np.cross(start.rate, com)
    data.qvel[3:6] = start.rate
    callback.attach()
    rows, pushes = [], _fading(folder, start, len(u), dt)
    try:
        data.act[:n] = start.rotors
        for push, pieces in zip(pushes, _arriving(commands, u, before, dt, voltage), strict=True):
            for seconds, nu in pieces:
                count = math.ceil(seconds / STEP)
                model.opt.timestep = seconds / count
                data.ctrl[:] = nu
                for _ in range(count):
                    turn = rotation(data.qpos[3:7] / np.linalg.norm(data.qpos[3:7]))
                    data.xfrc_applied[1] = [*(turn @ push[:3]), *(turn @ push[3:])]
                    mujoco.mj_step(model, data)
            q, rate = data.qpos[3:7].copy(), data.qvel[3:6].copy()
            turn = rotation(q)
            velocity = data.qvel[:3] + turn @ np.cross(rate, com)
            rows.append(
                np.concatenate([data.qpos[:3] + turn @ com, velocity, q, rate, data.act[:n]])
            )
    finally:
        callback.detach()
    return np.array(rows)


_KEYS = (
    "mass",
    "L",
    "prop_inertia",
    "gravity_vec",
    "J",
    "J_inv",
    "rpm2thrust",
    "rpm2torque",
    "mixing_matrix",
    "drag_matrix",
    "rotor_dyn_coef",
)


def _first_principles(package: str) -> Callable[..., tuple[Any, ...]]:
    try:
        if package == "crazyflow":
            from crazyflow.dynamics.first_principles import dynamics
        else:
            importlib.import_module(
                "scenarios.foreign.drone_models_plant"
            )  # imports it as it wants to be
            from drone_models.first_principles import dynamics
    except ImportError as missing:
        raise MissingSimulator(package) from missing
    return dynamics


def fly_drone_models(
    folder: Path,
    start: Start,
    u: FloatArray,
    before: FloatArray,
    dt: float,
    voltage: FloatArray | None = None,
    *,
    rest: bool = False,
) -> FloatArray:
    """drone-models' first-principles rates with the written parameters, by Runge-Kutta."""
    (commands,) = load(folder, "commands")
    (numbers,) = tomllib.loads((folder / "params.toml").read_text()).values()
    return _rates(
        "drone-models",
        numbers,
        commands,
        commands.RPM_MAX,
        start,
        u,
        before,
        dt,
        voltage,
        load(folder, "rest")[0] if rest else None,
        _fading(folder, start, len(u), dt),
    )


def fly_crazyflow(
    folder: Path,
    start: Start,
    u: FloatArray,
    before: FloatArray,
    dt: float,
    voltage: FloatArray | None = None,
    *,
    rest: bool = False,
) -> FloatArray:
    """crazyflow's first-principles rates with the written parameters, by Runge-Kutta."""
    (commands,) = load(folder, "commands")
    (numbers,) = tomllib.loads((folder / "params.toml").read_text()).values()
    return _rates(
        "crazyflow",
        numbers,
        commands,
        commands.RPM_MAX,
        start,
        u,
        before,
        dt,
        voltage,
        load(folder, "rest")[0] if rest else None,
        _fading(folder, start, len(u), dt),
    )


def _rates(
    package: str,
    numbers: Mapping[str, Any],
    commands: Any,
    scale: float,
    start: Start,
    u: FloatArray,
    before: FloatArray,
    dt: float,
    voltage: FloatArray | None,
    rest: Any = None,
    pushes: FloatArray | None = None,
) -> FloatArray:
    dynamics = _first_principles(package)
    p = {k: np.array(v, dtype=float) for k, v in numbers.items() if k in _KEYS}
    p["J_inv"] = np.linalg.inv(p["J"])

    pushes = np.zeros((len(u), 6)) if pushes is None else pushes

    def rate(s: FloatArray, cmd: FloatArray, push: FloatArray) -> FloatArray:
        quat, ang = s[3:7], s[10:13]
        q = quat[[3, 0, 1, 2]] / np.linalg.norm(quat)
        force, moment = push[:3], push[3:]
        if rest is not None:
            more = rest.rest(q, s[7:10], s[:3], ang, s[13:] / scale)
            force, moment = force + more[0], moment + more[1]
        turn = rotation(q)
        extra = {"dist_f": turn @ force, "dist_t": turn @ moment}
        d = dynamics(s[:3], quat, s[7:10], ang, cmd, s[13:], **p, **extra)
        v, w = quat[:3], quat[3]
        turning = 0.5 * np.concatenate([w * ang + np.cross(v, ang), [-v @ ang]])
        return np.concatenate([d[0], turning, d[2], d[3], d[4]])

    w, x, y, z = start.attitude
    s = np.concatenate(
        [start.position, [x, y, z, w], start.velocity, start.rate, scale * start.rotors]
    )
    rows = []
    for push, pieces in zip(pushes, _arriving(commands, u, before, dt, voltage), strict=True):
        for seconds, nu in pieces:
            count = math.ceil(seconds / (2 * STEP))
            h = seconds / count
            for _ in range(count):
                k1 = rate(s, scale * nu, push)
                k2 = rate(s + h / 2 * k1, scale * nu, push)
                k3 = rate(s + h / 2 * k2, scale * nu, push)
                s = s + h / 6 * (k1 + 2 * (k2 + k3) + rate(s + h * k3, scale * nu, push))
                s[3:7] /= np.linalg.norm(s[3:7])
        rows.append(np.concatenate([s[:3], s[7:10], s[[6, 3, 4, 5]], s[10:13], s[13:] / scale]))
    return np.array(rows)


def fly_pybullet(
    folder: Path,
    start: Start,
    u: FloatArray,
    before: FloatArray,
    dt: float,
    voltage: FloatArray | None = None,
    *,
    rest: bool = False,
) -> FloatArray:
    """PyBullet with the written URDF, pushed as gym-pybullet-drones does (BaseAviary: `_physics`,
    `_drag`): thrusts at the prop links, yaw torque and world drag at the centre of mass. Rotors of
    the written order come from commands.py."""
    try:
        import pybullet as bullet
    except ImportError as missing:
        raise MissingSimulator("pybullet") from missing
    (commands,) = load(folder, "commands")
    (path,) = folder.glob("*.urdf")
    order = [int(v) - 1 for v in path.read_text().split("are rotors ")[1].split(".")[0].split(",")]
    more = load(folder, "rest")[0] if rest else None
    client = bullet.connect(bullet.DIRECT)
    try:
        craft = _InBullet(bullet, client, path, start, more)
        rotors = commands.Rotors(start.rotors)
        for sent in before:
            rotors._line.pieces(sent, dt)
        rows = []
        count = math.ceil(dt / 0.0005)
        bullet.setTimeStep(dt / count, physicsClientId=client)
        pushes = _fading(folder, start, len(u), dt)
        for k, sent in enumerate(u):
            volt = None if voltage is None else float(voltage[k])
            for _ in range(count):
                rpm = commands.RPM_MAX * rotors.speeds(sent, dt / count, volt)[order]
                craft.step(rpm, rotors.nu, pushes[k])
            rows.append(np.concatenate([craft.motion(), rotors.nu]))
        return np.array(rows)
    finally:
        bullet.disconnect(client)


class _InBullet:
    """The written URDF in a client of PyBullet."""

    def __init__(self, bullet: Any, client: int, path: Path, start: Start, more: Any) -> None:
        self.bullet, self.at, self.more = bullet, {"physicsClientId": client}, more
        root = ElementTree.parse(path).getroot()
        self.numbers = {k: float(v) for k, v in root[0].attrib.items()}
        com = np.array([float(v) for v in root[1][0][0].attrib["xyz"].split()])
        bullet.setGravity(0, 0, -9.8, **self.at)
        inertia = bullet.URDF_USE_INERTIA_FROM_FILE
        self.body = body = bullet.loadURDF(str(path), flags=inertia, **self.at)
        bullet.changeDynamics(body, -1, linearDamping=0, angularDamping=0, **self.at)
        w, x, y, z = start.attitude
        turn = rotation(start.attitude)
        # Bullet's base is the inertial frame: at the centre of mass, along the principal axes.
        _, _, _, at, along, *_ = bullet.getDynamicsInfo(body, -1, **self.at)
        here, quat = bullet.multiplyTransforms(start.position - turn @ com, [x, y, z, w], at, along)
        bullet.resetBasePositionAndOrientation(body, here, quat, **self.at)
        bullet.resetBaseVelocity(body, start.velocity, turn @ start.rate, **self.at)
        self.back = bullet.invertTransform(at, along)

    def _place(self) -> tuple[Any, FloatArray]:
        """Position of the centre of mass, and attitude (w, x, y, z) of the body's own axes."""
        place, turned = self.bullet.getBasePositionAndOrientation(self.body, **self.at)
        _, q = self.bullet.multiplyTransforms(place, turned, *self.back)
        return place, np.array([q[3], q[0], q[1], q[2]])

    def step(self, rpm: FloatArray, nu: FloatArray, push: FloatArray) -> None:
        """One step under rotors of `rpm` (4,), in the file's order, nu (4,) in greybox's, and a
        force and torque `push` (6,) in body axes."""
        bullet, body, p, world = self.bullet, self.body, self.numbers, self.bullet.WORLD_FRAME
        thrust, torque = p["kf"] * rpm**2, p["km"] * rpm**2
        velocity, spin = bullet.getBaseVelocity(body, **self.at)
        factors = -np.array([p["drag_coeff_xy"], p["drag_coeff_xy"], p["drag_coeff_z"]])
        drag = factors * np.sum(rpm) / PER_MINUTE * np.array(velocity)
        place, q = self._place()
        axes = np.array(bullet.getMatrixFromQuaternion([*q[1:], q[0]])).reshape(3, 3)
        for i in range(4):
            up = [0, 0, thrust[i]]
            bullet.applyExternalForce(body, i, up, [0, 0, 0], bullet.LINK_FRAME, **self.at)
        yaw = axes[:, 2] * (-torque[0] + torque[1] - torque[2] + torque[3])
        yaw = yaw + axes @ push[3:]
        drag = drag + axes @ push[:3]
        bullet.applyExternalTorque(body, -1, yaw, world, **self.at)
        bullet.applyExternalForce(body, -1, drag, place, world, **self.at)
        if self.more is not None:
            rate = axes.T @ np.array(spin)
            rest = self.more.rest(q, velocity, place, rate, nu)
            force, moment = self.more.in_world(q, *rest)
            bullet.applyExternalForce(body, -1, force, place, world, **self.at)
            bullet.applyExternalTorque(body, -1, moment, world, **self.at)
        bullet.stepSimulation(**self.at)

    def motion(self) -> FloatArray:
        """Position, velocity, attitude and rate, (13,)."""
        velocity, spin = self.bullet.getBaseVelocity(self.body, **self.at)
        place, q = self._place()
        return np.concatenate([place, velocity, q, rotation(q).T @ np.array(spin)])


FOOT = 0.3048
"""[m]."""
FLIP, SWAP = np.diag([1.0, -1.0, -1.0]), np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
"""FLU and FRD into each other; ENU and NED."""


def fly_jsbsim(
    folder: Path,
    start: Start,
    u: FloatArray,
    before: FloatArray,
    dt: float,
    voltage: FloatArray | None = None,
    *,
    rest: bool = False,
) -> FloatArray:
    """JSBSim with the written aircraft on the planet that stands still; world ENU at the equator's
    longitude 0."""
    try:
        import jsbsim
    except ImportError as missing:
        raise MissingSimulator("jsbsim") from missing
    if rest or start.push is not None:
        raise ValueError("JSBSim takes no further wrench here")
    (commands,) = load(folder, "commands")
    step = 1e-4  # filters keep the step that the model was loaded with
    sim = _started(jsbsim.FGFDMExec(str(folder)), folder, start, step)
    position, rows = start.position.copy(), []

    def motion() -> tuple[FloatArray, FloatArray]:
        w = np.array([sim[f"velocities/v-{a}-fps"] for a in ("north", "east", "down")]) * FOOT
        return SWAP.T @ w, np.array([sim[f"velocities/{a}-rad_sec"] for a in "pqr"])

    last, _ = motion()
    for pieces in _arriving(commands, u, before, dt, voltage):
        for seconds, nu in pieces:
            count = round(seconds / step)
            for i, value in enumerate(nu, 1):
                sim[f"fcs/nu-cmd{i}"] = float(value)
            for _ in range(count):
                sim.run()
                now, _ = motion()
                position = position + step * 0.5 * (last + now)
                last = now
        velocity, rate = motion()
        phi, theta, psi = (sim[f"attitude/{a}-rad"] for a in ("phi", "theta", "psi"))
        body = SWAP.T @ _euler(phi, theta, psi) @ FLIP
        speeds = [sim[f"fcs/nu{i}"] for i in range(1, u.shape[1] + 1)]
        rows.append(np.concatenate([position, velocity, _quaternion(body), FLIP @ rate, speeds]))
    return np.array(rows)


def _started(sim: Any, folder: Path, start: Start, step: float) -> Any:
    """JSBSim with the written aircraft at the start, its rotors at their speeds."""
    (path,) = (folder / "aircraft").glob("*/*.xml")
    sim.set_debug_level(0)
    sim.load_planet(str(folder / "planet.xml"), False)
    sim.set_dt(step)
    sim.load_model(path.stem)
    turn = SWAP @ rotation(start.attitude) @ FLIP  # FRD to NED
    v = FLIP @ rotation(start.attitude).T @ start.velocity / FOOT
    p, q, r = FLIP @ start.rate
    for name, value in {
        "ic/h-sl-ft": 1000.0,
        "ic/lat-gc-deg": 0.0,
        "ic/long-gc-deg": 0.0,
        "ic/phi-rad": math.atan2(turn[2, 1], turn[2, 2]),
        "ic/theta-rad": -math.asin(turn[2, 0]),
        "ic/psi-true-rad": math.atan2(turn[1, 0], turn[0, 0]),
        "ic/u-fps": v[0],
        "ic/v-fps": v[1],
        "ic/w-fps": v[2],
        "ic/p-rad_sec": p,
        "ic/q-rad_sec": q,
        "ic/r-rad_sec": r,
    }.items():
        sim[name] = float(value)
    for i, nu in enumerate(start.rotors, 1):
        sim[f"fcs/nu-cmd{i}"] = float(nu)
    sim.run_ic()
    for axis, speed in re.findall(r"wind-(\w+)-fps (-?[\d.e+-]*\d)", path.read_text()):
        sim[f"atmosphere/wind-{axis}-fps"] = float(speed)
    sim.suspend_integration()  # filters run up to the speeds that the rotors start with
    tau = 1.0 / float(re.findall(r"<c1>(.*?)</c1>", path.read_text())[0])
    for _ in range(math.ceil(20.0 * tau / step)):
        sim.run()
    sim.resume_integration()
    sim.set_dt(step)
    return sim


def _euler(phi: float, theta: float, psi: float) -> FloatArray:
    c, s = np.cos([phi, theta, psi]), np.sin([phi, theta, psi])
    x = np.array([[1, 0, 0], [0, c[0], -s[0]], [0, s[0], c[0]]])
    y = np.array([[c[1], 0, s[1]], [0, 1, 0], [-s[1], 0, c[1]]])
    z = np.array([[c[2], -s[2], 0], [s[2], c[2], 0], [0, 0, 1]])
    return np.asarray(z @ y @ x)


def _quaternion(m: FloatArray) -> FloatArray:
    """(w, x, y, z) of a rotation that turns by less than half a turn."""
    w = 0.5 * math.sqrt(max(0.0, 1.0 + float(np.trace(m))))
    return np.array(
        [w, *(np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]]) / (4 * w))]
    )


FLYERS: Mapping[str, Flyer] = {
    "jsbsim": fly_jsbsim,
    "rotorpy": fly_rotorpy,
    "mujoco": fly_mujoco,
    "drone-models": fly_drone_models,
    "crazyflow": fly_crazyflow,
    "pybullet": fly_pybullet,
}


# ---------------------------------------------------------------- what ships with the simulators


def fly_shipped_rotorpy(
    commands: Any,
    start: Start,
    u: FloatArray,
    before: FloatArray,
    dt: float,
    voltage: FloatArray | None = None,
) -> FloatArray:
    """RotorPy's own Crazyflie. Commands become speeds so that it carries its own weight at the
    hover command of the real craft, which is more than its file says."""
    try:
        from rotorpy.vehicles.crazyflie_params import quad_params
    except ImportError as missing:
        raise MissingSimulator("rotorpy") from missing
    hover = math.sqrt(quad_params["mass"] * 9.81 / 4 / quad_params["k_eta"])
    order = _same_places([quad_params["rotor_pos"][k] for k in quad_params["rotor_pos"]])
    return _rotorpy(
        _multirotor(),
        quad_params,
        _Turned(commands, order),
        np.zeros(3),
        np.ones(4),
        hover / commands.HOVER,
        _turned(start, order),
        u,
        before,
        dt,
        voltage,
    )


def fly_shipped_drone_models(
    commands: Any,
    start: Start,
    u: FloatArray,
    before: FloatArray,
    dt: float,
    voltage: FloatArray | None = None,
) -> FloatArray:
    """drone-models' cf2x_L250, commands scaled as in `fly_shipped_rotorpy`."""
    _first_principles("drone-models")
    from drone_models.core import load_params

    numbers = load_params("first_principles", "cf2x_L250")
    mass, curve = float(numbers["mass"]), np.asarray(numbers["rpm2thrust"], dtype=float)
    need = mass * 9.81 / 4 - curve[0]
    hover = (-curve[1] + math.sqrt(curve[1] ** 2 + 4 * curve[2] * need)) / (2 * curve[2])
    m = np.asarray(numbers["mixing_matrix"], dtype=float)
    order = _same_places(list(np.stack([-m[1], m[0], 0 * m[0]], axis=1)))
    return _rates(
        "drone-models",
        {**numbers, "gravity_vec": [0, 0, -9.81]},
        _Turned(commands, order),
        hover / commands.HOVER,
        _turned(start, order),
        u,
        before,
        dt,
        voltage,
    )


SHIPPED = {"rotorpy": fly_shipped_rotorpy, "drone-models": fly_shipped_drone_models}


class _Turned:
    """commands.py with the rotors in another order, and even ones."""

    def __init__(self, commands: Any, order: list[int]) -> None:
        self.HOVER, self.HOVER_COMMAND = commands.HOVER, commands.HOVER_COMMAND
        self.DelayLine, self._own, self._order = commands.DelayLine, commands, order

    def normalised_speed(self, u: FloatArray, voltage: float | None = None) -> FloatArray:
        """Speeds of the shipped craft's rotors."""
        return np.asarray(self._own.normalised_speed(u, voltage))[self._order]


def _turned(start: Start, order: list[int]) -> Start:
    return Start(
        position=start.position,
        velocity=start.velocity,
        attitude=start.attitude,
        rate=start.rate,
        rotors=start.rotors[order],
    )


NANOBENCH_SIGNS = ((1, -1), (-1, -1), (-1, 1), (1, 1))
"""Front right, rear right, rear left, front left: signs of x and y of the rotors 1 to 4 of the
flights."""


def _same_places(hubs: list[Any]) -> list[int]:
    """Which rotor of the flights stands where each of `hubs` does."""
    return [NANOBENCH_SIGNS.index((int(np.sign(h[0])), int(np.sign(h[1])))) for h in hubs]
