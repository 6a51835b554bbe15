"""What may be learned on top of a model, one file per learner; the Gaussian process is "gp"."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping

from greybox.errors import ModelError, UnknownNameError
from greybox.residual.learners.deep_ensemble import DeepEnsemble
from greybox.residual.learners.learner import Features, Learner, LooksBack
from greybox.residual.learners.long_short_term_memory import LongShortTermMemory
from greybox.residual.learners.neural import NeuralLastLayer
from greybox.residual.learners.random_features import RandomFeatures
from greybox.residual.learners.sparse_law import SparseLaw
from greybox.residual.learners.temporal_convolution import TemporalConvolution
from greybox.takes import shown

__all__ = ["GP", "LEARNERS", "Features", "Learner", "LooksBack", "learner_for", "learner_of"]

GP = "gp"
LEARNERS: Mapping[str, Callable[[], Learner]] = {
    RandomFeatures.name: RandomFeatures,
    NeuralLastLayer.name: NeuralLastLayer,
    DeepEnsemble.name: DeepEnsemble,
    SparseLaw.name: SparseLaw,
    TemporalConvolution.name: TemporalConvolution,
    LongShortTermMemory.name: LongShortTermMemory,
}


def learner_of(name: str) -> Learner | None:
    """The learner of a name, or of a user's own file ("own.py:Name", which is run); None for the
    Gaussian process.

    Raises `UnknownNameError`, and `ModelError` for a file that cannot be run or has no learner of
    that name.
    """
    if name == GP:
        return None
    if name in LEARNERS:
        return LEARNERS[name]()
    if ".py:" not in name:
        raise UnknownNameError("learner", name, (GP, *LEARNERS))
    from greybox.model.own_model import run_program

    made = run_program(name)
    if inspect.isclass(made):
        try:
            made = made()
        except Exception as error:
            raise ModelError(
                f"making a {name.rpartition(':')[2]}: {error}",
                where=name,
                fix="a class without arguments",
            ) from None
    return _demanded(made, where=name)


def _demanded(made: object, where: str | None = None) -> Learner:
    """What was made or given, which is a learner. Raises `ModelError`."""
    if not isinstance(made, Learner):
        raise ModelError(
            "not a learner",
            where=where,
            expected="a name, and features(x, y, points, seed)",
            got=shown(made),
            fix="see docs/own_learner.md",
        )
    return made


def learner_for(learner: str | Learner, points: int | str, kernel: str) -> Learner | None:
    """The learner by name or as it is; None for the Gaussian process.

    Raises as `learner_of`, `ModelError` for what is no learner, and for choices that only a Gaussian
    process has.
    """
    other = learner_of(learner) if isinstance(learner, str) else _demanded(learner)
    if other is None:
        return None
    if points == "auto":
        raise ModelError(
            "points are chosen for a Gaussian process only",
            got=other.name,
            fix="give a number of points",
        )
    if kernel != "se":
        raise ModelError(
            "a kernel is for the Gaussian process",
            got=f"{kernel} beside {other.name}",
            fix="one of the two",
        )
    return other
