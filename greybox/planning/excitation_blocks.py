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

import numpy as np

from greybox.data import Dataset
from greybox.errors import FitError
from greybox.model.identified import IdentifiedModel
from greybox.planning.limits import Limits
from greybox.planning.manoeuvres import Manoeuvre, flown_together
from greybox.symbolic import FloatArray

LEVELS = (1.0, 0.75, 0.55, 0.4, 0.3, 0.2, 0.14, 0.1)
"""Amplitudes that are tried, the largest first."""
FADE = 0.5
"""Time in which a path fades in and out [s]."""
BAND = (0.7, 8.0)
"""Frequencies of the multi-sines [Hz]."""
Four = tuple[float, float, float, float]
Shape = Callable[[float, float], Four]


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
    voltage: Callable[[float], float] | None = None

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
    low, high = (float(thrust @ [1.0, u, u * u]) for u in limits.command)
    spare = min(high - weight / n, weight / n - low)
    if not spare > 0.02 * weight / n:
        raise FitError(
            "the craft cannot hover inside the command range",
            expected=f"below {weight / n:.3g} N and above it per rotor",
            got=f"{low:.3g} to {high:.3g} N",
            fix="greybox vehicle check; widen --command",
        )
    place = np.abs([r.position for r in vehicle.rotors])
    lever = (
        abs(v["torque.c2"] / v["thrust.c2"])
        if v["thrust.c2"]
        else abs(v["torque.c1"] / v["thrust.c1"])
    )
    moments = spare * np.array([place[:, 1].sum(), place[:, 0].sum(), n * lever])
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
    reach = (
        np.array([0.5 * limits.box[0], 0.5 * limits.box[1], 0.5 * (limits.box[2] - limits.floor)])
        * 0.85
    )
    g = float(model.physics.vehicle.gravity)

    def gate(t: float) -> float:
        edge = min(t, seconds - t) / FADE
        return 0.0 if edge <= 0 else 1.0 if edge >= 1 else 0.5 - 0.5 * float(np.cos(np.pi * edge))

    def sine(axis: int, cycles: float, share: float = 1.0) -> Callable[[float], float]:
        """A sine of `cycles` per piece, as large as room, speed and tilt allow."""
        w = 2 * np.pi * cycles / seconds
        push = 0.8 * g * (np.tan(limits.tilt) if axis < 2 else 0.5)
        size = share * min(reach[axis], 0.9 * limits.speed / w, push / w**2)
        return lambda t: float(size * np.sin(w * t) * gate(t))

    def along(*moves: tuple[int, Callable[[float], float]]) -> Shape:
        def offset(t: float, a: float) -> Four:
            out = [0.0, 0.0, 0.0, 0.0]
            for axis, shape in moves:
                out[axis] += a * shape(t)
            return out[0], out[1], out[2], out[3]

        return offset

    def turn(cycles: float) -> Callable[[float], float]:
        return lambda t: float(0.8 * np.pi * np.sin(2 * np.pi * cycles * t / seconds) * gate(t))

    def sink(t: float) -> float:
        return float(-reach[2] / 0.85 * 0.95 * (0.5 - 0.5 * np.cos(2 * np.pi * t / seconds)))

    fast, slow = max(2.0, round(seconds / 2.2)), max(1.0, round(seconds / 4.5))
    out: list[ExcitationBlock] = []

    def add(
        name: str,
        text: str,
        kind: str,
        *moves: tuple[int, Callable[[float], float]],
        twist: Shape | None = None,
    ) -> None:
        offset = along(*moves) if moves else None
        out.append(
            ExcitationBlock(
                name=name, text=text, kind=kind, seconds=seconds, offset=offset, twist=twist
            )
        )

    add("hover", "hover", "hover")
    add("surge_slow", "to and fro along x, slowly", "speed", (0, sine(0, slow)))
    add("surge_fast", "to and fro along x, fast", "speed", (0, sine(0, fast)))
    add("sway_slow", "to and fro along y, slowly", "speed", (1, sine(1, slow)))
    add("sway_fast", "to and fro along y, fast", "speed", (1, sine(1, fast)))
    add(
        "speed_sweep",
        "to and fro along x, faster and faster",
        "speed",
        (0, _growing(sine(0, fast), seconds)),
    )
    add("climb_and_sink", "climb and sink", "height", (2, sine(2, fast)))
    add("height_sweep", "sink to the floor and rise again", "height", (2, sink))
    climb = ((0, sine(0, slow, 0.8)), (2, sine(2, fast, 0.6)))
    add("climb_at_speed", "climb and sink while flying to and fro", "coupled", *climb)
    three = ((0, sine(0, fast, 0.65)), (1, sine(1, fast - 1, 0.65)), (2, sine(2, slow + 1, 0.5)))
    add("lissajous", "x, y and height at once at three frequencies", "coupled", *three)
    add(
        "figure_eight",
        "figure of eight",
        "coupled",
        (0, sine(0, slow, 0.8)),
        (1, sine(1, 2 * slow, 0.6)),
    )
    add("turns", "turn on the spot, left and right", "yaw", (3, turn(1.0)))
    add(
        "turns_at_speed",
        "to and fro while turning",
        "coupled",
        (0, sine(0, fast, 0.9)),
        (3, turn(1.0)),
    )
    if "vbat" in model.dynamics.inputs.names:
        add(
            "full_and_empty_pack",
            "climb and sink on a full, then on an empty pack",
            "battery",
            (2, sine(2, fast, 0.6)),
        )
        out[-1] = replace(out[-1], voltage=lambda t: 1.08 if t < 0.5 * seconds else 0.92)
    if setpoints_only:
        return out
    top = 0.6 * authority(model, limits)
    rng = np.random.default_rng(seed)
    tones = [_multisine(seconds, c, rng) for c in range(4)]
    pulses = (_doublet(0.12, 1.0), _doublet(0.25, 2.0), _three_two_one_one(0.1, 2.0))
    quick, wide, steps = (_centred(pulse, gate) for pulse in pulses)

    def inject(*signals: tuple[int, Callable[[float], float], float]) -> Shape:
        def twist(t: float, a: float) -> Four:
            pushes = [0.0, 0.0, 0.0, 0.0]
            for axis, shape, share in signals:
                pushes[axis] += a * share * float(top[axis]) * shape(t)
            return pushes[0], pushes[1], pushes[2], pushes[3]

        return twist

    def later(shape: Callable[[float], float], by: float) -> Callable[[float], float]:
        return lambda t: shape(t - by) if t >= by else 0.0

    for i, n in enumerate(("roll", "pitch", "yaw", "thrust")):
        add(f"{n}_multisine", f"multi-sine in {n}", "multisine", twist=inject((i, tones[i], 1.0)))
    every = inject(*((i, tones[i], 0.5) for i in range(4)))
    add(
        "all_multisine",
        "orthogonal multi-sines in roll, pitch, yaw and thrust",
        "multisine",
        twist=every,
    )
    moving = ((0, sine(0, slow, 0.8)), (1, sine(1, slow + 1, 0.5)))
    add(
        "multisine_at_speed",
        "orthogonal multi-sines while flying to and fro",
        "coupled",
        *moving,
        twist=every,
    )
    both = inject((0, quick, 1.0), (1, later(quick, 0.5), 1.0))
    add("roll_and_pitch_doublets", "roll and pitch doublets", "doublets", twist=both)
    add("yaw_doublets", "yaw doublets", "doublets", twist=inject((2, wide, 1.0)))
    add("throttle_doublets", "throttle doublets", "doublets", twist=inject((3, wide, 0.8)))
    both = inject((0, steps, 0.6), (1, later(steps, 1.0), 0.6))
    add("roll_and_pitch_3211", "3-2-1-1 in roll and pitch", "3-2-1-1", twist=both)
    both = inject((2, steps, 1.0), (3, later(steps, 1.0), 0.8))
    add("yaw_and_throttle_3211", "3-2-1-1 in yaw and throttle", "3-2-1-1", twist=both)
    return out


def _growing(shape: Callable[[float], float], seconds: float) -> Callable[[float], float]:
    return lambda t: shape(t) * min(t / (0.85 * seconds), 1.0)


def _centred(
    shape: Callable[[float], float], gate: Callable[[float], float]
) -> Callable[[float], float]:
    return lambda t: shape(t) if gate(t) > 0.3 else 0.0


def _doublet(width: float, every: float) -> Callable[[float], float]:
    """+1, -1, -1, +1 pulses (no net turn), then rest; every second one starts downwards."""

    def shape(t: float) -> float:
        number, since = divmod(t, every)
        k = int(since / width)
        return ((1.0, -1.0, -1.0, 1.0)[k] if k < 4 else 0.0) * (1.0 if number % 2 == 0 else -1.0)

    return shape


def _three_two_one_one(unit: float, every: float) -> Callable[[float], float]:
    """Up 3 units, down 2, up 1, down 1; then mirrored, so that nothing is left over."""

    def shape(t: float) -> float:
        number, since = divmod(t, every)
        k = int(since / unit)
        sign = 1.0 if k < 3 else -1.0 if k < 5 else 1.0 if k < 6 else -1.0 if k < 7 else 0.0
        return sign if number % 2 == 0 else -sign

    return shape


def _multisine(seconds: float, channel: int, rng: np.random.Generator) -> Callable[[float], float]:
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
