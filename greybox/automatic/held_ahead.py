"""Held ahead: which effects of a model hold where it is fitted by what it foretells.

A likelihood one sample ahead judges effects where the model is right but for them. Of a real craft
it may ask for effects with which errors ahead grow. Then the effects are fitted as plain `greybox
fit` fits them, and each is held against the same fit without it. Those go whose numbers gain less
than the logarithm of how many effects were asked for each; flights that judge say what the others
are worth.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from greybox.automatic.borrow import decide_for
from greybox.automatic.decide import Decided
from greybox.automatic.fit import Prepared, continued, fit_recipe, prepare, without_effects
from greybox.automatic.front_door import fit_as_decided
from greybox.automatic.setting import Given
from greybox.automatic.trials import QUICK, Say
from greybox.data import Dataset
from greybox.errors import FitError, GreyboxError
from greybox.estimation.fit import fit
from greybox.estimation.laplace import at_bound
from greybox.estimation.options import FitChoices, FitOptions
from greybox.estimation.result import Fit
from greybox.model.identified import IdentifiedModel
from greybox.model.model import PhysicsModel
from greybox.model.vehicle import Vehicle
from greybox.statistics.regret import information_on
from greybox.validation.judges import Judges
from greybox.validation.worth import Span, Worth, clearly, seconds, worth


@dataclass(frozen=True, kw_only=True, eq=False)
class HeldAhead:
    """The `fit` by errors ahead with the effects that hold, and what every effect that was asked is
    worth to it (None: nobody can tell, as nothing can be fitted without it)."""

    fit: Fit
    worth: Mapping[str, Worth | None]

    def held(self, name: str) -> bool:
        """Whether an effect that was asked is in the model of the fit."""
        return name in self.fit.model.effects


def held_ahead(
    model: PhysicsModel,
    asked: Sequence[str],
    data: Dataset,
    judges: Judges,
    span: Span,
    most: int,
    *,
    fixed: Sequence[str] = (),
    per_flight: Sequence[str] = (),
    say: Say = lambda text: None,
) -> HeldAhead | None:
    """The effects of `model` fitted to `data` by errors ahead, without those of the `asked` that
    these do not need, `most` at most, and what the others are worth `span` [s] ahead on flights
    that judge.

    What is `fixed` and `per_flight` (none: decided) holds for all fits. None where nothing can be
    fitted. Raises `DataError`, `ModelError`.
    """
    choices = FitChoices(fixed=fixed) if fixed else FitChoices()
    choices |= FitChoices(per_flight=per_flight) if per_flight else FitChoices()
    prepared = prepare(
        model.vehicle,
        data,
        keep_impossible=True,
        all_flights=True,
        decide_rate=False,
        keep_noise_free=True,
    )
    given = Given(
        effects=tuple(e for e in model.effects if e.name not in model.vehicle.effects),
        input=model.input,
        kinematic_noise=model.kinematic_noise,
        adapt=judges.adapt,
        choices=choices,
    )
    with contextlib.suppress(FitError):
        vehicle, decided = decide_for(model.vehicle, prepared, given)
        race = _Race(
            vehicle=vehicle,
            prepared=prepared,
            decided=decided,
            judges=judges,
            span=span,
            price=float(np.log(len(asked))),
        )
        return _raced(race, list(asked), most, say)
    return None


def _raced(race: _Race, asked: list[str], most: int, say: Say) -> HeldAhead:
    """What stays of the `asked`, `most` at most. Raises `FitError`."""
    say("the effects fitted by errors ahead")
    held = whole = race.fitted(())
    left, told = asked, dict[str, Worth | None]()
    while bound := [n for n in left if _at_bound(held, n)]:
        held = race.without(held, bound, say).fit or held
        left = [n for n in left if n not in bound]
        told |= dict.fromkeys(bound)
    wanted = [n for n in left if race.doubted(held, n)]
    while wanted:
        rows = {n: race.without(held, [n], say) for n in wanted}
        told |= {n: row.worth for n, row in rows.items()}
        wanted = sorted((n for n in wanted if rows[n].idle), key=lambda n: rows[n].gain)
        going, less = wanted, race.without(held, wanted, say) if len(wanted) > 1 else None
        if less is None or not less.idle:  # some stand for each other
            going, less = wanted[:1], rows[wanted[0]] if wanted else None
        if less is not None:
            held = less.fit or held
        left, wanted = ([n for n in some if n not in going] for some in (left, wanted))
    while True:
        if gone := [n for n in asked if n not in left]:
            say(f"the effects fitted by errors ahead, without {', '.join(gone)}")
            whole = race.fitted(gone)
        rows = {n: race.without(whole, [n], say) for n in left}
        told |= {n: row.worth for n, row in rows.items()}
        least = min(left, key=lambda n: rows[n].gain, default=None)
        if least is None or not (rows[least].idle or len(left) > most):
            return HeldAhead(fit=whole, worth=told)
        left = [n for n in left if n != least]


def _at_bound(held: Fit, name: str) -> bool:
    """Whether an effect ran to a bound: all of it to its absence (where the automatic fit holds it,
    and estimates nothing of it), or a number of it elsewhere, as it stands for something else."""
    null = {d.name: d.null for d in held.model.dynamics.parameters}
    own = held.of_effect(name)
    absent = [e.at_bound and e.value == null.get(n) for n, e in own.items()]
    bound = [e.at_bound for e in own.values()]
    return all(absent) or bound != absent


def is_bent(
    found: Fit,
    data: Dataset,
    judges: Judges,
    span: Span,
    least: float,
    lawful: IdentifiedModel | None = None,
) -> bool:
    """Whether the likelihood of `data`, which a fit was found by, bends its model: fitted by errors
    ahead the same model foretells flights that judge clearly better, and by the `least` share of
    the squared error on average, `span` [s] ahead. So nobody believes that these effects and gusts
    made the flights. `lawful` is the model of a fit with laws beside, which then has to foretell as
    well."""
    model = found.model
    options = FitOptions(
        predictor="multi-step",
        solver=QUICK,
        free=tuple(found.parameters),
        per_flight=tuple(n for n, e in found.parameters.items() if e.scope != "shared"),
        initialisation="nominal",
    )
    try:
        ahead = fit(model.dynamics, data, continued(options, found)).model
    except GreyboxError:
        return False
    old, new = judges.errors(lawful or model), judges.errors(ahead)
    gains = np.zeros(0) if old is None or new is None else seconds(old, new, span)
    return clearly(gains) and float(gains.mean()) > least / (2.0 - least)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Without:
    """The fit without some effects, None where nothing can be fitted, and what they are worth to
    the fit with them; `gain` is what its cost loses by them, less the price of their numbers."""

    fit: Fit | None = None
    worth: Worth | None = None
    gain: float = np.inf

    @property
    def idle(self) -> bool:
        """Whether flights that are fitted do without them."""
        return self.fit is not None and self.gain <= 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class _Race:
    """The craft, its flights, and how all effects together are fitted as `decided`; a number costs
    the `price`."""

    vehicle: Vehicle
    prepared: Prepared
    decided: Decided
    judges: Judges
    span: Span
    price: float

    def fitted(self, gone: Sequence[str]) -> Fit:
        """The automatic fit with all effects but those that are `gone`."""
        recipe = without_effects(self.decided.recipe, gone)
        return fit_as_decided(self.vehicle, self.prepared, replace(self.decided, recipe=recipe))

    def doubted(self, held: Fit, name: str) -> bool:
        """Whether a fit may do without an effect: what its cost would lose, to second order, is
        below three times the price of its numbers."""
        null = {d.name: d.null for d in held.model.dynamics.parameters}
        unknowns, value = held.problem.unknowns, held.problem.evaluate(held.theta)
        own = [i for i, u in enumerate(unknowns) if u.name in held.of_effect(name)]
        zero = [null[unknowns[i].name] for i in own]
        stuck = at_bound(held.problem, held.theta, value)
        if value.hessian is None or not own or None in zero or stuck[own].any():
            return True
        rest = [i for i in np.flatnonzero(~stuck).tolist() if i not in own]
        off = held.theta[own] - np.array(zero, dtype=float)
        loss = 0.5 * float(off @ information_on(value.hessian, own, rest) @ off)
        return loss < 3 * len(held.of_effect(name)) * self.price

    def without(self, held: Fit, names: Sequence[str], say: Say) -> _Without:
        """What effects `names` are worth to the fit, by one that goes on without them."""
        say(f"errors ahead without {', '.join(names)}")
        recipe = held.provenance.recipe
        assert recipe is not None
        going_on = replace(recipe, options=continued(recipe.options, held))
        try:
            less = without_effects(going_on, names)
            bare = fit_recipe(self.vehicle, self.prepared.data, less)
        except GreyboxError:
            return _Without()
        bare = bare.with_history(less, ())
        old, new = self.judges.errors(bare.model), self.judges.errors(held.model)
        return _Without(
            fit=bare,
            worth=None if old is None or new is None else worth(old, new, self.span),
            gain=bare.cost - held.cost - sum(len(held.of_effect(n)) for n in names) * self.price,
        )
