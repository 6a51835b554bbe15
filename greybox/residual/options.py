"""LearnOptions and GPOptions: all choices of learning, and of the training of a Gaussian process, in
one frozen record each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypedDict, Unpack

from greybox.errors import ModelError, UnknownNameError
from greybox.estimation.options import chosen
from greybox.residual.kernels import split_name
from greybox.residual.learners import GP, Learner
from greybox.residual.posterior import METHODS
from greybox.takes import COUNT, NATURAL, Kind, has, is_number, taken_fields

NOISE = ("white", "per-group", "auto")
PRIOR_MEANS = ("zero", "constant")


def _or_auto(kind: Kind, words: str) -> Kind:
    """What `kind` takes, in `words`, or "auto"."""
    return Kind(
        words=f'"auto" or {words}',
        fits=lambda v: v == "auto" if isinstance(v, str) else kind.fits(v),
        error=ModelError,
    )


POINTS = _or_auto(COUNT, COUNT.words)
INFLATION = _or_auto(
    Kind(words="", fits=lambda v: is_number(v) and v >= 1.0), "a factor of at least 1"
)
LEARNERS = Kind(
    words="a name, a file of your own (own.py:Name), or a learner",
    fits=lambda v: isinstance(v, str) or has("name", "features")(v),
    error=ModelError,
)
PART = Kind(words="a share from 0 to below 1", fits=lambda v: is_number(v) and 0 <= v < 1)


class LearnChoices(TypedDict, total=False):
    """The keywords of `learn`: the fields of `LearnOptions`, which says what they mean."""

    features: Sequence[str] | None
    place: bool
    kernel: str
    points: int | str
    learner: str | Learner
    seed: int
    refit: bool


@dataclass(frozen=True, kw_only=True)
class LearnOptions:
    """All choices of learning. Raises `ModelError` and `UnknownNameError` for what there is not."""

    features: tuple[str, ...] | None = None
    """Inputs of what is learned; None: the sets of `feature_sets` compete."""
    place: bool = False
    """Whether sets with what stands in the room compete too. They do not carry over to another
    room."""
    kernel: str = "se"
    """"se", "matern32", "matern52", or "linear+" one of these."""
    points: int | str = 50
    """Number of support points, or "auto"; features of another learner."""
    learner: str | Learner = GP
    """What is learned: "gp" or another name of `greybox.residual.learners`, a file of the user's own
    ("own.py:Name", which is run), or a `Learner`."""
    seed: int = 0
    """Seed of subsets and restarts."""
    refit: bool = False
    """Whether the physics is refitted beside what is learned; kept where left-out flights want it."""

    def __post_init__(self) -> None:
        taken_fields(self, points=POINTS, learner=LEARNERS)
        split_name(self.kernel)

    @classmethod
    def of(cls, options: LearnOptions | None, choices: LearnChoices) -> LearnOptions:
        """`options` (None: the defaults) with the `choices` in place of its own. Raises
        `UnknownNameError`."""
        return chosen("option of learning", cls, options, choices)

    def but(self, **choices: Unpack[LearnChoices]) -> LearnOptions:
        """These options with other `choices`. Raises `UnknownNameError`."""
        return LearnOptions.of(self, choices)


class GPChoices(TypedDict, total=False):
    """The keywords of `train_gp`: the fields of `GPOptions`, which says what they mean."""

    kernel: str
    method: str
    points: int | str
    seed: int
    restarts: int
    noise: str
    noise_inflation: str | float
    share_kernel: bool
    prior_mean: str
    subset: int
    hold_out: float
    polish: bool
    guard: bool
    epochs: int


@dataclass(frozen=True, kw_only=True)
class GPOptions:
    """All choices of a training. Raises `UnknownNameError` and `ModelError` for what there is
    not."""

    kernel: str = "se"
    """"se" (ARD), "matern32", "matern52", or "linear+" one of these."""
    method: str = "sgpr"
    """"sgpr" (all data projected on the support points), "svgp" (the same start, then `epochs` of
    mini-batches) or "exact" (every sample a support point)."""
    points: int | str = 100
    """Number of support points, or "auto": the smallest whose held-out NLPD is as good as the
    best."""
    seed: int = 0
    """Seed of subsets, restarts and held-out samples."""
    restarts: int = 2
    """Starts of the marginal likelihood."""
    noise: str = "white"
    """"white", "per-group", or "auto" (per group where the BIC says so)."""
    noise_inflation: str | float = "auto"
    """"auto" (integrated autocorrelation time of the standardised errors within groups), or a
    factor."""
    share_kernel: bool = False
    """One kernel for all outputs, which is cheaper to evaluate."""
    prior_mean: str = "zero"
    """"zero" (what is far from the data is left to the physics) or "constant" (the training
    mean)."""
    subset: int = 400
    """Samples of the exact likelihood."""
    hold_out: float = 0.25
    """Share of the samples, in whole groups, that judges whether the GP beats a constant; 0: no
    judgement."""
    polish: bool = False
    """Gradient polish of support points and hyper-parameters."""
    guard: bool = False
    """Raise a sparse variance to the full GP's (`sparse.variance_guard`); else it is the sparse
    posterior's own, as GPyTorch has it."""
    epochs: int = 5
    """Passes over the data of "svgp"."""

    def __post_init__(self) -> None:
        taken_fields(
            self,
            points=POINTS,
            noise_inflation=INFLATION,
            hold_out=PART,
            subset=COUNT,
            restarts=NATURAL,
            epochs=NATURAL,
        )
        split_name(self.kernel)
        for kind, value, known in (
            ("GP method", self.method, METHODS),
            ("noise model", self.noise, NOISE),
            ("prior mean", self.prior_mean, PRIOR_MEANS),
        ):
            if value not in known:
                raise UnknownNameError(kind, value, known)

    @classmethod
    def of(cls, options: GPOptions | None, choices: GPChoices) -> GPOptions:
        """`options` (None: the defaults) with the `choices` in place of its own. Raises
        `UnknownNameError`."""
        return chosen("option of a Gaussian process", cls, options, choices)

    def but(self, **choices: Unpack[GPChoices]) -> GPOptions:
        """These options with other `choices`. Raises `UnknownNameError`."""
        return GPOptions.of(self, choices)
