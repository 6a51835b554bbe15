"""Stability: does every training flight give the effects that were named the same numbers?

One fit gives the parameters of all named effects a value per flight. Cochran's Q (Biometrics 10(1), 1954) then tests for
every parameter whether the flights agree within their standard errors. A name that holds is a property of the vehicle: the
same in every flight. One that changes may be another effect that differs between the flights, or a vehicle that did.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.stats

from greybox.discovery.name import Addition
from greybox.discovery.nested import Nest, NestedFit

DIFFERENT = 1e-3
"""Probability under equal values, over all parameters asked, below which flights are said to differ."""


@dataclass(frozen=True, kw_only=True)
class Stability:
    """`name` ("motor_lag.tau") and what each flight says: flight -> (value, standard error), in `unit`; `p_value` of
    Cochran's Q over the `asked` parameters (Bonferroni); `spread`: standard deviation of the flights' values beyond what
    their errors explain (DerSimonian and Laird, Controlled Clinical Trials 7(3), 1986)."""

    name: str
    unit: str
    flights: dict[str, tuple[float, float]]
    p_value: float
    spread: float

    @property
    def differs(self) -> bool:
        """Whether the flights clearly disagree."""
        return self.p_value < DIFFERENT

    def to_dict(self) -> dict[str, Any]:
        """As in discovery.json."""
        return {
            "parameter": self.name, "unit": self.unit, "p_value": self.p_value, "spread": self.spread,
            "differs": self.differs,
            "flights": {f: {"value": v, "std": s} for f, (v, s) in self.flights.items()},
        }  # fmt: skip


def stability(nest: Nest, at: NestedFit, additions: Sequence[Addition]) -> list[Stability]:
    """One entry per parameter of a named effect that has one value for all flights; none where there is one flight, or
    where the fit with a value per flight does not converge."""
    own = set(at.fit.settings["per_flight"])
    names = [
        p for a in additions if not a.rivals for e in a.effects for p in nest.candidates.parameters[e]
        if p in at.fit.parameters and p not in own and not at.fit.parameters[p].at_bound
    ]  # fmt: skip
    if not names or len(nest.data.flights) < 2:
        return []
    options = nest.options.but(per_flight=(*nest.options.per_flight, *names))
    each = replace(nest, options=options, recent=[]).refit(at.effects, start=at)
    if not each.fit.converged:
        return []
    out = []
    for name in names:
        values = {f: (v, s) for f, (v, s) in each.fit.parameters[name].per_flight.items() if np.isfinite(s)}
        if len(values) > 1:
            p, spread = cochran([v for v, _ in values.values()], [s for _, s in values.values()])
            unit = at.fit.parameters[name].unit
            p = min(1.0, p * len(names))
            out.append(Stability(name=name, unit=unit, flights=values, p_value=p, spread=spread))
    return out


def cochran(values: Sequence[float], errors: Sequence[float]) -> tuple[float, float]:
    """(p-value of Q, standard deviation between the groups) of estimates with known standard errors."""
    v, w = np.asarray(values), 1 / np.asarray(errors) ** 2
    q = float((w * (v - (w * v).sum() / w.sum()) ** 2).sum())
    free = len(v) - 1
    scale = float(w.sum() - (w**2).sum() / w.sum())
    return float(scipy.stats.chi2.sf(q, free)), float(np.sqrt(max(0.0, (q - free) / scale)))
