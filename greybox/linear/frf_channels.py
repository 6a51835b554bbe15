"""What a frequency response is taken of: columns, sums of columns, and the commands as a pilot
knows them.

roll, pitch, yaw and thrust are what a mixer u_i = thrust + roll y_i - pitch x_i - yaw spin_i would
have been given (least squares), with hub positions x (forward) and y (left) over the largest one: a
unit of roll moves the outermost rotors by a unit, left ones up.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from greybox.data import Segment
from greybox.data.airframe import Airframe
from greybox.data.channel import group_names
from greybox.data.drive import drive_names
from greybox.errors import DataError, UnknownNameError
from greybox.linear.logs import ChannelSpec
from greybox.model.identified import IdentifiedModel
from greybox.model.linear import LinearModel
from greybox.symbolic import FloatArray

MIXERS = ("roll", "pitch", "yaw", "thrust")


def mixers(vehicle: Airframe, columns: Collection[str] = ()) -> dict[str, ChannelSpec]:
    """The mixed commands that the rotors of a vehicle have, by name (positive: x to the left wing
    up is roll, nose down pitch, to the left yaw, up thrust; body axes FLU). Where `columns` hold no
    commands but rotor speeds, these are mixed."""
    drive = drive_names(columns, len(vehicle.rotors)) or group_names("command", len(vehicle.rotors))
    hubs = np.array([r.position for r in vehicle.rotors], dtype=np.float64)
    hubs = hubs - hubs.mean(axis=0)
    spins = np.array([r.spin for r in vehicle.rotors], dtype=np.float64)
    columns = np.column_stack([hubs[:, 1], -hubs[:, 0], -spins, np.ones(len(hubs))])
    largest = np.abs(columns).max(axis=0)
    there = largest > 1e-6
    weights = np.linalg.pinv(columns[:, there] / largest[there], rcond=1e-6)
    names = [n for n, yes in zip(MIXERS, there, strict=True) if yes]
    return {
        name: ChannelSpec(
            name=name,
            terms=tuple((float(w), n) for w, n in zip(row, drive, strict=True) if abs(w) > 1e-9),
        )
        for name, row in zip(names, weights, strict=True)
    }


def vehicle_of(model: IdentifiedModel | LinearModel | None) -> Airframe | None:
    """The vehicle that a model was built of; None where it has none."""
    if isinstance(model, IdentifiedModel) and model.sensors:
        return model.physics.vehicle
    return None


def channels(
    texts: Sequence[str], vehicle: Airframe | None, what: str, columns: Collection[str] = ()
) -> tuple[ChannelSpec, ...]:
    """`p`, `name=a+2*b-c` or, with a vehicle, a mixed command of what is among `columns`. Raises
    `DataError`."""
    mixed = {} if vehicle is None else mixers(vehicle, columns)
    found = tuple(mixed.get(t) or ChannelSpec.parse(t) for t in texts)
    names = [s.name for s in found]
    if not found:
        raise DataError(f"no {what} named", fix=f"--{what} {'roll' if what == 'inputs' else 'p'}")
    if twice := sorted({n for n in names if names.count(n) > 1}):
        raise DataError(f"{what} given twice: {', '.join(twice)}", fix="name every channel once")
    for s in found:
        if s.name in MIXERS and s.name not in mixed and s.terms == ((1.0, s.name),):
            raise DataError(
                f"{s.name} is a mixed command",
                fix="--vehicle V.toml, which says where the rotors are"
                if vehicle is None
                else "name another input: these rotors make none",
            )
    return found


def mixed(segment: Segment, specs: Sequence[ChannelSpec]) -> FloatArray:
    """The channels as columns (N, len(specs)). Raises `UnknownNameError` for a column that is not
    there."""
    out = [np.sum([w * segment.column(c) for w, c in s.terms], axis=0) for s in specs]
    return np.column_stack(out) if out else np.zeros((segment.n, 0))


def weights_of(
    specs: Sequence[ChannelSpec], names: Sequence[str], model: str, what: str
) -> FloatArray:
    """Weights (len(specs), len(names)) of a model's own signals in channels; a signal that has a
    channel's name is it. Raises `UnknownNameError` for what the model does not have."""
    out = np.zeros((len(specs), len(names)))
    place: Mapping[str, int] = {n: i for i, n in enumerate(names)}
    for i, s in enumerate(specs):
        terms = ((1.0, s.name),) if s.name in place else s.terms
        for weight, name in terms:
            if name not in place:
                raise UnknownNameError(f"{what} of {model}", name, names)
            out[i, place[name]] += weight
    return out
