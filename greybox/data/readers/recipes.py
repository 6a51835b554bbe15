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
    columns, unit and frame are said, the arithmetic of each column first."""
    names = group_names(source.group, len(source.fields))
    stream = "" if source.stream == TABLE else f"{source.stream}."
    fields = [f"{'-' * f.startswith('-')}{stream}{f.lstrip('-')}" for f in source.fields]
    early = f", {1e3 * source.delay:.3g} ms before its stamp" if source.delay else ""
    factor = UNITS.get(source.group, {}).get(source.unit, 1.0)
    scales = np.broadcast_to(np.asarray(source.scale, dtype=float), (len(fields),))
    offsets = np.broadcast_to(np.asarray(source.offset, dtype=float), (len(fields),))
    bare = (scales == 1.0).all() and not offsets.any() and source.limits is None
    joint = (
        source.convert is not None
        or source.frame
        or not source.gravity
        or len(names) != len(fields)
    )
    if joint and bare:  # the unit stands for its factor
        texts = fields
    else:
        texts = [
            field
            and _affine(
                field if source.convert is None else f"converted {field}",
                factor * float(scale),
                float(offset),
                source.limits,
            )
            for field, scale, offset in zip(fields, scales, offsets, strict=True)
        ]
    if joint:
        unit = f" [{source.unit}]" if bare and source.unit not in ("", "1") else ""
        frame = f", {source.frame}" if source.frame else ""
        note = "" if source.gravity else ", gravity put back"
        note += f", {source.note}" if source.note else ""
        said = f"from {', '.join(t for t in texts if t)}{unit}{frame}{note}{early}"
        return dict.fromkeys(names, said)
    made = {name: text + early for name, text in zip(names, texts, strict=True) if text}
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
