"""How two measured streams relate: which reading of their axes explains the motion, by which
factor, how late. One estimation for position, velocity, attitude, rates and specific force.

Both streams are increments over the same span that kinematics makes equal, y = x. A reading (other
axes, signs, another frame) predicts another x or y. Readings are compared by the share of y's sum
of squares that they explain once size is set aside, the squared correlation; how sure a difference
is comes from leaving out one block of time after the other (jackknife). Rotations are those of
Wahba's problem (SIAM Review 7(3), 1965), solved by singular values (Markley, J. Astronaut. Sci.
36(3), 1988).
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from greybox.data.checks.mixture import FLOOR, Mixture, mixture, products
from greybox.data.checks.signals import FloatArray, IntArray, Integral
from greybox.data.checks.spans import STARTS, Spans

BLOCK = 2.0
"""Length of the blocks [s] that are left out one by one; shorter where a flight has fewer than
8."""
FEWEST_BLOCKS = 5
REACH = 0.15
"""Largest delay of a block of time from the common one [s]."""
FARTHEST = 0.5
"""Largest delay between two streams that is looked for [s]."""
LAG_STEP = 0.01
"""Steps of the lags that are tried [s], ..."""
COARSE = 0.03
"""... and of the common one."""
LEFT = 0.7
"""What another reading may leave unexplained, as a share of what the one given leaves ..."""
CLEAR = 3.0
"""... below which it must be by this many standard errors; ..."""
APART = 5.0
"""... or its correlation must be higher by this many standard errors."""
LEAST = 1e-4
"""Shares that are left below this are rounding."""
WHOLE = 1.0 - FLOOR
"""Where the reading given explains this much no other is looked for."""
SEEN = 0.25
"""A reading must explain this share of the motion."""
RATIO = 1.05
"""Factors between two streams are said from here on."""
ANGLES = (5.0, 9.0)
"""Rotations [deg] that are worth a warning, and that block: no craft is mounted like that."""

MOST_KNOWN = 1024
"""Searches that are remembered: those of some ten flights."""

Matrix = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Reading:
    """One reading of the columns: what it says ("" for the one given), how to mend the columns, and
    what it makes equal: increments y (M, 3) over spans, and those of the integral x."""

    text: str
    fix: str
    y: FloatArray
    x: Integral


@dataclass(frozen=True, kw_only=True, eq=False)
class Moments:
    """Sums over blocks of time of one reading: y x^T (B, 3, 3), y^2 and x^2 (B, 3). `lag` [s] is
    the median delay, positive where y is late against x."""

    cross: FloatArray
    yy: FloatArray
    xx: FloatArray
    lag: float

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return int(self.cross.shape[0])

    @functools.cached_property
    def left_out(self) -> Moments:
        """The sums of all blocks but one, for each block."""
        return Moments(
            cross=self.cross.sum(axis=0) - self.cross,
            yy=self.yy.sum(axis=0) - self.yy,
            xx=self.xx.sum(axis=0) - self.xx,
            lag=self.lag,
        )

    @functools.cached_property
    def total(self) -> Moments:
        """The sums over all blocks, as one block."""
        return Moments(
            cross=self.cross.sum(axis=0)[None],
            yy=self.yy.sum(axis=0)[None],
            xx=self.xx.sum(axis=0)[None],
            lag=self.lag,
        )

    def correlation(self, turn: Matrix, rows: Sequence[int] = (0, 1, 2)) -> FloatArray:
        """Correlation (B,) of these rows of y with those of the turned x."""
        at = list(rows)
        size = self.yy[:, at].sum(axis=1) * (self.xx @ (turn[at] ** 2).T).sum(axis=1)
        product = np.einsum("ij,bij->b", turn[at], self.cross[:, at])
        return product / np.sqrt(np.maximum(size, 1e-300))

    def share(self, turn: Matrix, rows: Sequence[int] = (0, 1, 2)) -> FloatArray:
        """Share (B,) of these rows of y that the turned x explains up to a factor above zero."""
        return np.maximum(self.correlation(turn, rows), 0.0) ** 2

    def rotation(self) -> Matrix:
        """The rotation that takes x closest to y (B = 1)."""
        left, _, right = np.linalg.svd(self.cross[0])
        turn = np.diag([1.0, 1.0, float(np.sign(np.linalg.det(left @ right)) or 1.0)])
        return np.asarray(left @ turn @ right, dtype=np.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class Tried:
    """A reading with its sums; `mixed` with those of the reading given where both foretell one
    y."""

    text: str
    fix: str
    sums: Moments
    mixed: Mixture | None = None


def joined(parts: Sequence[Moments]) -> Moments:
    """The blocks of several flights together, each at its own lag."""
    return Moments(
        cross=np.concatenate([p.cross for p in parts]),
        yy=np.concatenate([p.yy for p in parts]),
        xx=np.concatenate([p.xx for p in parts]),
        lag=float(np.median([p.lag for p in parts])),
    )


def _rows(
    y: FloatArray, x: Sequence[Integral], spans: Spans, dt: float, lags: IntArray
) -> tuple[IntArray, IntArray] | None:
    """(spans over which y, and x at all of these lags [samples], are known; where blocks of them
    start); None where fewer than `FEWEST_BLOCKS` blocks are left."""
    there = np.isfinite(y).all(axis=1)
    for of in x:
        for lag in lags.tolist():
            there &= spans.known(of, lag)
    which = np.flatnonzero(there)
    starts = _blocks(spans.rows[which, 0], dt)
    return None if starts is None else (which, starts)


def _blocks(rows: IntArray, dt: float) -> IntArray | None:
    """Where blocks of time start in increasing rows; None where there are too few."""
    if rows.size < 20:
        return None
    length = max(min(BLOCK / dt, (rows[-1] - rows[0]) / 8.0), 1.0)
    starts = np.flatnonzero(np.diff(rows // length, prepend=-1.0) > 0)
    return starts if starts.size >= FEWEST_BLOCKS else None


def long_enough(rows: int, dt: float, span: int, reach: float) -> bool:
    """Whether so many rows are enough for lags within `reach` [s] where none is missing."""
    most = round(reach / dt)
    return _blocks(np.arange(most, rows - span - most, max(1, span // STARTS)), dt) is not None


def _lags(dt: float, reach: float, centre: float = 0.0, step: float = LAG_STEP) -> IntArray:
    """The lags within `reach` [s] of the centre that are tried, a `step` [s] apart [samples]."""
    most, step = round(reach / dt), max(1, round(step / dt))
    return round(centre / dt) + step * np.arange(-(most // step), most // step + 1)


def mixed(given: Reading, other: Reading, spans: Spans, dt: float, lag: float) -> Mixture | None:
    """Sums that say where y stands between two readings of it, at one lag [s]; None where y is not
    the same, or too few spans are left."""
    if other.y is not given.y:
        return None
    late = round(lag / dt)
    found = _rows(given.y, (given.x, other.x), spans, dt, np.array([late]))
    if found is None:
        return None
    which, starts = found
    y, *x = (
        spans.without_bias(v, which)
        for v in (given.y[which], *(spans.among(r.x, late, which) for r in (given, other)))
    )
    # The way between two readings is not one between sizes: a position in mm is no other frame.
    size = float(np.sqrt((x[0] ** 2).sum() / max(float((y**2).sum()), 1e-300)))
    return mixture(size * y, x[0], x[1], starts)


_KNOWN: dict[bytes, tuple[Moments, IntArray] | None] = {}


def searched(reading: Reading, spans: Spans, dt: float) -> tuple[Moments, IntArray] | None:
    """(the sums of a reading at the delays of its blocks, the lags at which these know x, 0 among
    them); None where fewer than `FEWEST_BLOCKS` blocks are left.

    The blocks' delays lie within `REACH` of a common one, which is looked for within `FARTHEST`.
    What was searched before is known: flights are checked as files and as they are fitted, and are
    mostly the same.
    """
    numbers = (reading.y, reading.x.total, reading.x.lost, spans.rows, spans.weights)
    digest = hashlib.blake2b(f"{dt!r} {spans.centred} {[v.shape for v in numbers]}".encode())
    for v in numbers:
        digest.update(v.tobytes())
    key = digest.digest()
    if key not in _KNOWN:
        while len(_KNOWN) >= MOST_KNOWN:
            del _KNOWN[next(iter(_KNOWN))]
        _KNOWN[key] = _searched(reading, spans, dt)
    return _KNOWN[key]


def _searched(reading: Reading, spans: Spans, dt: float) -> tuple[Moments, IntArray] | None:
    """As `searched`."""
    centre = _centre(reading, spans, dt)
    found = _around(reading, spans, dt, centre) or _around(reading, spans, dt, 0.0)
    for _ in range(round(FARTHEST / REACH)):
        if found is None or at_the_edge(found[0].lag):
            break
        if abs(found[0].lag - centre) < REACH - 1.5 * LAG_STEP:
            break
        centre = found[0].lag
        found = _around(reading, spans, dt, centre) or found
    return found


def at_the_edge(lag: float) -> bool:
    """Whether a delay [s] is where the search ends: no estimate."""
    return abs(lag) > FARTHEST - 1.5 * LAG_STEP


def _around(
    reading: Reading, spans: Spans, dt: float, centre: float
) -> tuple[Moments, IntArray] | None:
    """The sums at the blocks' own lags around a common one, and the lags at which x is known."""
    lags = _lags(dt, REACH, centre)
    lags = lags[np.abs(lags) <= round(FARTHEST / dt)]
    every = np.union1d(lags, [0])
    found = moments(reading, spans, dt, lags, every)
    return None if found is None else (found, every)


def _centre(reading: Reading, spans: Spans, dt: float) -> float:
    """The delay [s] around which blocks look for theirs: none, unless one of the whole flight
    leaves far less than those near none."""
    known, lags = np.isfinite(reading.y).all(axis=1), _lags(dt, FARTHEST, step=COARSE)
    least = max(20.0, 0.5 * float((known & spans.known(reading.x, 0)).sum()))
    cross, size = np.zeros((lags.size, 3, 3)), np.full(lags.size, np.inf)
    for i, lag in enumerate(lags.tolist()):
        which = np.flatnonzero(known & spans.known(reading.x, lag))
        if which.size >= least:
            y, x = (
                spans.without_bias(v, which)
                for v in (reading.y.take(which, axis=0), spans.among(reading.x, lag, which))
            )
            cross[i], size[i] = y.T @ x, np.sqrt((y**2).sum() * (x**2).sum())
    alike = np.linalg.svd(cross, compute_uv=False).sum(axis=1) / np.maximum(size, 1e-300)
    left = 1.0 - alike**2
    near = np.abs(lags) <= round(0.5 * REACH / dt)
    best = int(np.argmin(left))
    return float(lags[best] * dt) if left[best] + LEAST < LEFT * left[near].min() else 0.0


def moments(
    reading: Reading, spans: Spans, dt: float, lags: IntArray, known_at: IntArray
) -> Moments | None:
    """The sums of a reading over the spans at which x is known at all lags `known_at` [samples];
    None where fewer than `FEWEST_BLOCKS` blocks are left.

    Clocks wander, so every block has its own of the `lags`: the one at which y and x are most
    alike, in whatever axes.
    """
    found = _rows(reading.y, (reading.x,), spans, dt, known_at)
    if found is None:
        return None
    which, starts = found
    y = spans.without_bias(reading.y[which], which)
    yy = np.add.reduceat(y * y, starts, axis=0)
    cross, xx = np.zeros((lags.size, starts.size, 3, 3)), np.zeros((lags.size, starts.size, 3))
    for i, lag in enumerate(
        lags.tolist()
    ):  # one at a time: all of them together are too much memory
        x = spans.without_bias(spans.among(reading.x, lag, which), which)
        cross[i] = products(y, x, starts)
        xx[i] = np.add.reduceat(x * x, starts, axis=0)
    size = np.sqrt(yy.sum(axis=1) * xx.sum(axis=2))
    alike = np.linalg.svd(cross, compute_uv=False).sum(axis=2) / np.maximum(size, 1e-300)
    # Ties go to the smaller lag: streams that stand still are alike at any.
    best = np.argmax(alike - 1e-9 * np.abs(lags)[:, None], axis=0)
    block = np.arange(starts.size)
    at = lags[best] * dt
    weight = np.argsort(at)
    middle = np.searchsorted(np.cumsum(yy.sum(axis=1)[weight]), 0.5 * yy.sum())
    return Moments(
        cross=cross[best, block],
        yy=yy,
        xx=xx[best, block],
        lag=float(at[weight[min(middle, at.size - 1)]]),
    )


def axis_readings() -> Iterator[tuple[str, Matrix, tuple[int, ...]]]:
    """(how it is written with {0}, {1}, {2} for the axes, matrix, rows that it touches) of all
    exchanges and sign changes of three axes but none."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            turn[range(3), order] = signs
            touched = tuple(i for i in range(3) if turn[i, i] != 1.0)
            parts = [f"{{{i}}} = {'-' if signs[i] < 0 else ''}{{{order[i]}}}" for i in touched]
            if touched:
                yield ", ".join(parts), turn, touched


@dataclass(frozen=True, kw_only=True)
class Better:
    """A reading that explains the motion far better than the one given: `share` and `given_share`
    of it that they explain; `angle` [deg] and its standard error where it is a rotation by an angle
    (0 otherwise). `others` are readings that explain about as much. `sure`: it makes a fit wrong."""

    text: str
    fix: str
    share: float
    given_share: float
    angle: float = 0.0
    angle_error: float = 0.0
    others: tuple[str, ...] = ()
    sure: bool = True

    @property
    def blocks(self) -> bool:
        """Whether it is beyond what a craft can have."""
        beyond = self.angle == 0.0 or self.angle - 2.0 * self.angle_error > ANGLES[1]
        return self.sure and beyond


def jackknife(values: FloatArray) -> float:
    """Standard error of an estimate from its values (B, ...) with one block left out each."""
    n = values.shape[0]
    return float(np.sqrt((n - 1.0) / n * ((values - values.mean(axis=0)) ** 2).sum()))


EYE: Matrix = np.eye(3)


def far_better(
    better: Moments, given: Moments, turn: Matrix = EYE, rows: Sequence[int] = (0, 1, 2)
) -> tuple[float, float] | None:
    """(share that `better` explains when turned, share that `given` explains), where the first is
    clearly and far better; None where it is not.

    What the one leaves over what the other leaves must be below `LEFT`, and that by `CLEAR`
    standard errors of its logarithm; or, where what is left is mostly noise, the correlations must
    differ by `APART` standard errors.
    """
    if better.blocks != given.blocks:
        return None

    def left(one: Moments, other: Moments) -> FloatArray:
        return np.log(
            (1.0 - one.share(turn, rows) + LEAST) / (1.0 - other.share(EYE, rows) + LEAST)
        )

    def ahead(one: Moments, other: Moments) -> FloatArray:
        return one.correlation(turn, rows) - other.correlation(EYE, rows)

    more, less = better.total, given.total
    share = float(more.share(turn, rows)[0]), float(less.share(EYE, rows)[0])
    ratio = float(left(more, less)[0])
    if share[0] < SEEN or ratio > np.log(LEFT):
        return None
    parts = better.left_out, given.left_out
    clear = ratio + CLEAR * jackknife(left(*parts)) < np.log(LEFT)
    return (
        share if clear or float(ahead(more, less)[0]) > APART * jackknife(ahead(*parts)) else None
    )


def nearer(between: Mixture | None) -> bool:
    """Whether the data are far nearer to the other reading than to the one given: what it leaves of
    their difference, (1 - w)^2, is below `LEFT` of what that leaves, w^2, by `CLEAR` standard
    errors. Noise that no reading knows stands halfway."""
    if between is None:
        return False
    weight, others = between.weights()
    return bool(weight - 1.0 / (1.0 + math.sqrt(LEFT)) > CLEAR * jackknife(others))


def better_reading(
    readings: Sequence[Tried], names: tuple[str, str, str], fix: str
) -> Better | None:
    """The reading that explains the motion far better than the first, or that the data are nearer
    to.

    `names` are those of x's axes, `fix` what to do where these are exchanged or turned. Of readings
    that explain about the same the simplest is taken: another frame, then the fewest axes.
    """
    given = readings[0].sums
    share = float(given.total.share(EYE)[0])
    every: tuple[int, ...] = (0, 1, 2)
    tried = [(r, EYE, every, 0) for r in readings[1:]]
    for text, matrix, rows in axis_readings():
        tried.append(
            (Tried(text=text.format(*names), fix=fix, sums=given), matrix, rows, len(rows))
        )
    good = []
    for one, turn, rows, rank in tried:
        whole = float(one.sums.total.share(turn)[0])
        if far_better(one.sums, given, turn, rows) is not None or (
            whole > max(share, SEEN) and nearer(one.mixed)
        ):
            good.append((rank, Better(text=one.text, fix=one.fix, share=whole, given_share=share)))
    turned = _turned(given, names, fix)
    if not good:
        return turned
    most = max(b.share for _, b in good)
    alike = [(rank, -b.share, b) for rank, b in good if 1.0 - b.share < (1.0 - most) / LEFT + 0.01]
    best, *others = (c[2] for c in sorted(alike, key=lambda c: c[:2]))
    best = replace(best, others=tuple(dict.fromkeys(o.text for o in others if o.text != best.text)))
    return turned if turned is not None and 1.0 - turned.share < LEFT * (1.0 - most) else best


def _turned(sums: Moments, names: tuple[str, str, str], fix: str) -> Better | None:
    """A rotation by an angle that is clear of what mounts and noise make; None where there is
    none."""
    turn = sums.total.rotation()
    more, less = (float(sums.total.share(m)[0]) for m in (turn, EYE))
    if more < SEEN:
        return None
    vector = _vector(turn)
    parts = sums.left_out
    others = np.array(
        [
            _vector(
                Moments(
                    cross=parts.cross[i][None], yy=parts.yy[i][None], xx=parts.xx[i][None], lag=0.0
                ).rotation()
            )
            for i in range(sums.blocks)
        ]
    )
    angle, error = float(np.degrees(np.linalg.norm(vector))), float(np.degrees(jackknife(others)))
    if angle - 2.0 * error < ANGLES[0] or angle < CLEAR * error:
        return None
    axis = vector / np.linalg.norm(vector)
    which = int(np.argmax(np.abs(axis)))
    about = f"{'-' if axis[which] < 0 else ''}{'xyz'[which]}"
    if abs(axis[which]) < 0.95:
        about = "(" + ", ".join(f"{v:.2f}" for v in axis) + ")"
    text = f"{', '.join(names)} are turned by {angle:.0f} deg about {about}"
    return Better(text=text, fix=fix, share=more, given_share=less, angle=angle, angle_error=error)


def _vector(turn: Matrix) -> FloatArray:
    """Rotation vector (3,) [rad] of a rotation matrix."""
    half = (
        np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2.0
    )
    sine, cosine = float(np.linalg.norm(half)), (float(np.trace(turn)) - 1.0) / 2.0
    angle = float(np.arctan2(sine, cosine))
    if sine < 1e-6:
        # No turn, or half a turn about the axis that stays.
        values, vectors = np.linalg.eigh((turn + turn.T) / 2.0)
        return np.zeros(3) if cosine > 0 else np.pi * vectors[:, int(np.argmax(values))]
    return half / sine * angle


@dataclass(frozen=True, kw_only=True)
class Factor:
    """By which factor y is larger than x: `value`, and the range [`low`, `high`] that noise in both
    allows, from the regression of y on x to that of x on y, three standard errors wider."""

    value: float
    low: float
    high: float

    @property
    def clear(self) -> bool:
        """Whether the factor is beyond `RATIO`, either way."""
        return self.low > RATIO or self.high < 1.0 / RATIO

    def to_the(self, power: float) -> Factor:
        """The factor to a power."""
        low, high = sorted((self.low**power, self.high**power))
        return Factor(value=self.value**power, low=low, high=high)


def factor(sums: Moments, axes: Sequence[int] = (0, 1, 2)) -> Factor | None:
    """Factor of the given reading over these axes; None where they are not alike enough to tell."""
    at = list(axes)

    def sizes(m: Moments) -> tuple[FloatArray, FloatArray]:
        cross = np.asarray([m.cross[:, i, i] for i in at]).sum(axis=0)
        yy, xx = m.yy[:, at].sum(axis=1), m.xx[:, at].sum(axis=1)
        return np.log(np.maximum(cross, 1e-300) / np.maximum(xx, 1e-300)), np.log(
            np.maximum(yy, 1e-300) / np.maximum(cross, 1e-300)
        )

    first, second = (float(v[0]) for v in sizes(sums.total))
    if second - first > -np.log(SEEN):
        return None
    errors = [jackknife(v) for v in sizes(sums.left_out)]
    return Factor(
        value=float(np.exp(0.5 * (first + second))),
        low=float(np.exp(first - 3.0 * errors[0])),
        high=float(np.exp(second + 3.0 * errors[1])),
    )
