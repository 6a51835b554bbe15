"""Profile likelihood intervals of poles, for modes that the data excite so weakly that a standard
error misleads.

The standard error of a pole is about its noise over the strength of its mode. Where the strength
itself is uncertain (a near pole-zero cancellation) the estimate of it is too large on average, so
that Wald intervals are too short, and the likelihood is no parabola. A profile needs neither: it is
the set of values at which the best model whose pole is held there loses less than the chi-square
quantile of -2 log likelihood (Meeker and Escobar 1995, The American Statistician 49(1)). Under
model error the quantile is multiplied by the ratio of robust to Fisher variance (Kent 1982,
Biometrika 69(1)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
import scipy.linalg as sla

from greybox.errors import DataError, GreyboxError
from greybox.linear.fit import LinearFit
from greybox.linear.parametrisation import Free
from greybox.linear.pem import Nuisance, Settings, Solution, minimise
from greybox.linear.predictor import from_full_vector, full_vector
from greybox.linear.records import Record, prepare
from greybox.linear.uncertainty import ComplexEstimate
from greybox.model.matrices import Matrices
from greybox.statistics.distributions import chi_square_quantile
from greybox.symbolic import FloatArray

Quantity = Literal["real", "imag", "magnitude", "angle"]
"""What of a pole is held or profiled: real or imaginary part, size, or angle [rad per sample]."""

WIDEST = 2.0
"""Distance from the estimate beyond which an interval counts as open: the unit circle is no
wider."""
CLOSE = 0.03
"""How near sqrt(ratio) must come to its quantile; 0.03 of about 2 moves an end by 1.5 % of the
half-width."""


class Mode(NamedTuple):
    """An eigenvalue of A with right and left eigenvectors (n,), scaled so that left @ right = 1."""

    value: complex
    right: np.ndarray
    left: np.ndarray


def mode_near(a: FloatArray, value: complex) -> Mode:
    """The eigenvalue of `a` nearest to `value`; of a pair the one on the side of `value`."""
    values, left, right = sla.eig(a, left=True, right=True)
    i = int(np.argmin(np.abs(values - value)))
    w, v = left[:, i].conj(), right[:, i]
    return Mode(complex(values[i]), v, w / (w @ v))


def measured(value: complex, quantity: Quantity) -> float:
    """The quantity of a pole."""
    if quantity == "real":
        return value.real
    if quantity == "imag":
        return value.imag
    return float(abs(value) if quantity == "magnitude" else np.angle(value))


def _slope(value: complex, quantity: Quantity) -> complex:
    """s with d quantity = Re(conj(s) d value); also the direction in which a pole is moved to
    change the quantity."""
    if quantity == "real":
        return 1.0
    if quantity == "imag":
        return 1.0j
    size = max(abs(value), 1e-12)
    return value / size if quantity == "magnitude" else 1.0j * value / size**2


def _error(poles: ComplexEstimate, index: int, quantity: Quantity) -> float:
    """Standard error of a quantity of one of the poles."""
    slope = _slope(complex(poles.value[index]), quantity)
    gradient = np.array([slope.real, slope.imag])
    return float(np.sqrt(gradient @ poles.covariance[index] @ gradient))


@dataclass(frozen=True, kw_only=True)
class HeldPole:
    """`Free` with one quantity of one pole held at `target`; a `Parametrisation`. `near` is where
    that pole is now."""

    base: Free
    quantity: Quantity
    target: float
    near: complex

    @property
    def system(self) -> Matrices:
        """The matrices at this point."""
        return self.base.system

    def tangent(self) -> FloatArray:
        """The free directions that leave the quantity alone to first order: (q, d - 1)."""
        free = self.base.tangent()
        n, m, p = self.system.sizes
        mode = mode_near(self.system.a, self.near)
        # A = F + K C: dA = dF + dK C + K dC, and d value = left dA right
        rows = np.hstack(
            [
                np.outer(mode.left, mode.right),
                np.zeros((n, m)),
                np.outer(mode.left, self.system.c @ mode.right),
            ]
        )
        change = np.concatenate(
            [rows.ravel(), np.outer(mode.left @ self.system.k, mode.right).ravel(), np.zeros(p * m)]
        )
        gradient = (np.conj(_slope(mode.value, self.quantity)) * (change @ free)).real
        return np.asarray(free @ sla.null_space(gradient[None]))

    def moved(self, step: FloatArray) -> HeldPole:
        """The point after a step, brought back to the target by shifting the eigenvalue alone."""
        vector = full_vector(self.system) + self.tangent() @ step
        return self._held(from_full_vector(vector, self.system.sizes), self.near)

    def started(self) -> HeldPole:
        """This point with the pole brought to the target."""
        return self._held(self.system, self.near)

    def _held(self, system: Matrices, near: complex) -> HeldPole:
        for _ in range(8):
            mode = mode_near(system.a, near)
            near = mode.value
            gap = self.target - measured(near, self.quantity)
            if abs(gap) < 1e-12:
                break
            direction = _slope(near, self.quantity)
            shift = gap * direction / abs(direction) ** 2
            change = shift * np.outer(mode.right, mode.left)
            a = system.a + (change if near.imag == 0.0 else 2.0 * change).real
            near = near + shift
            system = system._replace(a=np.asarray(a, dtype=np.float64))
        return replace(self, base=replace(self.base, system=system), near=near)


@dataclass(frozen=True, kw_only=True)
class Interval:
    """Profile likelihood interval of one quantity of one pole. An end is infinite where the
    likelihood never falls that far (the data do not bound the pole on that side).
    """

    pole: complex
    quantity: Quantity
    estimate: float
    lower: float
    upper: float
    level: float


@dataclass(frozen=True, kw_only=True)
class PoleProfile:
    """Profiles of the poles of `fit`; `records` and `start` are those of the fit at unit scale. See
    `pole_profile`."""

    fit: LinearFit
    records: Sequence[Record]
    start: Solution

    def interval(self, index: int, quantity: Quantity, *, level: float = 0.95) -> Interval:
        """Interval of a quantity of pole number `index` (order of `fit.uncertainty.poles()`).

        Raises `DataError` for an index out of range, or for the imaginary part or angle of a real
        pole.
        """
        pole, std = self._pole(index, quantity)
        quantile = float(np.sqrt(chi_square_quantile(level, 1))) * self._wider(index, quantity, std)
        at = measured(pole, quantity)
        lower, upper = (
            at + side * self._distance(pole, quantity, side, std, quantile) for side in (-1.0, 1.0)
        )
        return Interval(
            pole=pole, quantity=quantity, estimate=at, lower=lower, upper=upper, level=level
        )

    def ratio(self, index: int, quantity: Quantity, target: float) -> float:
        """By how much -2 log likelihood rises when the quantity of pole `index` is held at
        `target`; inf without a model."""
        pole, _ = self._pole(index, quantity)
        return self._rise(self._solve(pole, quantity, target, self.start))

    def _pole(self, index: int, quantity: Quantity) -> tuple[complex, float]:
        """A pole and the standard error of its quantity by the likelihood alone."""
        poles = self.fit.fisher.poles()
        if not 0 <= index < len(poles.value):
            raise DataError(f"pole {index}", expected=f"0 .. {len(poles.value) - 1}")
        value = complex(poles.value[index])
        if value.imag == 0.0 and quantity in ("imag", "angle"):
            raise DataError(
                f"the {quantity} of a real pole is not free", fix="profile its real part"
            )
        return value, _error(poles, index, quantity)

    def _wider(self, index: int, quantity: Quantity, std: float) -> float:
        """By how much robust errors are larger than `std`, those by the likelihood alone; 1 where
        there are none."""
        if self.fit.robust is None:
            return 1.0
        return max(_error(self.fit.robust.poles(), index, quantity) / max(std, 1e-300), 1.0)

    def _distance(
        self, pole: complex, quantity: Quantity, side: float, std: float, quantile: float
    ) -> float:
        """How far from the estimate the root of the ratio reaches its quantile: secant steps inside
        a bracket."""
        at = measured(pole, quantity)
        low, root_low, warm = 0.0, 0.0, self.start
        high, root_high = np.inf, np.inf
        distance = quantile * min(max(std, 1e-9), 0.1)
        for _ in range(16):
            solution = self._solve(pole, quantity, at + side * distance, warm)
            root = float(np.sqrt(self._rise(solution)))
            if abs(root - quantile) < CLOSE:
                break
            if root < quantile and solution is not None:
                low, root_low, warm = distance, root, solution
            else:
                high, root_high = distance, root
            if np.isinf(high):
                distance *= float(np.clip(quantile / max(root, 1e-3), 1.2, 3.0))
                if distance > WIDEST:
                    return np.inf
            else:
                share = (
                    0.5 if np.isinf(root_high) else (quantile - root_low) / (root_high - root_low)
                )
                distance = low + (high - low) * float(np.clip(share, 0.1, 0.9))
        return distance

    def _rise(self, solution: Solution | None) -> float:
        if solution is None:
            return np.inf
        return max(solution.evaluation.criterion - self.start.evaluation.criterion, 0.0)

    def _solve(
        self, pole: complex, quantity: Quantity, target: float, warm: Solution
    ) -> Solution | None:
        """The best model whose pole is held at the target, from `warm`; None where no stable
        predictor has it."""
        near = warm.point.near if isinstance(warm.point, HeldPole) else pole
        base = warm.point.base if isinstance(warm.point, HeldPole) else warm.point
        assert isinstance(base, Free)
        try:
            point = HeldPole(base=base, quantity=quantity, target=target, near=near).started()
            return minimise(point, self.records, Settings(tolerance=1e-2), nuisances=warm.nuisances)
        except (GreyboxError, np.linalg.LinAlgError):
            return None


def pole_profile(fit: LinearFit, records: Sequence[Record]) -> PoleProfile:
    """Prepare the profiles of a fit. `records` must be those of the fit, in the same order. Raises
    `DataError`."""
    names_u, names_y = fit.model.inputs.names, fit.model.outputs.names
    if len(records) != len(fit.records):
        raise DataError(f"{len(records)} records", expected=f"the {len(fit.records)} of the fit")
    scaled, scaling = prepare(
        records, delays=fit.model.delays, input_names=names_u, output_names=names_y
    )
    m = fit.model.matrices
    point = Free(
        system=m.scaled(scaling.input_scale, scaling.output_scale),
        noise_model=bool(np.any(m.k)),
        feedthrough=bool(np.any(m.d)),
    )
    nuisances = [
        Nuisance(x0=x0, offset=(c - scaling.output_offset) / scaling.output_scale)
        for x0, c in zip(fit.x0, fit.offsets)
    ]
    start = minimise(point, scaled, nuisances=nuisances)
    return PoleProfile(fit=fit, records=scaled, start=start)


def pole_intervals(fit: LinearFit, records: Sequence[Record]) -> tuple[Interval, ...]:
    """Profile likelihood intervals of every pole: real part, and imaginary part of the complex ones
    above the axis. Raises as `pole_profile`."""
    profile, out = pole_profile(fit, records), []
    for i, pole in enumerate(fit.uncertainty.poles().value):
        if pole.imag >= 0:
            out.append(profile.interval(i, "real"))
        if pole.imag > 0:
            out.append(profile.interval(i, "imag"))
    return tuple(out)
