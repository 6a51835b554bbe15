"""Attainable: how far a bare model comes that learned what it misses, for comparison."""

from __future__ import annotations

from greybox.data import Dataset
from greybox.errors import FitError
from greybox.model.identified import IdentifiedModel
from greybox.residual.learn import learn_checked
from greybox.validation.gap import Squares
from greybox.validation.judges import Judges


def attainable(bare: IdentifiedModel, data: Dataset, judges: Judges, seed: int) -> Squares:
    """Squared errors ahead on flights that judge of the `bare` model with a Gaussian process that
    learned from `data`. Raises `GreyboxError` where nothing can be learned or foretold."""
    errors = judges.errors(learn_checked(bare, data, seed=seed).model)
    if errors is None:
        raise FitError("the model with what it learned foretells nothing")
    return errors.own
