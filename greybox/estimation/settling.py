"""Gains of a filter over a record: from the covariance that its start has until they have settled,
then the settled ones.

The covariance of the predicted state runs on the linearisation at the reference point, from the
spread of the start, over the samples with their channels (`greybox.estimation.elements`). It is
followed sample by sample first, then at times that grow in proportion, each taken in the middle of
the stretch of samples that it stands for: without process noise a filter never settles, its gain
falls like 1/k (recursive least squares; Ljung 1999, System Identification, sec. 11.2), and log2(n)
stretches with a few nodes each follow it. The nodes depend on sample numbers only, so that
derivatives are exact.

Channels that come at a lower rate repeat in a pattern of L samples. The settled covariance is then
periodic (Bittanti, Colaneri and De Nicolao 1991, The Riccati Equation, ch. 6): one per phase. Where
channels are missing without a pattern the covariance is that of the channels that are usually
there, and every sample gets the gain of those it has.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from greybox.errors import FitError
from greybox.estimation.channel_pattern import Pattern
from greybox.estimation.elements import Element, System
from greybox.estimation.gain import (
    Riccati,
    SystemSamples,
    extended,
    linearisation_anywhere,
    rows_of,
    smith,
    stationary,
)
from greybox.estimation.record import Record
from greybox.estimation.recursion import GainTable, IntArray
from greybox.model.dynamics import Dynamics
from greybox.symbolic import BoolArray, FloatArray

FIRST = 8
"""Samples at the start whose covariances are followed one by one."""
STRETCHES = 2
"""Stretches of one gain in every doubling of time after them: within one P ~ 1/k changes by a fifth
about its middle."""
PHASES = 1
"""The same where every stretch has a gain for each phase of a pattern."""
SETTLED = 1e-6
"""Relative difference to the settled gain from which on it is that one. A wrong gain costs the
square of that."""
TOLD = 0.5
"""Standard deviation of an error of the start, given the first samples, in units of that without
them, below which the filter carries it. Of the others (heading without a compass, tilt or velocity
that show late) the linearisation knows too little: they are unknowns, and the flight itself tells
them."""
SOON = 0.1
"""Seconds that count as first, as where records are made."""
READINGS = 4
"""Readings of every channel that count as first, at least."""
NOTHING = 1e-6
"""Share of the pseudo-measurement's spread (100 times that of a start) that counts as no error of a
state."""


@dataclass(frozen=True, kw_only=True)
class Stretch:
    """Samples `begin` to `end` whose covariances are those of the samples from `node` on, phase by
    phase."""

    begin: int
    end: int
    node: int


def one_by_one(length: int) -> int:
    """Samples at the start that are followed one by one: at least `FIRST`, whole patterns of
    `length`."""
    return -(-FIRST // length) * length


def stretches(n: int, length: int) -> Iterator[Stretch]:
    """The stretches of n samples with a pattern of `length`, see `FIRST`, `STRETCHES` and
    `PHASES`."""
    whole = one_by_one(length)
    for t in range(min(whole, n)):
        yield Stretch(begin=t, end=t + 1, node=t)
    count, part = whole // length, STRETCHES if length == 1 else PHASES
    while count * length < n:
        size = 1 << max(0, (count // part).bit_length() - 1)
        yield Stretch(
            begin=count * length,
            end=min((count + size) * length, n),
            node=(count + size // 2) * length,
        )
        count += size


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordGains:
    """Filter of one record: `solutions` and, for every sample, the row of the tables made of them.

    `rows` (n_row) pairs of a solution's place and the channels there (as in `Record.patterns`);
    `pattern` (n,); `columns` (n_s,) as in `Settling`.
    """

    solutions: tuple[Riccati, ...]
    rows: tuple[tuple[int, FloatArray], ...]
    pattern: IntArray
    columns: BoolArray | None = None

    def tables(self) -> tuple[GainTable, FloatArray, tuple[FloatArray, ...] | None]:
        """(gains, covariances (n_row, n_e, n_e), their slopes per row (n_s, n_e, n_e))."""
        parts = rows_of([(self.solutions[i], there) for i, there in self.rows])
        k = np.array([v.K for v in parts])
        s = np.array([v.S for v in parts])
        zero = np.array([not there.any() for _, there in self.rows], dtype=np.int32)
        slopes = [(v.dK, v.dS) for v in parts if v.dK is not None and v.dS is not None]
        if not slopes:
            return GainTable(gain=k, zero=zero), s, None
        dk, ds = tuple(dk for dk, _ in slopes), tuple(self._whole(ds) for _, ds in slopes)
        columns = self.columns
        moving = None if columns is None else np.flatnonzero(columns).astype(np.int32)
        return GainTable(gain=k, zero=zero, derivative=dk, moving=moving), s, ds

    def _whole(self, slope: FloatArray) -> FloatArray:
        """Slopes in all unknowns, zero in those that do not move the filter."""
        if self.columns is None or self.columns.all():
            return slope
        whole = np.zeros((self.columns.size, *slope.shape[1:]))
        whole[self.columns] = slope
        return whole

    @property
    def covariances(self) -> FloatArray:
        """Covariance of the predicted state per row of the tables, (n_row, n_d, n_d)."""
        return np.array([self.solutions[i].P for i, _ in self.rows])

    @property
    def there(self) -> BoolArray:
        """Channels that are measured per row of the tables, (n_row, n_e)."""
        return np.array([there != 0 for _, there in self.rows])


def held(solution: Riccati, record: Record) -> RecordGains:
    """The filter of a record with one covariance from its first sample to its last."""
    rows = tuple((0, there) for there in record.patterns)
    return RecordGains(solutions=(solution,), rows=rows, pattern=record.pattern)


@dataclass(frozen=True, kw_only=True, eq=False)
class Settling:
    """The filter of one linear system, and how it gets there from a start. Not for several threads
    at once.

    values (A, G, C, D), q, r, weak, slopes, dq, dr as in `greybox.estimation.gain.stationary`;
    `columns` (n,): the slopes are those in the unknowns where it is true, the others (n in all) do
    not move the filter. Raises `FitError` where there is no stationary filter.
    """

    values: tuple[FloatArray, ...]
    q: FloatArray
    r: FloatArray
    weak: FloatArray
    slopes: tuple[FloatArray, ...] | None = None
    dq: FloatArray | None = None
    dr: FloatArray | None = None
    columns: BoolArray | None = None
    _known: dict[bytes, list[Riccati]] = field(default_factory=dict)
    _walks: dict[tuple[bytes, bytes, bytes], _Walk] = field(default_factory=dict)
    _elements: dict[bytes, list[Element]] = field(default_factory=dict)

    def settled(self, pattern: Pattern | None = None) -> list[Riccati]:
        """The solution for every phase of a pattern; of all channels all the time without one."""
        usual = pattern is None or bool(pattern.there.all())
        key = b"" if usual or pattern is None else pattern.there.tobytes()
        if key not in self._known:
            if usual or pattern is None:
                self._known[key] = [self._always()]
            elif pattern.ahead:
                # Flights whose slow channels come at other samples share what is the same.
                same, n = self.settled(pattern.turned(pattern.ahead)), pattern.length
                self._known[key] = [same[(j - pattern.ahead) % n] for j in range(n)]
            else:
                self._known[key] = self._periodic(pattern)
        return self._known[key]

    def gains(self, record: Record, spread: FloatArray | None) -> RecordGains:
        """The filter of a record, from the standard deviations `spread` (n_d,) of the errors of its
        start (infinite: the stationary one of a Gauss-Markov state under its noise); without them
        as if it had always run."""
        pattern = record.usual
        solutions = list(self.settled(pattern))
        node = np.arange(record.n) % len(solutions)
        if spread is not None:
            early, at = self._early(record, pattern, spread)
            node = np.where(at >= 0, at + len(solutions), node)
            solutions += early
        few = record.patterns
        pair = node * len(few) + record.pattern
        there = np.bincount(pair) > 0
        rows = tuple((int(i) // len(few), few[int(i) % len(few)]) for i in np.flatnonzero(there))
        return RecordGains(
            solutions=tuple(solutions),
            rows=rows,
            pattern=(np.cumsum(there) - 1)[pair].astype(np.int32),
            columns=self.columns,
        )

    def _always(self) -> Riccati:
        return stationary(self.values, self.q, self.r, self.weak, self.slopes, self.dq, self.dr)

    def told(self, record: Record) -> BoolArray:
        """Which errors of a record's start (n_d,) its first samples tell, as far as the
        linearisation knows."""
        pattern = record.usual
        cycles = max(READINGS, round(SOON / record.dt) // pattern.length)
        e = self.cycle(pattern, (cycles - 1).bit_length())
        sigma = record.x0_sigma / self._unit
        # The pseudo-measurement tells nothing of a start: it is a hundred times as wide.
        after = np.linalg.inv(np.eye(sigma.size) + sigma[:, None] * e.G * sigma)
        return np.asarray(np.diag(after) < TOLD**2)

    # ------------------------------------------------------------ covariances

    @functools.cached_property
    def _samples(self) -> SystemSamples:
        return SystemSamples(
            values=self.values,
            q=self.q,
            r=self.r,
            slopes=self.slopes,
            dq=self.dq,
            dr=self.dr,
        )

    @functools.cached_property
    def _unit(self) -> FloatArray:
        return np.sqrt(self.weak)

    @functools.cached_property
    def _system(self) -> System:
        a, g, c, d = self.values
        slopes = None
        if self.slopes is not None and self.dq is not None and self.dr is not None:
            da, dg, dc, dd = (extended(v, self.dq.shape[0]) for v in self.slopes)
            slopes = da, dg, dc, dd, self.dq, self.dr
        system = System(a=a, g=g, c=c, d=d, q=self.q, r=self.r, weak=self.weak, slopes=slopes)
        return system.scaled(self._unit)

    def element(self, there: BoolArray, times: int = 0) -> Element:
        """2^times samples with the channels `there`."""
        known = self._elements.setdefault(there.tobytes(), [])
        if not known:
            known.append(self._system.element(there))
        while len(known) <= times:
            known.append(known[-1].then(known[-1]))
        return known[times]

    def cycle(self, pattern: Pattern, times: int = 0) -> Element:
        """2^times repetitions of a pattern."""
        if pattern.length == 1:
            return self.element(pattern.there[0], times)
        known = self._elements.setdefault(b"cycle" + pattern.there.tobytes(), [])
        if not known:
            steps = [
                e for begin, size in pattern.runs for e in self._steps(pattern.there[begin], size)
            ]
            known.append(functools.reduce(Element.then, steps))
        while len(known) <= times:
            known.append(known[-1].then(known[-1]))
        return known[times]

    def _steps(self, there: BoolArray, count: int) -> list[Element]:
        """Elements that together are `count` samples with the channels `there`."""
        return [self.element(there, i) for i in range(count.bit_length()) if count >> i & 1]

    def solution(self, p: FloatArray, dp: FloatArray | None) -> Riccati:
        """What gains need from `p` and `dp` in units of the pseudo-measurement."""
        square = np.outer(self._unit, self._unit)
        return self._samples.at(p * square, None if dp is None else dp * square)

    def _begun(self, spread: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """(P, dP) of a start, see `gains`, in units of the pseudo-measurement."""
        own = np.flatnonzero(np.isinf(spread))
        variance, slope = kept_up(self.values, self.q, own), self._zero()
        square = np.where(np.isinf(spread), 0.0, spread) ** 2
        square[own] = variance
        if slope is not None and self.slopes is not None and self.dq is not None:
            da, dg = (extended(v, self.dq.shape[0]) for v in self.slopes[:2])
            a, g = self.values[0][own, own], self.values[1][own]
            fresh = self.dq @ (g**2).T + 2 * (g * dg[:, own]) @ self.q
            moved = (fresh + 2 * a * da[:, own, own] * variance) / (1 - a**2)
            slope[:, own, own] = moved / self.weak[own]
        return np.diag(square / self.weak), slope

    def _zero(self) -> FloatArray | None:
        if self.dq is None:
            return None
        n = self.weak.size
        return np.zeros((self.dq.shape[0], n, n))

    def _periodic(self, pattern: Pattern) -> list[Riccati]:
        cycle = self.cycle(pattern)
        p = cycle.settled()
        if p is None:
            raise FitError(
                "the Riccati equation of the predictor has no stationary solution",
                fix="measure the states that drift, or use the extended Kalman filter predictor",
            )
        _, dp = cycle.moved(p, self._zero())
        if dp is not None:
            dp = smith(cycle.closed(p), dp)
        return self.phases(p, dp, pattern, [(i, 1) for i in range(pattern.length)])[0]

    def phases(
        self,
        p: FloatArray,
        dp: FloatArray | None,
        pattern: Pattern,
        parts: Sequence[tuple[int, int]],
    ) -> tuple[list[Riccati], FloatArray, FloatArray | None]:
        """(solutions in the middle of `parts`, see `Pattern`, P and dP one pattern later), from P
        before the first phase."""
        found = []
        for begin, size in parts:
            there = pattern.there[begin]
            for e in self._steps(there, size // 2):
                p, dp = e.moved(p, dp)
            found.append(self.solution(p, dp))
            if pattern.length > 1:
                for e in self._steps(there, size - size // 2):
                    p, dp = e.moved(p, dp)
        return found, p, dp

    def _early(
        self, record: Record, pattern: Pattern, spread: FloatArray
    ) -> tuple[list[Riccati], npt.NDArray[np.intp]]:
        """(solutions before the filter has settled, which of them every sample (n,) has; -1:
        settled).

        Records that start alike share them.
        """
        length, settled = pattern.length, self.settled(pattern)
        first = one_by_one(length)
        actual = np.asarray(record.mask[:first] != 0)
        key = spread.tobytes(), actual.tobytes(), pattern.there.tobytes()
        if key not in self._walks:
            p, dp = self._begun(spread)
            self._walks[key] = _Walk(settling=self, pattern=pattern, actual=actual, p=p, dp=dp)
        walk = self._walks[key]
        at = np.full(record.n, -1, dtype=np.intp)
        place, middle = 0, [begin + size // 2 for begin, size in pattern.parts]
        part = np.repeat(np.arange(len(middle)), [size for _, size in pattern.parts])
        for stretch in stretches(record.n, length):
            rows = np.arange(stretch.begin, stretch.end)
            early = stretch.begin < first
            if place == len(walk.found):
                walk.go_on(stretch.node, whole=not early)
            if early:
                at[rows] = place
                place += 1
                continue
            new = walk.found[place : place + len(middle)]
            if all(self._alike(a, settled[j]) for a, j in zip(new, middle, strict=True)):
                break
            at[rows] = place + part[rows % length]
            place += len(middle)
        return walk.found[:place], at

    def _alike(self, one: Riccati, settled: Riccati) -> bool:
        """Whether gains and innovation covariances agree to `SETTLED`."""
        s = np.sqrt(np.diag(settled.S))
        # A state without noise, which settles at zero (rounded: below it), counts as zero from some
        # size on.
        size = np.sqrt(np.maximum(np.diag(settled.P), 0.0)) + NOTHING * self._unit
        off_s = np.abs(one.S - settled.S) / np.outer(s, s)
        off_n = np.abs(one.N - settled.N) / np.outer(size, s)
        return bool(max(off_s.max(initial=0.0), off_n.max(initial=0.0)) <= SETTLED)


def kept_up(values: Sequence[FloatArray], q: FloatArray, own: npt.NDArray[np.intp]) -> FloatArray:
    """Stationary variances (k,) of Gauss-Markov states `own` (k,), each fed by its noise alone, of
    the linear system (A, G, ...) under process noise of variances `q` (n_w,)."""
    a, g = values[0], values[1]
    return np.asarray(g[own] ** 2 @ q / (1 - (a[np.ix_(own, own)] ** 2).sum(axis=1)))


def start_variances(record: Record, values: Sequence[FloatArray], q: FloatArray) -> FloatArray:
    """Variances (n_d,) of the errors of a record's start, see `kept_up`."""
    square, own = record.x0_sigma**2, np.flatnonzero(record.lasting)
    square[own] = kept_up(values, q, own)
    return square


def start_sigma(
    dynamics: Dynamics, record: Record, p: FloatArray, process: FloatArray
) -> FloatArray:
    """Standard deviations (n_d,) of the errors of a record's start, where the parameters are `p`
    (n_p,) and the levels of the process noise `process` (n_w,)."""
    if not record.lasting.any():
        return record.x0_sigma
    window = record.inputs[: sum(dynamics.window) + 1].T
    values = linearisation_anywhere(dynamics).values(record.x0, window, p, record.dt)
    return np.sqrt(start_variances(record, values, process**2))


@dataclass(kw_only=True, eq=False)
class _Walk:
    """The covariance `p` (with slopes `dp`) at sample `t` of the records of one start, and the
    solutions `found` so far."""

    settling: Settling
    pattern: Pattern
    actual: BoolArray  # channels of the first samples
    p: FloatArray
    dp: FloatArray | None
    t: int = 0
    found: list[Riccati] = field(default_factory=list)

    def go_on(self, node: int, whole: bool) -> None:
        """Add the solution of the sample `node`, or those of the parts of the `whole` pattern from
        there on."""
        while self.t < min(node, len(self.actual)):
            self._move(self.settling.element(self.actual[self.t]), 1)
        length = self.pattern.length
        while self.t < node:
            times = ((node - self.t) // length).bit_length() - 1
            self._move(self.settling.cycle(self.pattern, times), length << times)
        if not whole or length == 1:
            self.found.append(self.settling.solution(self.p, self.dp))
            return
        new, self.p, self.dp = self.settling.phases(
            self.p, self.dp, self.pattern, self.pattern.parts
        )
        self.found += new
        self.t += length

    def _move(self, element: Element, samples: int) -> None:
        self.p, self.dp = element.moved(self.p, self.dp)
        self.t += samples
