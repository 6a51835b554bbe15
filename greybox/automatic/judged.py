"""A fit is judged, the same for Python and the commands: by flights that it did not see, or by pieces
that a fit of its own leaves out."""

from __future__ import annotations

from collections.abc import Iterable

from greybox.automatic.fit import Prepared, adaptation_of, on_pieces
from greybox.data import Dataset
from greybox.data.checks import CheckReport
from greybox.estimation.recipe import Recipe
from greybox.estimation.result import Fit
from greybox.model.verdict import Verdict
from greybox.validation.advice import hints_of
from greybox.validation.options import HorizonChoices
from greybox.validation.result import Validation
from greybox.validation.usefulness import LEFT_OUT
from greybox.validation.validate import validate


def judged(
    found: Fit,
    prepared: Prepared,
    recipe: Recipe,
    test: Dataset,
    *,
    reports: Iterable[CheckReport] = (),
    adapt: float | None = None,
    left_out: bool = True,
    horizons: HorizonChoices | None = None,
) -> tuple[Validation, Verdict | None]:
    """(validation on `test` flights where there are any, else on pieces `left_out` of those that
    were fitted, else on these; the verdict on the pieces, where there are any).

    `reports` are the checks of the test flights; `adapt` [s] is what was asked for, None: the
    recipe's own, on test flights. Of a fit that did not arrive nothing is left out. Raises
    `DataError`, `FitError`.
    """
    ahead: HorizonChoices = horizons or {}
    hints = hints_of(found, (prepared.report, *reports), kinematic_noise=recipe.kinematic_noise)
    pieces, beside = None, None
    if left_out and found.converged:
        pieces = on_pieces(found.model.physics.vehicle, prepared.data, recipe)
    if pieces is not None:
        beside = validate(*pieces, **ahead, hints=hints, judged_on=LEFT_OUT)
    if test.flights:
        seconds = adaptation_of(recipe, test, adapt)
        seen = validate(found.model, test, **ahead, adapt=seconds, hints=hints)
    elif beside is not None:
        seen = beside
    else:
        seen = validate(found.model, prepared.data, **ahead, adapt=adapt, hints=hints)
    return seen, None if beside is None else beside.verdict
