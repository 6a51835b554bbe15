"""IdentifiedModel: what a fit leaves behind. Everything that validation, export and control need,
and no raw data.

On disk it is one JSON file (schema "greybox.model/1"): vehicle, effects, sensors and settings (of a
model of the user's own, its equations) and noise, from which the CasADi expressions are rebuilt
exactly, estimates with covariance, noise levels, training
domain, data hash and a checksum.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from greybox.distribution import VERSION
from greybox.errors import FileFormatError, ModelError, UnknownNameError
from greybox.files import Json, Parsed, checksum, read_json, to_plain, well_formed, write_json
from greybox.model.dynamics import Dynamics, StateSpaceModel
from greybox.model.effect import Effect
from greybox.model.effective_lag import EffectiveLag, effective_lag
from greybox.model.effects_file import effects_of, own_effects
from greybox.model.given_values import demand_changes
from greybox.model.layer import innermost, learned_part, physics_of
from greybox.model.model import PhysicsModel
from greybox.model.noise import Augmented, Disturbance, NoisePart, noise_part, with_parts
from greybox.model.own_model import own_from_dict, own_to_dict
from greybox.model.parameter import ParameterValues
from greybox.model.sensor import Sensor
from greybox.model.sensors import SENSORS
from greybox.model.vehicle import Vehicle
from greybox.model.verdict import NOT_JUDGED, Verdict
from greybox.shown import Cell, Shown
from greybox.symbolic import FloatArray

SCHEMA = "greybox.model/1"
KINDS = ("physics", "own")
"""The model of a vehicle, and one of the user's own equations."""
SHORTEST_SAMPLE = 1e-5
"""Sample time [s] below which a file is refused: a step sees as many commands as fit into the
longest delay."""


@runtime_checkable
class OwnFile(Protocol):
    """A layer that a model file of its own kind holds."""

    def file_of(self, model: IdentifiedModel) -> dict[str, Json]:
        """Plain values of the file of a model whose dynamics this is."""
        ...


def library_versions() -> dict[str, str]:
    """Versions of greybox and of the libraries that shape a result."""
    out = {"greybox": VERSION}
    for name in ("casadi", "numpy", "scipy"):
        try:
            out[name] = version(name)
        except PackageNotFoundError:
            out[name] = "unknown"
    return out


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class IdentifiedModel(Shown):
    """A fitted Dynamics with estimates, their covariance and the noise levels of its filter.

    `values` holds every model parameter (per-flight ones at their mean over the training flights),
    `per_flight` the values of each training flight, `flight_spread` name -> (mean, standard
    deviation between flights). `covariance` belongs to `covariance_names` (shared parameters),
    `flight_covariance` (n + k, k) says how these and the means of the k numbers of `flight_spread`
    vary with those means ((0, 0): nobody said).
    `considered`: of parameters that were held although they are not exact, name -> (standard error,
    how far each estimate moves per unit, per-flight ones on average); `covariance` includes what
    that does, `flight_spread` does not. `form_covariance`: of covariance_names, what the flights
    add where they want an effect that the model lacks ((0, 0): nothing). Predictions of this model
    do without it; whoever takes the number for one of the craft needs it (`standard_errors`).
    `process_noise` (n_w) and `sensor_noise` (n_e) are standard deviations per sample of
    `sample_time` seconds. `domain` maps channels to the (min, max) seen in training. `weak` (n_d)
    are the standard deviations of the pseudo-measurement that keeps undetectable states finite.
    `horizon_noise` (n_w) replaces `process_noise` where uncertainty is propagated without
    measurements (calibrated on multi-step errors); None: the same. `verdict` says what judging it
    on flights found, None where nobody did (or it was changed since). `recipes`: channel -> how it
    was made of what the training logs hold, where it is not a column of that name as it stands;
    None: nobody said.
    """

    dynamics: Dynamics
    values: ParameterValues
    covariance_names: tuple[str, ...] = ()
    covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    considered: Mapping[str, tuple[float, Mapping[str, float]]] = field(default_factory=dict)
    form_covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    per_flight: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    flight_spread: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    flight_covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    process_noise: FloatArray
    sensor_noise: FloatArray
    weak: FloatArray
    horizon_noise: FloatArray | None = None
    reference_state: FloatArray
    reference_inputs: FloatArray
    sample_time: float
    domain: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    data_hash: str = ""
    trained_on: tuple[str, ...] = ()
    trained_samples: frozenset[str] = frozenset()
    recipes: Mapping[str, str] | None = None
    source: str = ""
    verdict: Verdict | None = None

    def _shown_text(self) -> str:
        """The verdict first, then the model and its values with their standard errors."""
        first = NOT_JUDGED if self.verdict is None else self.verdict.line
        trained = ", ".join(self.trained_on) or "nothing that is known"
        where = f"  {self.sample_time:g} s a step, identified on {trained}"
        rows = [
            f"  {r['parameter']} {r['value']:.5g}"
            + ("" if r["std"] is None else f" +- {r['std']:.2g}")
            + f" {r['unit']}"
            for r in self._shown_rows()
        ]
        lag = [] if self.effective_lag is None else [f"  {self.effective_lag.line}"]
        return "\n".join([first, self.name, where, *lag, *rows])

    def _shown_rows(self) -> list[dict[str, Cell]]:
        """One row per parameter; `std` is None for what was held."""
        std = self.standard_errors
        return [
            {
                "parameter": d.name,
                "value": self.values[d.name],
                "std": std.get(d.name),
                "unit": d.unit,
                "scope": d.scope,
            }
            for d in self.dynamics.parameters
        ]

    @property
    def name(self) -> str:
        """The model's name."""
        return self.dynamics.name

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects of a physics model."""
        physics = physics_of(self.dynamics)
        return () if physics is None else tuple(e.name for e in physics.effects)

    @property
    def sensors(self) -> frozenset[str]:
        """Names of the sensors of a physics model."""
        physics = physics_of(self.dynamics)
        return frozenset() if physics is None else physics.sensor_names

    @property
    def core(self) -> Dynamics:
        """The innermost model: without noise states and learned parts."""
        return innermost(self.dynamics)

    @cached_property
    def physics(self) -> PhysicsModel:
        """The innermost model of a vehicle. Raises `ModelError` for another kind (see `core`)."""
        physics = physics_of(self.dynamics)
        if physics is None:
            raise ModelError(
                f"{self.name} is not the model of a vehicle",
                expected="a physics model",
                got=type(self.core).__name__,
            )
        return physics

    @cached_property
    def effective_lag(self) -> EffectiveLag | None:
        """Motor lag, delays and filter of the gyro as one number; None for fewer than two."""
        physics = physics_of(self.dynamics)
        measured = physics is not None and physics.input == "speed"
        names = self.covariance_names
        whole = self.covariance + self.form_among(names)
        return effective_lag(self.values, names, whole, measured=measured)

    @property
    def channel_groups(self) -> tuple[str, ...]:
        """Channel group of every innovation component (its own name without sensors)."""
        physics = physics_of(self.dynamics)
        return self.dynamics.innovations.names if physics is None else physics.channel_groups

    def form_among(self, names: Sequence[str]) -> FloatArray:
        """`form_covariance` (k, k) of these names; 0 where nothing is known of one."""
        out, own = np.zeros((len(names), len(names))), self.covariance_names
        if self.form_covariance.size:
            at = [i for i, n in enumerate(names) if n in own]
            rows = [own.index(names[i]) for i in at]
            out[np.ix_(at, at)] = self.form_covariance[np.ix_(rows, rows)]
        return out

    @property
    def form_errors(self) -> dict[str, float]:
        """Standard deviation of `form_covariance`, of the estimates that have one."""
        variances = np.diag(self.form_among(self.covariance_names)).tolist()
        return {n: v**0.5 for n, v in zip(self.covariance_names, variances, strict=True) if v > 0}

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard error of every shared estimate, of its form too."""
        own = zip(self.covariance_names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True)
        return {n: float(np.hypot(s, self.form_errors.get(n, 0.0))) for n, s in own}

    @property
    def joint_covariance(self) -> tuple[tuple[str, ...], FloatArray]:
        """Names and covariance (k, k) of the shared parameters and of those that were held although
        they are not exact. Only together do they keep what the flights know well, as the ratio of
        thrust to a mass that was held."""
        names, held = self.covariance_names, self.considered
        moves = np.array([[by.get(n, 0.0) for _, by in held.values()] for n in names])
        square = np.diag([sigma**2 for sigma, _ in held.values()])
        cross = moves.reshape(len(names), len(held)) @ square
        return (*names, *held), np.block([[self.covariance, cross], [cross.T, square]])

    @property
    def noise_ahead(self) -> FloatArray:
        """Process noise (n_w) where nothing is measured any more: `horizon_noise`, where there is
        one."""
        return self.process_noise if self.horizon_noise is None else self.horizon_noise

    def parameter_vector(self, changes: Mapping[str, float] | None = None) -> FloatArray:
        """p (n_p) in the order of the model, with `changes` applied. Raises `UnknownNameError`."""
        values = self.values.replace(dict(changes or {}))
        return np.array([values[d.name] for d in self.dynamics.parameters])

    def flight_vector(self, flight: str) -> FloatArray:
        """p for a training flight (its own values), or the mean over flights for any other."""
        return self.parameter_vector(self.per_flight.get(flight))

    def with_values(self, changes: Mapping[str, float]) -> IdentifiedModel:
        """A copy with some values changed, which nobody has judged.

        Raises `UnknownNameError`, and `ModelError` for what is no finite number within the bounds
        of its parameter, or makes an inertia that no body has.
        """
        demand_changes(self.dynamics, changes, self.values)
        return replace(self, values=self.values.replace(changes), verdict=None)

    def to_dict(self) -> dict[str, Json]:
        """Plain values of the model file. Raises `ModelError` for other than catalogue parts."""
        if isinstance(self.dynamics, OwnFile):
            return self.dynamics.file_of(self)
        physics = _saved_core(self)
        parts = self.dynamics.parts if isinstance(self.dynamics, Augmented) else ()
        body: dict[str, Json] = {
            "schema": SCHEMA,
            "kind": "own" if isinstance(physics, StateSpaceModel) else "physics",
            "name": self.name,
            **_core_to_dict(physics),
            "noise_parts": [p.to_dict() for p in parts],
            "sample_time": self.sample_time,
            "values": dict(self.values),
            "units": {d.name: d.unit for d in self.dynamics.parameters},
            "covariance": {
                "names": list(self.covariance_names),
                "matrix": self.covariance.tolist(),
            },
            **({"considered": _considered_to_dict(self)} if self.considered else {}),
            **_said(
                form_covariance=self.form_covariance if self.form_errors else None,
                flight_covariance=self.flight_covariance if self.flight_covariance.size else None,
                recipes=self.recipes,
            ),
            **(
                {}
                if self.effective_lag is None
                else {"effective_lag": self.effective_lag.to_dict()}
            ),
            "per_flight": {k: dict(v) for k, v in self.per_flight.items()},
            "flight_spread": {k: list(v) for k, v in self.flight_spread.items()},
            "process_noise": dict(
                zip(self.dynamics.noises.names, self.process_noise.tolist(), strict=True)
            ),
            "horizon_noise": None
            if self.horizon_noise is None
            else dict(zip(self.dynamics.noises.names, self.horizon_noise.tolist(), strict=True)),
            "sensor_noise": dict(
                zip(self.dynamics.innovations.names, self.sensor_noise.tolist(), strict=True)
            ),
            "weak": self.weak.tolist(),
            "reference": {
                "state": self.reference_state.tolist(),
                "inputs": self.reference_inputs.tolist(),
            },
            "domain": {k: list(v) for k, v in self.domain.items()},
            "data_hash": self.data_hash,
            "trained_on": list(self.trained_on),
            **({"trained_samples": sorted(self.trained_samples)} if self.trained_samples else {}),
            **({} if self.verdict is None else {"verdict": to_plain(self.verdict.to_dict())}),
            "versions": library_versions(),
        }
        return {**body, "checksum": checksum({k: v for k, v in body.items() if k != "versions"})}

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the model file atomically."""
        return write_json(path, self.to_dict())

    @staticmethod
    def load(
        path: str | os.PathLike[str],
        *,
        effects: Iterable[Effect] = (),
        sensors: Iterable[Sensor] = (),
    ) -> IdentifiedModel:
        """Read a model file; `effects`, `sensors`: those not in the catalogues (`load_effects`).

        Raises `FileFormatError` (schema, checksum, sizes, an effect that is not given),
        `VehicleError`, `UnknownNameError`.
        """
        return IdentifiedModel.from_dict(
            read_json(path, schema=SCHEMA), where=str(path), effects=effects, sensors=sensors
        )

    @staticmethod
    def from_dict(
        data: Parsed,
        *,
        where: str = "model",
        effects: Iterable[Effect] = (),
        sensors: Iterable[Sensor] = (),
    ) -> IdentifiedModel:
        """Rebuild a model from the values of its file."""
        _check_file(data, where)
        with well_formed(where):
            _demand_sample(data, "sample_time")
            dynamics: Dynamics
            if data["kind"] == "own":
                dynamics = own_from_dict(data["own"], where=where)
            else:
                dynamics = _physics_from_dict(data, effects, sensors, where)
            model = _identified_from_dict(data, with_parts(dynamics, _noise_parts(data)), where)
            _check(model)
        return model


def _check_file(data: Parsed, where: str) -> None:
    """Raises `FileFormatError` for another kind of model, or a file that was changed."""
    if data.get("kind") == "hybrid":
        raise learned_part(FileFormatError, where)
    if data.get("kind") not in KINDS:
        raise FileFormatError(
            "unknown kind of model",
            where=where,
            expected=" or ".join(KINDS),
            got=repr(data.get("kind")),
        )
    body = {k: v for k, v in data.items() if k not in ("checksum", "versions")}
    if checksum(body) != data.get("checksum"):
        raise FileFormatError(
            "the checksum does not fit",
            where=where,
            fix="the file was edited or cut off; write it again",
        )


def _identified_from_dict(data: Parsed, dynamics: Dynamics, where: str) -> IdentifiedModel:
    """The numbers of a file with their `dynamics`."""
    return IdentifiedModel(
        dynamics=dynamics,
        values=ParameterValues({d.name: d.nominal for d in dynamics.parameters}).replace(
            data["values"]
        ),
        covariance_names=tuple(data["covariance"]["names"]),
        covariance=np.asarray(data["covariance"]["matrix"], dtype=float).reshape(
            (len(data["covariance"]["names"]),) * 2
        ),
        considered={
            n: (float(v["std"]), {k: float(x) for k, x in v["moves"].items()})
            for n, v in data.get("considered", {}).items()
        },
        form_covariance=_form(data),
        per_flight={k: {n: float(x) for n, x in v.items()} for k, v in data["per_flight"].items()},
        flight_spread={k: (float(v[0]), float(v[1])) for k, v in data["flight_spread"].items()},
        flight_covariance=np.asarray(data.get("flight_covariance", np.zeros((0, 0))), dtype=float),
        process_noise=np.array([float(data["process_noise"][n]) for n in dynamics.noises.names]),
        sensor_noise=np.array([float(data["sensor_noise"][n]) for n in dynamics.innovations.names]),
        weak=np.asarray(data["weak"], dtype=float),
        horizon_noise=None
        if data.get("horizon_noise") is None
        else np.array([float(data["horizon_noise"][n]) for n in dynamics.noises.names]),
        reference_state=np.asarray(data["reference"]["state"], dtype=float),
        reference_inputs=np.asarray(data["reference"]["inputs"], dtype=float),
        sample_time=float(data["sample_time"]),
        domain={k: (float(v[0]), float(v[1])) for k, v in data["domain"].items()},
        data_hash=str(data["data_hash"]),
        trained_on=tuple(data["trained_on"]),
        trained_samples=frozenset(map(str, data.get("trained_samples", ()))),
        recipes=None if data.get("recipes") is None else dict(data["recipes"]),
        source=where,
        verdict=None if data.get("verdict") is None else Verdict.from_dict(data["verdict"]),
    )


def _form(data: Parsed) -> FloatArray:
    """Earlier files have only its standard deviations."""
    errors = data.get("form_errors")
    if errors is None:
        return np.asarray(data.get("form_covariance", np.zeros((0, 0))), dtype=float)
    return np.diag([float(errors.get(n, 0.0)) ** 2 for n in data["covariance"]["names"]])


def _said(**tables: object) -> dict[str, Json]:
    """Tables of the file that are there."""
    return {key: to_plain(table) for key, table in tables.items() if table is not None}


def _demand_sample(data: Parsed, key: str) -> None:
    if not SHORTEST_SAMPLE <= float(data[key]) < np.inf:
        raise ValueError(f"{key} is {float(data[key]):g} s")


def _considered_to_dict(model: IdentifiedModel) -> dict[str, Json]:
    return {n: {"std": s, "moves": dict(by)} for n, (s, by) in model.considered.items()}


def _saved_core(model: IdentifiedModel) -> PhysicsModel | StateSpaceModel:
    """What a model file holds below the noise parts. Raises `ModelError` for anything else."""
    dynamics = model.dynamics
    physics = dynamics.core if isinstance(dynamics, Augmented) else dynamics
    if physics is not model.core:
        raise ModelError(
            "no model file holds this layer", got=f"{type(dynamics).__name__} on {model.name}"
        )
    if not isinstance(physics, (PhysicsModel, StateSpaceModel)):
        raise ModelError(
            "only vehicles and models of the user's own (StateSpaceModel) can be saved",
            got=type(physics).__name__,
            fix="write it as a StateSpaceModel, or keep its Python code and save its values",
        )
    return physics


def _core_to_dict(core: PhysicsModel | StateSpaceModel) -> dict[str, Json]:
    """What the innermost model is built from."""
    if isinstance(core, StateSpaceModel):
        return {"own": own_to_dict(core)}
    return {
        "vehicle": core.vehicle.to_dict(),
        "effects": [e.name for e in core.effects],
        **({"own_effects": own} if (own := own_effects(core.effects)) else {}),
        "sensors": [s.name for s in core.sensors],
        "input": core.input,
        "model_sample_time": core.sample_time,
        "kinematic_noise": core.kinematic_noise,
        "omega_known": core.omega_known,
    }


def _physics_from_dict(
    data: Parsed, effects: Iterable[Effect], sensors: Iterable[Sensor], where: str
) -> PhysicsModel:
    """The model of a vehicle that a file describes; `effects` and `sensors` as in `load`."""
    _demand_sample(data, "model_sample_time")
    known = {s.name: s for s in (*SENSORS, *sensors)}
    if missing := [str(n) for n in data["sensors"] if n not in known]:
        raise UnknownNameError("sensor", missing[0], known, where=where)
    return PhysicsModel(
        vehicle=Vehicle.from_dict(data["vehicle"], where=where),
        effects=effects_of(data["effects"], data.get("own_effects", {}), effects, where=where),
        sensors=tuple(known[n] for n in data["sensors"]),
        input=data["input"],
        sample_time=float(data["model_sample_time"]),
        kinematic_noise=bool(data.get("kinematic_noise", False)),
    )


def _noise_parts(data: Parsed) -> list[NoisePart]:
    """The noise that is correlated in time; earlier files named the groups of disturbances and one
    time of all of them."""
    if "noise_parts" in data:
        return [noise_part(record) for record in data["noise_parts"]]
    groups = data["disturbance"]
    time = float(data["disturbance_time_constant"]) if groups else 1.0
    return [Disturbance(group=g, time=time) for g in groups]


def _check(model: IdentifiedModel) -> None:
    """Raises `ValueError` where sizes, names or ranges of what a file gave do not fit its model."""
    dynamics = model.dynamics
    for what, value, size in (
        ("weak", model.weak, len(dynamics.error_states)),
        ("reference state", model.reference_state, len(dynamics.states)),
        ("reference inputs", model.reference_inputs, len(dynamics.inputs)),
    ):
        if value.shape != (size,):
            raise ValueError(f"{what} has shape {value.shape}, expected ({size},)")
    levels = [model.process_noise, model.sensor_noise]
    levels += [] if model.horizon_noise is None else [model.horizon_noise]
    for numbers in (
        *levels,
        model.weak,
        model.reference_state,
        model.reference_inputs,
        model.parameter_vector(),
    ):
        if not np.isfinite(numbers).all():
            raise ValueError("a number is not finite")
    if any((v < 0).any() for v in levels):
        raise ValueError("a noise level is negative")
    names = [
        *model.covariance_names,
        *model.considered,
        *model.flight_spread,
        *(n for v in model.per_flight.values() for n in v),
    ]
    for name in names:
        model.values[name]
    if len(set(model.covariance_names)) < len(model.covariance_names):
        raise ValueError("a name is twice in the covariance")
    if doubled := set(model.considered) & {*model.covariance_names, *model.flight_spread}:
        raise ValueError(f"{min(doubled)} is both held and estimated")
    if model.form_covariance.size and model.form_covariance.shape != model.covariance.shape:
        raise ValueError("the errors of its form are not of what was estimated")
    if not (
        np.isfinite(model.form_covariance).all() and (np.diag(model.form_covariance) >= 0).all()
    ):
        raise ValueError("an error of a form is negative or not finite")
    _check_errors(model)
    texts = (*model.trained_on, *model.covariance_names, *(model.recipes or {}).values())
    if not all(isinstance(n, str) for n in texts):
        raise ValueError("a name is not a text")


def _check_errors(model: IdentifiedModel) -> None:
    """Raises `ValueError` where errors of what was held, or of what flights have, do not fit what
    was estimated."""
    own = len(model.flight_spread)
    if model.flight_covariance.size and model.flight_covariance.shape != (
        len(model.covariance_names) + own,
        own,
    ):
        raise ValueError("the covariance of what flights have is not of what was estimated")
    if not np.isfinite(model.flight_covariance).all():
        raise ValueError("a covariance of what flights have is not finite")
    errors = [x for s, by in model.considered.values() for x in (s, *by.values())]
    if not np.isfinite(errors).all():
        raise ValueError("an error of a held parameter is not finite")
    estimated = {*model.covariance_names, *model.flight_spread}
    for name, (sigma, by) in model.considered.items():
        if sigma < 0:
            raise ValueError(f"the error of {name}, which was held, is negative: {sigma:g}")
        if foreign := sorted(set(by) - estimated):
            raise ValueError(f"{name} moves {foreign[0]}, which was not estimated")
