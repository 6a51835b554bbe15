"""Held ahead: which effects of a model hold where it is fitted by what it foretells.

A likelihood one sample ahead judges effects where the model is right but for them. Of a real craft
it may ask for effects with which errors ahead grow. Then the effects are fitted as plain `greybox
fit` fits them, and each is held against the same fit without it. Those go whose numbers gain less
than the logarithm of how many effects were asked for each; flights that judge say what the others
are worth.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from greybox.automatic.fit import Prepared, continued, fit_recipe, prepare, without_effects
from greybox.automatic.front_door import fit_prepared
from greybox.automatic.setting import Given
from greybox.automatic.trials import QUICK, Say
from greybox.data import Dataset
from greybox.errors import FitError, GreyboxError
from greybox.estimation.fit import fit
from greybox.estimation.laplace import at_bound, free_information
from greybox.estimation.options import FitChoices, FitOptions
from greybox.estimation.other_scales import on_other_scales
from greybox.estimation.result import Fit
from greybox.model.identified import IdentifiedModel
from greybox.model.known import NOTHING, Known
from greybox.model.model import PhysicsModel
from greybox.validation.judges import Judges
from greybox.validation.worth import Span, Worth, clearly_smaller, seconds, worth

UNABLE = "names rest on the likelihood alone: nothing can be fitted by errors ahead ({})"


@dataclass(frozen=True, kw_only=True, eq=False)
class HeldAhead:
    """The `fit` by errors ahead with the effects that hold, and what every effect that was asked is
    worth to it (None: flights do without it, or nothing can be fitted without it); there was no
    room for those that are `crowded_out`, which were worth it to a larger model."""

    fit: Fit
    worth: Mapping[str, Worth | None]
    crowded_out: frozenset[str] = frozenset()

    def held(self, name: str) -> bool:
        """Whether an effect that was asked is in the model of the fit."""
        return name in self.fit.model.effects


@dataclass(frozen=True, kw_only=True)
class Terms:
    """What holds for all fits that have it: numbers that are `fixed` and `per_flight` (none:
    decided), and what is `known` of the craft, which goes before its file."""

    fixed: Sequence[str] = ()
    per_flight: Sequence[str] = ()
    known: Known = NOTHING

    def of(self, model: PhysicsModel) -> FitChoices:
        """The terms of the parameters of a model."""
        there = {d.name for d in model.parameters}
        every = (*self.fixed, *self.known.held)
        held, own = ([n for n in names if n in there] for names in (every, self.per_flight))
        choices = FitChoices(fixed=held) if held else FitChoices()
        choices |= FitChoices(per_flight=own) if own else FitChoices()
        return choices | _as_known(self.known, there)


def held_ahead(
    model: PhysicsModel,
    asked: Sequence[str],
    data: Dataset,
    judges: Judges,
    span: Span,
    most: int,
    *,
    terms: Terms = Terms(),
    say: Say = lambda text: None,
    unable: Say = lambda text: None,
) -> HeldAhead | None:
    """The effects of `model` fitted to `data` by errors ahead, without those of the `asked` that
    these do not need, `most` at most, and what the others are worth `span` [s] ahead on flights
    that judge, on `terms`. None where nothing can be fitted, which `unable` is told. Raises
    `DataError`, `ModelError`.
    """
    race = _Race(
        model=model,
        prepared=prepare(
            model.vehicle,
            data,
            keep_impossible=True,
            all_flights=True,
            decide_rate=False,
            keep_noise_free=True,
        ),
        judges=judges,
        span=span,
        choices=terms.of(model),
        price=float(np.log(len(asked))),
    )
    try:
        raced = _raced(race, list(asked), most, say)
        return replace(raced, fit=on_other_scales(raced.fit, terms.known.untold))
    except FitError as error:
        unable(UNABLE.format(error))
        return None


def _as_known(known: Known, there: Collection[str]) -> FitChoices:
    """What is known of parameters that are `there`, as choices of a fit; none for nothing."""
    priors = {n: p for n, p in known.prior.items() if n in there}
    held = {n: v for n, v in known.held.items() if n in there}
    if not priors and not held:
        return FitChoices()
    values = {n: mean for n, (mean, _) in priors.items()} | held
    return FitChoices(values=values, priors=priors, flight_priors=priors)


def _raced(race: _Race, asked: list[str], most: int, say: Say) -> HeldAhead:
    """What stays of the `asked`, `most` at most. Raises `FitError`."""
    say("the effects fitted by errors ahead")
    held, left = race.fitted(()), asked
    while bound := [n for n in left if _at_bound(held, n)]:
        held = race.without(held, bound, say).fit or held
        left = [n for n in left if n not in bound]
    rows = {n: race.without(held, [n], say) for n in left if race.doubted(held, n)}
    crowded = dict[str, Worth | None]()
    while True:
        left = _without_idle(race, held, left, rows, say)
        if gone := [n for n in asked if n not in left]:
            say(f"the effects fitted by errors ahead, without {', '.join(gone)}")
            held = race.fitted(gone)
        left = [n for n in left if n in held.model.effects]  # the fit may have dropped one
        rows = {n: race.without(held, [n], say) for n in left}
        if any(row.idle for row in rows.values()):
            continue
        if len(left) <= most:
            told = dict.fromkeys(asked) | crowded | {n: row.worth for n, row in rows.items()}
            return HeldAhead(fit=held, worth=told, crowded_out=frozenset(crowded))
        least = min(left, key=lambda n: rows[n].gain)
        crowded[least] = rows[least].worth
        left.remove(least)


def _without_idle(
    race: _Race, held: Fit, left: list[str], rows: Mapping[str, _Without], say: Say
) -> list[str]:
    """Of the effects that are `left` those that stay, by the `rows` of those that were asked."""
    while idle := sorted((n for n in rows if rows[n].idle), key=lambda n: rows[n].gain):
        going, less = idle, race.without(held, idle, say) if len(idle) > 1 else None
        if less is None or not less.idle:  # some stand for each other
            going, less = idle[:1], rows[idle[0]]
        held = less.fit or held
        left, idle = ([n for n in some if n not in going] for some in (left, idle))
        rows = {n: race.without(held, [n], say) for n in idle}
    return left


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
    known: Known = NOTHING,
    unable: Say = lambda text: None,
) -> bool:
    """Whether the likelihood of `data`, which a fit was found by, bends its model: fitted by errors
    ahead the same model foretells flights that judge clearly better, and by the `least` share of
    the squared error on average, `span` [s] ahead. So nobody believes that these effects and gusts
    made the flights. `lawful` is the model of a fit with laws beside, which then has to foretell as
    well; `known` is what was known before. Not where nothing can be fitted, which `unable` is told."""
    model = found.model
    options = FitOptions(
        predictor="multi-step",
        solver=QUICK,
        free=tuple(found.parameters),
        per_flight=tuple(n for n, e in found.parameters.items() if e.scope != "shared"),
        initialisation="nominal",
    ).but(**_as_known(known, {d.name for d in model.dynamics.parameters}))
    try:
        ahead = fit(model.dynamics, data, continued(options, found)).model
    except GreyboxError as error:
        unable(UNABLE.format(error))
        return False
    old, new = judges.errors(lawful or model), judges.errors(ahead)
    gains = np.zeros(0) if old is None or new is None else seconds(old, new, span)
    return clearly_smaller(gains, least)


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
    """The flights, and what holds for every fit; a number costs the `price`."""

    model: PhysicsModel
    prepared: Prepared
    judges: Judges
    span: Span
    choices: FitChoices
    price: float

    def fitted(self, gone: Sequence[str]) -> Fit:
        """The automatic fit with all effects but those that are `gone`."""
        vehicle = self.model.vehicle
        stated = {*vehicle.effects, *gone}
        given = Given(
            effects=tuple(e for e in self.model.effects if e.name not in stated),
            input=self.model.input,
            kinematic_noise=self.model.kinematic_noise,
            adapt=self.judges.adapt,
            choices=self.choices,
        )
        return fit_prepared(vehicle, self.prepared, given)

    def doubted(self, held: Fit, name: str) -> bool:
        """Whether a fit may do without an effect: what its cost would lose, to second order, is
        below three times the price of its numbers."""
        null = {d.name: d.null for d in held.model.dynamics.parameters}
        unknowns, value = held.problem.unknowns, held.problem.evaluate(held.theta)
        own = [i for i, u in enumerate(unknowns) if u.name in held.of_effect(name)]
        zero = [null[unknowns[i].name] for i in own]
        stuck = at_bound(held.problem, held.theta, value)
        if not own or None in zero or stuck[own].any():
            return True
        off = held.theta[own] - np.array(zero, dtype=float)
        loss = 0.5 * float(off @ free_information(held.problem, held.theta, value, own) @ off)
        return loss < 3 * len(held.of_effect(name)) * self.price

    def without(self, held: Fit, names: Sequence[str], say: Say) -> _Without:
        """What effects `names` are worth to the fit, by one that goes on without them."""
        say(f"errors ahead without {', '.join(names)}")
        recipe = held.provenance.recipe
        assert recipe is not None
        going_on = replace(recipe, options=continued(recipe.options, held))
        try:
            less = without_effects(going_on, names)
            bare = fit_recipe(self.model.vehicle, self.prepared.data, less)
        except GreyboxError:
            return _Without()
        bare = bare.with_history(less, ())
        old, new = self.judges.errors(bare.model), self.judges.errors(held.model)
        return _Without(
            fit=bare,
            worth=None if old is None or new is None else worth(old, new, self.span),
            gain=bare.cost - held.cost - sum(len(held.of_effect(n)) for n in names) * self.price,
        )
