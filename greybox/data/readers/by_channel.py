"""The form of `[columns]` before 0.1.0, one entry per channel (`p = { name = "gyro_x", scale =
0.0174 }`), in the dialect of `mapping`. Vehicle files that speak it are read until 0.2.0 and say
so; what a model file holds is read for good.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeGuard

from greybox.data.channel import (
    GROUPS,
    TIME,
    canonical_names,
    group_names,
    is_canonical,
    rotor_index,
)
from greybox.errors import DataError, UnknownNameError

_KEYS: Mapping[str, object] = {"name": "", "scale": 1.0, "offset": 0.0, "causal": True}


def is_by_channel(content: Mapping[str, object]) -> bool:
    """Whether a table `[columns]` names channels (`p`) and not groups (`rate`)."""
    return any(key == TIME or is_canonical(key) for key in content)


def by_group(content: Mapping[str, object], rotors: int, *, where: str) -> dict[str, object]:
    """The same in the dialect of `mapping`. A channel without an entry keeps its own name; of a
    group one of whose channels was smoothed none starts a prediction.

    Raises `DataError` and `UnknownNameError`, which name the file and the key.
    """
    known = (TIME, *canonical_names(rotors))
    entries: dict[str, dict[str, object]] = {}
    for key, value in content.items():
        if key not in known:
            if is_canonical(key) and rotor_index(key) is not None:
                raise DataError(
                    f"the vehicle has {rotors} rotors",
                    where=f"{where}.{key}",
                    fix="add the [[rotor]] or drop the column",
                )
            raise UnknownNameError("channel", key, known, where=where)
        entry = {"name": value} if isinstance(value, str) else value
        if not isinstance(entry, Mapping):
            raise DataError(
                "a name or a table is needed here", where=f"{where}.{key}", got=repr(value)[:60]
            )
        for name in entry:
            if name not in _KEYS:
                raise UnknownNameError("key", name, _KEYS, where=f"{where}.{key}")
        entries[key] = {**_KEYS, "name": key, **entry}
        if not isinstance(entries[key]["name"], str):
            raise DataError(
                "'name' is not a text", where=f"{where}.{key}", got=repr(entries[key]["name"])[:60]
            )
    taken = [e["name"] for e in entries.values()]
    out: dict[str, object] = {}
    if TIME in entries:
        out["time"] = _time(entries[TIME])
    for group in GROUPS:
        names = group_names(group, rotors)
        if any(n in entries for n in names):
            own = [entries.get(n, {**_KEYS, "name": "" if n in taken else n}) for n in names]
            out[group] = _table(own)
    return out


def _time(entry: Mapping[str, object]) -> dict[str, object]:
    scale = entry["scale"]
    unit = {1e-3: "ms", 1e-6: "us", 1e-9: "ns"}.get(scale) if _number(scale) else None
    said: dict[str, object] = {"field": entry["name"], "unit": unit or "s"}
    return said | {
        k: entry[k]
        for k in ("scale", "offset")
        if entry[k] != _KEYS[k] and not (k == "scale" and unit)
    }


def _table(entries: list[dict[str, object]]) -> dict[str, object]:
    """The table of one group; scales that differ in sign only become a minus sign of the field."""
    scales = [e["scale"] for e in entries]
    names = [e["name"] for e in entries]
    numbers = [s for s in scales if _number(s)]
    alike = len(numbers) == len(scales) and len({abs(s) for s in numbers}) == 1
    if alike and min(numbers) < 0:
        names = [f"-{n}" if s < 0 else n for n, s in zip(names, numbers, strict=True)]
        scales = [abs(s) for s in numbers]
    out: dict[str, object] = {"fields": names}
    for key, values in (("scale", scales), ("offset", [e["offset"] for e in entries])):
        if any(v != _KEYS[key] for v in values):
            out[key] = values[0] if all(v == values[0] for v in values) else values
    if any(e["causal"] is not True for e in entries):
        out["causal"] = next(
            (e["causal"] for e in entries if not isinstance(e["causal"], bool)), False
        )
    return out


def _number(value: object) -> TypeGuard[int | float]:
    return isinstance(value, int | float) and not isinstance(value, bool)
