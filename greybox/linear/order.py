"""Order selection: information criteria over all orders, confirmed by whiteness and by held-out
data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import trim_mean, wilcoxon

from greybox.errors import DataError, GreyboxError
from greybox.files import Json
from greybox.linear.pem import evaluate, start_nuisances
from greybox.linear.records import Record
from greybox.linear.search import Found, Options, refine, sweep
from greybox.statistics.whiteness import hosking
from greybox.symbolic import FloatArray

CRITERIA = ("aic", "aicc", "bic")
ONE_ERROR = 0.16
"""One-sided p-value of a difference of one standard error."""


@dataclass(frozen=True, kw_only=True)
class OrderRow:
    """One order: -2 log likelihood, number of parameters, criteria, whiteness p-value, held-out log
    det (or NaN).

    `held_out` is -2 log likelihood per sample on data that this row's rival fit never saw, a mean
    over blocks of 50 samples without the tenth at either end, so that one rough landing does not
    decide; `held_out_p` the p-value of a signed-rank test over blocks that the best row predicts no
    better than this one, NaN where there are too few blocks for it ever to say so.
    """

    order: int
    criterion: float
    parameters: int
    aic: float
    aicc: float
    bic: float
    whiteness: float
    converged: bool
    held_out: float = float("nan")
    held_out_p: float = float("nan")


@dataclass(frozen=True, kw_only=True)
class OrderChoice:
    """The chosen order with its table, the reasons in words, and the fits of all orders (scaled
    units)."""

    order: int
    rule: str
    rows: tuple[OrderRow, ...]
    reasons: tuple[str, ...]
    found: dict[int, Found]
    singular_values: FloatArray

    def to_dict(self) -> dict[str, Json]:
        """Plain values, without the fits."""
        return {
            "order": self.order,
            "rule": self.rule,
            "reasons": list(self.reasons),
            "singular_values": self.singular_values.tolist(),
            "table": [vars(r) for r in self.rows],
        }

    def format(self) -> str:
        """A table for the terminal."""
        lines = ["order  -2 log L      d       AIC      AICc       BIC  whiteness p  held out"]
        for r in self.rows:
            mark = "*" if r.order == self.order else " "
            lines.append(
                f"{r.order:>4}{mark} {r.criterion:>10.1f} {r.parameters:>5} {r.aic:>10.1f} "
                f"{r.aicc:>9.1f} {r.bic:>9.1f}  {r.whiteness:>11.2g}  {r.held_out:>8.4f}"
            )
        return "\n".join([*lines, *self.reasons])


def choose_order(
    records: Sequence[Record],
    largest: int,
    options: Options,
    *,
    criterion: str = "bic",
    cross_validate: bool = False,
    patience: int = 4,
) -> OrderChoice:
    """Fit orders 1 .. largest (scaled records) and choose by `criterion`.

    AIC: Akaike 1974; AICc: Hurvich and Tsai 1989; BIC: Schwarz 1978.

    With `cross_validate` the orders are also fitted on about 70 % of the data (whole records where
    there are three or more, else the first part of each) and scored on the rest: the smallest order
    that is within one standard error of the best (Hastie, Tibshirani and Friedman 2009, sec. 7.10;
    by the ranks of blocks, so that one rough landing does not decide) wins over a larger one that
    the criterion prefers. A model that did not converge gives way to one within that error that
    did. The chosen fit is polished to the tolerance of `options`. Raises `DataError` for an unknown
    criterion or data too short for order 1.
    """
    if criterion not in CRITERIA:
        raise DataError(f"order criterion '{criterion}'", expected=" or ".join(CRITERIA))
    count = sum(len(r) for r in records)
    largest = _affordable(records, largest)
    penalty = np.log(count) if criterion == "bic" else 2.0
    found = sweep(records, largest, options, patience=patience, penalty=float(penalty))
    rows = [_row(f, records) for f in found.values()]
    by_rule = min(rows, key=lambda r: getattr(r, criterion)).order
    if cross_validate:
        rows = _held_out(rows, records, options)
    order, told = _by_held_out(rows, by_rule)
    refined: set[int] = set()
    while order not in refined:
        found[order] = refine(found[order], records, options)
        refined.add(order)
        done = found[order].solution.status.converged
        rows = [replace(r, converged=done) if r.order == order else r for r in rows]
        order, told = _by_held_out(rows, by_rule)
    reasons = [f"{criterion.upper()} is smallest at order {by_rule}", *told]
    reasons += _left(next(r for r in rows if r.order == order))
    if order == max(found) and len(found) == largest:
        reasons.append(f"order {order} is the largest tried: raise `largest`")
    return OrderChoice(
        order=order,
        rule=criterion,
        rows=tuple(rows),
        reasons=tuple(reasons),
        found=found,
        singular_values=found[order].singular_values,
    )


def _by_held_out(rows: Sequence[OrderRow], order: int) -> tuple[int, list[str]]:
    """The smallest order that predicts unseen data no worse than by chance, where that is below
    `order`, and why. Where its fit did not converge, the smallest such order whose fit did."""
    if not any(np.isfinite(r.held_out) for r in rows):
        return order, []
    scored = [r for r in rows if np.isfinite(r.held_out_p)]
    if not scored:
        return order, ["held-out data are too short to tell one order from another"]
    best = min(scored, key=lambda r: r.held_out)
    no_worse = [r for r in scored if r.held_out_p > ONE_ERROR]
    enough = min(r.order for r in no_worse)
    reasons = [
        f"on held-out data order {best.order} predicts best and order {enough} is not "
        "worse by more than chance (one standard error)"
    ]
    if enough < order:
        order = enough
        reasons.append(
            f"order {order} is taken: the larger orders do not predict unseen data better"
        )
    settled = [r.order for r in no_worse if r.converged]
    if settled and not next(r for r in rows if r.order == order).converged:
        reasons[1:] = [
            f"order {settled[0]} is taken: the fit of order {order} did not converge, and this one "
            "is not worse by more than chance"
        ]
        order = settled[0]
    return order, reasons


def _left(chosen: OrderRow) -> list[str]:
    """What the innovations of the chosen order still hold."""
    if not np.isfinite(chosen.whiteness):
        return []
    white = chosen.whiteness > 0.01
    first = (
        f"innovations at order {chosen.order} are {'white' if white else 'not white'} "
        f"(joint portmanteau p = {chosen.whiteness:.2g})"
    )
    if white:
        return [first]
    return [
        first,
        "what is left is structure that more states do not remove cheaply: nonlinearity, "
        "time variation, unmeasured inputs or clock jitter",
    ]


def _affordable(records: Sequence[Record], largest: int) -> int:
    """No more orders than leave ten scalar samples per parameter; raises where order 1 has not even
    two."""
    m, p = records[0].u.shape[1], records[0].y.shape[1]
    seen = sum(int(np.isfinite(r.y).sum()) for r in records)
    if seen < 2 * (m + 2 * p):
        raise DataError(
            f"{seen} output samples are too few even for order 1", fix="pass a longer record"
        )
    return max(1, min(largest, seen // (10 * (m + 2 * p))))


def _row(found: Found, records: Sequence[Record]) -> OrderRow:
    s = found.solution
    count = sum(len(r) for r in records)
    scalars = sum(int(np.isfinite(r.y).sum()) for r in records)
    p = records[0].y.shape[1]
    d = s.tangent.shape[1]
    total = d + p * (p + 1) // 2
    value = s.evaluation.criterion
    return OrderRow(
        order=s.system.order,
        criterion=value,
        parameters=d,
        aic=value + 2 * total,
        aicc=value + 2 * total * scalars / max(scalars - total - 1, 1),
        bic=value + total * np.log(count),
        whiteness=_whiteness(found, records),
        converged=s.status.converged,
    )


def _whiteness(found: Found, records: Sequence[Record]) -> float:
    """p-value of the joint test over 25 lags; NaN where there are too few samples for it."""
    s = found.solution
    e = [np.where(np.isfinite(r.y), q.e, np.nan) for r, q in zip(records, s.evaluation.predictions)]
    test = hosking(e, 25, fitted=min(2 * s.system.order, 20) * e[0].shape[1])
    return float("nan") if test is None else test.p_value


def _held_out(
    rows: Sequence[OrderRow], records: Sequence[Record], options: Options
) -> list[OrderRow]:
    train, test = split(records)
    largest = max(r.order for r in rows)
    try:
        found = sweep(train, largest, options)
    except GreyboxError:
        return list(rows)
    terms: dict[int, np.ndarray] = {}
    for order, f in found.items():
        s = f.solution
        nuisances = start_nuisances(s.system, test, options.settings)
        e = np.vstack(
            [q.e for q in evaluate(s.system, nuisances, test, s.evaluation.noise).predictions]
        )
        noise = s.evaluation.noise
        white = np.linalg.solve(np.linalg.cholesky(noise), e.T).T
        terms[order] = (white**2).sum(axis=1) + np.linalg.slogdet(noise)[1]
    scores = {order: float(trim_mean(_blocks(values), 0.1)) for order, values in terms.items()}
    best = min(scores, key=lambda k: scores[k])
    out = []
    for r in rows:
        if r.order not in terms:
            out.append(r)
            continue
        difference = terms[r.order] - terms[best]
        out.append(replace(r, held_out=scores[r.order], held_out_p=_no_worse(difference)))
    return out


def split(records: Sequence[Record]) -> tuple[list[Record], list[Record]]:
    """About 70 % to train and 30 % to test: every third record where those hold 20-45 % of the
    samples, else by time."""
    third = [r for i, r in enumerate(records) if i % 3 == 2]
    if 0.2 <= sum(map(len, third)) / sum(map(len, records)) <= 0.45:
        return [r for i, r in enumerate(records) if i % 3 != 2], third
    train, test = [], []
    for r in records:
        cut = int(0.7 * len(r))
        train.append(Record(u=r.u[:cut], y=r.y[:cut], name=r.name))
        test.append(Record(u=r.u[cut:], y=r.y[cut:], name=r.name))
    return train, test


def _blocks(values: np.ndarray, block: int = 50) -> np.ndarray:
    """Means of consecutive blocks, which are nearly independent where single samples are not."""
    return np.array([part.mean() for part in np.array_split(values, max(len(values) // block, 2))])


def _no_worse(difference: np.ndarray) -> float:
    """One-sided signed-rank p-value of the block means of a difference being above zero; 1 where it
    is zero, NaN where even all blocks together would be chance."""
    means = _blocks(difference)
    if 0.5 ** len(means) > ONE_ERROR:
        return float("nan")
    if not np.any(difference):
        return 1.0
    return float(wilcoxon(means, alternative="greater").pvalue)
