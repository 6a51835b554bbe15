"""Judges: flights that judge models by what these foretell, the same for all that a search asks."""

from __future__ import annotations

import contextlib
import weakref
from collections.abc import Collection
from dataclasses import dataclass, field

from greybox.data import Dataset
from greybox.errors import GreyboxError
from greybox.estimation.result import Fit
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import physics_of
from greybox.validation.against import TRACE
from greybox.validation.gap import GapRow, HeldOutErrors, Squares, gap, predict_ahead
from greybox.validation.validate import verdict_on
from greybox.validation.worth import Span, clearly_smaller, seconds

_Known = weakref.WeakKeyDictionary[IdentifiedModel, dict[bool, HeldOutErrors | None]]
"""Errors without and with what has no name, as long as somebody has the model."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Judges:
    """The `flights`, of which a model may adapt to the first `adapt` [s]; `seed` of bootstraps."""

    flights: Dataset
    adapt: float | None = None
    seed: int = 0
    _known: _Known = field(default_factory=weakref.WeakKeyDictionary)

    @property
    def samples(self) -> int:
        """How many there are."""
        return sum(f.n for f in self.flights)

    def errors(self, model: IdentifiedModel, *, unnamed: bool = False) -> HeldOutErrors | None:
        """Ahead, as `predict_ahead` gives them, once; None where the model predicts nothing."""
        known = self._known.setdefault(model, {})
        if unnamed not in known:
            found = None
            with contextlib.suppress(GreyboxError):
                adapt = self.adapt or 0.0
                found = predict_ahead(model, self.flights, adapt=adapt, unnamed=unnamed)
            known[unnamed] = found
        return known[unnamed]

    def judged(self, found: Fit) -> Fit:
        """A fit with their verdict, where they can tell."""
        seen = verdict_on(found.model, self.flights, self.adapt)
        return found if seen is None else found.judged(seen)

    def oppose(
        self,
        before: HeldOutErrors | None,
        model: IdentifiedModel,
        names: Collection[str],
        span: Span,
    ) -> bool:
        """Whether effects of a model stand against force and torque without a name: somewhere with
        them much larger errors than `before`, which what the filter sees mends; and all in all,
        within `span` [s], clearly larger ones, by more than a trace, than without all of them or
        one, all other numbers as they are.

        Where commands answer gusts, the craft itself may foretell worse by its physics alone than a
        wrong one that answers less, or a second ahead than itself without its lag; but not all in
        all.
        """
        if not any(r.doubtful for r in self.rows(before, model)):
            return False
        own, ways = self.errors(model), (names, *([n] for n in sorted(names)))
        nulls = (_at_null(model, some) for some in ways)
        bare = (self.errors(model.with_values(values)) for values in nulls if values)
        return any(old and own and clearly_smaller(seconds(own, old, span), TRACE) for old in bare)

    def rows(
        self,
        before: HeldOutErrors | None,
        model: IdentifiedModel,
        proposals: HeldOutErrors | None = None,
        attainable: Squares | None = None,
    ) -> list[GapRow]:
        """The gap from errors `before` to those of the model, with those of `proposals` and what
        is `attainable` beside; none where one of the two predicts nothing."""
        after = self.errors(model)
        if before is None or after is None:
            return []
        filtered = None
        if physics_of(model.dynamics) is not None:
            filtered = self.errors(model, unnamed=True)
        return gap(
            (before.own, before.floor),
            (after.own, after.floor),
            units=after.units,
            proposals=proposals.own if proposals else None,
            attainable=attainable,
            filtered=filtered.own if filtered else None,
            seed=self.seed,
        )


def _at_null(model: IdentifiedModel, names: Collection[str]) -> dict[str, float]:
    """The numbers with which effects of these names are not there; none for a sensor's noise."""
    return {
        d.name: min(max(d.null, d.lower), d.upper)
        for d in model.dynamics.parameters
        if d.null is not None and d.name.split(".")[0] in names
    }
