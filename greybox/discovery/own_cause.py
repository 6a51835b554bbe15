"""Own cause: what a model of the user's own may miss, for the same search as a vehicle's. Its
effects are parameters with a `null` (`greybox.model.own_effect`). What has no name is a disturbance
of every group of its process noise, and laws of that are terms of states and inputs.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

from greybox.discovery.cause import Cause, Causes
from greybox.discovery.rules import RULES
from greybox.errors import ModelError
from greybox.estimation.result import Fit
from greybox.model.dynamics import StateSpaceModel
from greybox.model.known import NOTHING, Known
from greybox.model.layer import physics_of
from greybox.model.noise import Augmented, Disturbance
from greybox.model.own_effect import (
    Terms,
    absent_value,
    declared_effects,
    with_terms,
    without_effects,
)
from greybox.model.parameter import Parameter
from greybox.residual.laws.effect_file import Law, effect_name
from greybox.residual.laws.own_file import own_law, own_law_text


@dataclass(frozen=True, kw_only=True, eq=False)
class LawCause(Cause):
    """A law of what has no name: `terms` of its parameters are added to the dynamics."""

    declared: tuple[Parameter, ...]
    terms: Terms


@dataclass(frozen=True, kw_only=True, eq=False)
class OwnCauses(Causes):
    """Those of a model of the user's own, which holds all of them."""

    model: StateSpaceModel
    _cores: dict[frozenset[str], StateSpaceModel] = field(default_factory=dict)

    def built(self, structure: Iterable[str]) -> Augmented:
        """The model of a structure, with a disturbance of every group of its process noise."""
        gone = frozenset(self.effects) - set(structure)
        if gone not in self._cores:  # one object for one structure shares what is compiled for it
            self._cores[gone] = without_effects(self.model, gone) if gone else self.model
        groups = dict.fromkeys(n.split(".")[0] for n in self.model.noises.names)
        return Augmented(core=self._cores[gone], parts=tuple(Disturbance(group=g) for g in groups))

    def with_cause(self, *more: Cause) -> Self:
        """These and further causes. Raises `ModelError`, `UnknownNameError`."""
        model = self.model
        for cause in more:
            if isinstance(cause, LawCause):
                model = with_terms(model, cause.declared, cause.terms)
        offered = {**self.offered, **{c.name: c for c in more}}
        return replace(self, model=model, offered=offered, _cores={} if more else self._cores)

    def of_laws(self, laws: Sequence[Law], taken: Collection[str]) -> list[Cause]:
        """Each as further terms, read back from its file."""
        out: list[Cause] = []
        for number, law in enumerate(laws, 1):
            declared, terms = own_law(own_law_text(law, number, taken))
            name = effect_name(law.channel, taken)
            out.append(LawCause(**vars(_cause(name, declared)), declared=declared, terms=terms))
        return out

    def law_file(self, law: Law, number: int, taken: Collection[str]) -> str:
        """A program that builds the model with the law."""
        return own_law_text(law, number, taken)


def _cause(name: str, declared: Iterable[Parameter]) -> Cause:
    prior = {d.name: (absent_value(d), RULES.typical * d.scale) for d in declared}
    return Cause(name=name, kind="effect", parameters=tuple(prior), prior=prior)


def offer_own(
    model: StateSpaceModel,
    *,
    fixed: Iterable[str] = (),
    per_flight: Iterable[str] = (),
    known: Known = NOTHING,
) -> OwnCauses:
    """The effects of a model of the user's own; none of one whose numbers are `known`.

    Raises `ModelError` for one without process noise.
    """
    if not len(model.noises):
        raise ModelError(
            "the model has no process noise that something missing could enter by",
            where=model.name,
            fix="noise_states: the states whose equations are in doubt",
        )
    declared = declared_effects(model) if known is NOTHING else {}
    offered = {n: _cause(n, ps) for n, ps in declared.items()}
    every = {p for c in offered.values() for p in c.parameters}
    held = {*fixed, *known.held}
    core = (d.name for d in model.parameters if d.sigma > 0 and d.name not in every)
    return OwnCauses(
        model=model,
        offered=offered,
        core=tuple(n for n in core if n not in held),
        unjudged={},
        per_flight=tuple(per_flight),
        known=known.prior,
        untold=known.untold,
    )


def memory_of(found: Fit | None) -> str:
    """What one-step errors of a user's own model say where they are not white; else ""."""
    white = found is None or physics_of(found.model.dynamics) or not found.covariance.coloured
    said = "errors one step ahead are NOT WHITE: a part with states of its own is missing"
    return "" if white else f"{said} (a lag, play)"
