"""Lost commands: a row that the logger lost takes its command along, and what that command did
arrives unforeseen.

The command of such a row is taken as the one before, give or take `LOST` of the mean command: an
error du of covariance Sigma. It arrives when commands arrive, after whatever delays the model has.
With B_i = dF/du(k) and H_i = dh/du(k) seen from row k + i of the lost row k, the state i rows after
the next is off by X_i du, X_0 = B_0, and its sample by E_i du:

    E_i = C X_i + H_(i+1),   F_i = A X_i + B_(i+1),   X_(i+1) = F_i - K_i E_i
    S_i = S + w_i E_i Sigma E_i',   K_i = (A P C' + G Q D' + w_i F_i Sigma E_i') S_i^-1

the gain that is best for the state after it. (With an error that stays this is Friedland's bias,
IEEE Trans. Automatic Control 14(4), 1969; there the command would be estimated as well, here each
sample only corrects the state.) A record that runs linearly uses u(k) one row earlier, too: then
X_0 = B_0 + A B_(-1). What is left of X counts at samples that something new reaches, with a weight
w_i that is 1 but for the smallest shares (`SHARE`) and goes smoothly to 0 without any: the
likelihood stays smooth where a delay passes a whole sample, and is that of the model without the
delay where that is 0. Not followed are the noise that K_i lets in besides, rows among these that
were lost themselves, and all but the last two lost rows.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import dataclass

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.estimation.point_functions import PointFunction
from greybox.estimation.record import REACH, Record
from greybox.estimation.reference_point import (
    Fixed,
    Reference,
    ReferenceStep,
    once_per_model,
    unchanging,
)
from greybox.model.dynamics import Dynamics
from greybox.symbolic import Expr, FloatArray

LOST = 0.04
"""Standard deviation of a lost command about the one before, relative to the mean command."""
SHARE = 0.1
"""Share of a command from which on it counts in full."""


@dataclass(frozen=True, kw_only=True)
class Pushes:
    """B (m, n_d, n_u) and H (m, n_e, n_u) per standard deviation of every command, for i = 0 .. m-1
    rows after the lost one, `early` (n_d, n_u) for the row before it, and, with slopes, their
    derivatives (n_s, ...). The last is zero."""

    B: FloatArray
    H: FloatArray
    early: FloatArray
    dB: FloatArray | None = None
    dH: FloatArray | None = None
    dearly: FloatArray | None = None

    @functools.cached_property
    def weights(self) -> tuple[FloatArray, FloatArray]:
        """w (m - 1,) and its slopes (n_s, m - 1): by the squared share of the command that reaches
        state or sample then."""
        parts = (
            (self.B[:-1], self.dB if self.dB is None else self.dB[:, :-1]),
            (self.H[1:], self.dH if self.dH is None else self.dH[:, 1:]),
        )
        n = len(self.B) - 1
        square, slope = np.zeros(n), np.zeros((0 if self.dB is None else len(self.dB), n))
        for v, dv in parts:
            own = (v**2).sum(axis=(1, 2))
            whole = own.sum()
            if whole == 0:
                continue
            square += own / whole
            if dv is not None:
                d = 2 * (v * dv).sum(axis=(2, 3))
                slope += d / whole - own * d.sum(axis=1, keepdims=True) / whole**2
        part = np.minimum(square / SHARE**2, 1.0)
        return part * (2 - part), 2 * (1 - part) * slope / SHARE**2

    @functools.cached_property
    def felt(self) -> int:
        """Bits of the rows after a lost one (bit i: i rows after the next) at which anything
        arrives."""
        return sum(1 << i for i, w in enumerate(self.weights[0][:REACH]) if w > 0)


class LostCommands:
    """Derivatives of step and sample in every command that they look at, at one state, as functions
    of the parameters. They are derived when they are asked for.

    `fixed` as in `ReferenceStep.at_point`.
    """

    def __init__(self, dynamics: Dynamics, active: tuple[str, ...], fixed: Fixed = ()) -> None:
        reference = Reference(dynamics, tuple(active), fixed)
        self._functions = PointFunction(reference, "pushes", _stacked)
        self._rows = len(dynamics.error_states), len(dynamics.innovations)
        self._now = dynamics.window[0]
        self._slow = [n == "vbat" for n in dynamics.inputs.names]

    def at(
        self,
        x: FloatArray,
        window: FloatArray,
        p: FloatArray,
        dt: float,
        columns: npt.NDArray[np.int_] | None = None,
    ) -> Pushes:
        """Pushes at the state x, the command window (n_u, past + 1 + future) and the parameters p;
        with `columns` also slopes in those of the active parameters."""
        sigma = LOST * np.abs(window[:, self._now])
        sigma[self._slow] = 0.0  # the voltage is slow: the row before has it
        if columns is None:
            value = self._functions.values(x, window, p, dt)
            (b, early), (h, _) = self._unpack(value[None], sigma)
            return Pushes(B=b[0], H=h[0], early=early[0])
        value, slope = self._functions.with_slopes(x, window, p, dt)
        (b, early), (h, _) = self._unpack(value[None], sigma)
        (db, dearly), (dh, _) = self._unpack(slope[columns], sigma)
        return Pushes(B=b[0], H=h[0], early=early[0], dB=db, dH=dh, dearly=dearly)

    def _unpack(
        self, stacked: FloatArray, sigma: FloatArray
    ) -> list[tuple[FloatArray, FloatArray]]:
        """[(B, early), (H, unused)] of every row of `stacked`: (k, past + 2, n, n_u), the latest
        command first, and (k, n, n_u) for the command that comes."""
        made, at, many = [], 0, len(stacked)
        width = stacked.shape[1] // sum(self._rows)
        for rows in self._rows:
            block = stacked[:, at : at + rows * width]
            at += rows * width
            by_row = block.reshape(many, width // sigma.size, sigma.size, rows)
            by_row = by_row.transpose(0, 3, 1, 2) * sigma
            late = by_row[:, :, self._now :: -1].transpose(0, 2, 1, 3)
            none = np.zeros((many, 1, rows, sigma.size))
            made.append(
                (np.concatenate([late, none], axis=1), by_row[:, :, self._now + 1 :].sum(axis=2))
            )
        return made


def _stacked(at: ReferenceStep) -> Expr:
    """Derivatives of step and sample in the commands of the window, column by column."""
    commands = ca.vec(at.window)
    parts = [at.out @ ca.jacobian(at.after, commands), -ca.jacobian(at.e, commands)]
    return ca.vertcat(*(ca.densify(ca.vec(v)) for v in at.at_rest(parts)))


_built = once_per_model(LostCommands)


def lost_commands(
    dynamics: Dynamics,
    active: tuple[str, ...] = (),
    x: Iterable[float] = (),
    other: Iterable[float] = (),
) -> LostCommands:
    """`LostCommands`, built once per process; for the state `x` where another such state is known
    (`other` as in `greybox.estimation.gain.linearisation_at`)."""
    return _built(dynamics, tuple(active), unchanging(x, other))


def any_lost(records: Iterable[Record]) -> bool:
    """Whether a record has rows that were lost with their commands."""
    return any((r.patterns > 1).any() for r in records)
