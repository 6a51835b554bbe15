"""What is learned with is a learner, of a whole number of points: anything else is said in one line
before any work."""

from __future__ import annotations

import pytest

from greybox.errors import ModelError
from greybox.residual.learners import learner_for
from greybox.residual.options import GPOptions, LearnOptions


@pytest.mark.parametrize("points", [0, -3, 2.5, "many", None])
@pytest.mark.parametrize("kind", [GPOptions, LearnOptions])
def test_points_are_a_whole_number_above_zero(
    kind: type[GPOptions | LearnOptions], points: object
) -> None:
    with pytest.raises(ModelError, match="whole number"):
        kind(points=points)
    assert kind(points=7).points == 7 and kind(points="auto").points == "auto"


@pytest.mark.parametrize("given", [3, object(), None])
def test_what_is_no_learner_is_refused(given: object) -> None:
    with pytest.raises(ModelError, match="not a learner"):
        learner_for(given, 50, "se")
