"""Regimes: in which range of speed, rate, height, throttle, voltage or time the discrepancy lives.

Every signal's values along the flights are cut into quarters of equal count; the RMS of the smoothed discrepancy of each
axis in a quarter, against its RMS over all flights, is one cell of the map (1 = as everywhere).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from greybox.discovery.terms import rotors
from greybox.residual.discrepancy import Discrepancy
from greybox.symbolic import FloatArray

QUARTERS = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class Regime:
    """`edges` (5,) [unit] of the quarters of `signal`; `ratio` (axes, 4): RMS in the quarter over RMS everywhere."""

    signal: str
    unit: str
    edges: FloatArray
    ratio: FloatArray

    def to_dict(self) -> dict[str, Any]:
        """As in discovery.json."""
        return {"signal": self.signal, "unit": self.unit, "edges": self.edges.tolist(), "ratio": self.ratio.tolist()}


def regimes(seen: Discrepancy, names: Sequence[str]) -> tuple[Regime, ...]:
    """The map of a smoothed discrepancy over what its features `names` tell; signals that do not vary are left out."""
    at = {n: seen.z[:, i] for i, n in enumerate(names)}
    signals: list[tuple[str, str, FloatArray]] = []
    for label, unit, parts in (
        ("speed", "m/s", [f"body_velocity.{a}" for a in "xyz"]),
        ("rate", "rad/s", list("pqr")),
    ):
        if all(p in at for p in parts):
            signals.append((label, unit, np.sqrt(sum(at[p] ** 2 for p in parts))))
    if "position.z" in at:
        signals.append(("height", "m", at["position.z"]))
    nu = rotors(names, seen.z)
    if nu.shape[1]:
        signals.append(("throttle", "-", nu.mean(axis=1)))
    if "vbat" in at:
        signals.append(("voltage", "V", at["vbat"]))
    signals.append(("time", "share of the flight", _time(seen.flights)))
    y = seen.y - seen.y.mean(axis=0)
    rms = np.sqrt((y**2).mean(axis=0))
    out = []
    for label, unit, values in signals:
        edges = np.quantile(values, np.linspace(0, 1, QUARTERS + 1))
        if not (np.diff(edges) > 0).all() or not (rms > 0).all():
            continue
        quarter = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, QUARTERS - 1)
        if np.unique(quarter).size < QUARTERS:  # so few values that an edge between two of them leaves a quarter empty
            continue
        cells = [np.sqrt((y[quarter == k] ** 2).mean(axis=0)) / rms for k in range(QUARTERS)]
        out.append(Regime(signal=label, unit=unit, edges=edges, ratio=np.stack(cells, axis=1)))
    return tuple(out)


def _time(flights: Sequence[str]) -> FloatArray:
    """Place of every row within its flight, 0 .. 1."""
    names = np.asarray(flights)
    out = np.zeros(len(names))
    for n in dict.fromkeys(flights):
        rows = np.flatnonzero(names == n)
        out[rows] = np.arange(rows.size) / max(rows.size - 1, 1)
    return out
