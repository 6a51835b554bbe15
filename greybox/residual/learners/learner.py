"""Learner: what may be learned on top of a model, as the features of a last layer that is linear.

    g_j(z) = s_j phi(x)'theta_j,   x = (z - mean)/scale,   theta_j ~ N(0, 1/strength)

A learner makes phi from what the physics missed on the training flights; everything else is common:
the weights theta are fitted by multi-step errors through the physics
(`greybox.residual.open_loop_fit`), their strength is chosen on left-out flights, their covariance
is the uncertainty, and it is calibrated and exported like that of the Gaussian process, whose
features are those of its support points. (Bayesian last layer: Snoek et al. 2015, ICML; Harrison,
Sharma and Pavone 2018, WAFR.)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol, runtime_checkable

from greybox.symbolic import Expr, FloatArray

Features = Callable[[Expr], Expr]
"""phi: a CasADi column x (n_in) of standardised inputs -> a column of features (M)."""


@runtime_checkable
class Learner(Protocol):
    """A way to make features. A user's own is a class without arguments, one file."""

    @property
    def name(self) -> str:
        """What it is called in files and tables."""

    def features(
        self, x: FloatArray, y: FloatArray, *, points: int, seed: int
    ) -> Mapping[str, Features]:
        """Candidates by name, which compete on left-out flights: x (N, n_in) standardised inputs, y
        (N, n_out) the force, torque or other push that the physics missed there, in units of its
        spread. About `points` features each."""


@runtime_checkable
class LooksBack(Learner, Protocol):
    """A learner that looks at earlier commands too; it is told what its inputs are called."""

    def lags(self, sample_time: float) -> int:
        """Earlier samples, sample_time [s] apart, of every command that it asks for."""

    def of(self, names: Sequence[str]) -> Learner:
        """The same for inputs of these names (n_in); u1[t-3] is that of three samples ago."""


@runtime_checkable
class SaysCentred(Protocol):
    """A learner that says whether its inputs are moved to zero mean."""

    @property
    def centred(self) -> bool:
        """Whether they are."""


@runtime_checkable
class SaysEnsemble(Protocol):
    """A learner that says whether its candidates are members of one ensemble."""

    @property
    def ensemble(self) -> bool:
        """Whether they are."""


def is_centred(learner: Learner) -> bool:
    """Whether its inputs are moved to zero mean: yes, unless it says `centred = False`."""
    return not isinstance(learner, SaysCentred) or bool(learner.centred)


def is_ensemble(learner: Learner) -> bool:
    """Whether its candidates are members of one ensemble: no, unless it says `ensemble = True`."""
    return isinstance(learner, SaysEnsemble) and bool(learner.ensemble)
