"""All kinds of noise part, and a part from its record in a file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields

import numpy as np

from greybox.errors import UnknownNameError
from greybox.model.noise.coloured import Coloured
from greybox.model.noise.delay import Delay
from greybox.model.noise.disturbance import Disturbance
from greybox.model.noise.drift import Drift
from greybox.model.noise.gust import Gust
from greybox.model.noise.line import Line
from greybox.model.noise.low_pass import LowPass
from greybox.model.noise.part import NoisePart, SensorPart

KINDS: tuple[type[NoisePart], ...] = (Disturbance, Gust, Coloured, Drift, Line, LowPass, Delay)
"""All kinds of noise part."""
UNMOVED = tuple(k.kind for k in KINDS if not (issubclass(k, SensorPart) and k.filters))
"""Kinds whose states no motion of the model reaches: all but filters of a reading."""
_PLACE = {k.kind: next(f.name for f in fields(k) if f.default is MISSING) for k in KINDS}  # type: ignore[arg-type]
_START = {
    k.kind: {f.name: f.default for f in fields(k) if f.default is not MISSING}  # type: ignore[arg-type]
    for k in KINDS
}


def part_named(name: str) -> NoisePart:
    """The part kind.place ("low_pass.gyro", "disturbance.force") with the start values of its kind.

    Raises `UnknownNameError` for a kind that there is not; a place is looked up by the model.
    """
    kinds = {k.kind: k for k in KINDS}
    kind, _, place = name.partition(".")
    if kind not in kinds or not place:
        raise UnknownNameError("noise part", name, [f"{k}.<sensor or group>" for k in kinds])
    return noise_part({**_START[kind], "kind": kind, _PLACE[kind]: place})


def noise_part(record: Mapping[str, object]) -> NoisePart:
    """The part that `NoisePart.to_dict` wrote as `record`.

    Raises `UnknownNameError` for a kind that there is not, `ValueError` for fields that are not
    those of its kind, or are no names and finite numbers.
    """
    kinds = {k.kind: k for k in KINDS}
    kind = record.get("kind")
    if not isinstance(kind, str) or kind not in kinds:
        raise UnknownNameError("kind of noise", str(kind), kinds)
    wanted = {f.name: f.type for f in fields(kinds[kind])}  # type: ignore[arg-type]
    own = {name: value for name, value in record.items() if name != "kind"}
    if own.keys() != wanted.keys():
        raise ValueError(
            f"{kind} noise with {', '.join(own) or 'nothing'}, expected {', '.join(wanted)}"
        )
    for name, value in own.items():
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if wanted[name] == "float" and not (number and np.isfinite(float(value))):  # type: ignore[arg-type]
            raise ValueError(f"{name} of {kind} noise is {value!r}")
        if wanted[name] == "str" and not isinstance(value, str):
            raise ValueError(f"{name} of {kind} noise is {value!r}")
    return kinds[kind](**own)
