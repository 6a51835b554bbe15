"""Trials: sets of effects fitted to the first part of every flight, and how well they foretell the
part left out.

One build serves all nested sets: what a set does not have is held at nothing in the largest. Of the
sets within one standard error of the best the one with the lowest BIC is taken, less the effects
that nothing feels: one that is there and left out bends what it is taken for.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

from greybox.automatic.filters import without_noise_of
from greybox.automatic.foretell import Score, foretell
from greybox.automatic.sets import Step, all_names_of, effects_of, name_of
from greybox.automatic.setting import Setting, with_priors_of
from greybox.data import Dataset
from greybox.errors import GreyboxError
from greybox.estimation.fit import fit, noise_of
from greybox.estimation.options import FitOptions
from greybox.estimation.result import Fit
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt
from greybox.model.model import PhysicsModel

QUICK = LevenbergMarquardt(tolerance=0.2, max_iterations=20)
"""Solver of the comparison: ends within about half a standard error of the optimum."""
TO_THE_END = LevenbergMarquardt(tolerance=0.2, max_iterations=100)
"""... of the likelihood of a set that was chosen: most steps were made."""
WORTH = 0.05
"""Share of its squared error by which a larger set must improve a smaller one: less is worth
nothing."""
POOR = 0.1
"""Share of the last value's squared error (a third of the error) above which the likelihood
foretells poorly, so that errors further ahead are tried for every set."""

Say = Callable[[str], None]


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidate:
    """A set of effects fitted to the first parts of the flights, and how it foretells the rest: by
    the one-step `likelihood` and, where that was tried, by errors further `ahead`."""

    steps: tuple[Step, ...]
    likelihood: Fit
    likelihood_score: Score
    ahead: Fit | None = None
    ahead_score: Score | None = None

    @property
    def name(self) -> str:
        """That of the last step."""
        return self.steps[-1].name

    @property
    def looks_ahead(self) -> bool:
        """Whether errors further ahead foretell better, by more than their standard error and by
        what is worth anything: the likelihood knows its parameters better."""
        if self.ahead_score is None:
            return False
        gain, error = self.ahead_score.better_by(self.likelihood_score)
        return gain > max(error, WORTH * self.likelihood_score.mean)

    @property
    def fit(self) -> Fit:
        """The fit that foretells better."""
        return self.ahead if self.ahead is not None and self.looks_ahead else self.likelihood

    @property
    def score(self) -> Score:
        """Its score."""
        better = self.ahead_score is not None and self.looks_ahead
        return (
            self.ahead_score if better and self.ahead_score is not None else self.likelihood_score
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Begun:
    """A set of effects fitted by the likelihood, not judged yet, with the model and the options of
    that fit."""

    steps: tuple[Step, ...]
    likelihood: Fit
    model: PhysicsModel
    options: FitOptions


@dataclass(frozen=True, kw_only=True, eq=False)
class Trials:
    """Fits of sets of effects to the first of two `parts`; `largest` is the set of all steps,
    `considered` what the final fit carries into its errors. `say` gets a line where one fails."""

    setting: Setting
    parts: tuple[Dataset, Dataset]
    largest: tuple[Step, ...]
    considered: tuple[str, ...]
    say: Say

    def tried(
        self,
        steps: tuple[Step, ...],
        options: FitOptions,
        before: Candidate | None,
        *,
        solver: LevenbergMarquardt = QUICK,
    ) -> Candidate | None:
        """`steps` fitted and judged, from where `before` ended; None where that is not possible.

        Errors further ahead are tried where the likelihood foretells poorly.
        """
        begun = self.by_likelihood(steps, options, before, solver=solver)
        return None if begun is None else self.judged(begun)

    def by_likelihood(
        self,
        steps: tuple[Step, ...],
        options: FitOptions,
        before: Candidate | None,
        *,
        solver: LevenbergMarquardt = QUICK,
        afresh: Collection[str] = (),
    ) -> Begun | None:
        """`steps` fitted by the likelihood; effects begin `afresh` from their nominal values."""
        options = self.setting.with_flight_values(options, steps).but(solver=solver, considered=())
        options = options.but(predictor="innovation")
        if before is None:
            options = options.but(initialisation="equation-error")
        else:
            dropped = {*afresh, *(set(all_names_of(before.steps)) - set(all_names_of(steps)))}
            options = _from(before.likelihood, options, dropped)
        try:
            model, options = self._one_library(steps, options)
            plain = fit(model, self.parts[0], options)
        except GreyboxError as error:
            self.say(f"  {steps[-1].name}: {error}")
            return None
        return Begun(steps=steps, likelihood=plain, model=model, options=options)

    def judged(self, begun: Begun) -> Candidate | None:
        """The candidate that a fit by the likelihood began, with errors further ahead where it
        foretells poorly; None where it cannot run on what was left out."""
        plain, name = begun.likelihood, begun.steps[-1].name
        try:
            score = foretell(plain.model, self.parts[1])
        except GreyboxError as error:
            self.say(f"  {name}: {error}")
            return None
        found = Candidate(steps=begun.steps, likelihood=plain, likelihood_score=score)
        if "predictor" in self.setting.given.choices or score.mean <= POOR:
            return found
        options = _from(plain, begun.options, set()).but(predictor="multi-step")
        try:
            many = fit(begun.model, self.parts[0], options)
            return replace(found, ahead=many, ahead_score=foretell(many.model, self.parts[1]))
        except GreyboxError as error:
            self.say(f"  {name}, errors ahead: {error}")
            return found

    def ended(self, chosen: Candidate, options: FitOptions) -> Candidate:
        """`chosen` with a likelihood that ended at its maximum, or as near as it comes."""
        if chosen.likelihood.converged:
            return chosen
        begun = self.by_likelihood(chosen.steps, options, chosen, solver=TO_THE_END)
        return chosen if begun is None else replace(chosen, likelihood=begun.likelihood)

    def without_unfelt(self, chosen: Candidate, options: FitOptions) -> Candidate:
        """`chosen` without what nothing feels, if that is `plainer`."""
        kept = _felt_steps(chosen)
        if kept == chosen.steps:
            return chosen
        less = self.tried(kept, options, chosen)
        return chosen if less is None else plainer(chosen, less)

    def _one_library(
        self, steps: tuple[Step, ...], options: FitOptions
    ) -> tuple[PhysicsModel, FitOptions]:
        """The model of the largest set in which what is not among `steps` is held at nothing: the
        same predictions, and one build serves all nested sets."""
        own = set(all_names_of(steps))
        more = [
            replace(s, effects=tuple(e for e in s.effects if name_of(e) not in own))
            for s in self.largest
        ]
        model = self.setting.model(effects_of((*steps, *more)))
        options = with_priors_of(options, model)
        absent = set(all_names_of(tuple(more)))
        null = {
            d.name: d.nominal if d.null is None else d.null
            for d in model.parameters
            if d.name.split(".")[0] in absent
        }
        free = [d.name for d in model.parameters if d.sigma > 0 and d.name not in options.fixed]
        return model, options.but(
            fixed=(*options.fixed, *null),
            values={**options.values, **null},
            build=(*free, *self.considered),
        )


def likeliest_of_the_good(tried: Sequence[Candidate]) -> Candidate:
    """Of candidates that foretell as well as the best the one with the lowest BIC."""
    best = _best(tried)
    return min((c for c in tried if _as_good(c, best)), key=lambda c: c.likelihood.bic)


def plainer(chosen: Candidate, less: Candidate) -> Candidate:
    """`less`, which is `chosen` without effects that nothing feels one by one, unless BIC and the
    pieces left out both ask for all of them together. Pieces that are foretold a little better with
    these are mostly luck where all errors are tiny; where no model is exact, BIC asks for what
    foretells other flights worse."""
    asked = less.likelihood.bic > chosen.likelihood.bic
    return chosen if asked and not _as_good(less, chosen) else less


def _best(tried: Sequence[Candidate]) -> Candidate:
    return min(tried, key=lambda c: c.score.mean)


def _as_good(one: Candidate, best: Candidate) -> bool:
    """Whether the best is better by less than its standard error, or by less than is worth
    anything."""
    gain, error = best.score.better_by(one.score)
    return gain <= max(error, WORTH * one.score.mean)


def _from(start: Fit, options: FitOptions, dropped: set[str]) -> FitOptions:
    """`options` from the estimates and noise levels of a fit, less those of effects that are
    `dropped`. Levels that it has not stay as they are."""
    values = {n: e.value for n, e in start.parameters.items() if n.split(".")[0] not in dropped}
    levels = noise_of(start.model)
    for part in set(start.settings["noise_parts"]) - set(options.noise_parts):
        values, levels = without_noise_of(part, values), without_noise_of(part, levels)
    held = {n: v for n, v in options.noise.items() if n in options.held_noise}
    levels = {n: v for n, v in levels.items() if not n.startswith(tuple(f"{h}." for h in held))}
    return options.but(
        values={**values, **options.values},
        noise={**options.noise, **levels, **held},
        initialisation="nominal",
    )


def _felt_steps(candidate: Candidate) -> tuple[Step, ...]:
    """The steps without those of their effects, after the first step, whose every parameter is
    nothing within its error."""
    first, *more = candidate.steps
    kept = [first]
    for step in more:
        felt = tuple(e for e in step.effects if candidate.fit.feels(name_of(e)))
        if felt:
            kept.append(replace(step, effects=felt))
    return tuple(kept)
