"""The errors of a fit with what the form of its model adds: what is bent into the place of what is
missing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from greybox.estimation.result import Estimate, Fit
from greybox.statistics.evidence import FELT
from greybox.symbolic import FloatArray

HELD = "the errors hold that now"


def widened(
    found: Fit, spread: FloatArray, rows: Mapping[str, Sequence[int]], line: str = ""
) -> Fit:
    """The fit with wider errors: `spread` (n, n) is added to the covariance of the estimates,
    `rows` are the places of every parameter in it, of one with a value in every flight those of its
    flights, in order. `line` says which are no measurement. Predictions and the model's own
    covariance stay."""
    wider = {
        n: _with_spread(e, spread, rows[n]) if rows.get(n) else e
        for n, e in found.parameters.items()
    }
    model = found.model
    shared = model.covariance_names
    means = np.zeros((len(shared), len(spread)))
    for k, n in enumerate(shared):
        if places := list(rows.get(n, ())):
            means[k, places] = 1.0 / len(places)
    more = model.form_among(shared) + means @ spread @ means.T
    model = replace(model, form_covariance=more)
    estimates = replace(found.estimates, parameters=wider, model=model)
    return doubted(replace(found, estimates=estimates), line)


def doubted(found: Fit, *lines: str) -> Fit:
    """The fit with what else is said of the form of its model."""
    old = found.diagnostics
    form = "; ".join(s for s in (old.covariance.form, *lines) if s)
    others = tuple(w for w in old.warnings if w != old.covariance.form)
    said = replace(
        old,
        covariance=replace(old.covariance, form=form),
        warnings=(form, *others) if form else old.warnings,
    )
    return replace(found, diagnostics=said)


def moved_away(
    found: Fit, shift: FloatArray, rows: Mapping[str, Sequence[int]]
) -> dict[str, float]:
    """By how many standard errors `shift` (n,) moves the estimates that it moves beyond what is
    felt; `rows` as for `widened`. Memories of what has no name are no measurements anyhow."""
    away = {}
    for name, e in found.parameters.items():
        if rows.get(name) and e.std > 0 and not name.startswith("disturbance."):
            size = float(np.abs(shift[list(rows[name])].mean())) / e.std
            if size > FELT:
                away[name] = size
    return away


def no_measurement(away: Mapping[str, float], why: str, known: str) -> str:
    """Which numbers are none, by how many standard errors `why` would move them, and what is
    `known`; nothing where there are none."""
    if not away:
        return ""
    one = len(away) == 1
    return (
        f"{', '.join(away)} {'is' if one else 'are'} no measurement: {why} move "
        f"{'it' if one else 'them'} by up to {max(away.values()):.0f} standard errors; {known}"
    )


def _mean(spread: FloatArray, rows: Sequence[int]) -> float:
    """Variance of the mean of these rows."""
    return max(float(spread[np.ix_(rows, rows)].mean()), 0.0)


def _with_spread(e: Estimate, spread: FloatArray, rows: Sequence[int]) -> Estimate:
    """The estimate with its part of `spread`."""
    own = np.diag(spread)[list(rows)]
    each = dict(e.per_flight)
    if len(each) == len(rows):
        each = {
            f: (v, float(np.hypot(s, np.sqrt(more))))
            for (f, (v, s)), more in zip(each.items(), own, strict=True)
        }
    return replace(e, std=float(np.hypot(e.std, np.sqrt(_mean(spread, rows)))), per_flight=each)
