"""The standard sets of effects, nested: what small multirotors have, most common first.

Each step adds what the steps before cannot say; which step a craft needs, left-out flight decides,
and of its effects those stay that are felt. Order and content follow what flights of small
quadrotors showed: the air's forces and moments, then what is trimmed anew for every flight, then
clocks.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from greybox.automatic.facts import Facts
from greybox.model.composition import SHAPING, acts_on_speeds
from greybox.model.effect import Effect
from greybox.model.effects import CATALOGUE, effect_by_name
from greybox.model.vehicle import Vehicle

APART = 0.3
"""Samples by which attitude and gyro are apart from which a late pose is offered: the resolution of
the check that measures it."""


@dataclass(frozen=True, kw_only=True)
class Step:
    """Effects that enter together, and which of their parameters have one value per flight."""

    name: str
    effects: tuple[str | Effect, ...]
    per_flight: tuple[str, ...] = field(default=())


def name_of(effect: str | Effect) -> str:
    """The name of an effect that may stand for itself."""
    return effect if isinstance(effect, str) else effect.name


def names_of(step: Step) -> tuple[str, ...]:
    """Names of the effects of a step."""
    return tuple(name_of(e) for e in step.effects)


def effects_of(steps: tuple[Step, ...]) -> tuple[str | Effect, ...]:
    """The effects of all steps."""
    return tuple(e for s in steps for e in s.effects)


def all_names_of(steps: tuple[Step, ...]) -> tuple[str, ...]:
    """Names of the effects of all steps."""
    return tuple(n for s in steps for n in names_of(s))


def shares_effect(steps: tuple[Step, ...], step: Step) -> bool:
    """Whether an effect of `step` is among those of `steps`."""
    return not set(all_names_of(steps)).isdisjoint(names_of(step))


def listed(steps: tuple[Step, ...]) -> str:
    """The names of the effects, or "none"."""
    return ", ".join(all_names_of(steps)) or "none"


BASE = Step(
    name="rotors and sensors",
    effects=(
        "motor_lag",
        "command_delay",
        "rotor_speed_delay",
        "rotor_speed_scale",
        "gyro_bias",
        "accelerometer_bias",
    ),
)

TRIM = Step(
    name="trim of each flight",
    effects=("rotor_asymmetry", "mocap_misalignment"),
    per_flight=("rotor_asymmetry", "mocap_misalignment"),
)
TRIMMED = ("center_of_mass.x", "center_of_mass.y")
"""What takes up the trim of a single flight: a torque in proportion to the thrust."""

STEPS = (
    Step(
        name="air, rotors and battery",
        effects=(
            "battery_sag",
            "rotor_gyroscopic",
            "rotor_drag",
            "axial_inflow",
            "blade_flapping",
            "rotational_damping",
        ),
    ),
    TRIM,
    Step(name="clocks of each flight", effects=("pose_delay",), per_flight=("pose_delay",)),
)

LATE_POSE = Step(name="pose_delay", effects=("pose_delay",))
"""What is tried with a filter of the IMU: one delay of the pose for all flights."""


def nested_sets(
    vehicle: Vehicle, facts: Facts, *, input: Literal["command", "speed"] = "command"
) -> tuple[Step, ...]:
    """The base and the steps after it whose effects can be felt by the sensors of these flights.

    Effects of the vehicle file are there from the start and not offered again. Rotor speeds that
    are the `input` already hold what shapes a command.
    """
    steps = []
    for step in (BASE, *STEPS):
        usable = tuple(
            n
            for n in names_of(step)
            if not _there(n, vehicle, input) and is_felt(n, vehicle, facts) and _acts_on(n, input)
        )
        if usable or step is BASE:
            steps.append(Step(name=step.name, effects=usable, per_flight=step.per_flight))
    return tuple(steps)


def without_lag(base: Step) -> Step:
    """The base set that is tried, too, where `lag_is_a_jump`."""
    kept = tuple(e for e in base.effects if name_of(e) != "motor_lag")
    return replace(base, name="no lag", effects=kept)


def lag_is_a_jump(vehicle: Vehicle) -> bool:
    """Whether rotors without a lag differ from those with a very short one: an effect of the file
    feels how fast they change speed. A fit that starts with a lag does not get there."""
    felt = any("rotor-acceleration" in e.tags and e.name in vehicle.effects for e in CATALOGUE)
    return felt and "motor_lag" not in vehicle.effects


def _there(name: str, vehicle: Vehicle, input: str) -> bool:
    """Whether the vehicle file brings an effect; it says nothing of how a log has rotor speeds."""
    return name in vehicle.effects and not (
        input == "speed" and effect_by_name(name).stage in SHAPING
    )


def _acts_on(name: str, input: str) -> bool:
    return input == "command" or acts_on_speeds(effect_by_name(name))


def is_felt(name: str, vehicle: Vehicle, facts: Facts) -> bool:
    """Whether the sensors of these flights can show an effect of the catalogue."""
    effect = effect_by_name(name)
    if effect.missing(vehicle, facts.sensors):
        return False
    if "vbat" in effect.needs.columns and not facts.voltage:
        return False
    if name in (
        "rotor_drag",
        "axial_inflow",
        "blade_flapping",
    ):  # proportional to a velocity that something must show
        return bool(facts.sensors & {"position", "velocity"})
    if name == "pose_delay":  # offered where attitude and gyro were seen apart
        return facts.has_pose and facts.has_imu and facts.apart > APART
    return True


def per_flight_parameters(steps: tuple[Step, ...], vehicle: Vehicle) -> tuple[str, ...]:
    """Names of all parameters of the steps that differ from flight to flight."""
    return tuple(
        f"{effect}.{d.name}"
        for step in steps
        for effect in step.per_flight
        if effect in names_of(step)
        for d in effect_by_name(effect).parameters(vehicle)
    )
