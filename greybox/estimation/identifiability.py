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

from greybox.statistics.regret import information_on
from greybox.symbolic import FloatArray

WEAK = 1e-7
"""Scaled eigenvalue below which a direction counts as not identified (a correlation of 1 -
5e-8)."""
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
    information: FloatArray, names: Sequence[str], values: Sequence[float]
) -> tuple[Combination, ...]:
    """Combinations without information. `information` (k, k) of the named parameters, `values` (k,)
    their estimates."""
    k = len(names)
    if not k:
        return ()
    diagonal = np.diag(information)
    top = float(
        np.max(diagonal * np.square(np.maximum(np.abs(np.asarray(values)), 1e-300)), initial=0.0)
    )
    out: list[Combination] = []
    alone = [
        i
        for i in range(k)
        if diagonal[i] * max(abs(values[i]), 1e-300) ** 2 <= 1e-14 * top and values[i] != 0
    ]
    for i in alone:
        out.append(
            Combination(
                names=(names[i],),
                weights=(1.0,),
                eigenvalue=0.0,
                text=f"{names[i]}: the data say nothing about it; fix it or fly a manoeuvre that "
                "excites it",
            )
        )
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
        relative = step / np.array([values[i] if values[i] else np.inf for i in seen])
        if not np.abs(relative).max() > 0:
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
                text=_words(chosen, shares),
            )
        )
    return tuple(out)


def _words(names: Sequence[str], weights: Sequence[float]) -> str:
    listed = ", ".join(names[:-1]) + f" and {names[-1]}"
    if all(abs(w - 1) < 0.05 for w in weights):
        return f"{listed} only as a ratio: a common factor on all of them changes no prediction"
    if all(abs(abs(w) - 1) < 0.05 for w in weights):
        up = [n for n, w in zip(names, weights, strict=True) if w > 0]
        down = [n for n, w in zip(names, weights, strict=True) if w < 0]
        return (
            f"{listed} only as a product: {', '.join(up)} up and {', '.join(down)} down by one "
            "factor cancel"
        )
    terms = ", ".join(f"{n} {100 * w:+.0f} %" for n, w in zip(names, weights, strict=True))
    return f"{listed} not separately: the change ({terms}) changes no prediction"
