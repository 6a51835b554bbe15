"""How a channel is made of what a log holds, in one line of arithmetic: whoever runs a model on a
machine must make its signals alike."""

from __future__ import annotations

import numpy as np

from greybox.data.channel import group_names
from greybox.data.readers.mapping import TABLE
from greybox.data.readers.recording import UNITS, Source


def recipes(source: Source) -> dict[str, str]:
    """Channel -> text, as "(pwm1 - 1000) / 1000". A channel that is a column of its own name as it
    stands has none. Where a channel is of no one column (Euler angles, other axes) its group's
    columns, unit and frame are said."""
    names = group_names(source.group, len(source.fields))
    stream = "" if source.stream == TABLE else f"{source.stream}."
    fields = [f"{'-' * f.startswith('-')}{stream}{f.lstrip('-')}" for f in source.fields]
    early = f", {1e3 * source.delay:.3g} ms before its stamp" if source.delay else ""
    if source.convert is not None or source.frame or len(names) != len(fields):
        unit = f" [{source.unit}]" if source.unit not in ("", "1") else ""
        frame = f", {source.frame}" if source.frame else ""
        note = f", {source.note}" if source.note else ""
        said = f"from {', '.join(f for f in fields if f)}{unit}{frame}{note}{early}"
        return dict.fromkeys(names, said)
    factor = UNITS.get(source.group, {}).get(source.unit, 1.0)
    scales = np.broadcast_to(factor * np.asarray(source.scale, dtype=float), (len(fields),))
    offsets = np.broadcast_to(np.asarray(source.offset, dtype=float), (len(fields),))
    made = {
        name: _affine(field, float(scale), float(offset), source.limits) + early
        for name, field, scale, offset in zip(names, fields, scales, offsets, strict=True)
        if field
    }
    return {name: text for name, text in made.items() if text != name}


def _affine(field: str, scale: float, offset: float, limits: tuple[float, float] | None) -> str:
    text = field if scale == 1.0 else f"{scale:.6g} {field}"
    low, high = (0.0, 1.0) if limits is None else limits
    offset -= low
    if offset:
        text = f"{text} {'-' if offset < 0 else '+'} {abs(offset):.6g}"
    if high - low == 1.0:
        return text
    return f"({text}) / {high - low:.6g}" if offset else f"{text} / {high - low:.6g}"
