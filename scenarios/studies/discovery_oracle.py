"""What a search could have found at best: the model that is told the hidden effects, on the same flights.

A silent search is to blame only where the oracle's BIC is better than that of the model without the effects, a group only
where its other members are far behind the oracle, and a gap that did not close only where the oracle closes it. BIC is
that of Schwarz 1978, as everywhere in greybox.discovery.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from greybox.data import Dataset
from greybox.discovery.candidates import candidates
from greybox.discovery.carried import with_states
from greybox.discovery.gap import NOTHING
from greybox.discovery.lead import led
from greybox.discovery.nested import Nest, NestedFit
from greybox.discovery.veto import HeldOut
from greybox.estimation.record import sample_time
from greybox.model.vehicle import Vehicle

AHEAD = 0.5
"""Horizon [s] at which gaps are compared."""


def oracle(
    vehicle: Vehicle, train: Dataset, test: Dataset, truth: Mapping[str, float], final: NestedFit,
    groups: Iterable[Sequence[str]] = (), lasting: Sequence[str] = (),
) -> dict[str, Any]:  # fmt: skip
    """Plain values. `truth`: full parameter name -> true value; `final`: what the search ended with; `groups`: the rivals of
    every group that it left, a or a+b each; `lasting`: "force", "torque" where the plant's gusts are, which the oracle
    knows.

    gain      BIC without any addition less that of the oracle; None where an effect cannot be judged with these columns
    rivals    rival -> BIC with it in place of its group's effects, less the oracle's
    affected  the group whose error half a second ahead the oracle shrinks most, None where it shrinks none
    closed    share of that shrinkage that the search achieved
    """
    offered = candidates(vehicle, train.channels, sample_time=sample_time(train), noncausal=train.noncausal)
    names = tuple(dict.fromkeys(n.split(".")[0] for n in truth))
    if not set(names) <= set(offered.names):
        return {"gain": None, "rivals": {}, "affected": None, "closed": None}
    nest = Nest(candidates=offered, data=led(train))
    if lasting:
        nest = with_states(nest, lasting)
    null = nest.refit(())
    task = nest.task(names, start=null, first={(n, None): v for n, v in truth.items()})
    if set(names) & set(offered.moving):
        # The truth is far from the noise levels of the null model, from where fits without a velocity may go astray.
        typical = nest.task(names, start=null, first=nest.typical(names))
        task = nest.from_each(replace(task, starts=(*task.starts, *typical.starts)))
    told = nest.settle(nest.refits([task])[0])
    others: dict[str, NestedFit] = {}
    for group in groups:
        kept = [n for n in names if n not in {m for r in group for m in r.split("+")}]
        for rival in group:
            chosen = tuple(dict.fromkeys((*kept, *rival.split("+"))))
            # A rival that nothing can show here stands in its group for what it would look like.
            if set(chosen) != set(names) and set(chosen) <= set(offered.names):
                fits = [nest.refit(chosen, start=null, also=told)]
                fits += [nest.unled(chosen, null)] if set(chosen) & set(offered.moving) else []
                others[rival] = min(fits, key=lambda f: f.bic)
    affected, closed = _closed(HeldOut(test), null, told, final)
    return {
        "gain": null.bic - told.bic, "rivals": {r: f.bic - told.bic for r, f in others.items()}, "affected": affected,
        "closed": closed,
    }  # fmt: skip


def ahead(judge: HeldOut, fitted: NestedFit) -> dict[str, float]:
    """Group -> RMSE half a second ahead."""
    return {r["group"]: r["rmse"] for r in judge.errors(fitted) if r["horizon_s"] == AHEAD}


def _closed(judge: HeldOut, null: NestedFit, told: NestedFit, final: NestedFit) -> tuple[str | None, float | None]:
    before, best, own = (ahead(judge, f) for f in (null, told, final))
    shared = [g for g in before if best.get(g) and g in own]
    group = max(shared, key=lambda g: before[g] / best[g], default=None)
    if group is None or before[group] ** 2 < NOTHING * best[group] ** 2:
        return None, None
    return group, (before[group] ** 2 - own[group] ** 2) / (before[group] ** 2 - best[group] ** 2)
