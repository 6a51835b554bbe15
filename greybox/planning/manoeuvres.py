"""Manoeuvres: short flights that a model can be flown through, for asking which of them tells two
models apart.

A manoeuvre is a path (position and yaw against time) and wanted angular accelerations and thrust
steps on top. A cascade controller with the model's own mass, inertia and rotor maps flies it in
closed loop (position and velocity to tilt, tilt to angular acceleration; Mahony, Kumar and Corke
2012, IEEE RAM 19(3), sec. "control"), trimmed as an autopilot trims; the result is the noise-free
log.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from greybox.data import Dataset, dataset_from_arrays
from greybox.errors import FitError, ModelError
from greybox.estimation.engine import engine_for
from greybox.frames import numeric
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import physics_of
from greybox.model.linearise import trim
from greybox.model.sensors import SENSORS
from greybox.symbolic import BoolArray, FloatArray

SECONDS = 6.0
TILT = np.radians(35.0)
"""Largest tilt that is asked for."""
CLIPPED = 0.05
"""Share of samples in which a rotor may stand at its limit."""
POSITION, VELOCITY, ATTITUDE, RATE = 2.5, 3.0, 60.0, 13.0
"""Gains: 1/s^2, 1/s, 1/s^2, 1/s."""
LOST = 3.0
"""Distance from the path at which a flight counts as lost [m]."""
START = (0.0, 0.0, 1.5)


@dataclass(frozen=True, kw_only=True)
class Manoeuvre:
    """`path(t, a)` -> (x, y, z, yaw) [m, rad]; `twist(t, a)` -> wanted (3,) [rad/s^2] and share of
    thrust added; `amplitudes` a in `unit`; `voltage(t)` -> factor on the battery voltage."""

    name: str
    text: str
    unit: str
    amplitudes: tuple[float, ...]
    path: Callable[[float, float], tuple[float, float, float, float]] = lambda t, a: (*START, 0.0)
    twist: Callable[[float, float], tuple[float, float, float, float]] = lambda t, a: (
        0.0,
        0.0,
        0.0,
        0.0,
    )
    voltage: Callable[[float], float] = lambda t: 1.0
    needs_battery: bool = False


def _swing(t: float, speed: float, period: float = 4.0) -> float:
    """A sine path whose largest speed is `speed`."""
    w = 2 * np.pi / period
    return float(speed / w * np.sin(w * t))


def _doublet(t: float, every: float = 1.6, width: float = 0.12) -> float:
    """+1, -1, -1, +1 pulses (no net turn), then rest."""
    k = int((t % every) / width)
    return (1.0, -1.0, -1.0, 1.0)[k] if k < 4 else 0.0


def _chirp(t: float, low: float = 0.6, high: float = 8.0) -> float:
    """A sine whose frequency rises from `low` to `high` Hz over the flight."""
    rate = (high - low) / SECONDS
    return float(np.sin(2 * np.pi * (low + 0.5 * rate * t) * t))


X, Y, Z = START
LIBRARY = (
    Manoeuvre(name="hover", text="hover", unit="", amplitudes=(0.0,)),
    Manoeuvre(
        name="forward_and_back",
        text="fly forward and back, nose fixed",
        unit="m/s",
        amplitudes=(1.5, 4.0),
        path=lambda t, a: (X + _swing(t, a), Y, Z, 0.0),
    ),
    Manoeuvre(
        name="sideways",
        text="fly sideways to and fro, nose fixed",
        unit="m/s",
        amplitudes=(1.5, 4.0),
        path=lambda t, a: (X, Y + _swing(t, a), Z, 0.0),
    ),
    Manoeuvre(
        name="climb_and_sink",
        text="climb and sink",
        unit="m/s",
        amplitudes=(0.5, 2.0),
        path=lambda t, a: (X, Y, Z + 2 + _swing(t, a), 0.0),
    ),
    Manoeuvre(
        name="climb_at_speed",
        text="climb and sink while flying to and fro",
        unit="m/s",
        amplitudes=(1.0, 2.0),
        path=lambda t, a: (X + _swing(t, 1.5 * a, 5.3), Y, Z + 2 + _swing(t, a), 0.0),
    ),
    Manoeuvre(
        name="turn_on_the_spot",
        text="turn on the spot",
        unit="rad/s",
        amplitudes=(1.0, 2.5),
        path=lambda t, a: (X, Y, Z, a * t),
    ),
    Manoeuvre(
        name="turn_at_speed",
        text="fly to and fro while turning",
        unit="rad/s",
        amplitudes=(1.0, 2.0),
        path=lambda t, a: (X + _swing(t, 2.5), Y, Z, a * t),
    ),
    Manoeuvre(
        name="roll_and_pitch_doublets",
        text="roll and pitch doublets",
        unit="rad/s^2",
        amplitudes=(15.0, 40.0),
        twist=lambda t, a: (a * _doublet(t), a * _doublet(t - 0.8 if t > 0.8 else 1.5), 0.0, 0.0),
    ),
    Manoeuvre(
        name="roll_and_pitch_chirp",
        text="roll and pitch chirp, 0.6 to 8 Hz",
        unit="rad/s^2",
        amplitudes=(10.0, 25.0),
        twist=lambda t, a: (a * _chirp(t), a * _chirp(0.83 * t), 0.0, 0.0),
    ),
    Manoeuvre(
        name="yaw_doublets",
        text="yaw doublets",
        unit="rad/s^2",
        amplitudes=(3.0, 10.0),
        twist=lambda t, a: (0.0, 0.0, a * _doublet(t, width=0.25), 0.0),
    ),
    Manoeuvre(
        name="yaw_doublets_at_speed",
        text="yaw doublets while flying to and fro",
        unit="rad/s^2",
        amplitudes=(3.0, 10.0),
        path=lambda t, a: (X + _swing(t, 2.5), Y, Z, 0.0),
        twist=lambda t, a: (0.0, 0.0, a * _doublet(t, width=0.25), 0.0),
    ),
    Manoeuvre(
        name="throttle_doublets",
        text="throttle doublets in hover",
        unit="of the thrust",
        amplitudes=(0.15, 0.3),
        twist=lambda t, a: (0.0, 0.0, 0.0, a * _doublet(t, width=0.2)),
    ),
    Manoeuvre(
        name="low_pass",
        text="sink to the floor and rise again",
        unit="m",
        amplitudes=(0.1, 0.2),
        path=lambda t, a: (X, Y, a + 0.65 * (1 + np.cos(2 * np.pi * t / SECONDS)), 0.0),
    ),
    Manoeuvre(
        name="full_and_empty_pack",
        text="hover on a full and then on an empty pack",
        unit="",
        amplitudes=(0.0,),
        voltage=lambda t: 1.08 if t < SECONDS / 2 else 0.9,
        needs_battery=True,
    ),
)
"""What is tried; amplitudes that the vehicle cannot fly are left out by `flown`."""


def flying_model(model: IdentifiedModel) -> IdentifiedModel:
    """A model with all states, that can be flown, with the same parameters: `model` itself unless
    its log was blind."""
    physics = physics_of(model.dynamics)
    if "position" in {n.split(".")[0] for n in model.dynamics.states.names} or physics is None:
        return model
    whole = replace(
        physics,
        sensors=(*physics.sensors, *(s for s in SENSORS if s.shows and s not in physics.sensors)),
    )
    return replace(model, dynamics=whole)


def flown(
    model: IdentifiedModel, manoeuvre: Manoeuvre, amplitude: float, *, seconds: float = SECONDS
) -> Dataset | None:
    """The noise-free log of `model` flying the manoeuvre; None where the rotors saturate or the
    path is lost.

    Raises `FitError` for a model without position and attitude.
    """
    return flown_together(model, [(manoeuvre, amplitude)], seconds=seconds)[0]


@dataclass(frozen=True, kw_only=True)
class Trial:
    """How a manoeuvre went: its noise-free log, or None and where (n,) it could not be flown: the
    rotors at their limits, the path lost."""

    log: Dataset | None
    failed: BoolArray


def flown_together(
    model: IdentifiedModel, flights: Sequence[tuple[Manoeuvre, float]], *, seconds: float = SECONDS
) -> list[Dataset | None]:
    """`flown` for many manoeuvres with their amplitudes: all craft go on sample by sample side by
    side."""
    return [trial.log for trial in tried_together(model, flights, seconds=seconds)]


def tried_together(
    model: IdentifiedModel, flights: Sequence[tuple[Manoeuvre, float]], *, seconds: float = SECONDS
) -> list[Trial]:
    """`flown_together`, and where what is not flown failed."""
    dynamics, dt = model.dynamics, model.sample_time
    n, m, rotors = round(seconds / dt), len(flights), len(model.physics.vehicle.rotors)
    failed = np.zeros((m, n), dtype=bool)
    if not flights or not float(model.values["mass"]) > 0:
        failed[:, 0] = True
        return [Trial(log=None, failed=where) for where in failed]
    engine = engine_for(dynamics, ())
    at = _places(model)
    columns, width = list(dynamics.inputs.names), engine.past + 1 + engine.future
    course = _Course.of(flights, n, dt)
    start, hover = _hover(model, columns[:rotors])
    pilot = _Pilot(model, hover[:rotors])
    u = np.zeros((m, n + width - 1, len(columns)))
    if "vbat" in columns:
        volts = model.reference_inputs[columns.index("vbat")] * course.voltage
        u[:, :, columns.index("vbat")] = np.pad(
            volts, ((0, 0), (engine.past, engine.future)), mode="edge"
        )
    x = np.tile(start, (m, 1))
    x[:, at["position"]] = course.here[:, 0, :3]
    y, p, live = np.zeros((m, n, engine.ny)), model.parameter_vector(), np.arange(m)
    for k in range(n):
        if not live.size:
            break
        command, failed[live, k] = pilot.command(x, at, course, live, k)
        # The first command also stands for those before the flight.
        u[live, 0 if k == 0 else k + engine.past : k + width, :rotors] = command[:, None]
        horizon = 2 if k < n - 1 else 1
        windows = u[live, k : k + width + horizon - 1]
        seen, states = engine.rollout(
            starts=x,
            rows=np.arange(live.size) * windows.shape[1],
            horizon=horizon,
            inputs=windows.reshape(-1, len(columns)),
            p=p,
            dt=dt,
            want_states=True,
        )
        assert states is not None
        y[live, k], x = seen[:, 0], states[:, -1]
        away = np.abs(x[:, at["position"]] - course.here[live, k, :3]).max(axis=1)
        kept = np.isfinite(x).all(axis=1) & (away <= LOST)
        failed[live[~kept], k:] = True
        live, x = live[kept], x[kept]
    lost = np.setdiff1d(np.arange(m), live)
    return [
        Trial(log=None, failed=failed[i])
        if i in lost or failed[i].mean() > CLIPPED
        else Trial(
            log=_log(model, u[i, engine.past : engine.past + n], y[i], flights[i][0].name),
            failed=np.zeros(n, dtype=bool),
        )
        for i in range(m)
    ]


def _places(model: IdentifiedModel) -> dict[str, list[int]]:
    """Where the states that are flown by stand. Raises `FitError` where one is missing."""
    names = model.dynamics.states.names
    at = {
        b: [i for i, n in enumerate(names) if n.split(".")[0] == b]
        for b in ("position", "velocity", "attitude", "rate")
    }
    if not all(at.values()):
        raise FitError("the model cannot be flown: it has no position or attitude")
    return at


def _log(model: IdentifiedModel, u: FloatArray, y: FloatArray, name: str) -> Dataset:
    """Inputs (n, n_u) and outputs (n, n_y) as a log."""
    dynamics = model.dynamics
    table = dict(zip(dynamics.inputs.names, u.T, strict=True))
    table |= dict(zip(dynamics.outputs.names, y.T, strict=True))
    return dataset_from_arrays(model.sample_time * np.arange(len(u)), table, name=name)


def _hover(model: IdentifiedModel, rotors: Sequence[str]) -> tuple[FloatArray, FloatArray]:
    """(state (n_x,), command (n_u,)) in which the craft hovers, moments of its own balanced; those
    of the level reference where there is none."""
    given = dict(zip(model.dynamics.inputs.names, model.reference_inputs.tolist(), strict=True))
    level = np.asarray(model.dynamics.reference(given), dtype=float)
    kept = ("d_position.", "d_velocity.", "d_attitude.z")
    names = model.dynamics.error_states.names
    try:
        point = trim(
            model.dynamics,
            model.sample_time,
            values=model.values,
            start=level,
            command=model.reference_inputs,
            fixed_states=[n for n in names if n.startswith(kept)],
            free_commands=rotors,
        )
    except ModelError:
        return level, model.reference_inputs
    return point.x, point.u


@dataclass(frozen=True, kw_only=True)
class _Course:
    """What is wanted of every craft at every sample: `here`, `velocity`, `push` (m, n, 4) of x, y,
    z and yaw and their derivatives; `twist` (m, n, 4) and `voltage` (m, n) as in `Manoeuvre`."""

    here: FloatArray
    velocity: FloatArray
    push: FloatArray
    twist: FloatArray
    voltage: FloatArray

    @classmethod
    def of(cls, flights: Sequence[tuple[Manoeuvre, float]], n: int, dt: float) -> _Course:
        times = [k * dt for k in range(n + 1)]
        path = np.array(
            [[manoeuvre.path(t, a) for t in times] for manoeuvre, a in flights], dtype=float
        )
        before, here, after = (
            np.concatenate([path[:, :1], path[:, :-2]], axis=1),
            path[:, :-1],
            path[:, 1:],
        )
        velocity, push = (after - before) / (2 * dt), (after - 2 * here + before) / dt**2
        velocity[:, :2], push[:, :2] = (after - here)[:, :2] / dt, 0.0
        twist = np.array(
            [[manoeuvre.twist(t, a) for t in times[:-1]] for manoeuvre, a in flights], dtype=float
        )
        voltage = np.array(
            [[manoeuvre.voltage(t) for t in times[:-1]] for manoeuvre, _ in flights], dtype=float
        )
        return cls(here=here, velocity=velocity, push=push, twist=twist, voltage=voltage)


def yaw_lever(model: IdentifiedModel) -> float:
    """Torque over thrust [m] that a rotor gains over the range of its command."""
    actuator, v = model.physics.vehicle.actuator, model.values
    low, high = (np.array([1.0, u, u * u]) for u in (actuator.u_min, actuator.u_max))
    thrust, torque = (
        float(np.array([v[f"{kind}.c{k}"] for k in range(3)]) @ (high - low))
        for kind in ("thrust", "torque")
    )
    return torque / thrust if thrust else 0.0


class _Pilot:
    """The cascade controller of one model, for many craft at once. What its maps miss at the
    `hover` command (rotors,) is fed forward."""

    def __init__(self, model: IdentifiedModel, hover: FloatArray) -> None:
        vehicle, v = model.physics.vehicle, model.values
        self.mass, self.gravity = v["mass"], float(vehicle.gravity)
        self.inertia = np.array([v[f"inertia.{a}{a}"] for a in "xyz"])
        self.thrust = [v[f"thrust.c{k}"] for k in range(3)]
        lever = yaw_lever(model)
        place = np.array([r.position for r in vehicle.rotors], dtype=float)
        spin = np.array([r.spin for r in vehicle.rotors], dtype=float)
        mix = np.stack([np.ones(len(spin)), place[:, 1], -place[:, 0], -lever * spin])
        self.unmix = np.linalg.pinv(mix)
        self.low, self.high = float(vehicle.actuator.u_min), float(vehicle.actuator.u_max)
        balanced = mix @ (np.vander(hover, 3, increasing=True) @ self.thrust)
        self.lift, self.moment = balanced[0] / (self.mass * self.gravity), balanced[1:]

    def command(
        self,
        x: FloatArray,
        at: dict[str, list[int]],
        course: _Course,
        craft: npt.NDArray[np.int_],
        k: int,
    ) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
        """(u (m, rotors), whether a rotor stands at its limit (m,)) of `craft` in states x (m, n_x)
        at sample k."""
        omega = x[:, at["rate"]]
        here, velocity, push, twist = (
            v[craft, k] for v in (course.here, course.velocity, course.push, course.twist)
        )
        wanted = push[:, :3] + POSITION * (here[:, :3] - x[:, at["position"]])
        wanted += VELOCITY * (velocity[:, :3] - x[:, at["velocity"]])
        wanted[:, 2] = np.maximum(wanted[:, 2] + self.gravity, 0.3 * self.gravity)
        side = np.hypot(wanted[:, 0], wanted[:, 1])
        wanted[:, :2] *= np.minimum(1.0, np.tan(TILT) * wanted[:, 2] / np.maximum(side, 1e-12))[
            :, None
        ]
        turn = numeric("matrix", x[:, at["attitude"]]).reshape(-1, 3, 3)
        up, nose = turn[:, :, 2], turn[:, :, 0]
        thrust = self.mass * (wanted * up).sum(axis=1) * (1 + twist[:, 3])
        goal = wanted / np.linalg.norm(wanted, axis=1, keepdims=True)
        # In body axes: turn' (up x goal).
        seen = np.einsum("kji,kj->ki", turn, goal)
        off = here[:, 3] - np.arctan2(nose[:, 1], nose[:, 0])
        error = np.stack(
            [-seen[:, 1], seen[:, 0], 0.25 * np.arctan2(np.sin(off), np.cos(off))], axis=1
        )
        rate = -omega
        rate[:, 2] = 0.5 * (velocity[:, 3] - omega[:, 2])
        turning = ATTITUDE * error + RATE * rate + twist[:, :3]
        moment = self.inertia * turning + self.moment
        force = np.column_stack([self.lift * thrust, moment]) @ self.unmix.T
        c0, c1, c2 = self.thrust
        root = np.sqrt(np.maximum(c1 * c1 - 4 * c2 * (c0 - np.maximum(force, 0.0)), 0.0))
        nu = (root - c1) / (2 * c2) if c2 else (force - c0) / c1
        u: FloatArray = np.clip(nu, self.low, self.high)
        return u, np.any(np.abs(u - nu) > 1e-9, axis=1)
