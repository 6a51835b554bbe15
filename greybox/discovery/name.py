"""Name: which effect to add next, and when not to say its name.

Candidates that pass the family-wise score test are refitted jointly with everything found so far; the likelihood decides
between them (BIC). A candidate is named when it beats every rival by more than 10 (very strong evidence, Kass and Raftery
1995); rivals within 10 are returned as a group. Effects whose slopes at the null are the same (motor lag and command
delay) are refitted alone and together.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from greybox.discovery.candidates import LOOK_ALIKES, TIMING, TOGETHER
from greybox.discovery.clocks import SHORT, in_other_words, said_shorter
from greybox.discovery.nested import FINE, ROOM, SHARES, Nest, NestedFit, Refit
from greybox.discovery.screen import Score
from greybox.statistics.evidence import CLEAR

PLAIN = 0.1
"""Log likelihood per sample from which on a gain is plain. On held-out flights the errors further ahead are then not asked:
as long as much else is missing they are those of the rest, and a right addition may raise them. An effect with a threshold
must gain that much where few blocks feel it."""
CONTENDERS = 4
"""How many candidates of a screening are refitted."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Addition:
    """One step: `effects` were added (one, or two that go together) with family-wise `p_value`; `delta_bic` = BIC without
    minus BIC with, `delta_bic_rival` to the best rival (None without one; above 30 a little too large, as such rivals are
    fitted roughly), `rivals` name -> weight of those within `CLEAR`
    (empty: the name is clear). `before` and `after` are the fits."""

    effects: tuple[str, ...]
    p_value: float
    delta_bic: float
    delta_bic_rival: float | None
    rivals: dict[str, float]
    before: NestedFit
    after: NestedFit
    scores: tuple[Score, ...]


def next_addition(
    nest: Nest, at: NestedFit, scores: Sequence[Score], alpha: float, refused: Collection[frozenset[str]] = ()
) -> Addition | None:
    """The best addition to `at`, or None where no candidate passes the tests or none improves BIC clearly. Sets of effects
    that were `refused` are not tried."""
    passing = [s for s in scores if s.judged and s.allowed and s.p_family <= alpha]
    # A limit that was moved until a few samples felt it may also be the end of a curve: it must gain plainly.
    rare = [s for s in passing if s.threshold and s.burst]
    passing = [s for s in passing if s not in rare]
    # The statistic in the metric of block scores cannot exceed their number, whatever the size of the effect: it tests but
    # does not rank. Fisher's is twice the gain in likelihood that a refit is expected to have, but for lags and delays,
    # which gain far more than their first step tells: these always contend.
    passing = sorted(passing, key=lambda s: -s.statistic)
    passing = [s for i, s in enumerate(passing) if i < CONTENDERS or s.name in TIMING]
    plain = 2 * PLAIN * max(at.fit.n_samples, 1)
    unscored = [*(s for s in scores if s.refit), *rare]
    if not passing and not unscored:
        return None
    by_name = {s.name: s for s in scores}
    sets: list[tuple[str, ...]] = [(s.name,) for s in (*passing, *unscored)]
    for group in LOOK_ALIKES:
        if any(s.name in group for s in passing):
            sets += [(n,) for n in group if n in by_name and by_name[n].judged and (n,) not in sets]
    for pair in TOGETHER:
        if any(s.name in pair for s in passing) and all(n in by_name and by_name[n].judged for n in pair):
            sets.append(pair)
    sets = [c for c in sets if frozenset(c) not in refused]
    tasks = []
    for chosen in sets:
        first = {k: v for n in chosen for k, v in by_name[n].estimate.items()}
        shares = FINE if any(by_name[n].threshold for n in chosen) else SHARES
        task = nest.task((*at.effects, *chosen), start=at, first=first, shares=shares)
        tasks.append(nest.from_each(task) if any(by_name[n].refit for n in chosen) else task)
    fits: dict[tuple[str, ...], Refit] = {}
    behind: dict[tuple[str, ...], Refit] = {}
    for chosen, found in zip(sets, nest.contest(tasks), strict=True):
        if found.overtaken:
            behind[chosen] = found
        enough = plain if any(s.name in chosen for s in rare) else -np.inf
        if found.comparable and not any(found.at_bound(n) for n in chosen) and at.bic - found.bic > enough:
            fits[chosen] = found
    if not fits:
        return None
    order = sorted(fits, key=lambda c: fits[c].bic)
    best = order[0]
    # Two names must be clearly better than one of them.
    fewer = [c for c in order if set(c) < set(best)]
    if fewer and fits[fewer[0]].bic - fits[best].bic < CLEAR:
        best = fewer[0]
    gain = at.bic - fits[best].bic
    if gain < CLEAR:
        return None
    # A pair that contains the best, or a part of it, is no rival: it is the same story with more or fewer words.
    fits = behind | fits
    same = in_other_words(at, best)
    others = [c for c in (*order[1:], *behind) if not set(c) & (set(best) | same)]
    gaps = {"+".join(c): fits[c].bic - fits[best].bic for c in others}
    near = {n: g for n, g in gaps.items() if g < CLEAR}
    weights = np.exp(-0.5 * np.array([0.0, *near.values()]))
    weights /= weights.sum()
    rivals = dict(zip(("+".join(best), *near), weights.tolist(), strict=True)) if near else {}
    alike = _all_late(nest, fits[best], best)
    rivals = _same_within_a_sample(nest, fits[best], best, gaps) or (alike if set(rivals) <= set(alike) else rivals)
    p_value = min(by_name[n].p_family for n in best)
    gap = min(gaps.values()) if gaps else None
    after = fits[best]
    if shorter := said_shorter(nest, at, after):
        best, rivals, after = tuple(n for n in shorter.effects if n not in at.effects), {}, shorter
        gain = at.bic - after.bic
    if {*best} <= {s.name for s in unscored}:
        p_value = _likelihood_ratio(at, after, len(nest.candidates.parameters))
        if p_value > alpha:
            return None
    return Addition(
        effects=best, p_value=p_value, delta_bic=gain, delta_bic_rival=gap, rivals=rivals, before=at,
        after=nest.settle(after), scores=tuple(scores),
    )  # fmt: skip


def _likelihood_ratio(at: NestedFit, found: Refit, tests: int) -> float:
    """Level of the likelihood ratio test (Wilks 1938), times the number of candidates (Bonferroni). In the likelihoods the
    initial states have paid for themselves: a velocity that is not there without the effect."""
    dof = found.n_parameters - at.n_parameters
    level = float(scipy.stats.chi2.sf(2 * (found.evidence - at.evidence), dof))
    return min(1.0, tests * max(level, float(np.finfo(float).tiny)))  # beyond what a float holds it is small, not zero


def _same_within_a_sample(nest: Nest, found: Refit, new: tuple[str, ...], gaps: Mapping[str, float]) -> dict[str, float]:
    """Equal rivals where what was found is a time much shorter than a sample: lag and delay of the command in any case, and
    what is not far behind; `gaps`: rival -> BIC behind."""
    times = [abs(v) for (n, _), v in found.theta.items() if n.split(".")[0] in new]
    if len(new) != 1 or new[0] not in TIMING or max(times, default=np.inf) >= SHORT * nest.candidates.physics.sample_time:
        return {}
    # Next to a lag that is known or found already, a delay is no other word for it.
    free = [p for p in TOGETHER if set(p) & set(found.effects) == set(new) and set(p) <= set(nest.candidates.parameters)]
    pair = next(iter(free), ())
    near = [n for n, g in gaps.items() if g < (ROOM if n in TIMING else CLEAR)]
    names = tuple(dict.fromkeys((*new, *pair, *near)))
    return dict.fromkeys(names, 1 / len(names)) if len(names) > 1 else {}


def _all_late(nest: Nest, found: Refit, best: tuple[str, ...]) -> dict[str, float]:
    """The delays of commands and of sensors as equal rivals where all sensors are late alike: only their sum shows. No
    command is early, and what has a name already is not asked again."""
    other = nest.candidates.late_alike
    if other is None or best not in (("command_delay",), (other,)) or {"command_delay", other} <= set(found.effects):
        return {}
    size = min((v for (n, _), v in found.theta.items() if n.split(".")[0] in best), default=0.0)
    return {} if size < 0 else dict.fromkeys(("command_delay", other), 0.5)


def stands_in(nest: Nest, found: Addition, instead_of: Sequence[Addition]) -> Addition | None:
    """The addition that `found` only stands in for: clearly likelier than it, and with nothing to gain from it.

    What held-out flights withheld by chance must not get the name of its look-alike.
    """
    for other in instead_of:
        if set(other.effects) & set(found.effects) or found.after.bic - other.after.bic < CLEAR:
            continue
        task = nest.task((*other.after.effects, *found.effects), start=other.after, also=found.after)
        both = nest.contest([task], other.after.bic)[0]
        if both.comparable and other.after.bic - both.bic < CLEAR:
            return other
    return None


def still_needed(
    nest: Nest, at: NestedFit, effect: str, before: NestedFit | None = None
) -> tuple[NestedFit | None, float]:
    """(the fit without `effect` if it does not improve BIC clearly next to the others, else None; BIC without - with).

    `before`: a fit without the effect, whose noise levels have room for it.
    """
    left = tuple(e for e in at.effects if e != effect)
    tasks = [nest.task(left, start=at, also=before)]
    tasks += [nest.task(left, start=at, first=later) for later in _handed_over(at, effect)]
    smaller = min(nest.contest(tasks, at.bic), key=lambda r: r.bic)
    gain = smaller.bic - at.bic
    return (None if gain > CLEAR or not smaller.converged else nest.settle(smaller)), gain


def _handed_over(at: NestedFit, effect: str) -> list[dict[tuple[str, str | None], float]]:
    """Starts for a fit without `effect`, a lag or delay: another one of these takes over its time.

    Only their sum is seen well, and between them lie kinks (delays of whole samples) that stop a fit on its way.
    """
    if effect not in TIMING:
        return []
    times = {n: e.value for n, e in at.fit.parameters.items() if n.split(".")[0] in TIMING}
    gone = sum(v for n, v in times.items() if n.split(".")[0] == effect)
    return [{(n, None): v + gone} for n, v in times.items() if n.split(".")[0] != effect]


def prune(
    nest: Nest, at: NestedFit, additions: Sequence[Addition], *, single: bool = False, spared: Collection[str] = ()
) -> tuple[NestedFit, list[Addition], list[str]]:
    """Leave out, one by one, what is not needed next to the others, `spared` names not; with `single` also an addition that
    is alone.

    The last addition is tried as well: it may only have led the others out of a local optimum.
    Returns the last fit, the additions with the effects that stay, and a sentence for every effect that went.
    """
    notes = []
    for earlier in additions if len(additions) > 1 or single else ():
        for name in (n for n in earlier.effects if n in at.effects and n not in spared):
            smaller, gain = still_needed(nest, at, name, earlier.before)
            if smaller is not None:
                notes.append(f"{name} was added and is not needed next to the others (BIC {gain:.1f}): removed")
                at = smaller
    return at, still_there(additions, at), notes


def still_there(additions: Sequence[Addition], at: NestedFit) -> list[Addition]:
    """The additions with the effects that the fit `at` has."""
    kept = [replace(a, effects=tuple(e for e in a.effects if e in at.effects)) for a in additions]
    return [a for a in kept if a.effects]
