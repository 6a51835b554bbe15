"""What may be learned on top of a model, one file per learner; the Gaussian process is "gp"."""

from __future__ import annotations

import inspect
from collections.abc import Callable

from greybox.errors import ModelError, UnknownNameError
from greybox.residual.learners.deep_ensemble import DeepEnsemble
from greybox.residual.learners.learner import Features, Learner
from greybox.residual.learners.neural import NeuralLastLayer
from greybox.residual.learners.random_features import RandomFeatures
from greybox.residual.learners.sparse_law import SparseLaw

__all__ = ["GP", "LEARNERS", "Features", "Learner", "learner_of"]

GP = "gp"
LEARNERS: dict[str, Callable[[], Learner]] = {
    c.name: c for c in (RandomFeatures, NeuralLastLayer, DeepEnsemble, SparseLaw)
}


def learner_of(name: str) -> Learner | None:
    """The learner of a name, or of a user's own file ("own.py:Name", which is run); None for the Gaussian process.

    Raises `UnknownNameError`, and `ModelError` for a file that cannot be run or has no learner of that name.
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
                f"making a {name.rpartition(':')[2]}: {error}", where=name, fix="a class without arguments"
            ) from None
    if not isinstance(made, Learner):
        raise ModelError(
            "not a learner",
            where=name,
            expected="a name, and features(x, y, points, seed)",
            fix="see docs/own_learner.md",
        )
    return made
