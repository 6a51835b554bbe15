"""Model files of every kind: `load_model` reads what `greybox fit` and `greybox learn` wrote,
`save_model` writes it.

A hybrid is one JSON file (schema "greybox.model/1", kind "hybrid"): the physics model's own file
inside, the Gaussian process with all its arrays, and a checksum. One file, so that a write is all
or nothing. Numbers only: nothing is executed.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

from greybox.errors import FileFormatError
from greybox.files import Json, Parsed, checksum, read_json, well_formed
from greybox.model.effect import Effect
from greybox.model.identified import SCHEMA, IdentifiedModel
from greybox.model.sensor import Sensor
from greybox.residual.hybrid import HybridModel
from greybox.residual.weight_space import read_part


def save_model(model: IdentifiedModel, path: str | os.PathLike[str]) -> Path:
    """`model.save(path)`: write a model file atomically. Returns the path. Raises `ModelError` for
    a model not made of catalogue parts."""
    return model.save(path)


def load_model(
    path: str | os.PathLike[str], *, effects: Iterable[Effect] = (), sensors: Iterable[Sensor] = ()
) -> IdentifiedModel:
    """Read a model file, physics or hybrid; `effects` and `sensors` are those of the user's own
    (`load_effects`).

    Raises `FileFormatError` (schema, checksum, sizes), `VehicleError`, `UnknownNameError`,
    `ModelError`.
    """
    where = str(path)
    data: Parsed = read_json(path, schema=SCHEMA)
    if data.get("kind") == "output-hybrid":
        raise FileFormatError(
            "a predictor of outputs, not a model of motion",
            where=where,
            fix="learn.json beside it says what it is worth; greybox.load and greybox export take it",
        )
    if data.get("kind") != "hybrid":
        return IdentifiedModel.from_dict(data, where=where, effects=effects, sensors=sensors)
    if _checksum(data) != data.get("checksum"):
        raise FileFormatError(
            "the checksum does not fit",
            where=where,
            fix="the file was edited or cut off; write it again",
        )
    with well_formed(where):
        base = IdentifiedModel.from_dict(
            data["base"], where=where, effects=effects, sensors=sensors
        )
        return replace(base, dynamics=HybridModel(inner=base.dynamics, posterior=read_part(data)))


def _checksum(body: Mapping[str, Json]) -> str:
    return checksum({k: v for k, v in body.items() if k not in ("checksum", "versions")})
