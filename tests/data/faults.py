"""Faults put into real logs: each function takes a raw log and gives a broken copy."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np

from greybox.data import RawLog, read_table
from greybox.examples import flight_path, vehicle_path
from greybox.model.vehicle import Vehicle, read_vehicle


@functools.cache
def vehicle(set_name: str) -> Vehicle:
    return read_vehicle(vehicle_path(set_name))


@functools.cache
def real(set_name: str, flight: str) -> RawLog:
    return read_table(flight_path(set_name, flight), vehicle(set_name))


def with_channels(raw: RawLog, **channels: np.ndarray) -> RawLog:
    return replace(raw, channels={**raw.channels, **channels})


def scaled(raw: RawLog, names: str, factor: float) -> RawLog:
    return with_channels(raw, **{n: raw.channels[n] * factor for n in names.split()})


def exchanged(raw: RawLog, a: str, b: str) -> RawLog:
    return with_channels(raw, **{a: raw.channels[b], b: raw.channels[a]})


def conjugated(raw: RawLog) -> RawLog:
    return scaled(raw, "qx qy qz", -1.0)


def scalar_last(raw: RawLog) -> RawLog:
    c = raw.channels
    return with_channels(raw, qw=c["qx"], qx=c["qy"], qy=c["qz"], qz=c["qw"])


def late(raw: RawLog, rows: int, names: str) -> RawLog:
    return with_channels(raw, **{n: np.roll(raw.channels[n], rows) for n in names.split()})


def with_time(raw: RawLog, t: np.ndarray) -> RawLog:
    return replace(raw, t=t)


def without_rows(raw: RawLog, start: int, stop: int) -> RawLog:
    keep = np.ones(raw.n, dtype=bool)
    keep[start:stop] = False
    return replace(
        raw,
        t=raw.t[keep],
        rows=raw.rows[keep],
        channels={k: v[keep] for k, v in raw.channels.items()},
        extra={k: v[keep] for k, v in raw.extra.items()},
    )


def frozen(raw: RawLog, names: str, start: int, stop: int) -> RawLog:
    out = {}
    for n in names.split():
        out[n] = raw.channels[n].copy()
        out[n][start:stop] = out[n][start]
    return with_channels(raw, **out)
