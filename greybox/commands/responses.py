"""How outputs follow commands, for the page of a fit: the flights' own responses, the model's over
them, its steps."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from greybox.data import Dataset
from greybox.errors import GreyboxError
from greybox.linear.frf import frf
from greybox.linear.frf_channels import channels, mixed, mixers, vehicle_of, weights_of
from greybox.model.frequency_response import step_response
from greybox.report.response_section import Responses, Step

if TYPE_CHECKING:
    from greybox.model.identified import IdentifiedModel

OWN = {"roll": "p", "pitch": "q", "yaw": "r", "thrust": "az"}
"""What a command of a vehicle is for."""
MOST = 6
"""Pairs that are drawn of a model that is no vehicle."""
SECONDS, SAMPLES = 0.5, 50
"""A step response lasts as long as the open loop of a page, or so many samples where these last
longer."""


def responses(model: IdentifiedModel, *datasets: Dataset) -> Responses | None:
    """Of all flights together; None for a model without inputs."""
    pairs = _pairs(model)
    if not pairs:
        return None
    inputs, outputs = (tuple(dict.fromkeys(names)) for names in zip(*pairs, strict=True))
    vehicle = vehicle_of(model)
    data = Dataset(flights=tuple(f for d in datasets for f in d))
    specs = channels(inputs, vehicle, "inputs", model.dynamics.inputs.names)
    steps = max(round(SECONDS / model.sample_time), SAMPLES)
    seen = weights_of(
        channels(outputs, vehicle, "outputs"),
        model.dynamics.innovations.names,
        model.name,
        "output",
    )
    driven = np.linalg.pinv(weights_of(specs, model.dynamics.inputs.names, model.name, "input"))
    answer = seen @ step_response(model, steps) @ driven
    moved = np.concatenate([mixed(s, specs) for f in data for s in f.segments])
    size = np.nanstd(moved, axis=0)
    units = {s.name: s.unit for s in model.dynamics.innovations}
    drawn = [
        Step(
            input=i,
            output=o,
            size=float(size[inputs.index(i)]),
            t=model.sample_time * np.arange(steps, dtype=np.float64),
            values=size[inputs.index(i)] * answer[:, outputs.index(o), inputs.index(i)],
            unit=units[o],
        )
        for i, o in pairs
        if size[inputs.index(i)] > 0
    ]
    try:
        found = frf(data, inputs, outputs, vehicle=vehicle, model=model).to_dict()
    except GreyboxError as error:
        return Responses(steps=drawn, why=str(error).rstrip("."))
    wanted = [p for p in found["pairs"] if (p["input"], p["output"]) in pairs]
    return Responses(steps=drawn, measured={**found, "pairs": wanted})


def _pairs(model: IdentifiedModel) -> list[tuple[str, str]]:
    """(input, output): what each command of a vehicle is for; of another model the first of all
    pairs."""
    vehicle, seen = vehicle_of(model), model.dynamics.innovations.names
    if vehicle is None:
        return list(product(model.dynamics.inputs.names, seen))[:MOST]
    return [(i, o) for i in mixers(vehicle) if (o := OWN[i]) in seen]
