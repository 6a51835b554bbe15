"""The literal types of choices, which an editor completes, list exactly the names that a fit
takes."""

from __future__ import annotations

from typing import get_args

import pytest

from greybox.estimation import options
from greybox.estimation.criteria import CRITERIA
from greybox.estimation.predictors import PREDICTORS
from greybox.estimation.solvers import SOLVERS


@pytest.mark.parametrize(
    ("literal", "names"),
    [
        (options.PredictorName, PREDICTORS),
        (options.CriterionName, CRITERIA),
        (options.SolverName, SOLVERS),
    ],
)
def test_a_literal_lists_the_registered_names(literal: object, names: dict[str, object]) -> None:
    assert get_args(literal) == tuple(names)
