"""Selection: which few columns of many a response needs, from normal equations of stretches.

Forward by orthogonal least squares (Chen, Billings and Luo 1989, International Journal of Control
50(5)) with the extended BIC (Chen and Chen 2008, Biometrika 95(3): log n + 2 log t a column), on
random halves of the stretches; columns that are chosen in most halves are candidates (stability
selection, Meinshausen and Buhlmann 2010, JRSS B 72(4); a column that is nearly another one shares
its votes, Faletto and Bien 2022, arXiv:2201.00494), and of these those stay that make flights which
were left out more likely.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from greybox.residual.laws.normal_equations import RIDGE, Normal, solve
from greybox.symbolic import FloatArray

HALVES = 30
STABLE = 0.7
"""Share of the halves in which a column must be chosen."""
ALIKE = 0.9
"""Correlation above which two columns share their votes."""


def forward(
    xx: FloatArray,
    xy: FloatArray,
    always: Sequence[int],
    groups: Sequence[str],
    most: int,
    price: float,
    allowed: Sequence[int] | None = None,
) -> list[int]:
    """Columns next to those that are `always` in, each the one that explains most of what is left,
    up to `most` of a group, while the sum of squares falls by more than `price` (in units of the
    noise variance)."""
    n = len(xy)
    chosen: list[int] = []
    size = np.diag(xx)
    # What the chosen columns leave of every column's square and of its product with y; rows of the
    # Cholesky factor.
    left, target, rows = size.copy(), xy.copy(), np.zeros((0, n))
    free = np.zeros(n, dtype=bool)
    free[list(range(n) if allowed is None else allowed)] = True
    free[list(always)] = False

    def sweep(j: int) -> None:
        """Project column j out of the others."""
        nonlocal left, target, rows
        if left[j] > RIDGE * max(size[j], 1e-300):
            row = (xx[j] - rows[:, j] @ rows) / np.sqrt(left[j])
            target = target - row * (target[j] / np.sqrt(left[j]))
            left = left - row**2
            rows = np.vstack([rows, row])

    for j in always:
        sweep(j)
    while free.any():
        fit = free & (left > 1e-4 * size)
        gains = np.where(fit, target**2 / np.where(fit, left, 1.0), -1.0)
        j = int(gains.argmax())
        if gains[j] <= price:
            break
        chosen.append(j)
        free[j] = False
        if sum(groups[i] == groups[j] for i in chosen) >= most:
            free[[i for i in range(n) if groups[i] == groups[j]]] = False
        sweep(j)
    return chosen


def price_of(samples: int, columns: int) -> float:
    """What one of so many columns must gain, in units of the noise variance (extended BIC)."""
    return float(np.log(max(samples, 2)) + 2 * np.log(max(columns, 2)))


def select(
    normal: Normal,
    always: Sequence[int],
    groups: Sequence[str],
    *,
    most: int,
    samples: int,
    seed: int,
) -> list[int]:
    """Stable columns that help on what was left out, most useful first. `groups`: a label per
    column."""
    stretches, columns = normal.xy.shape
    if stretches < 4 or columns == len(always):
        return []
    price = price_of(samples, columns)
    rng = np.random.default_rng(seed)
    counts = np.zeros(columns)
    alike = np.abs(_correlation(normal.xx.sum(0), always)) > ALIKE
    for _ in range(HALVES):
        half = rng.choice(stretches, stretches // 2, replace=False)
        chosen = forward(
            normal.xx[half].sum(0), normal.xy[half].sum(0), always, groups, most, price
        )
        if chosen:
            counts += alike[chosen].any(axis=0)
    stable = np.flatnonzero(counts >= STABLE * HALVES)
    order = forward(
        normal.xx.sum(0), normal.xy.sum(0), always, groups, most, price, stable.tolist()
    )
    kept: list[int] = []
    best = left_out(normal, [*always])
    for j in order:
        value = left_out(normal, [*always, *kept, j])
        if value > best:
            kept, best = [*kept, j], value
    return kept


def _correlation(xx: FloatArray, always: Sequence[int]) -> FloatArray:
    """Of columns from which those that are `always` in were projected out."""
    c = list(always)
    if c:
        xx = xx - xx[:, c] @ np.linalg.pinv(xx[np.ix_(c, c)], hermitian=True) @ xx[c]
    size = np.sqrt(np.maximum(np.diag(xx), 1e-300))
    out = np.asarray(xx / size[:, None] / size)
    out[c] = out[:, c] = 0.0
    np.fill_diagonal(out, 1.0)
    return out


def needed(normal: Normal, columns: Sequence[int], one: int, price: float) -> bool:
    """Whether `one` of the columns is worth its price, and helps on what was left out."""
    rest = [i for i in columns if i != one]
    xx, xy = normal.xx.sum(0), normal.xy.sum(0)
    gain = xy[columns] @ solve(xx, xy, columns) - xy[rest] @ solve(xx, xy, rest)
    return bool(gain > price and left_out(normal, columns) > left_out(normal, rest))


def left_out(normal: Normal, columns: Sequence[int]) -> float:
    """By how much these columns lower the sum of squares of flights that were left out, one at a
    time (stretches, of a single flight: neighbouring stretches share slow signals, other flights do
    not)."""
    names = np.asarray(normal.flights)
    labels = names if len(set(normal.flights)) > 1 else np.arange(len(names))
    c, total = list(columns), 0.0
    for label in np.unique(labels):
        out = labels == label
        value = solve(normal.xx[~out].sum(0), normal.xy[~out].sum(0), c) if c else np.zeros(0)
        xx, xy = normal.xx[out].sum(0)[np.ix_(c, c)], normal.xy[out].sum(0)[c]
        total += float(2 * value @ xy - value @ xx @ value)
    return total
