"""Manoeuvres: short flights that a model can be flown through, for asking which of them tells two models apart.

A manoeuvre is a path (position and yaw against time) and wanted angular accelerations and thrust steps on top. A cascade
controller with the model's own mass, inertia and rotor maps flies it in closed loop (position and velocity to tilt, tilt to
angular acceleration; Mahony, Kumar and Corke 2012, IEEE RAM 19(3), sec. "control"); the result is the noise-free log.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from greybox.data import Dataset, dataset_from_arrays
from greybox.errors import FitError
from greybox.estimation.engine import engine_for
from greybox.frames import numeric
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import physics_of
from greybox.model.sensors import SENSORS
from greybox.symbolic import FloatArray

SECONDS = 6.0
TILT = np.radians(35.0)
"""Largest tilt that is asked for."""
CLIPPED = 0.05
"""Share of samples in which a rotor may stand at its limit."""
POSITION, VELOCITY, ATTITUDE, RATE = 2.5, 3.0, 60.0, 13.0
"""Gains: 1/s^2, 1/s, 1/s^2, 1/s."""
START = (0.0, 0.0, 1.5)


@dataclass(frozen=True, kw_only=True)
class Manoeuvre:
    """`path(t, a)` -> (x, y, z, yaw) [m, rad]; `twist(t, a)` -> wanted (3,) [rad/s^2] and share of thrust added;
    `amplitudes` a in `unit`; `voltage(t)` -> factor on the battery voltage."""

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
    """A model with all states, that can be flown, with the same parameters: `model` itself unless its log was blind."""
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
    """The noise-free log of `model` flying the manoeuvre; None where the rotors saturate or the path is lost.

    Raises `FitError` for a model without position and attitude.
    """
    dynamics, dt = model.dynamics, model.sample_time
    engine = engine_for(dynamics, ())
    names = dynamics.states.names
    at = {
        b: [i for i, n in enumerate(names) if n.split(".")[0] == b]
        for b in ("position", "velocity", "attitude", "rate")
    }
    if not all(at.values()):
        raise FitError("the model cannot be flown: it has no position or attitude")
    vehicle = model.physics.vehicle
    n, rotors = round(seconds / dt), len(vehicle.rotors)
    p, values = model.parameter_vector(), model.values
    columns = list(dynamics.inputs.names)
    voltage = columns.index("vbat") if "vbat" in columns else None
    volts = model.reference_inputs[voltage] if voltage is not None else 0.0
    pilot = _Pilot(model)
    u = np.zeros((n + engine.past + engine.future, len(columns)))
    x = np.asarray(
        dynamics.reference(dict(zip(columns, model.reference_inputs.tolist(), strict=True))),
        dtype=float,
    )
    x[at["position"]] = manoeuvre.path(0.0, amplitude)[:3]
    y = np.zeros((n, engine.ny))
    clipped = 0
    for k in range(n):
        t = k * dt
        command, hit = pilot.command(x, at, manoeuvre, amplitude, t)
        clipped += hit
        here = (
            slice(0, k + engine.past + 1 + engine.future)
            if k == 0
            else slice(k + engine.past, k + engine.past + 1 + engine.future)
        )
        u[here, :rotors] = command  # the first command also stands for those before the flight
        if voltage is not None:
            u[here, voltage] = volts * manoeuvre.voltage(t)
        seen, states = engine.rollout(
            starts=x[None],
            rows=np.array([k]),
            horizon=2 if k < n - 1 else 1,
            inputs=u,
            p=p,
            dt=dt,
            want_states=True,
        )
        assert states is not None
        y[k] = seen[0, 0]
        x = states[0, -1]
        if (
            not np.isfinite(x).all()
            or abs(x[at["position"]] - np.array(manoeuvre.path(t, amplitude)[:3])).max() > 3.0
        ):
            return None
    if clipped > CLIPPED * n or float(values["mass"]) <= 0:
        return None
    table = dict(zip(columns, u[engine.past : engine.past + n].T, strict=True))
    table |= dict(zip(dynamics.outputs.names, y.T, strict=True))
    return dataset_from_arrays(dt * np.arange(n), table, name=manoeuvre.name)


class _Pilot:
    """The cascade controller of one model."""

    def __init__(self, model: IdentifiedModel) -> None:
        vehicle, v = model.physics.vehicle, model.values
        self.mass, self.gravity = v["mass"], float(vehicle.gravity)
        self.inertia = np.array([v[f"inertia.{a}{a}"] for a in "xyz"])
        self.thrust = [v[f"thrust.c{k}"] for k in range(3)]
        lever = v["torque.c2"] / v["thrust.c2"] if v["thrust.c2"] else 0.0
        place = np.array([r.position for r in vehicle.rotors], dtype=float)
        spin = np.array([r.spin for r in vehicle.rotors], dtype=float)
        mix = np.stack([np.ones(len(spin)), place[:, 1], -place[:, 0], -lever * spin])
        self.unmix = np.linalg.pinv(mix)
        self.low, self.high = float(vehicle.actuator.u_min), float(vehicle.actuator.u_max)
        self.dt = model.sample_time

    def command(
        self,
        x: FloatArray,
        at: dict[str, list[int]],
        manoeuvre: Manoeuvre,
        amplitude: float,
        t: float,
    ) -> tuple[FloatArray, bool]:
        """(u (n,), whether a rotor stands at its limit)."""
        q, omega = x[at["attitude"]], x[at["rate"]]
        before, here, after = (
            np.array(manoeuvre.path(max(t + s, 0.0), amplitude)) for s in (-self.dt, 0.0, self.dt)
        )
        velocity, push = (after - before) / (2 * self.dt), (after - 2 * here + before) / self.dt**2
        if t < 2 * self.dt:
            velocity, push = (after - here) / self.dt, 0 * push
        wanted = (
            push[:3]
            + POSITION * (here[:3] - x[at["position"]])
            + VELOCITY * (velocity[:3] - x[at["velocity"]])
        )
        wanted[2] += self.gravity
        wanted[2] = max(wanted[2], 0.3 * self.gravity)
        side = float(np.hypot(wanted[0], wanted[1]))
        if side > np.tan(TILT) * wanted[2]:
            wanted[:2] *= np.tan(TILT) * wanted[2] / side
        turn = numeric("matrix", q)[0].reshape(3, 3)
        up, nose = turn[:, 2], turn[:, 0]
        twist = np.array(manoeuvre.twist(t, amplitude))
        thrust = self.mass * float(wanted @ up) * (1 + twist[3])
        error = turn.T @ np.cross(up, wanted / np.linalg.norm(wanted))
        yaw = float(np.arctan2(nose[1], nose[0]))
        error[2] = 0.25 * float(np.arctan2(np.sin(here[3] - yaw), np.cos(here[3] - yaw)))
        turning = (
            ATTITUDE * error
            + RATE * (np.array([0.0, 0.0, velocity[3]]) - omega) * [1.0, 1.0, 0.5]
            + twist[:3]
        )
        force = self.unmix @ np.array([thrust, *(self.inertia * turning)])
        c0, c1, c2 = self.thrust
        root = np.sqrt(np.maximum(c1 * c1 - 4 * c2 * (c0 - np.maximum(force, 0.0)), 0.0))
        nu = (root - c1) / (2 * c2) if c2 else (force - c0) / c1
        u = np.clip(nu, self.low, self.high)
        return u, bool((np.abs(u - nu) > 1e-9).any())
