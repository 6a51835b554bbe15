"""Pieces: short manoeuvres that start and end in hover at home, from which a plan is put together.

Setpoint pieces move position and yaw: sines slow and fast, speed and height sweeps, turns, coupled
paths. Injected pieces add angular accelerations and thrust behind the attitude controller:
orthogonal multi-sines (Morelli 2003, AIAA 2003-5600: every input its own harmonics, random phases
with a low peak), doublets and 3-2-1-1 (Jategaonkar 2015, Flight Vehicle System Identification, ch.
2). Amplitude 1 is the most that box, speed and tilt allow on paper; `fit_in` lowers it until the
flight does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from greybox.data import Dataset
from greybox.errors import FitError
from greybox.model.identified import IdentifiedModel
from greybox.planning.limits import Limits
from greybox.planning.manoeuvres import Manoeuvre, flown_together, yaw_lever
from greybox.symbolic import FloatArray

LEVELS = (1.0, 0.75, 0.55, 0.4, 0.3, 0.2, 0.14, 0.1)
"""Amplitudes that are tried, the largest first."""
FADE = 0.5
"""Time in which a path fades in and out [s]."""
BAND = (0.7, 8.0)
"""Frequencies of the multi-sines [Hz]."""
Four = tuple[float, float, float, float]
Shape = Callable[[float, float], Four]
Signal = Callable[[float], float]


@dataclass(frozen=True, kw_only=True)
class ExcitationBlock:
    """One manoeuvre of `seconds`: `offset(t, a)` -> (x, y, z, yaw) from home [m, rad], `twist(t,
    a)` -> angular acceleration (3) [rad/s^2] and share of thrust added, `voltage(t)` -> factor on
    the battery voltage."""

    name: str
    text: str
    kind: str
    seconds: float
    offset: Shape | None = None
    twist: Shape | None = None
    voltage: Signal | None = None

    @property
    def injected(self) -> bool:
        """Whether it needs signals that are added behind the attitude controller."""
        return self.twist is not None


@dataclass(frozen=True, kw_only=True)
class Flown:
    """A piece at the amplitude that keeps the limits, with its noise-free log."""

    piece: ExcitationBlock
    amplitude: float
    log: Dataset


def sequence(
    steps: Sequence[tuple[ExcitationBlock, float]], limits: Limits, name: str = "plan"
) -> Manoeuvre:
    """Pieces with amplitudes, one after the other, as one manoeuvre from home to home."""
    ends = np.cumsum([p.seconds for p, _ in steps])

    def at(t: float) -> tuple[int, float]:
        k = min(int(np.searchsorted(ends, t, side="right")), len(steps) - 1)
        return k, min(t - (float(ends[k - 1]) if k else 0.0), steps[k][0].seconds)

    def path(t: float, a: float) -> Four:
        k, since = at(t)
        piece, size = steps[k]
        x, y, z, yaw = piece.offset(since, a * size) if piece.offset else (0.0, 0.0, 0.0, 0.0)
        hx, hy, hz = limits.home
        return hx + x, hy + y, hz + z, yaw

    def twist(t: float, a: float) -> Four:
        k, since = at(t)
        piece, size = steps[k]
        return piece.twist(since, a * size) if piece.twist else (0.0, 0.0, 0.0, 0.0)

    def voltage(t: float) -> float:
        k, since = at(t)
        shape = steps[k][0].voltage
        return shape(since) if shape else 1.0

    return Manoeuvre(
        name=name, text=name, unit="", amplitudes=(1.0,), path=path, twist=twist, voltage=voltage
    )


def fit_in(
    model: IdentifiedModel, pieces: Sequence[ExcitationBlock], limits: Limits
) -> list[Flown | None]:
    """Every piece, all of one duration, at the largest amplitude that keeps the limits; None where
    even the smallest does not. They are flown side by side."""
    best: list[Flown | None] = [None] * len(pieces)
    # LEVELS[low] does not fly, LEVELS[high] does (beyond the last: none does).
    low, high = np.full(len(pieces), -1), np.full(len(pieces), len(LEVELS))
    tried = np.zeros(len(pieces), dtype=int)  # the largest first, then the middle of what is left
    while (open_ := np.flatnonzero(high - low > 1)).size:
        flights = [
            (sequence([(pieces[i], LEVELS[tried[i]])], limits, pieces[i].name), 1.0)
            for i in open_.tolist()
        ]
        logs = flown_together(model, flights, seconds=pieces[0].seconds)
        for i, log in zip(open_.tolist(), logs, strict=True):
            if log is not None and not limits.broken(log):
                best[i] = Flown(piece=pieces[i], amplitude=LEVELS[tried[i]], log=log)
                high[i] = tried[i]
            else:
                # A hover has no amplitude.
                low[i] = len(LEVELS) if pieces[i].kind == "hover" else tried[i]
        tried = (low + high) // 2
    return best


def authority(model: IdentifiedModel, limits: Limits) -> FloatArray:
    """Largest angular accelerations [rad/s^2] and share of thrust (4,) that the command range
    leaves around hover.

    Raises `FitError` where the model cannot hover inside the command range.
    """
    v, vehicle = model.values, model.physics.vehicle
    thrust, n = np.array([v[f"thrust.c{k}"] for k in range(3)]), len(vehicle.rotors)
    weight = v["mass"] * vehicle.gravity
    low, high = (float(thrust @ [1.0, u, u * u]) for u in limits.commands)
    spare = min(high - weight / n, weight / n - low)
    if not spare > 0.02 * weight / n:
        raise FitError(
            "the craft cannot hover inside the command range",
            expected=f"below {weight / n:.3g} N and above it per rotor",
            got=f"{low:.3g} to {high:.3g} N",
            fix="greybox vehicle check; widen --command",
        )
    place = np.abs([r.position for r in vehicle.rotors])
    moments = spare * np.array([place[:, 1].sum(), place[:, 0].sum(), n * abs(yaw_lever(model))])
    inertia = np.array([v[f"inertia.{a}{a}"] for a in "xyz"])
    return np.append(moments / inertia, n * spare / weight)


def excitation_blocks(
    model: IdentifiedModel,
    limits: Limits,
    *,
    seconds: float,
    seed: int = 0,
    setpoints_only: bool = False,
) -> list[ExcitationBlock]:
    """The pieces of `seconds` each that suit the limits. `seed` draws the phases of the
    multi-sines."""
    room = _Room(limits=limits, seconds=seconds, gravity=float(model.physics.vehicle.gravity))
    out = _setpoints(room)
    if "vbat" in model.dynamics.inputs.names:
        pack = room.block(
            "full_and_empty_pack",
            "climb and sink on a full, then on an empty pack",
            "battery",
            (2, room.sine(2, room.fast, 0.6)),
        )
        out.append(replace(pack, voltage=lambda t: 1.08 if t < 0.5 * seconds else 0.92))
    if setpoints_only:
        return out
    return out + _injections(room, 0.6 * authority(model, limits), np.random.default_rng(seed))


@dataclass(frozen=True, kw_only=True)
class _Room:
    """Paths of pieces of `seconds`, as large as room, speed and tilt allow."""

    limits: Limits
    seconds: float
    gravity: float

    @cached_property
    def reach(self) -> FloatArray:
        """Distance from home (3,) [m]."""
        x, y, z = self.limits.box
        return 0.85 * np.array([0.5 * x, 0.5 * y, 0.5 * (z - self.limits.floor)])

    @property
    def fast(self) -> float:
        """Cycles per piece of a quick motion."""
        return max(2.0, round(self.seconds / 2.2))

    @property
    def slow(self) -> float:
        """Cycles per piece of a slow motion."""
        return max(1.0, round(self.seconds / 4.5))

    def gate(self, t: float) -> float:
        """Fades a path in and out."""
        edge = min(t, self.seconds - t) / FADE
        return 0.0 if edge <= 0 else 1.0 if edge >= 1 else 0.5 - 0.5 * float(np.cos(np.pi * edge))

    def sine(self, axis: int, cycles: float, share: float = 1.0) -> Signal:
        """A sine of `cycles` per piece along an axis [m]."""
        w, speed, tilt = 2 * np.pi * cycles / self.seconds, self.limits.speed, self.limits.tilt
        push = 0.8 * self.gravity * (np.tan(tilt) if axis < 2 else 0.5)
        size = share * min(self.reach[axis], 0.9 * speed / w, push / w**2)
        return lambda t: float(size * np.sin(w * t) * self.gate(t))

    def turn(self, t: float) -> float:
        """Yaw to the left and to the right [rad]."""
        return float(0.8 * np.pi * np.sin(2 * np.pi * t / self.seconds) * self.gate(t))

    def sink(self, t: float) -> float:
        """Down to the floor and up again [m]."""
        down = 0.5 - 0.5 * np.cos(2 * np.pi * t / self.seconds)
        return float(-self.reach[2] / 0.85 * 0.95 * down)

    def block(
        self,
        name: str,
        text: str,
        kind: str,
        *moves: tuple[int, Signal],
        twist: Shape | None = None,
    ) -> ExcitationBlock:
        """A piece that moves along these axes (3: yaw)."""

        def offset(t: float, a: float) -> Four:
            out = [0.0, 0.0, 0.0, 0.0]
            for axis, shape in moves:
                out[axis] += a * shape(t)
            return out[0], out[1], out[2], out[3]

        return ExcitationBlock(
            name=name,
            text=text,
            kind=kind,
            seconds=self.seconds,
            offset=offset if moves else None,
            twist=twist,
        )


def _setpoints(room: _Room) -> list[ExcitationBlock]:
    """Pieces that move position and yaw."""
    block, sine, fast, slow = room.block, room.sine, room.fast, room.slow
    sweep = _growing(sine(0, fast), room.seconds)
    climb = ((0, sine(0, slow, 0.8)), (2, sine(2, fast, 0.6)))
    three = ((0, sine(0, fast, 0.65)), (1, sine(1, fast - 1, 0.65)), (2, sine(2, slow + 1, 0.5)))
    eight = ((0, sine(0, slow, 0.8)), (1, sine(1, 2 * slow, 0.6)))
    turning = ((0, sine(0, fast, 0.9)), (3, room.turn))
    return [
        block("hover", "hover", "hover"),
        block("surge_slow", "to and fro along x, slowly", "speed", (0, sine(0, slow))),
        block("surge_fast", "to and fro along x, fast", "speed", (0, sine(0, fast))),
        block("sway_slow", "to and fro along y, slowly", "speed", (1, sine(1, slow))),
        block("sway_fast", "to and fro along y, fast", "speed", (1, sine(1, fast))),
        block("speed_sweep", "to and fro along x, faster and faster", "speed", (0, sweep)),
        block("climb_and_sink", "climb and sink", "height", (2, sine(2, fast))),
        block("height_sweep", "sink to the floor and rise again", "height", (2, room.sink)),
        block("climb_at_speed", "climb and sink while flying to and fro", "coupled", *climb),
        block("lissajous", "x, y and height at once at three frequencies", "coupled", *three),
        block("figure_eight", "figure of eight", "coupled", *eight),
        block("turns", "turn on the spot, left and right", "yaw", (3, room.turn)),
        block("turns_at_speed", "to and fro while turning", "coupled", *turning),
    ]


def _injections(room: _Room, top: FloatArray, rng: np.random.Generator) -> list[ExcitationBlock]:
    """Pieces that add angular accelerations [rad/s^2] and a share of thrust, up to `top` (4,)."""
    block = room.block
    tones = [_multisine(room.seconds, c, rng) for c in range(4)]
    pulses = (_doublet(0.12, 1.0), _doublet(0.25, 2.0), _three_two_one_one(0.1, 2.0))
    quick, wide, steps = (_centred(pulse, room.gate) for pulse in pulses)

    def inject(*signals: tuple[int, Signal, float]) -> Shape:
        def twist(t: float, a: float) -> Four:
            pushes = [0.0, 0.0, 0.0, 0.0]
            for axis, shape, share in signals:
                pushes[axis] += a * share * float(top[axis]) * shape(t)
            return pushes[0], pushes[1], pushes[2], pushes[3]

        return twist

    def later(shape: Signal, by: float) -> Signal:
        return lambda t: shape(t - by) if t >= by else 0.0

    out = [
        block(f"{n}_multisine", f"multi-sine in {n}", "multisine", twist=inject((i, tones[i], 1.0)))
        for i, n in enumerate(("roll", "pitch", "yaw", "thrust"))
    ]
    every = inject(*((i, tones[i], 0.5) for i in range(4)))
    moving = ((0, room.sine(0, room.slow, 0.8)), (1, room.sine(1, room.slow + 1, 0.5)))
    tilting = inject((0, quick, 1.0), (1, later(quick, 0.5), 1.0))
    tilts = inject((0, steps, 0.6), (1, later(steps, 1.0), 0.6))
    turns = inject((2, steps, 1.0), (3, later(steps, 1.0), 0.8))
    return [
        *out,
        block(
            "all_multisine",
            "orthogonal multi-sines in roll, pitch, yaw and thrust",
            "multisine",
            twist=every,
        ),
        block(
            "multisine_at_speed",
            "orthogonal multi-sines while flying to and fro",
            "coupled",
            *moving,
            twist=every,
        ),
        block("roll_and_pitch_doublets", "roll and pitch doublets", "doublets", twist=tilting),
        block("yaw_doublets", "yaw doublets", "doublets", twist=inject((2, wide, 1.0))),
        block("throttle_doublets", "throttle doublets", "doublets", twist=inject((3, wide, 0.8))),
        block("roll_and_pitch_3211", "3-2-1-1 in roll and pitch", "3-2-1-1", twist=tilts),
        block("yaw_and_throttle_3211", "3-2-1-1 in yaw and throttle", "3-2-1-1", twist=turns),
    ]


def _growing(shape: Signal, seconds: float) -> Signal:
    return lambda t: shape(t) * min(t / (0.85 * seconds), 1.0)


def _centred(shape: Signal, gate: Signal) -> Signal:
    return lambda t: shape(t) if gate(t) > 0.3 else 0.0


def _doublet(width: float, every: float) -> Signal:
    """+1, -1, -1, +1 pulses (no net turn), then rest; every second one starts downwards."""

    def shape(t: float) -> float:
        number, since = divmod(t, every)
        k = int(since / width)
        return ((1.0, -1.0, -1.0, 1.0)[k] if k < 4 else 0.0) * (1.0 if number % 2 == 0 else -1.0)

    return shape


def _three_two_one_one(unit: float, every: float) -> Signal:
    """Up 3 units, down 2, up 1, down 1; then mirrored, so that nothing is left over."""

    def shape(t: float) -> float:
        number, since = divmod(t, every)
        k = int(since / unit)
        sign = 1.0 if k < 3 else -1.0 if k < 5 else 1.0 if k < 6 else -1.0 if k < 7 else 0.0
        return sign if number % 2 == 0 else -sign

    return shape


def _multisine(seconds: float, channel: int, rng: np.random.Generator) -> Signal:
    """Sines at the harmonics channel + 4 m of the piece within BAND, peak 1; of 40 draws of phases
    that of lowest peak."""
    k = np.arange(1, int(BAND[1] * seconds) + 1)
    k = k[(k >= BAND[0] * seconds) & (k % 4 == channel)]
    # About as many per octave: neighbours at high frequency are thinned out.
    k = k[np.unique(np.searchsorted(k, np.geomspace(k[0], k[-1], 10)).clip(max=k.size - 1))]
    w, t = 2 * np.pi * k / seconds, np.linspace(0, seconds, 2000)
    best, phases = np.inf, np.zeros(k.size)
    for _ in range(40):
        drawn = rng.uniform(0, 2 * np.pi, k.size)
        peak = float(np.abs(np.sin(np.outer(t, w) + drawn).sum(axis=1)).max())
        if peak < best:
            best, phases = peak, drawn
    ramp = 0.3

    def shape(t: float) -> float:
        fade = float(np.clip(min(t, seconds - t) / ramp, 0.0, 1.0))
        return fade * float(np.sin(w * t + phases).sum()) / best

    return shape
