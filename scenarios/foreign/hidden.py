"""What can be hidden in a foreign craft, and how large it is in flight.

`hidden_effect` draws an effect of the catalogue by name, `outside_effect` one that the catalogue
does not have; sizes follow the craft's mass, inertia and rotor speed. `settled` hands to the
simulator what it does by itself (its own body, commands, rotors, drag, wind) and returns the rest,
which acts from outside (`scenarios.foreign.loads`).

Ranges: drag and inflow 0.15 to 0.5 1/s at hover (Faessler et al. 2018; Folk et al. 2023), delays 8
to 25 ms, rotors uneven by up to 8 %, thrust factor 0.1 to 0.3 (PX4), IMU scale and alignment of
consumer MEMS parts (1 to 3 %, 1 to 2 degrees), accelerometer bias 5 to 30 mg, wind 2 to 12 m/s.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from greybox.plants import effects as known
from greybox.plants.airframe import Airframe
from greybox.plants.battery import Battery
from greybox.plants.effects.base import PlantEffect
from greybox.plants.vectors import Vector, add
from scenarios.foreign.craft import Air, Craft
from scenarios.plants import outside

NEEDS_DRAG = ("steady_wind",)
"""Acts only through a drag that the vehicle file must know, or that is hidden with it."""
LATERAL, TURNS = ("force.x", "force.y"), ("torque.x", "torque.y", "torque.z")
ROLL_PITCH = TURNS[:2]
BATTERY = "battery_sag"


class Sizes:
    """Sizes that suit one craft, drawn by `random`.

    per_rotor [kg/rad]: a drag of 1 1/s at hover, shared by the rotors; inertia [kg m^2]; arm [m];
    weight [N].
    """

    def __init__(self, frame: Airframe, random: np.random.Generator) -> None:
        self._random = random
        self.frame = frame
        self.mass = float(frame.mass)
        self.weight = self.mass * frame.gravity
        self.inertia = tuple(float(j) for j in frame.inertia)
        hover = float(frame.hover_speed)
        self.hover = hover
        self.per_rotor = self.mass / (len(frame.rotors) * hover * float(frame.speed_max or 1.0))
        self.arm = max(float(np.hypot(*r.position[:2])) for r in frame.rotors)

    def size(self, low: float, high: float) -> float:
        """A size between low and high."""
        return float(self._random.uniform(low, high))

    def signed(self, low: float, high: float) -> float:
        """The same with a random sign."""
        return self.size(low, high) * (1.0 if self._random.random() < 0.5 else -1.0)

    def three(self, low: float, high: float) -> Vector:
        """Three signed sizes."""
        return (self.signed(low, high), self.signed(low, high), self.signed(low, high))

    def uneven(self) -> tuple[float, ...]:
        """Shares of four rotors of sum zero, the largest at least 3 %."""
        while True:
            deltas = self._random.uniform(-0.08, 0.08, len(self.frame.rotors))
            deltas -= deltas.mean()
            if np.abs(deltas).max() > 0.03:
                return tuple(float(d) for d in deltas)


def _wind(s: Sizes, low: float = 2.0, high: float = 6.0) -> known.SteadyWind:
    speed, angle = s.size(low, high), s.size(0.0, 2.0 * np.pi)
    return known.SteadyWind(w_x=float(speed * np.cos(angle)), w_y=float(speed * np.sin(angle)))


def _xyz(name: str, values: Vector) -> dict[str, float]:
    return {f"{name}_{axis}": v for axis, v in zip("xyz", values)}


def _center(s: Sizes) -> PlantEffect:
    return known.CenterOfMassOffset(
        c_x=s.arm * s.signed(0.03, 0.08), c_y=s.arm * s.signed(0.03, 0.08)
    )


def _force(s: Sizes) -> PlantEffect:
    return known.ConstantForce(
        f_x=s.weight * s.signed(0.02, 0.05), f_y=s.weight * s.signed(0.02, 0.05)
    )


def _body_drag(s: Sizes) -> PlantEffect:
    side, up = s.weight * s.size(0.01, 0.03), s.weight * s.size(0.01, 0.03)
    return known.ParasiticDrag(c_x=side, c_y=side, c_z=up)


def _products(s: Sizes) -> PlantEffect:
    xy, xz, yz = s.three(0.05, 0.12)
    j = s.inertia[0]
    return known.ProductsOfInertia(Jxy=j * xy, Jxz=j * xz, Jyz=j * yz)


def _damping(s: Sizes) -> PlantEffect:
    p, q, r = (j * s.size(0.8, 2.0) for j in s.inertia)
    return known.RotationalDamping(d_p=p, d_q=q, d_r=r)


def _rotor_drag(s: Sizes) -> PlantEffect:
    k = s.per_rotor * s.size(0.15, 0.5)
    return known.RotorDrag(k_x=k, k_y=k)


def _linear_drag(s: Sizes) -> PlantEffect:
    side, up = s.mass * s.size(0.15, 0.5), s.mass * s.size(0.15, 0.5)
    return known.LinearDrag(d_x=side, d_y=side, d_z=up)


def _saturation(s: Sizes) -> PlantEffect:
    frame = s.frame
    room = frame.u_max - s.hover
    return known.CommandSaturation(
        a_hi=room * s.size(0.5, 0.7), u_min=frame.u_min, u_max=frame.u_max
    )


_KNOWN: dict[str, Callable[[Sizes], PlantEffect]] = {
    "accelerometer_bias": lambda s: known.AccelerometerBias(**_xyz("b", s.three(0.05, 0.3))),
    "accelerometer_lever_arm": lambda s: known.AccelerometerLeverArm(
        **_xyz("r", s.three(0.1 * s.arm, 0.4 * s.arm))
    ),
    "accelerometer_scale": lambda s: known.AccelerometerScale(**_xyz("s", s.three(0.01, 0.03))),
    "axial_inflow": lambda s: known.AxialInflow(k_z=s.per_rotor * s.size(0.15, 0.5)),
    BATTERY: lambda s: known.BatterySag(nominal_voltage=1.0, c_V=s.size(0.6, 1.2)),
    "blade_flapping": lambda s: known.BladeFlapping(
        k_flap=s.inertia[0] * s.per_rotor / s.mass * s.size(1.5, 4.0)
    ),
    "center_of_mass_offset": _center,
    "command_delay": lambda s: known.CommandDelay(d=s.size(0.008, 0.025)),
    "command_saturation": _saturation,
    "constant_force": _force,
    "gyro_bias": lambda s: known.GyroBias(**_xyz("b", s.three(0.01, 0.05))),
    "gyro_scale": lambda s: known.GyroScale(**_xyz("s", s.three(0.01, 0.03))),
    "imu_misalignment": lambda s: known.ImuMisalignment(**_xyz("theta", s.three(0.015, 0.04))),
    "mocap_misalignment": lambda s: known.MocapMisalignment(**_xyz("theta", s.three(0.015, 0.04))),
    "motor_lag": lambda s: known.MotorLag(tau=s.size(0.02, 0.06)),
    "parasitic_drag": _body_drag,
    "payload_mass": lambda s: known.PayloadMass(mu=s.size(0.08, 0.25)),
    "pose_delay": lambda s: known.PoseDelay(d=s.size(0.01, 0.03)),
    "pose_lever_arm": lambda s: known.PoseLeverArm(**_xyz("r", s.three(0.1 * s.arm, 0.4 * s.arm))),
    "products_of_inertia": _products,
    "rotational_damping": _damping,
    "rotor_asymmetry": lambda s: known.RotorAsymmetry(delta=s.uneven()),
    "rotor_drag": _rotor_drag,
    "rotor_gyroscopic": lambda s: known.RotorGyroscopic(J_r=s.inertia[0] * s.size(1e-3, 4e-3)),
    "sensor_delay": lambda s: known.SensorDelay(d=s.size(0.008, 0.02)),
    "steady_wind": _wind,
    "thrust_curve": lambda s: known.ThrustCurve(f=s.size(0.1, 0.3)),
    "translational_lift": lambda s: known.TranslationalLift(k_h=s.weight * s.size(0.003, 0.008)),
    "linear_drag": _linear_drag,
}
CATALOGUED = tuple(_KNOWN)
"""Effects of the catalogue that can be hidden; ground_effect needs flights near the ground."""
DRAWN = tuple(n for n in CATALOGUED if n != "linear_drag")
"""Effects that a seed draws from: of the time when the first logs were judged, so that each seed
keeps its log. The others are judged by name (`single:linear_drag`)."""


@dataclass(frozen=True, kw_only=True)
class Stranger:
    """An effect outside the catalogue: how it is drawn, the axes it acts on, the catalogue's names
    that are of its kind."""

    make: Callable[[Sizes], PlantEffect]
    axes: tuple[str, ...]
    family: tuple[str, ...] = ()


OUTSIDE: dict[str, Stranger] = {
    "magnet": Stranger(
        make=lambda s: outside.Magnet(m=s.inertia[0] * s.size(1.0, 2.0)), axes=TURNS
    ),
    "sloshing_mass": Stranger(
        make=lambda s: outside.SloshingMass(mass=s.mass * s.size(0.05, 0.08), arm=0.2 * s.arm),
        axes=(*LATERAL, *ROLL_PITCH),
    ),
    "thrust_gap": Stranger(
        make=lambda s: outside.ThrustGap(depth=s.size(0.15, 0.25), centre=s.hover),
        axes=("force.z", *TURNS),
    ),
    "wall": Stranger(
        make=lambda s: outside.Wall(pull=s.weight * s.size(0.08, 0.15), arm=0.1 * s.arm),
        axes=(*LATERAL, *ROLL_PITCH),
    ),
    "warm_motors": Stranger(
        make=lambda s: outside.WarmMotors(fade=s.size(0.07, 0.12), reference=s.hover),
        axes=("force.z",),
    ),
    "tether": Stranger(
        make=lambda s: outside.Tether(
            stiffness=s.weight * s.size(0.015, 0.03), weight=s.weight * s.size(0.02, 0.04)
        ),
        axes=(*LATERAL, "force.z"),
    ),
    "power_drag": Stranger(
        make=lambda s: outside.PowerDrag(c=s.weight * s.size(0.015, 0.03)),
        axes=(*LATERAL, "force.z"),
        family=("parasitic_drag", "linear_drag", "rotor_drag", "axial_inflow"),
    ),
    "quadratic_damping": Stranger(
        make=lambda s: outside.QuadraticDamping(d=s.inertia[0] * s.size(1.2, 2.5)),
        axes=TURNS,
        family=("rotational_damping",),
    ),
    "relaxing_drag": Stranger(
        make=lambda s: outside.RelaxingDrag(k=s.mass * s.size(0.3, 0.6)),
        axes=(*LATERAL, "force.z"),
        family=("rotor_drag", "linear_drag", "parasitic_drag", "axial_inflow"),
    ),
    "hysteretic_damping": Stranger(
        make=lambda s: outside.HystereticDamping(d=s.inertia[0] * s.size(1.0, 2.0)),
        axes=TURNS,
        family=("rotational_damping",),
    ),
    "munk_moment": Stranger(
        make=lambda s: outside.MunkMoment(k=s.inertia[0] * s.size(1.2, 2.5)),
        axes=("torque.y", "torque.z"),
    ),
    "air_outlet": Stranger(
        make=lambda s: outside.AirOutlet(loss=s.weight * s.size(0.03, 0.06)),
        axes=("force.z", *ROLL_PITCH),
    ),
    "loose_arm": Stranger(
        make=lambda s: outside.LooseArm(tilt=s.size(0.02, 0.04)), axes=(*LATERAL, "torque.z")
    ),
    "returning_wake": Stranger(
        make=lambda s: outside.ReturningWake(push=s.weight * s.size(0.08, 0.15), reference=s.hover),
        axes=(*LATERAL, "force.z"),
    ),
}
"""Sizes are those at which the effects matter in flight, as shares of weight and inertia."""


@dataclass(frozen=True, kw_only=True)
class Own:
    """What one simulator has of its own, in a form that is not that of the catalogue."""

    simulator: str
    axes: tuple[str, ...]
    family: tuple[str, ...]


OWN: dict[str, Own] = {
    "fluid": Own(
        simulator="mujoco",
        axes=(*LATERAL, "force.z", *TURNS),
        family=(
            *("parasitic_drag", "linear_drag", "rotor_drag", "axial_inflow"),
            "rotational_damping",
        ),
    ),
    "linear_drag": Own(
        simulator="drone_models",
        axes=(*LATERAL, "force.z"),
        family=("linear_drag", "rotor_drag", "axial_inflow", "parasitic_drag"),
    ),
    "rotor_law": Own(
        simulator="drone_models",
        axes=("force.z", *TURNS),
        family=(
            "motor_lag",
            "motor_lag_asymmetry",
            "motor_lag_speed",
            "motor_lag_second",
            "thrust_curve",
            "command_delay",
        ),
    ),
}
"""MuJoCo's fluid on its inertia box; drone-models' drag and its rotors fitted to Crazyflies."""


def hidden_effect(name: str, frame: Airframe, random: np.random.Generator) -> PlantEffect:
    """A catalogue effect at the size at which it matters in flight of this craft.

    Raises ValueError for a name that is not in CATALOGUED.
    """
    if name not in _KNOWN:
        raise ValueError(f"no such effect: {name}; there are {', '.join(CATALOGUED)}")
    return _KNOWN[name](Sizes(frame, random))


def windy(
    frame: Airframe, random: np.random.Generator, slowest: float, fastest: float
) -> tuple[PlantEffect, ...]:
    """Wind between these speeds [m/s], and drag and inflow that a craft can fly against in it."""
    s = Sizes(frame, random)
    drag, inflow = s.per_rotor * s.size(0.12, 0.25), s.per_rotor * s.size(0.15, 0.4)
    return (
        _wind(s, slowest, fastest),
        known.RotorDrag(k_x=drag, k_y=drag),
        known.AxialInflow(k_z=inflow),
    )


def outside_effect(name: str, frame: Airframe, random: np.random.Generator) -> PlantEffect:
    """An effect that no catalogue has, at a size that matters. Raises ValueError for an unknown
    name."""
    if name not in OUTSIDE:
        raise ValueError(f"no such effect: {name}; there are {', '.join(OUTSIDE)}")
    return OUTSIDE[name].make(Sizes(frame, random))


def settled(
    simulator: str, craft: Craft, effects: Iterable[PlantEffect]
) -> tuple[Craft, tuple[PlantEffect, ...]]:
    """The craft that this simulator is given, and the effects that are left to act from outside."""
    left: list[PlantEffect] = []
    for effect in effects:
        taken = _taken(simulator, craft, effect)
        if taken is None:
            left.append(effect)
        else:
            craft = taken
    return craft, tuple(left)


def _taken(simulator: str, craft: Craft, effect: PlantEffect) -> Craft | None:
    """The craft with this effect, where simulator or plant contract have it; else None."""
    air, frame = craft.air, craft.airframe
    if isinstance(effect, known.SteadyWind):
        wind = (float(effect.w_x), float(effect.w_y), float(effect.w_z))
        return replace(craft, air=replace(air, wind=wind))
    if isinstance(effect, known.CommandDelay):
        return replace(craft, delay=float(effect.d))
    if isinstance(effect, known.MotorLag):
        return replace(craft, lag=float(effect.tau))
    if isinstance(effect, known.RotorAsymmetry):
        return replace(craft, uneven=tuple(float(d) for d in effect.delta))
    if isinstance(effect, known.BatterySag):
        return with_battery(replace(craft, sag=float(effect.c_V)))
    body = (known.PayloadMass, known.ProductsOfInertia, known.CenterOfMassOffset)
    if isinstance(effect, (*body, known.AccelerometerLeverArm)):
        moments, products = effect.inertia_change()
        changed = replace(
            frame,
            mass=float(frame.mass) * float(effect.mass_factor()),
            inertia=add(frame.inertia, moments),
            products=add(frame.products, products),
            center_of_mass=add(frame.center_of_mass, effect.center_of_mass_shift()),
            imu_position=add(frame.imu_position, effect.imu_shift()),
        )
        return replace(craft, airframe=changed)
    changed_air = _in_rotorpy(air, effect) if simulator == "rotorpy" else None
    return None if changed_air is None else replace(craft, air=changed_air)


def _in_rotorpy(air: Air, effect: PlantEffect) -> Air | None:
    """What RotorPy's own rotors do."""
    if isinstance(effect, known.RotorDrag) and effect.k_x == effect.k_y:
        return replace(air, rotor_drag=float(effect.k_x))
    if isinstance(effect, known.AxialInflow):
        return replace(air, inflow=float(effect.k_z))
    if isinstance(effect, known.TranslationalLift):
        return replace(air, lift=float(effect.k_h))
    if isinstance(effect, known.BladeFlapping):
        return replace(air, flapping=float(effect.k_flap))
    if isinstance(effect, known.ParasiticDrag):
        return replace(air, parasitic=(float(effect.c_x), float(effect.c_y), float(effect.c_z)))
    return None


def with_battery(craft: Craft) -> Craft:
    """The craft with a battery that gives half of its charge in 200 s at full current, so that its
    voltage falls well within a flight."""
    mass = float(craft.airframe.mass)
    cells = 1.0 if mass < 0.1 else 3.0 if mass < 1.0 else 6.0
    current = 60.0 * mass / cells
    battery = Battery(
        full=4.1 * cells,
        empty=3.3 * cells,
        capacity=400.0 * current,
        resistance=0.25 * cells / current,
        idle_current=0.02 * current,
        full_current=current,
    )
    return replace(
        craft, airframe=replace(craft.airframe, nominal_voltage=3.8 * cells), battery=battery
    )


def names_of(effects: Sequence[PlantEffect]) -> tuple[str, ...]:
    """Their names in the catalogue."""
    return tuple(effect.name for effect in effects)
