"""The manifest of a bundle: what a reader, human or machine, must know to call its functions.

Its JSON Schema is greybox/schemas/manifest.json.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NotRequired, TypedDict

import casadi as ca
import numpy as np

from greybox.files import Json
from greybox.model.identified import IdentifiedModel, library_versions
from greybox.model.layer import physics_of
from greybox.model.linear import LinearModel
from greybox.model.verdict import Outcome
from greybox.residual.posterior import GPPosterior
from greybox.symbolic import FloatArray, Layout
from mpc_export.c_code import CSource
from mpc_export.c_model import CODES, scale_of, sizes_of
from mpc_export.calibration import GAIN, LEVEL
from mpc_export.functions import ModelFunctions
from mpc_export.golden import Golden
from mpc_export.innovation_form import BaseForm
from mpc_export.model_parts import Exportable
from mpc_export.points import Reduction
from mpc_export.predictors import PredictorModel

SCHEMA = "greybox.bundle/1"
FRAMES = {
    "world": "ENU, z up; gravity is (0, 0, -g)",
    "body": "FLU: x forward, y left, z up; thrust along +z",
    "attitude": "unit quaternion (w, x, y, z), body to world",
    "error_state": "q = q_hat * exp(d_attitude/2), p = p_hat + R_hat d_position, v = v_hat + R_hat "
    "d_velocity, the rest by addition: body axes of the estimate",
    "matrices": "column by column, all entries",
}
TOLERANCE = {"double": 1e-10, "float": 1e-4}
"""Largest allowed difference between C and CasADi, in units of an output's scale."""


Column = Literal["scale", "reference", "lower", "upper", "value", "sensor_noise"]
COLUMNS: tuple[Column, ...] = ("scale", "reference", "value", "lower", "upper", "sensor_noise")
"""Numbers that a vector may have."""


class SignalRow(TypedDict):
    """One entry of a vector; what is not finite is None."""

    index: int
    name: str
    unit: str
    meaning: str
    scale: NotRequired[float | None]
    reference: NotRequired[float | None]
    lower: NotRequired[float | None]
    upper: NotRequired[float | None]
    value: NotRequired[float | None]
    sensor_noise: NotRequired[float | None]


class PortRow(TypedDict):
    """An argument or result of a function; results have a `scale`."""

    name: str
    rows: int
    columns: int
    scale: NotRequired[float]


class FunctionRow(TypedDict):
    """One function with all that it takes and gives."""

    name: str
    arguments: list[PortRow]
    results: list[PortRow]


class ModelPart(TypedDict):
    """What was exported."""

    name: str
    kind: str
    effects: list[str]
    trained_on: list[str]


class TargetPart(TypedDict, total=False):
    """What a target says of itself: its example or its folder, and what it found out."""

    example: str
    f_expl_difference: dict[str, float]
    file: str
    binary: bool
    folder: str
    selftest: str
    horizon: int
    attempts: int
    stops_from: float | None
    note: str
    every_calls: int
    interval_us: int
    period_ns: int


class CPart(TypedDict):
    """What a caller of the C source must know."""

    prefix: str
    real: str
    integer: str
    source_bytes: int
    kernels: list[str]
    work: dict[str, int]
    work_bytes: int
    functions: dict[str, dict[str, int]]


class DelayPart(TypedDict):
    """How a delay of d seconds is in f_d, and that f has none."""

    history: dict[str, int]
    parameters: dict[str, float]
    form: str
    f_excludes_delay: bool


class ReturnCode(TypedDict):
    """What a function in C may return."""

    code: int
    name: str
    meaning: str


class Vectors(TypedDict):
    """What stands where in every vector."""

    states: list[SignalRow]
    error_states: list[SignalRow]
    inputs: list[SignalRow]
    parameters: list[SignalRow]
    outputs: list[SignalRow]
    innovations: list[SignalRow]
    features: list[SignalRow]
    learned: list[SignalRow]
    targets: list[SignalRow]


class Manifest(Vectors):
    """manifest.json; greybox/schemas/manifest.json says more."""

    schema: str
    name: str
    model: ModelPart
    sample_time: float
    identified_sample_time: float
    integrator: str
    hold: str
    delay: DelayPart
    frames: dict[str, str]
    sizes: dict[str, int]
    groups: list[str]
    functions: list[FunctionRow]
    values: dict[str, float]
    flight_spread: dict[str, list[float]]
    covariance: dict[str, Json]
    adapted: dict[str, Json]
    calibration: dict[str, Json]
    noise: dict[str, Json]
    domain: dict[str, Json]
    c: CPart | None
    abi: int | None
    return_codes: list[ReturnCode]
    thread_safety: str
    tolerance: float
    targets_written: dict[str, TargetPart]
    notes: list[str]
    data_hash: str
    versions: dict[str, str]
    reduction: NotRequired[Reduction | None]
    files: NotRequired[dict[str, str]]
    checksum: NotRequired[str]


@dataclass(frozen=True, kw_only=True)
class Written:
    """What else was written: the C source and its work space by function, what each target says of
    itself, the number of the C interface."""

    c: tuple[CSource, Mapping[str, int]] | None
    targets: Mapping[str, TargetPart]
    abi: int | None


def manifest_of(
    functions: ModelFunctions,
    golden: Sequence[Golden],
    written: Written,
    *,
    name: str,
    real: str,
    groups: Sequence[str],
) -> Manifest:
    """Plain values of the manifest, without file checksums."""
    f, model = functions, functions.model
    frames = FRAMES if "attitude.w" in f.states else {k: FRAMES[k] for k in ("matrices",)}
    return {
        "schema": SCHEMA,
        "name": name,
        "model": _model(f),
        "sample_time": f.dt,
        "identified_sample_time": f.identified_dt,
        "integrator": _integrator(f),
        "hold": "zero-order: u is constant from sample to sample",
        "delay": _delay(f),
        "frames": dict(frames),
        "sizes": {**f.sizes, "own_states": f.own_states, "own_error_states": f.own_error_states},
        **_vectors(f),
        "groups": list(groups),
        "functions": [_function(fn, g) for fn, g in zip(f.functions.values(), golden, strict=True)],
        "values": {k: float(v) for k, v in sorted(f.sampled.values.items())},
        "flight_spread": {k: list(v) for k, v in model.flight_spread.items()}
        if isinstance(model, IdentifiedModel)
        else {},
        "covariance": {
            "names": list(f.covariance_names),
            "matrix": f.covariance.tolist(),
            "form_errors": dict(model.form_errors) if isinstance(model, IdentifiedModel) else {},
        },
        "adapted": _adapted(f),
        "calibration": _calibration(f),
        "noise": {
            "process": f.noise.process.tolist(),
            "gain": f.noise.gain.tolist(),
            "innovation": f.noise.innovation.tolist(),
            "predicted": f.noise.covariance.tolist(),
        },
        "domain": _domain(f),
        "c": None if written.c is None else _c(*written.c, real),
        "abi": written.abi,
        "return_codes": [
            {"code": i, "name": n, "meaning": why} for i, (n, why) in enumerate(CODES)
        ],
        "thread_safety": "functions have no state: call them from any number of threads, each with "
        "work space of its own",
        "tolerance": TOLERANCE[real],
        "targets_written": dict(written.targets),
        "notes": _notes(f),
        "data_hash": model.data_hash if isinstance(model, IdentifiedModel) else "",
        "versions": library_versions(),
    }


def _vectors(f: ModelFunctions) -> Vectors:
    return {
        "states": _signals(f.states, scale=f.scales[0], reference=f.reference[0]),
        "error_states": _signals(f.error_states),
        "inputs": _signals(
            f.inputs,
            scale=f.scales[1],
            reference=f.reference[1],
            lower=f.bounds[0],
            upper=f.bounds[1],
        ),
        "parameters": _signals(f.parameters, value=f.parameter_values),
        "outputs": _signals(f.outputs, scale=f.scales[2]),
        "innovations": _signals(f.innovations, sensor_noise=f.noise.sensor),
        "features": _signals(f.features),
        "learned": _signals(f.learned),
        "targets": _signals(f.targets),
    }


def _adapted(f: ModelFunctions) -> dict[str, Json]:
    """The parameters that the filter adapts in flight."""
    return {
        "names": list(f.adapted.names),
        "covariance": f.adapted.covariance.tolist(),
        "lower": f.adapted.lower.tolist(),
        "upper": f.adapted.upper.tolist(),
        "state_limits": dict(f.adapted.limits),
    }


def _calibration(f: ModelFunctions) -> dict[str, Json]:
    """How the stated errors ahead are calibrated in flight."""
    return {
        "names": list(f.calibration.horizons.names),
        "samples": list(f.calibration.samples),
        "seconds": [n * f.dt for n in f.calibration.samples],
        "every": f.calibration.every,
        "sigma": f.calibration.sigma.tolist(),
        "axes": [list(rows) for rows in f.calibration.axes],
        "level": LEVEL,
        "gain": GAIN,
    }


def _model(f: ModelFunctions) -> ModelPart:
    model = f.model
    if isinstance(model, LinearModel):
        return {"name": model.name, "kind": "linear", "effects": [], "trained_on": []}
    if isinstance(model, PredictorModel):
        return {
            "name": model.name,
            "kind": model.kind,
            "effects": [],
            "trained_on": list(model.trained_on),
        }
    kind = "physics" if f.posterior is None else "hybrid"
    return {
        "name": model.name,
        "kind": kind,
        "effects": list(model.effects),
        "trained_on": list(model.trained_on),
    }


def _integrator(f: ModelFunctions) -> str:
    if f.discrete:
        return "none: the model is a map from sample to sample"
    learned = (
        "; the learned push is evaluated at the sample and held over it"
        if f.posterior is not None
        else ""
    )
    return (
        "rotor lag exactly (exponential), rigid body by one classical Runge-Kutta 4 step per "
        f"sample, quaternion brought back to unit length{learned}"
    )


def _delay(f: ModelFunctions) -> DelayPart:
    """How a delay of d seconds is in f_d, and that f has none."""
    seconds = {k: v for k, v in f.sampled.values.items() if k.endswith("delay.d")}
    return {
        "history": {k: int(v) for k, v in f.delay.items()},
        "parameters": {k: float(v) for k, v in seconds.items()},
        "form": "d = (m + s) dt with whole m and 0 <= s < 1: over the first s dt of a step the "
        "rotors see the command of "
        "m + 1 samples ago, then that of m samples ago; exact for a held command",
        "f_excludes_delay": True,
    }


def _signals(layout: Layout, **columns: FloatArray) -> list[SignalRow]:
    """`columns` are some of `COLUMNS`, (n,) each."""
    out = []
    for i, s in enumerate(layout):
        row: SignalRow = {"index": i, "name": s.name, "unit": s.unit, "meaning": s.meaning}
        for key in COLUMNS:
            if key in columns:
                value = float(columns[key][i])
                row[key] = value if math.isfinite(value) else None
        out.append(row)
    return out


def _function(function: ca.Function, golden: Golden) -> FunctionRow:
    def ports(kind: Literal["in", "out"]) -> list[PortRow]:
        count = getattr(function, f"n_{kind}")()
        names = [getattr(function, f"name_{kind}")(i) for i in range(count)]
        shapes = [getattr(function, f"size_{kind}")(i) for i in range(count)]
        return [{"name": n, "rows": r, "columns": c} for n, (r, c) in zip(names, shapes)]

    results = ports("out")
    for port in results:
        port["scale"] = scale_of(golden.results[port["name"]])
    return {"name": function.name(), "arguments": ports("in"), "results": results}


def _domain(f: ModelFunctions) -> dict[str, Json]:
    channels = f.model.domain
    out: dict[str, Json] = {
        "channels": {k: [float(v[0]), float(v[1])] for k, v in channels.items()},
        "learned": None,
    }
    if f.posterior is not None:
        box = f.posterior.domain
        out["learned"] = {
            "inputs": list(f.posterior.inputs.names),
            "lower": box.lower.tolist(),
            "upper": box.upper.tolist(),
            "distance_quantiles": dict(zip(("50", "95", "99", "100"), box.distance)),
            "samples": box.samples,
            "points": f.posterior.points,
            "method": f.posterior.method,
            "noise": f.posterior.noise.tolist(),
            "variance_factor": list(f.posterior.variance_factor)
            if isinstance(f.posterior, GPPosterior)
            else [],
        }
    return out


def _c(source: CSource, work: Mapping[str, int], real: str) -> CPart:
    pointer, number, integer = (
        8,
        8 if real == "double" else 4,
        8 if source.integer.startswith("long") else 4,
    )
    return {
        "prefix": source.prefix,
        "real": real,
        "integer": source.integer,
        "source_bytes": source.source.stat().st_size,
        "kernels": list(source.kernels),
        "work": dict(work),
        "work_bytes": pointer * (work["sz_arg"] + work["sz_res"] + 2)
        + integer * (work["sz_iw"] + 1)
        + number * (work["sz_w"] + 1),
        "functions": sizes_of(source),
    }


def _doubts(model: Exportable) -> list[str]:
    """What the model is worth, where it is not usable as it is: a fit that did not converge, the
    line of a verdict."""
    if isinstance(model, PredictorModel):
        if not isinstance(model.form, BaseForm):
            return []
        return _doubts(model.form.base.model)
    if isinstance(model, LinearModel):
        return [model.unsettled] if model.unsettled else []
    verdict = model.verdict
    return [] if verdict is None or verdict.outcome is Outcome.USABLE else [verdict.line]


def _notes(f: ModelFunctions) -> list[str]:
    """What a user must not overlook."""
    out = _doubts(f.model)
    if f.discrete:
        out.append("the model is discrete: there is no f, only f_d")
    if isinstance(f.model, PredictorModel) and f.model.form.exogenous:
        out.append(
            f"{', '.join(f.model.form.exogenous)}: measured or known from elsewhere, in p; held "
            "over a prediction"
        )
    if f.delay:
        out.append("f has no delay; f_d has it, as input-history states")
    if any(k.startswith("sensor_delay.") and v != 0 for k, v in f.sampled.values.items()):
        out.append(
            "states are those of the instant that gyro and accelerometer show, sensor_delay.d "
            "before the pose's"
        )
    if not math.isclose(f.dt, f.identified_dt, rel_tol=1e-9):
        out.append(
            f"identified at {f.identified_dt:g} s and exported at {f.dt:g} s: white noise keeps "
            "its intensity, the sensor noise of one sample stays"
        )
    window = f.sampled.dynamics.window
    physics = physics_of(f.sampled.dynamics)
    if physics is None and np.isfinite(f.bounds).any():
        out.append(
            "bounds of the commands are the range seen in training: limits of the machine are not "
            "known"
        )
    if physics is not None and physics.input == "speed":
        out.append(
            "inputs are rotor speeds [rad/s]: no motor lag between a command and the thrust is in "
            "the model, and how late its logs had the speeds is left out"
        )
    elif window[1]:
        out.append(
            "identified with commands that run linearly between samples, exported with commands "
            "that are held"
        )
    if f.sampled.exogenous:
        out.append(
            f"{', '.join(f.sampled.exogenous)} is a run-time parameter: give its present value in p"
        )
    if f.sampled.runtime:
        out.append("Q, K and S are those of the identified values, whatever p says")
    if isinstance(f.model, IdentifiedModel) and f.model.flight_spread and not f.adapted.names:
        out.append(
            f"{', '.join(f.model.flight_spread)}: differs from flight to flight, the mean is taken "
            "as exact; the group adapt learns it in flight"
        )
    return out
