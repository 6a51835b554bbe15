"""Which combinations of parameters the data cannot tell apart, in words.

The information of the data alone (no priors), with initial states and noise levels eliminated, is
scaled to unit diagonal; eigenvectors of (near-)zero eigenvalues are the combinations that leave the
prediction unchanged. In relative coordinates a common factor shows as equal entries: "only their
ratio" (REALITY: mass alone known scales inertia, arm and yaw coefficient together). (Bellman and
Astrom 1970, Math. Biosciences 7; Brun, Reichert and Kunsch 2001, WRR 37(4).)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from greybox.statistics.evidence import FELT
from greybox.statistics.regret import information_on
from greybox.symbolic import FloatArray

WEAK = 1e-7
"""Scaled eigenvalue below which a direction may be not identified (a correlation of 1 - 5e-8): it
is where data do not feel all of a parameter change along it. Two that cancel may be known to a
millionth each, and to a hundredth together."""
ROUNDED = 1e-10
"""Scaled eigenvalue that rounding leaves of none: what is felt by it is no news."""
SHARE = 0.1
"""Smallest share of a direction that is worth naming."""


@dataclass(frozen=True, kw_only=True)
class Combination:
    """A direction that the data do not see: names, relative weights (largest 1), scaled eigenvalue,
    words."""

    names: tuple[str, ...]
    weights: tuple[float, ...]
    eigenvalue: float
    text: str


def marginal_information(information: FloatArray, keep: Sequence[int]) -> FloatArray:
    """Information of the unknowns `keep` with all others eliminated, (k, k)."""
    return information_on(information, keep, sorted({*range(len(information))} - {*keep}))


def unidentified(
    information: FloatArray,
    names: Sequence[str],
    values: Sequence[float],
    scales: Sequence[float],
) -> tuple[Combination, ...]:
    """Combinations without information. `information` (k, k) of the named parameters, `values` (k,)
    their estimates and `scales` (k,) their typical sizes.

    What is known of a parameter is measured against its typical size, or against its value where
    that is larger: an estimate that happens to be next to zero may be known as well as any. A
    change is one of the value, where data tell that from nothing.
    """
    k = len(names)
    if not k:
        return ()
    diagonal = np.diag(information)
    sizes = np.maximum(np.abs(np.asarray(values, dtype=np.float64)), np.asarray(scales))
    sizes = np.copysign(sizes, values)
    told = np.abs(values) * np.sqrt(np.maximum(diagonal, 0.0)) > FELT
    changed = np.where(told, values, sizes)
    known = diagonal * sizes**2
    alone = np.flatnonzero(known <= 1e-14 * known.max()).tolist()
    out = [
        Combination(
            names=(names[i],),
            weights=(1.0,),
            eigenvalue=0.0,
            text=f"{names[i]}: the data say nothing about it; fix it or fly a manoeuvre that "
            "excites it",
        )
        for i in alone
    ]
    seen = [i for i in range(k) if i not in alone and diagonal[i] > 0]
    if len(seen) < 2:
        return tuple(out)
    size = np.sqrt(diagonal[seen])
    scaled = information[np.ix_(np.asarray(seen), np.asarray(seen))] / np.outer(size, size)
    eigenvalues, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
    for value, v in zip(eigenvalues, vectors.T, strict=True):
        if value > WEAK * eigenvalues[-1]:
            break
        step = v / size  # change of the parameters along the direction
        relative = step / changed[seen]
        if _felt(value, np.abs(relative).max(), eigenvalues[-1]):
            continue
        weights = relative / relative[np.argmax(np.abs(relative))]
        part = [j for j in np.argsort(-np.abs(weights)) if abs(weights[j]) >= SHARE]
        if len(part) < 2:
            continue
        chosen = tuple(names[seen[j]] for j in part)
        shares = tuple(float(weights[j]) for j in part)
        out.append(
            Combination(
                names=chosen,
                weights=shares,
                eigenvalue=float(max(value, 0.0)),
                text=_words(chosen, shares, bool(told[[seen[j] for j in part]].all())),
            )
        )
    return tuple(out)


def _felt(eigenvalue: float, largest: float, most: float) -> bool:
    """Whether data feel a change of all of the parameter that moves most along a direction of unit
    length, where rounding of the `most` known one leaves that to say."""
    return not largest > 0 or bool(
        eigenvalue > ROUNDED * most and np.sqrt(eigenvalue) > FELT * largest
    )


def _words(names: Sequence[str], weights: Sequence[float], told: bool) -> str:
    """What cannot be seen of `names`. Where they are not all `told` from nothing, no factor is."""
    listed = ", ".join(names[:-1]) + f" and {names[-1]}"
    if told and all(abs(w - 1) < 0.05 for w in weights):
        return f"{listed} only as a ratio: a common factor on all of them changes no prediction"
    if told and all(abs(abs(w) - 1) < 0.05 for w in weights):
        up = [n for n, w in zip(names, weights, strict=True) if w > 0]
        down = [n for n, w in zip(names, weights, strict=True) if w < 0]
        return (
            f"{listed} only as a product: {', '.join(up)} up and {', '.join(down)} down by one "
            "factor cancel"
        )
    terms = ", ".join(f"{n} {100 * w:+.0f} %" for n, w in zip(names, weights, strict=True))
    return f"{listed} not separately: the change ({terms}) changes no prediction"
