"""Then: whether a model that was identified before still foretells flights of now.

What has changed shows in that. Flights ask by their likelihood for more than has changed: for what
the model lacked from the start, as it was fitted by its errors ahead, or other manoeuvres show it.
So a model with all that is held against the one of then by what both foretell, and where it does
not foretell clearly better nothing in it is a change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from greybox.estimation.record import sample_time
from greybox.model.identified import IdentifiedModel
from greybox.statistics.blocks import clearly
from greybox.validation.gap import HeldOutErrors
from greybox.validation.judges import Judges
from greybox.validation.validate import verdict_on
from greybox.validation.worth import Span, seconds


@dataclass(frozen=True, kw_only=True, eq=False)
class Then:
    """The `model` of then on flights of now that judge, and its `errors` ahead there."""

    model: IdentifiedModel
    judges: Judges
    errors: HeldOutErrors

    @classmethod
    def on(cls, model: IdentifiedModel | None, judges: Judges) -> Self | None:
        """None where there is no model, or it predicts nothing there."""
        if model is None or not np.isclose(model.sample_time, sample_time(judges.flights)):
            return None
        errors = judges.errors(model)
        return None if errors is None else cls(model=model, judges=judges, errors=errors)

    def beats(self, new: HeldOutErrors | None, span: Span) -> bool:
        """Whether it foretells clearly better within `span` than a model whose errors are `new`."""
        return new is not None and clearly(-seconds(self.errors, new, span))

    def unchanged(self, new: HeldOutErrors | None, added: Sequence[str], span: Span) -> str:
        """In words, that a model with what is `added`, whose errors are `new`, does not foretell
        clearly better within `span`; empty where it does, or nobody knows."""
        changes = np.zeros(0) if new is None else seconds(self.errors, new, span)
        if not added or changes.size < 2 or clearly(changes):
            return ""
        now, was = (
            verdict_on(self.model, self.judges.flights, self.judges.adapt),
            self.model.verdict,
        )
        lost = now is not None and now.refused and not (was and was.refused)
        first = "CHANGED, BY NOTHING ON OFFER" if lost else "NOTHING HAS CHANGED that is felt"
        on = "" if lost else " (go on with it, not with what is written here)"
        seen = f": the model of --from{on} is {now.line} there" if now else ""
        return (
            f"{first}{seen}. What makes flights likelier does not foretell better: "
            f"{', '.join(added)} (missing from the start, or worth nothing)"
        )
