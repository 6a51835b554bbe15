"""What a search could have found at best: the structure that is told the hidden effects, on the
same flights.

A silent search is to blame only where the oracle is certified, a set only where its other members
are beaten by the oracle, and a gap that did not close only where the oracle closes it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from greybox.data import Dataset
from greybox.data.lead import without_lead_in
from greybox.discovery.cause import offer
from greybox.discovery.certificate import certificates, splits
from greybox.discovery.evidence import Fitted, Flights
from greybox.discovery.name import LOG10
from greybox.discovery.search import Rival
from greybox.estimation.fit import Fit
from greybox.estimation.record import sample_time
from greybox.model.vehicle import Vehicle
from greybox.validation.gap import NOTHING, HeldOutErrors, predict_ahead

AHEAD = 0.5
"""Horizon [s] at which gaps are compared."""


def oracle(
    vehicle: Vehicle,
    train: Dataset,
    test: Dataset,
    truth: Mapping[str, float],
    final: Fit,
    groups: Iterable[Sequence[str]] = (),
) -> dict[str, Any]:
    """Plain values. `truth`: full parameter name -> true value; `final`: what the search ended
    with; `groups`: the sets that it left, a or a+b each.

    log10_e   hidden effect -> log10 e of the oracle against the structure without it
    gain      log evidence of the oracle less that of the base; None where an effect cannot be judged
    rivals    rival -> log evidence with it in place of its set's effects, less the oracle's
    affected  the group whose error half a second ahead the oracle shrinks most, None: none
    closed    share of that shrinkage that the search achieved
    """
    causes = offer(
        vehicle, train.channels, sample_time=sample_time(train), noncausal=train.noncausal
    )
    names = tuple(dict.fromkeys(n.split(".")[0] for n in truth))
    if not set(names) <= set(causes.offered):
        return {"log10_e": {}, "gain": None, "rivals": {}, "affected": None, "closed": None}
    flights = Flights(causes=causes, data=without_lead_in(train))
    null = flights.fit(())
    told = flights.fit(names, [{**null.known, **{(n, None): v for n, v in truth.items()}}])
    without = {
        n: [Rival(instead=(), fitted=flights.fit(set(names) - {n}, [told.known]))] for n in names
    }
    certified = certificates(told, without, splits(flights, without_lead_in(test)), np.inf)
    others: dict[str, Fitted] = {}
    for group in groups:
        kept = [n for n in names if n not in {m for r in group for m in r.split("+")}]
        for rival in group:
            chosen = frozenset((*kept, *rival.split("+")))
            if chosen != set(names) and chosen <= set(causes.offered):
                others[rival] = flights.fit(chosen, [told.known, null.known])
    affected, closed = _closed(test, flights.settled(null), flights.settled(told), final)
    return {
        "log10_e": {n: c.log_e / LOG10 for n, c in certified.items()},
        "gain": told.log_evidence - null.log_evidence,
        "rivals": {r: f.log_evidence - told.log_evidence for r, f in others.items()},
        "affected": affected,
        "closed": closed,
    }


def ahead(seen: HeldOutErrors) -> dict[str, float]:
    """Group -> RMSE half a second ahead."""
    out = {}
    for (group, horizon), blocks in seen.own.items():
        if horizon == AHEAD and any(b.size for b in blocks):
            out[group] = float(np.sqrt(np.concatenate(blocks).mean()))
    return out


def _closed(test: Dataset, null: Fit, told: Fit, final: Fit) -> tuple[str | None, float | None]:
    before, best, own = (ahead(predict_ahead(f.model, test)) for f in (null, told, final))
    shared = [g for g in before if best.get(g) and g in own]
    group = max(shared, key=lambda g: before[g] / best[g], default=None)
    if group is None or before[group] ** 2 < NOTHING * best[group] ** 2:
        return None, None
    gained = before[group] ** 2 - own[group] ** 2
    return group, gained / (before[group] ** 2 - best[group] ** 2)
