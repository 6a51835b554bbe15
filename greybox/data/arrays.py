"""Flights from memory: arrays and data frames, on whatever clock they were sampled by."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from greybox.data.airframe import Airframe
from greybox.data.channel import TIME, is_canonical
from greybox.data.conditioning import condition
from greybox.data.dataset import Dataset, Flight
from greybox.data.fingerprint import fingerprint
from greybox.data.impossible import without_impossible
from greybox.data.raw import FloatArray, RawLog
from greybox.data.repeats import without_repeats
from greybox.data.segment import CLOCK_TOLERANCE, Segment, floats, steps_of
from greybox.errors import DataError
from greybox.takes import CHANNELS, TEXT, VEHICLE, takes


@takes(channels=CHANNELS, name=TEXT, vehicle=VEHICLE)
def dataset_from_arrays(
    t: npt.ArrayLike,
    channels: Mapping[str, npt.ArrayLike],
    *,
    name: str = "flight",
    notes: Sequence[str] = (),
    vehicle: Airframe | None = None,
    rate: float | None = None,
) -> Dataset:
    """A data set of one flight from arrays: `t` (N,) [s], `channels` name -> (N,), NaN = missing;
    or a data frame, whose column `t` is no channel.

    On a uniform clock samples stay as they are. Where stamps jitter or leave gaps, or a `vehicle`
    or a `rate` [Hz] is given, they are treated as those of a file: `greybox.data.read_log` says
    how, the flight's `notes` what was done. Take-off and landing stay. Raises `DataError`, also
    where time goes back or stands still.

    >>> dataset_from_arrays([0.0, 0.01, 0.02], {"p": [0.1, float("nan"), 0.3]}, name="bench")
    Dataset: 1 flight, 3 samples
      bench: 0.03 s at 100 Hz, p
    """
    given = {k: v for k, v in channels.items() if k != TIME}
    times = floats(t, int(np.size(t)), "t", name)
    if vehicle is None and rate is None and _as_it_is(times):
        segment = Segment(t=times, channels=given, flight=name)  # type: ignore[arg-type]
        return Dataset(flights=(Flight(name=name, segments=(segment,), notes=tuple(notes)),))
    columns = {k: floats(v, times.size, f"channel {k}", name) for k, v in given.items()}
    raw = without_repeats(_raw_log(times, columns, name, notes))
    raw = raw if vehicle is None else without_impossible(raw, vehicle)
    return Dataset(
        flights=(condition(raw, vehicle, rate=rate, trim=False, where=f"flight {name}"),)
    )


def _as_it_is(t: FloatArray) -> bool:
    """Whether a segment takes these stamps, or says what is wrong with them."""
    if t.size < 2 or not np.isfinite(t).all():
        return True
    dt, shift = steps_of(t)
    return shift <= CLOCK_TOLERANCE * dt


def _raw_log(
    t: FloatArray, columns: Mapping[str, FloatArray], name: str, notes: Sequence[str]
) -> RawLog:
    """The arrays as a log. Raises `DataError` for values that are infinite, and where no column is
    a channel: of another column nobody knows whether it is held between samples."""
    where = f"flight {name}"
    own = {k: v for k, v in columns.items() if not is_canonical(k)}
    if len(own) == len(columns):
        raise DataError(
            f"another clock is needed (t is not uniform, or a rate or a vehicle is given), and none "
            f"of {', '.join(own)} is a channel of a vehicle",
            where=where,
            fix="put them on a uniform clock: only you know which of them hold between samples",
        )
    for k, v in columns.items():
        if np.isinf(v).any():
            raise DataError(f"channel {k} has an infinite value", where=where)
    said = (f"columns kept but not used: {', '.join(own)}",) if own else ()
    channels = {k: v for k, v in columns.items() if k not in own}
    return RawLog(
        t=t,
        channels=channels,
        extra=own,
        rows=np.arange(t.size, dtype=np.int64),
        flight=name,
        source="",
        sha256="",
        notes=(*notes, *said),
        fingerprint=fingerprint(channels),
    )
