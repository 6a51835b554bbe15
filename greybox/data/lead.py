"""Lead: the start of a flight tells only which commands are still on their way."""

from __future__ import annotations

from dataclasses import replace

from greybox.data import Dataset
from greybox.data.segment import START_SECONDS

LEADS = 4
"""The start of a segment only tells its commands where the segment is more than so many times as
long."""


def without_lead_in(data: Dataset) -> Dataset:
    """The data without the first `START_SECONDS` seconds of every segment, whose commands are
    remembered.

    Commands before the first row are unknown: a model with a delay predicts the samples after it
    wrongly, one with rotor states does not, and would be preferred for that alone. `data_hash` of
    the result is that of the samples that are left.
    """
    flights = []
    for f in data:
        lead = round(START_SECONDS / f.dt)
        kept = [s.rows(lead, s.n) if s.n > LEADS * lead else s for s in f.segments]
        flights.append(replace(f, segments=tuple(kept)))
    return Dataset(flights=tuple(flights))
