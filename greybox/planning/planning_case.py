"""PlanningCase: the model that a plan is made for, what is to be estimated in it, and what is known
of that before."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from greybox.errors import GreyboxError, ModelError, UnknownNameError
from greybox.estimation.fit import noise_of
from greybox.model.dynamics import Dynamics
from greybox.model.effect import Effect
from greybox.model.effects import effect_by_name
from greybox.model.identified import IdentifiedModel
from greybox.model.model import PhysicsModel
from greybox.model.noise import disturbances, sensor_parts, with_parts
from greybox.model.parameter import Parameter, ParameterValues
from greybox.model.sensor import Sensor
from greybox.model.sensors import USUAL
from greybox.model.vehicle import Vehicle
from greybox.symbolic import FloatArray

DEFAULT_SENSORS = ("position", "attitude", "gyro", "accelerometer")


class Estimated(Protocol):
    """What the information about parameters asks of a subject."""

    @property
    def dynamics(self) -> Dynamics:
        """What will be fitted."""

    @property
    def free(self) -> tuple[str, ...]:
        """The parameters to estimate."""

    @property
    def wanted(self) -> tuple[str, ...]:
        """Of these the ones that the plan is for."""

    @property
    def values(self) -> Mapping[str, float]:
        """Parameter values that are taken for true."""

    @property
    def noise(self) -> Mapping[str, float]:
        """Noise levels by name."""

    @property
    def precision(self) -> FloatArray:
        """What is known of `free` before (k, k)."""

    @property
    def declared(self) -> dict[str, Parameter]:
        """Declarations by name."""


@dataclass(frozen=True, kw_only=True)
class PlanningCase:
    """`dynamics` is what will be fitted, with the noise that lasts of a fitted model, `flying` the
    same craft without, with all sensors, `free` the parameters to estimate.

    `values` are taken for true, `noise` are levels by name, `precision` (k, k) is what is known of
    `free` before. `wanted` are the parameters that the plan is for; `groups` maps effects to their
    free parameters.
    """

    dynamics: Dynamics
    physics: PhysicsModel
    flying: IdentifiedModel
    free: tuple[str, ...]
    wanted: tuple[str, ...]
    groups: Mapping[str, tuple[str, ...]]
    values: Mapping[str, float]
    noise: Mapping[str, float]
    precision: FloatArray
    sample_time: float

    @property
    def known_before(self) -> dict[str, float]:
        """Standard deviations of what is known before; parameters of which nothing is known are
        left out."""
        seen = np.diag(self.precision) > 0
        spread = np.linalg.pinv(self.precision, hermitian=True)
        return {n: float(np.sqrt(spread[i, i])) for i, n in enumerate(self.free) if seen[i]}

    @property
    def declared(self) -> dict[str, Parameter]:
        """Declarations by name."""
        return {d.name: d for d in self.dynamics.parameters}


def planning_case(
    vehicle: Vehicle | None = None,
    model: IdentifiedModel | None = None,
    *,
    effects: Iterable[str | Effect] = (),
    free: Iterable[str] | None = None,
    values: Mapping[str, float] | None = None,
    noise: Mapping[str, float] | None = None,
    sensors: Iterable[str] | None = None,
    sample_time: float | None = None,
    assumed: float = 1.0,
) -> PlanningCase:
    """What `vehicle`, or the fitted `model` of it, is to be planned for.

    `effects` are what the plan is for: their parameters are estimated, at the size that vehicle,
    model or `values` give them, else at `assumed` times their typical one. Everything with a sigma
    in the vehicle file is estimated beside them, or exactly `free`. With a model, its covariance is
    what is known before, and its noise is that of the flights. Raises `ModelError`, `UnknownNameError`,
    `GreyboxError`.
    """
    asked = tuple(effect_by_name(e) if isinstance(e, str) else e for e in effects)
    if model is not None:
        physics = _fitted(model, asked, sensors, sample_time)
    elif vehicle is not None:
        physics = _described(vehicle, asked, sensors, sample_time)
    else:
        raise GreyboxError(
            "nothing to plan for", expected="a vehicle or a model", fix="--vehicle V.toml"
        )
    if physics.input != "command":
        raise ModelError(
            "a model driven by measured rotor speeds cannot be flown",
            fix="log the commands, and fit them",
        )
    dynamics = physics if model is None else _with_noise_of(model, physics)
    declared = {d.name: d for d in dynamics.parameters}
    known = {} if model is None else dict(model.values)
    numbers = {n: known.get(n, d.nominal) for n, d in declared.items()}
    for e in asked:
        _typical(e, physics.vehicle, declared, numbers, known, assumed)
    numbers |= _inside(values or {}, declared)
    groups = {
        e.name: tuple(n for n in declared if n.startswith(f"{e.name}.")) for e in physics.effects
    }
    wanted = tuple(n for e in asked for n in groups[e.name])
    names = _free(declared, free, wanted, model)
    return PlanningCase(
        dynamics=dynamics,
        physics=physics,
        flying=_flying(physics, numbers, physics.sample_time),
        free=names,
        wanted=tuple(n for n in wanted if n in names) or names,
        groups={
            e: inside for e, ns in groups.items() if (inside := tuple(n for n in ns if n in names))
        },
        values=numbers,
        noise=noise_levels(dynamics, model, noise),
        precision=precision_of(declared, names, model),
        sample_time=physics.sample_time,
    )


def _fitted(
    model: IdentifiedModel,
    asked: Sequence[Effect],
    sensors: Iterable[str] | None,
    sample_time: float | None,
) -> PhysicsModel:
    """The physics of a fitted model with the effects that it does not have yet."""
    physics = model.core
    if not isinstance(physics, PhysicsModel):
        raise ModelError(
            "only physics models can be planned for",
            got=type(physics).__name__,
            fix="pass the model.json of greybox fit",
        )
    have = {e.name for e in physics.effects}
    return replace(
        physics,
        effects=(*physics.effects, *(e for e in asked if e.name not in have)),
        sensors=_sensors(tuple(sensors)) if sensors else physics.sensors,
        sample_time=sample_time or model.sample_time,
    )


def _with_noise_of(model: IdentifiedModel, physics: PhysicsModel) -> Dynamics:
    """The physics with what lasts of the fitted model's noise: its white rest alone is what no
    flight has, and would promise errors that none gives."""
    kept = [p for p in sensor_parts(model.dynamics) if p.sensor in physics.sensor_names]
    return with_parts(physics, (*kept, *disturbances(model.dynamics)))


def _described(
    vehicle: Vehicle,
    asked: Sequence[Effect],
    sensors: Iterable[str] | None,
    sample_time: float | None,
) -> PhysicsModel:
    """The physics of a vehicle file, with the sensors whose noise it states, or the usual four."""
    names = (
        tuple(sensors or (s for s in (x.name for x in USUAL) if s in vehicle.noise))
        or DEFAULT_SENSORS
    )
    own = [
        e
        for e in (effect_by_name(n) for n in vehicle.effects)
        if e.name not in {a.name for a in asked}
    ]
    return PhysicsModel(
        vehicle=vehicle,
        effects=(*own, *asked),
        sensors=_sensors(names),
        sample_time=sample_time or 0.01,
    )


def _inside(values: Mapping[str, float], declared: Mapping[str, Parameter]) -> Mapping[str, float]:
    """The given values. Raises `UnknownNameError`, and `GreyboxError` beyond a bound."""
    for n, v in values.items():
        if n not in declared:
            raise UnknownNameError("parameter", n, declared)
        if not declared[n].lower <= v <= declared[n].upper:
            raise GreyboxError(
                f"{n} is outside its bounds",
                expected=f"{declared[n].lower:g} to {declared[n].upper:g}",
                got=f"{v:g}",
                fix="check the unit",
            )
    return values


def _free(
    declared: Mapping[str, Parameter],
    given: Iterable[str] | None,
    wanted: Sequence[str],
    model: IdentifiedModel | None,
) -> tuple[str, ...]:
    """The parameters to estimate: those given, or what is uncertain before and what is wanted.
    Raises `UnknownNameError`, and `GreyboxError` for none."""
    if given is not None:
        chosen = set(given)
        for n in chosen - set(declared):
            raise UnknownNameError("parameter", n, declared)
    else:
        before = (
            set(model.covariance_names)
            if model is not None
            else {n for n, d in declared.items() if d.sigma > 0}
        )
        chosen = before | set(wanted)
    names = tuple(n for n in declared if n in chosen)
    if not names:
        raise GreyboxError(
            "nothing to estimate: every number is exact",
            fix="name effects with --for, or give numbers of the vehicle file a sigma",
        )
    return names


def _sensors(names: tuple[str, ...]) -> tuple[Sensor, ...]:
    known = {s.name: s for s in USUAL}
    for n in names:
        if n not in known:
            raise UnknownNameError("sensor", n, known)
    return tuple(s for s in known.values() if s.name in names)


def _typical(
    effect: Effect,
    vehicle: Vehicle,
    declared: Mapping[str, Parameter],
    numbers: dict[str, float],
    known: Mapping[str, float],
    assumed: float,
) -> None:
    """An effect that nobody gave a size is taken at the size of a typical change, not at its
    null."""
    stated = vehicle.effects.get(effect.name, {})
    for n, d in declared.items():
        head, _, short = n.partition(".")
        if (
            head == effect.name
            and short not in stated
            and n not in known
            and d.null is not None
            and d.nominal == d.null
        ):
            numbers[n] = float(np.clip(d.null + assumed * d.scale, d.lower, d.upper))


def _flying(physics: PhysicsModel, numbers: Mapping[str, float], dt: float) -> IdentifiedModel:
    whole = replace(physics, sensors=USUAL)
    vehicle = physics.vehicle
    c0, c1, c2 = (numbers[f"thrust.c{k}"] for k in range(3))
    share = numbers["mass"] * vehicle.gravity / len(vehicle.rotors)
    roots = np.roots([c2, c1, c0 - share]) if c2 else np.array([(share - c0) / c1])
    real = [float(r.real) for r in roots if abs(r.imag) < 1e-9 and r.real > 0]
    if not real:
        raise ModelError("the thrust map never carries the weight", fix="greybox vehicle check")
    inputs = [min(real)] * len(vehicle.rotors) + [vehicle.nominal_voltage or 1.0] * (
        len(whole.inputs) - len(vehicle.rotors)
    )
    means = dict(zip(whole.inputs.names, inputs, strict=True))
    return IdentifiedModel(
        dynamics=whole,
        values=ParameterValues({d.name: numbers[d.name] for d in whole.parameters}),
        process_noise=whole.noise_scale(dt),
        sensor_noise=whole.sensor_scale(),
        weak=np.full(len(whole.error_states), 100.0),
        reference_state=whole.reference(means),
        reference_inputs=np.array(inputs),
        sample_time=dt,
    )


def noise_levels(
    dynamics: Dynamics, model: IdentifiedModel | None, given: Mapping[str, float] | None
) -> dict[str, float]:
    """Levels of the model's filter (where it has them), then the given ones."""
    levels = noise_of(model) if model is not None else {}
    here = {f"noise.process.{n}" for n in dynamics.noises.names} | {
        f"noise.sensor.{n}" for n in dynamics.innovations.names
    }
    return {n: v for n, v in levels.items() if n in here} | dict(given or {})


def precision_of(
    declared: Mapping[str, Parameter], names: tuple[str, ...], model: IdentifiedModel | None
) -> FloatArray:
    """What is known before: the priors of the vehicle file and of effects, or the covariance of the
    fitted model."""
    sigma = np.array([declared[n].believed[1] for n in names])
    out = np.diag([s**-2 if 0 < s < np.inf else 0.0 for s in sigma])
    if model is not None and model.covariance_names:
        at = [i for i, n in enumerate(model.covariance_names) if n in names]
        places = [names.index(model.covariance_names[i]) for i in at]
        whole = model.covariance + model.form_among(model.covariance_names)
        out[places, :] = 0.0
        out[np.ix_(places, places)] = np.linalg.pinv(whole[np.ix_(at, at)], hermitian=True)
    return out
