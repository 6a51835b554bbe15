"""Do past inputs still explain the innovations? Cross-correlation with bands that know both
signals' colour.

If innovation e and input u are independent, the estimated correlations at lags i and j have
covariance sum_k r_e(k) r_u(k + i - j) / n (M. S. Bartlett, J. Royal Statistical Society Suppl. 8,
1946; L. Ljung, "System Identification", 2nd ed., 1999, section 16.6). Smooth inputs therefore give
smooth chance correlations, which naive bands 1/sqrt(n) and lag-by-lag reading take for a finding.
Lag tau pairs the innovation at t + tau with the input at t.

Under feedback the controller answers past innovations: negative lags (and lag 0, where the command
is computed from the same sample) are correlated for the right model too. The verdict therefore uses
positive lags only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypedDict

import numpy as np
import numpy.typing as npt
import scipy.linalg

from greybox.errors import DataError
from greybox.statistics.correlation import centred, check_lags, lagged
from greybox.statistics.distributions import chi_square_tail, normal_quantile
from greybox.symbolic import FloatArray
from greybox.validation.samples import names_for, stretches

NOTE = (
    "Verdict from positive lags only (input before innovation): under feedback the commands answer "
    "past innovations, so that lag 0 and negative lags are correlated for a perfect model too. "
    "Where the innovations are not white, feedback reaches positive lags as well; read this test "
    "after the whiteness test."
)


class CrossPairRow(TypedDict):
    """A `CrossPair` in a result file."""

    innovation: str
    input: str
    n: int
    band: float
    outside: float
    q: float
    dof: int
    p_value: float
    r: list[float]


class CrossDocument(TypedDict):
    """A `CrossCorrelation` in a result file."""

    level: float
    max_lag: int
    lags: list[int]
    pairs: list[CrossPairRow]
    skipped: list[str]
    note: str


@dataclass(frozen=True, kw_only=True)
class CrossPair:
    """Correlation of one innovation component with one input.

    `r` (2 max_lag + 1,) over lags -max_lag..max_lag, `band` the half-width if independent.
    `outside` is the share of the positive lags outside; `q`, `dof`, `p_value` test all positive
    lags at once with their covariance.
    """

    innovation: str
    input: str
    n: int
    r: FloatArray
    band: float
    outside: float
    q: float
    dof: int
    p_value: float

    def to_dict(self) -> CrossPairRow:
        """Plain values under the names of the fields."""
        return {
            "innovation": self.innovation,
            "input": self.input,
            "n": self.n,
            "band": self.band,
            "outside": self.outside,
            "q": self.q,
            "dof": self.dof,
            "p_value": self.p_value,
            "r": self.r.tolist(),
        }


@dataclass(frozen=True, kw_only=True)
class CrossCorrelation:
    """All pairs of innovation and input; `skipped` names inputs that never moved."""

    pairs: tuple[CrossPair, ...]
    max_lag: int
    level: float
    skipped: tuple[str, ...]
    note: str = NOTE

    def to_dict(self) -> CrossDocument:
        """Plain values: level, max_lag, lags, pairs, skipped, note."""
        return {
            "level": self.level,
            "max_lag": self.max_lag,
            "lags": list(range(-self.max_lag, self.max_lag + 1)),
            "pairs": [p.to_dict() for p in self.pairs],
            "skipped": list(self.skipped),
            "note": self.note,
        }

    def format(self) -> str:
        """A table for the terminal: p-values, innovations down, inputs across."""
        rows, heads = (
            list(dict.fromkeys(getattr(p, k) for p in self.pairs)) for k in ("innovation", "input")
        )
        width = max(len("innovation"), *(len(r) for r in rows))
        table = {(p.innovation, p.input): p for p in self.pairs}
        lines = [
            f"{'innovation':<{width}}  "
            + "  ".join(f"{h:>8}" for h in heads)
            + "   (p-values, positive lags)"
        ]
        for row in rows:
            cells = "  ".join(f"{table[row, h].p_value:>8.2g}" for h in heads)
            lines.append(f"{row:<{width}}  {cells}")
        if self.skipped:
            lines.append(f"not tested, constant: {', '.join(self.skipped)}")
        return "\n".join([*lines, self.note])


def _taper(m: int) -> FloatArray:
    # Bartlett's triangle: the product of tapered sequences keeps a positive spectrum.
    weights: FloatArray = 1.0 - np.abs(np.arange(-m, m + 1)) / (m + 1.0)
    return weights


def _auto(records: Sequence[FloatArray], m: int) -> FloatArray:
    """Tapered autocorrelation at lags -m..m of one column of centred records (n, 1), positive
    semidefinite."""
    values, weights = centred(records, each=True)
    c, count = lagged(values, weights, values, weights, range(m + 1))
    r = c[:, 0, 0] * count[:, 0, 0] / (c[0, 0, 0] * count[0, 0, 0])
    return np.concatenate([r[:0:-1], r]) * _taper(m)


def _joint(
    zeta: FloatArray, r_e: FloatArray, r_u: FloatArray, n: float
) -> tuple[float, int, FloatArray]:
    """(q, dof, first row of the covariance times n) of the correlations zeta at consecutive
    lags."""
    m = len(zeta)
    # sum_k r_e(k) r_u(k + s): the correlation of two even sequences is their convolution.
    both = np.convolve(r_e, r_u)
    middle = len(both) // 2
    row = both[middle : middle + m]
    values, vectors = scipy.linalg.eigh(scipy.linalg.toeplitz(row))
    # Directions that a smooth input hardly excites carry estimation noise of the covariance only.
    keep = values > 0.01 * values[-1]
    score = vectors[:, keep].T @ zeta
    return float(n * np.sum(score * score / values[keep])), int(keep.sum()), row


def cross_correlation(
    innovations: Sequence[npt.ArrayLike] | npt.ArrayLike,
    inputs: Sequence[npt.ArrayLike] | npt.ArrayLike,
    *,
    names: Sequence[str] | None = None,
    input_names: Sequence[str] | None = None,
    max_lag: int = 25,
    memory: int | None = None,
    level: float = 0.99,
) -> CrossCorrelation:
    """Cross-correlation of innovations (N_i, d) with inputs (N_i, m), one array of each per flight,
    NaN = missing.

    The mean of every flight is removed from both. `memory` is the number of lags over which the
    signals' own correlation is estimated for the bands (4 max_lag, and at least 100, where the
    flights are long enough). `level` is that of the bands (0.99). Raises `DataError` for arrays
    that do not match, too few samples, or when no input moves.
    """
    e, u = _alike(innovations, inputs)
    labels = names_for(names, e[0].shape[1], what="e")
    heads = names_for(input_names, u[0].shape[1], what="u")
    if not 0.0 < level < 1.0:
        raise DataError(f"cross-correlation: level {level:g}", expected="between 0 and 1")
    check_lags(e, max_lag, what="innovations")
    moving = [
        j for j in range(len(heads)) if any(np.nanmax(c) > np.nanmin(c) for c in _finite(u, j))
    ]
    if not moving:
        raise DataError("no input moves: nothing to correlate with", got=", ".join(heads))
    inputs_kept = [b[:, moving] for b in u]
    check_lags(inputs_kept, max_lag, what="inputs")
    if memory is None:
        memory = min(max(4 * max_lag, 100), max(len(a) for a in e) // 4)
    memory = max(memory, max_lag)
    lags = range(-max_lag, max_lag + 1)
    (ev, ew), (uv, uw) = centred(e, each=True), centred(inputs_kept, each=True)
    c, count = lagged(ev, ew, uv, uw, lags)
    e_scale = np.sqrt(sum((v * v).sum(axis=0) for v in ev) / sum(w.sum(axis=0) for w in ew))
    u_scale = np.sqrt(sum((v * v).sum(axis=0) for v in uv) / sum(w.sum(axis=0) for w in uw))
    r = c / (e_scale[:, None] * u_scale)
    r_e = [_auto([a[:, i : i + 1] for a in e], memory) for i in range(len(labels))]
    r_u = [_auto([b[:, j : j + 1] for b in inputs_kept], memory) for j in range(len(moving))]
    return CrossCorrelation(
        pairs=tuple(
            _pair((name, heads[column]), r[:, i, j], r_e[i], r_u[j], count[max_lag, i, j], level)
            for i, name in enumerate(labels)
            for j, column in enumerate(moving)
        ),
        max_lag=max_lag,
        level=level,
        skipped=tuple(h for j, h in enumerate(heads) if j not in moving),
    )


def _pair(
    names: tuple[str, str],
    r: FloatArray,
    r_e: FloatArray,
    r_u: FloatArray,
    count: float,
    level: float,
) -> CrossPair:
    """The test of one innovation and input from their cross-correlation r (2 max_lag + 1,), the
    autocorrelations of both and the number of samples."""
    positive = r[len(r) // 2 + 1 :]
    q, dof, row = _joint(positive, r_e, r_u, float(count))
    band = float(normal_quantile(0.5 + level / 2.0)) * float(np.sqrt(row[0] / float(count)))
    return CrossPair(
        innovation=names[0],
        input=names[1],
        n=int(count),
        r=r,
        band=band,
        outside=float(np.mean(np.abs(positive) > band)),
        q=q,
        dof=dof,
        p_value=float(chi_square_tail(q, dof)),
    )


def _alike(
    innovations: Sequence[npt.ArrayLike] | npt.ArrayLike,
    inputs: Sequence[npt.ArrayLike] | npt.ArrayLike,
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Both as stretches of the same lengths. Raises `DataError`."""
    e, u = stretches(innovations, what="innovations"), stretches(inputs, what="inputs")
    lengths = [len(a) for a in e], [len(b) for b in u]
    if lengths[0] != lengths[1]:
        raise DataError(
            "innovations and inputs differ in length", got=f"{lengths[0]} and {lengths[1]}"
        )
    return e, u


def _finite(records: Sequence[FloatArray], column: int) -> list[FloatArray]:
    parts = [r[np.isfinite(r[:, column]), column] for r in records]
    return [p for p in parts if len(p)]
