"""Setting: what holds for every fit that the automatic fit compares, decided from the user's word and
the facts of the flights before anything is fitted.

Of two numbers of which flights show the ratio alone the better known one is held.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from greybox.automatic.facts import Facts
from greybox.automatic.like import lasting
from greybox.automatic.sets import Step, per_flight_parameters
from greybox.data import Dataset
from greybox.errors import ModelError, UnknownNameError
from greybox.estimation.fit import with_noise_of
from greybox.estimation.options import FitChoices, FitOptions
from greybox.estimation.record import sample_time
from greybox.model.core_parameters import core_parameters, leading
from greybox.model.dynamics import Dynamics
from greybox.model.effect import Effect
from greybox.model.effects import CATALOGUE
from greybox.model.identified import IdentifiedModel
from greybox.model.model import PhysicsModel, build_model, input_of
from greybox.model.noise import KINDS, part_named, with_parts
from greybox.model.parameter import Parameter
from greybox.model.sensors import SENSORS
from greybox.model.vehicle import Vehicle

RATIOS = (("mass", "thrust", "motion"), ("torque", "inertia.zz", "yaw"))
"""Pairs that scale together and change no prediction: force over mass, yaw torque over inertia. A
map is its leading coefficient."""

Note = Callable[[str, str, str, str], None]
"""Takes a decision: about what, the choice, its reason, and the option that decides otherwise."""


@dataclass(frozen=True, kw_only=True)
class Given:
    """What the user decided; None or absent: open. `choices` are fields of `FitOptions`, `source`
    is a model of a craft like this one."""

    effects: tuple[str | Effect, ...] | None = None
    input: Literal["command", "speed"] | None = None
    kinematic_noise: bool | None = None
    adapt: float | None = None
    source: IdentifiedModel | None = None
    choices: FitChoices = field(default_factory=lambda: FitChoices())


@dataclass(frozen=True, kw_only=True, eq=False)
class Setting:
    """The craft, its flights and their `facts`, what the user decided, and what follows for every
    fit: the input, noise on the attitude kinematics, options."""

    vehicle: Vehicle
    data: Dataset
    facts: Facts
    given: Given
    input: Literal["command", "speed"]
    kinematic_noise: bool
    options: FitOptions

    def model(self, effects: tuple[str | Effect, ...]) -> PhysicsModel:
        """The model with these effects. Raises `ModelError`."""
        return build_model(
            self.vehicle,
            self.data.channels,
            effects,
            input=self.input,
            sample_time=sample_time(self.data),
            noncausal=self.data.noncausal,
            kinematic_noise=self.kinematic_noise,
        )

    def with_flight_values(self, options: FitOptions, steps: tuple[Step, ...]) -> FitOptions:
        """With one value per flight of the parameters that `steps` say, unless the user did."""
        if "per_flight" in self.given.choices:
            return options
        own = per_flight_parameters(steps, self.vehicle)
        return options.but(per_flight=tuple(dict.fromkeys((*options.per_flight, *own))))


def with_priors_of(options: FitOptions, model: Dynamics) -> FitOptions:
    """The options with those of their priors that are of the `model`, its noise included: what was
    said of an effect that is not in it waits for one that has it."""
    if not options.priors and not options.flight_priors:
        return options
    known = {d.name for d in with_noise_of(model, options).parameters}
    return options.but(
        priors={n: p for n, p in options.priors.items() if n in known},
        flight_priors={n: p for n, p in options.flight_priors.items() if n in known},
    )


def demand_known_priors(options: FitOptions, model: PhysicsModel) -> None:
    """Raises `UnknownNameError` for a prior of what neither the `model`, an effect of the catalogue
    nor a kind of noise has."""
    vehicle = model.vehicle
    known = {d.name for d in model.parameters}
    known |= {f"{e.name}.{p.name}" for e in CATALOGUE for p in e.parameters(vehicle)}
    kinds = {k.kind for k in KINDS}
    for name in (*options.priors, *options.flight_priors):
        if name.split(".")[0] in kinds:
            noisy = with_parts(model, [part_named(name.rpartition(".")[0])])
            known |= {d.name for d in noisy.parameters}
        if name not in known:
            raise UnknownNameError("parameter", name, known)


def setting_of(
    vehicle: Vehicle, data: Dataset, facts: Facts, given: Given, said: FitOptions, note: Note
) -> Setting:
    """What follows from the facts and what was `given`; `said` are its choices as options.

    Raises `ModelError` for rotor speeds without a scale.
    """
    input = given.input or input_of(data.channels, vehicle)
    if input == "speed":
        facts = facts.without({s.name for s in SENSORS if not s.usual})
    _demand_scale(input, vehicle)
    if given.input is None and input != "command":
        note(
            "input",
            "measured rotor speeds",
            "the logs have rotor speeds and no commands",
            "--input",
        )
    kinematic_noise = _kinematics(facts, given, note)
    options = _disturbance(said, facts, given, note)
    options = _noise(_lasting(options, given), vehicle, facts, given, note)
    return Setting(
        vehicle=vehicle,
        data=data,
        facts=facts,
        given=given,
        input=input,
        kinematic_noise=kinematic_noise,
        options=_held(options, vehicle, given, note),
    )


def _demand_scale(input: str, vehicle: Vehicle) -> None:
    if input == "speed" and vehicle.actuator.speed_max is None:
        raise ModelError(
            "the rotor speeds have no scale",
            expected="actuator.speed_max [rad/s] in the vehicle file",
            fix="add the rotor speed at full command, or log the commands",
        )


def _kinematics(facts: Facts, given: Given, note: Note) -> bool:
    if given.kinematic_noise is not None:
        return given.kinematic_noise
    if "attitude" not in facts.sensors:
        return False
    # What an estimator adds to the turn is no torque either: without noise of its own in the
    # kinematics it is fitted as one, and as less lag.
    if facts.axes_apart > facts.wander:
        reason = (
            f"an estimator's attitude: the gyro is {1e3 * facts.sample * facts.axes_apart:.1f} ms "
            "later about one axis than about another"
        )
    elif facts.sample or facts.loose:
        late = 1e3 * facts.sample * facts.wander
        reason = f"gyro and attitude drift apart by {late:.1f} ms within a flight"
    elif "gyro" in facts.sensors:
        reason = "the flights do not tell whether gyro and attitude drift apart"
    else:
        reason = "no gyro is there that the attitude could drift apart from"
    about = "noise on the attitude kinematics"
    note(about, "yes" if facts.loose else "no", reason, "--kinematic-noise")
    return facts.loose


def _disturbance(options: FitOptions, facts: Facts, given: Given, note: Note) -> FitOptions:
    if "disturbance" in given.choices:
        return options
    felt = bool(facts.sensors & {"position", "velocity", "accelerometer"})
    groups = ("force", "torque") if felt else ("torque",)
    note(
        "disturbance states",
        ", ".join(groups),
        "gusts and what is not modelled push for a while; no parameter shall explain them",
        "--disturbance",
    )
    return options.but(disturbance=groups)


def _lasting(options: FitOptions, given: Given) -> FitOptions:
    if given.source is None:
        return options
    return options.but(priors={**lasting(given.source, options.disturbance), **options.priors})


def _noise(
    options: FitOptions, vehicle: Vehicle, facts: Facts, given: Given, note: Note
) -> FitOptions:
    if "noise" in given.choices:
        return options
    levels = {
        f"noise.sensor.{component}": float(f"{level:.3g}")
        for (sensor, component), level in facts.noise.items()
        if sensor not in vehicle.noise
    }
    if not levels:
        return options
    note(
        "sensor noise",
        "starts from the fastest part of each channel and is estimated",
        "the vehicle file states none; third differences of the channels",
        "--noise",
    )
    return options.but(noise=levels)


def _held(options: FitOptions, vehicle: Vehicle, given: Given, note: Note) -> FitOptions:
    """Of two numbers of which the flights show the ratio alone, the one that is known
    better."""
    said = given.choices
    if "free" in said or ("fixed" in said and not options.fixed):  # said: nothing is held
        return options
    named = set(said.get("per_flight", ()))
    declared = {d.name: _believed(d, options) for d in core_parameters(vehicle)}
    held = []
    values = {n: d.nominal for n, d in declared.items()}
    for *pair, shown_by in RATIOS:
        names = [n if n in declared else leading(n, values) for n in pair]
        both = [declared[n] for n in names]
        if not all(0 < d.sigma < np.inf and d.nominal for d in both):
            continue
        if set(names) & set(said.get("fixed", ())):
            continue
        better, worse = sorted(both, key=lambda d: (d.name in named, d.sigma / abs(d.nominal)))
        held.append(better.name)
        note(
            better.name,
            f"held at {better.nominal:.4g} {better.unit}",
            f"{shown_by} shows only its ratio to {worse.name}, which is known less well; its own "
            f"{100 * better.sigma / abs(better.nominal):.2g} % are carried into the errors",
            "--fixed, --considered",
        )
    options = options.but(fixed=(*options.fixed, *held))
    return options if "considered" in said else options.but(considered=tuple(held))


def _believed(d: Parameter, options: FitOptions) -> Parameter:
    """The declaration with the prior that the user gave in its place. Raises `ModelError` for one
    that is centred where the parameter cannot be."""
    given = options.priors.get(d.name)
    return d if given is None else replace(d, nominal=given[0], sigma=given[1])
