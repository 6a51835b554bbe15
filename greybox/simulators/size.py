"""Size: how large what a simulator cannot say is, over the states that the model was trained on.

    force, turning   what the change does to the specific force and the angular acceleration
    thrust           share of the thrust at hover, at the battery voltages of training
    position, angle  how far a flight of half a second goes astray by it

Points are drawn from the ranges of the training flights (`IdentifiedModel.domain`); what was not
measured there is at rest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from greybox.files import Json
from greybox.model.layer import LearnedPush
from greybox.model.model import PhysicsModel
from greybox.simulators.change import Change, changed
from greybox.simulators.craft import Craft
from greybox.simulators.learned import learned_at, with_learned
from greybox.symbolic import FloatArray

POINTS, FLIGHTS, FLIGHT_TIME = 256, 24, 0.5
"""Drawn states, drawn flights, and how long these last [s]."""


@dataclass(frozen=True, kw_only=True)
class Size:
    """Root mean square and largest change of specific force [m/s^2] and angular acceleration
    [rad/s^2]; lowest and highest change of the thrust at hover (shares); root mean square error of
    position [m] and attitude [rad] after `FLIGHT_TIME`."""

    force: float
    force_max: float
    turning: float
    turning_max: float
    thrust: tuple[float, float]
    position: float
    angle: float

    def to_dict(self) -> dict[str, Json]:
        """Plain values."""
        return {**asdict(self), "thrust": list(self.thrust)}

    @property
    def text(self) -> str:
        """For people; what is zero is left out."""
        parts = []
        thrust = max(self.thrust, key=abs)
        if abs(thrust) >= 5e-4:
            parts.append(f"thrust {100 * thrust:+.1f} %")
        if self.force_max >= 5e-4:
            parts.append(f"{self.force:.2g} m/s^2 (up to {self.force_max:.2g})")
        if self.turning_max >= 5e-3:
            parts.append(f"{self.turning:.2g} rad/s^2 (up to {self.turning_max:.2g})")
        if self.position >= 5e-5 or self.angle >= 5e-5:
            where = f"{1e3 * self.position:.2g} mm, {math.degrees(self.angle):.2g} deg"
            parts.append(f"after {FLIGHT_TIME:g} s {where}")
        return "; ".join(parts) or "nothing that is seen in these flights"


def size_of(craft: Craft, change: Change, *, unlearned: bool = False) -> Size:
    """What a change does to a craft, over its training domain; `unlearned`: and losing what was
    learned beside its physics."""
    other = changed(craft, [change])
    points = _points(craft, POINTS)
    here, there = _accelerations(craft, points), _accelerations(other, points)
    if unlearned:
        here = here + _learned_accelerations(craft, points)
    difference = there - here
    force = np.linalg.norm(difference[:3], axis=0)
    turning = np.linalg.norm(difference[3:], axis=0)
    position, angle = _astray(craft, other, unlearned=unlearned)
    return Size(
        force=_rms(force),
        force_max=float(force.max()),
        turning=_rms(turning),
        turning_max=float(turning.max()),
        thrust=_thrust_at_hover(craft, other),
        position=position,
        angle=angle,
    )


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


@dataclass(frozen=True, kw_only=True, eq=False)
class _States:
    """Columns are states: attitude (4, n), velocity and position world, rate (3, n), input (n_u,
    n)."""

    attitude: FloatArray
    velocity: FloatArray
    position: FloatArray
    rate: FloatArray
    inputs: FloatArray


def _range(craft: Craft, name: str, default: float) -> tuple[float, float]:
    low, high = craft.domain.get(name, (default, default))
    return float(low), float(high)


def _points(craft: Craft, count: int) -> _States:
    """States drawn evenly from the ranges of training."""
    random = np.random.default_rng(0)

    def draw(names: tuple[str, ...], default: float) -> FloatArray:
        box = np.array([_range(craft, n, default) for n in names])
        return box[:, :1] + (box[:, 1:] - box[:, :1]) * random.random((len(names), count))

    vector = np.clip(draw(("qx", "qy", "qz"), 0.0), -0.57, 0.57)
    attitude = np.vstack([np.sqrt(1.0 - np.sum(vector**2, axis=0)), vector])
    commands = tuple(craft.physics.inputs.names[: craft.count])
    inputs = draw(commands, craft.hover_command)
    if len(craft.physics.inputs.names) > craft.count:
        inputs = np.vstack([inputs, draw(("vbat",), craft.nominal_voltage or 1.0)])
    return _States(
        attitude=attitude,
        velocity=draw(("vx", "vy", "vz"), 0.0),
        position=draw(("x", "y", "z"), 1.0),
        rate=draw(("p", "q", "r"), 0.0),
        inputs=inputs,
    )


@lru_cache(maxsize=64)
def _acceleration_function(physics: PhysicsModel) -> ca.Function:
    """(attitude, velocity, position, rate, inputs, p) -> specific force and angular acceleration,
    rotors at the speed that they settle at."""
    sizes = (4, 3, 3, 3, len(physics.inputs), len(physics.parameters))
    q, v, x, rate, u, p = (ca.SX.sym(n, k) for n, k in zip("qvxwup", sizes, strict=True))
    body = physics.body
    values = {d.name: p[i] for i, d in enumerate(physics.parameters)}
    memory = ca.SX.zeros(len(body.staged.remembered))
    blocks = {"attitude": q, "velocity": v, "position": x, "rate": rate, "memory": memory}
    nu = body.rotors.goal(u, values)
    force, alpha, _ = body.accelerations(blocks, nu, nu * 0, u, values, ca.SX.zeros(9))
    return ca.Function("accelerations", [q, v, x, rate, u, p], [ca.vertcat(force, alpha)])


def accelerations(craft: Craft, states: Mapping[str, FloatArray]) -> FloatArray:
    """Specific force [m/s^2] and angular acceleration [rad/s^2] in body axes (6, n) of settled
    rotors. `states` has attitude (4, n), velocity, position, rate (3, n) and inputs (n_u, n)."""
    return _accelerations(craft, _States(**states))


def _accelerations(craft: Craft, s: _States) -> FloatArray:
    p = np.array([craft.values[d.name] for d in craft.physics.parameters])
    inputs = _inputs_of(craft, s.inputs)
    found = _acceleration_function(craft.physics)(
        s.attitude, s.velocity, s.position, s.rate, inputs, p
    )
    return np.asarray(found, dtype=float)


def _learned_accelerations(craft: Craft, s: _States) -> FloatArray:
    """What was learned, as `_accelerations`."""
    inputs = _inputs_of(craft, s.inputs)
    nu = _rotors(craft, inputs)
    blocks = ("position", "velocity", "attitude", "rate")
    states = [
        start_state(craft, {b: getattr(s, b)[:, k] for b in blocks} | {"rotor": nu[:, k]})
        for k in range(inputs.shape[1])
    ]
    push = learned_at(craft, np.stack(states, axis=1), inputs)
    return np.vstack([push[:3] / craft.mass, np.linalg.solve(craft.inertia, push[3:])])


def _rotors(craft: Craft, inputs: FloatArray) -> FloatArray:
    """Rotor speeds (n, m) that settle under `inputs` (n_u, m)."""
    physics = craft.physics
    u, p = ca.SX.sym("u", len(physics.inputs)), ca.SX.sym("p", len(physics.parameters))
    values = {d.name: p[i] for i, d in enumerate(physics.parameters)}
    goal = ca.Function("goal", [u, p], [physics.body.rotors.goal(u, values)])
    return np.asarray(goal(inputs, [craft.values[d.name] for d in physics.parameters]), dtype=float)


def _inputs_of(craft: Craft, inputs: FloatArray) -> FloatArray:
    """Inputs (n_u, n) as the craft's model takes them: a change may bring in or take away the
    battery, whose voltage is then the nominal one or not needed."""
    wanted = len(craft.physics.inputs)
    if len(inputs) < wanted:
        volt = np.full((wanted - len(inputs), inputs.shape[1]), craft.nominal_voltage or 1.0)
        return np.vstack([inputs, volt])
    return inputs[:wanted]


def _thrust_at_hover(craft: Craft, other: Craft) -> tuple[float, float]:
    """Lowest and highest share by which the thrust at the hover command changes, over the battery
    voltages of training."""
    still = np.zeros((3, 2))
    height = np.array([[0.0, 0.0], [0.0, 0.0], list(_range(craft, "z", 1.0))])
    inputs = np.full((len(craft.physics.inputs), 2), craft.hover_command)
    if len(craft.physics.inputs) > craft.count:
        inputs[-1] = _range(craft, "vbat", craft.nominal_voltage or 1.0)
    states = _States(
        attitude=np.array([[1.0, 1.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]]),
        velocity=still,
        position=height,
        rate=still,
        inputs=inputs,
    )
    here, there = _accelerations(craft, states)[2], _accelerations(other, states)[2]
    share = there / here - 1.0
    return float(share.min()), float(share.max())


# ---------------------------------------------------------------- flights


@lru_cache(maxsize=64)
def flight_function(physics: PhysicsModel | LearnedPush, dt: float, steps: int) -> ca.Function:
    """(x0, inputs over past + steps + future, p) -> states (n_x, steps) of the noise-free model."""
    past, future = physics.window
    x, u = (
        ca.SX.sym("x", len(physics.states)),
        ca.SX.sym("u", len(physics.inputs), past + 1 + future),
    )
    p, w = ca.SX.sym("p", len(physics.parameters)), ca.SX.zeros(len(physics.noises))
    step = ca.Function("step", [x, u, p], [physics.step(0.0, x, u, p, w, dt)])
    start = ca.MX.sym("x0", len(physics.states))
    record = ca.MX.sym("u", len(physics.inputs), past + steps + future)
    values = ca.MX.sym("p", len(physics.parameters))
    state, out = start, []
    for k in range(steps):
        state = step(state, record[:, k : k + past + 1 + future], values)
        out.append(state)
    return ca.Function("flight", [start, record, values], [ca.horzcat(*out)])


def fly(
    craft: Craft,
    start: Mapping[str, FloatArray],
    commands: FloatArray,
    dt: float,
    *,
    learned: bool = False,
) -> FloatArray:
    """States (n_x, steps) of the craft in our own model, with what was `learned` or by its physics
    alone, from blocks of `start` (position, velocity, attitude, rate), rotors at the speed of
    hover, under `commands` (n_u, steps)."""
    physics = with_learned(craft) if learned else craft.physics
    commands = _inputs_of(craft, commands)
    past, future = physics.window
    steps = commands.shape[1]
    x0 = start_state(craft, start)
    hover = np.repeat(_hover_inputs(craft, commands)[:, None], past, axis=1)
    record = np.hstack([hover, commands, np.repeat(commands[:, -1:], future, axis=1)])
    p = np.array([craft.values[d.name] for d in physics.parameters])
    return np.asarray(flight_function(physics, dt, steps)(x0, record, p), dtype=float)


def _hover_inputs(craft: Craft, commands: FloatArray) -> FloatArray:
    return np.array([*[craft.hover_command] * craft.count, *commands[craft.count :, 0]])


def start_state(craft: Craft, start: Mapping[str, FloatArray]) -> FloatArray:
    """x (n_x): blocks by name (position, velocity, attitude, rate; speeds nu as rotor), rotors
    at hover speed and memories zero where not given."""
    axes = {"position": "xyz", "velocity": "xyz", "attitude": "wxyz", "rate": "xyz"}
    values = {
        f"{b}.{a}": float(start[b][i]) for b, names in axes.items() for i, a in enumerate(names)
    }
    rotor = start.get("rotor", np.full(craft.count, craft.hover_nu))
    names = craft.physics.states.names
    out = []
    for n in names:
        if n in values:
            out.append(values[n])
        elif n.startswith("memory."):
            out.append(0.0)
        else:
            out.append(float(rotor[int(n.rpartition(".")[2]) - 1]))
    return np.array(out)


def _astray(craft: Craft, other: Craft, *, unlearned: bool) -> tuple[float, float]:
    """Root mean square distance [m] and angle [rad] between the two after `FLIGHT_TIME`, from
    drawn states under commands that move about hover; `unlearned`: only the first flies with what
    was learned."""
    random = np.random.default_rng(1)
    points = _points(craft, FLIGHTS)
    dt = craft.sample_time
    steps = max(2, round(FLIGHT_TIME / dt))
    low, high = craft.command_range
    hover = craft.hover_command
    room = 0.15 * min(hover - low, high - hover)
    distances, angles = [], []
    for k in range(FLIGHTS):
        slow = random.standard_normal((craft.count, 1 + steps // 10)) * max(room, 0.0)
        commands = np.clip(hover + np.repeat(slow, 10, axis=1)[:, :steps], low, high)
        inputs = np.vstack([commands, points.inputs[craft.count :, k : k + 1].repeat(steps, 1)])
        start = {
            "position": points.position[:, k],
            "velocity": points.velocity[:, k],
            "attitude": points.attitude[:, k],
            "rate": 0.3 * points.rate[:, k],
        }
        a = fly(craft, start, inputs, dt, learned=unlearned)[:, -1]
        b = fly(other, start, inputs, dt)[:, -1]
        distances.append(np.linalg.norm(a[:3] - b[:3]))
        angles.append(2.0 * math.acos(min(1.0, abs(float(a[6:10] @ b[6:10])))))
    return _rms(np.array(distances)), _rms(np.array(angles))
