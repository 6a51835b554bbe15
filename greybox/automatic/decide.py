"""decide: from flights and a vehicle file to the recipe of a fit, every choice with its reason.

1. What the flights show (`facts`): sensors, their fastest noise, whether clocks wander.
2. The nested standard sets of effects (`sets`) are fitted one after the other on the first part of
   every flight, each with disturbance states of force and torque, and foretell the part that was
   left out. The smallest set within one standard error of the best is taken.
3. On that set: one value per flight for the thrust scale where flights differ by more than their
   errors; and errors half a second ahead as the criterion where that foretells better.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import scipy.stats

from greybox.automatic.decision import Decision, Recipe
from greybox.automatic.facts import WANDER, Facts
from greybox.automatic.foretell import Score, foretell
from greybox.automatic.sets import Step, nested_sets, per_flight_parameters
from greybox.data import Dataset, Flight
from greybox.errors import FitError, GreyboxError
from greybox.estimation.fit import Fit, fit, noise_of
from greybox.estimation.options import FitOptions
from greybox.estimation.record import sample_time
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt
from greybox.model.core_parameters import core_parameters
from greybox.model.model import PhysicsModel, build_model
from greybox.model.vehicle import Vehicle

FIRST_PART = 0.65
"""Share of a flight that sets are fitted on; the rest is foretold."""
ENOUGH_SECONDS = 150.0
"""Flight time from which more only costs time when sets are compared."""
SHORTEST = 6.0
"""Flights shorter than this [s] are too short to leave a part out."""
FELT = 3.0
"""Standard errors from which one of a step's parameters counts as felt."""
CLEAR = 0.01
"""Probability below which flights count as different in their thrust scale (chi-square test)."""
NOTICEABLE = 0.005
"""... and the spread between them that matters: half a percent of thrust."""
ADAPT = 5.0
"""Seconds of a new flight from which its own parameters are taken."""
QUICK = LevenbergMarquardt(tolerance=0.05, max_iterations=25)
"""Solver of the comparison: within a third of a standard error of the optimum."""

RATIOS = (("mass", "thrust.c2", "motion"), ("torque.c2", "inertia.zz", "yaw"))
"""Pairs that scale together without changing any prediction: force over mass, yaw torque over inertia."""

Say = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class Given:
    """What the user decided; None or empty: open. Field names are those of `Recipe` and `FitOptions`."""

    effects: tuple[str, ...] | None = None
    input: Literal["command", "speed"] = "command"
    kinematic_noise: bool | None = None
    adapt: float | None = None
    options: Mapping[str, object] = field(default_factory=dict)

    def has(self, name: str) -> bool:
        """Whether an option of the fit was given."""
        return name in self.options


@dataclass(frozen=True, kw_only=True)
class Decided:
    """The recipe and how it came about; `best` is the last fit of the comparison (None: none succeeded)."""

    recipe: Recipe
    decisions: tuple[Decision, ...]
    best: Fit | None
    score: Score | None


@dataclass(frozen=True, kw_only=True, eq=False)
class _Candidate:
    steps: tuple[Step, ...]
    fit: Fit
    score: Score

    @property
    def name(self) -> str:
        return self.steps[-1].name


def decide(
    vehicle: Vehicle, data: Dataset, facts: Facts, given: Given, *, say: Say = lambda text: None
) -> Decided:
    """The recipe for a fit of `vehicle` to `data` (already at the rate that it is fitted at).

    `say` gets a line per thing done. Raises `DataError`, `ModelError` where no model can be built.
    """
    return _Decider(vehicle=vehicle, data=data, facts=facts, given=given, say=say).run()


@dataclass(kw_only=True)
class _Decider:
    vehicle: Vehicle
    data: Dataset
    facts: Facts
    given: Given
    say: Say
    decisions: list[Decision] = field(default_factory=list)

    def run(self) -> Decided:
        given, facts = self.given, self.facts
        kinematic = given.kinematic_noise
        if kinematic is None:
            kinematic = facts.wander > WANDER
            if "attitude" in facts.sensors:
                self.note(
                    "noise on the attitude kinematics", "yes" if kinematic else "no",
                    f"gyro and attitude drift apart by {facts.wander:.1f} samples within a flight", "--kinematic-noise",
                )
        base: dict[str, object] = {}
        if not given.has("disturbance"):
            base["disturbance"] = ("force", "torque") if self._feels_force() else ("torque",)
            self.note(
                "disturbance states", ", ".join(base["disturbance"]),  # type: ignore[arg-type]
                "gusts and what is not modelled push for a while, and no parameter shall explain them", "--disturbance",
            )
        if not given.has("noise"):
            stated = set(self.vehicle.noise)
            base["noise"] = {
                f"noise.sensor.{n}": float(f"{v:.3g}") for n, v in facts.noise.items() if n not in stated
            }
            if base["noise"]:
                self.note(
                    "sensor noise", "starts from the fastest part of each channel, free within a factor of about ten",
                    "third differences of the measured channels", "--noise, --hold-noise",
                )
        base |= dict(given.options)
        base = self._held(base)
        if given.effects is not None:
            steps: tuple[Step, ...] = (Step(name="as asked", effects=given.effects),)
            chosen, best = self._one_set(steps, kinematic, base)
        else:
            chosen, best = self._nested(kinematic, base)
        options = FitOptions.of(None, base)  # type: ignore[arg-type]
        options = self._thrust_per_flight(options, best)
        per_flight = [n for n in per_flight_parameters(chosen, self.vehicle) if n not in options.per_flight]
        if not given.has("per_flight"):
            options = options.but(per_flight=(*options.per_flight, *per_flight))
        effects = tuple(e for s in chosen for e in s.effects)
        recipe = Recipe(effects=effects, input=given.input, kinematic_noise=kinematic, options=options)
        recipe, score = self._criterion(recipe, best)
        recipe = replace(recipe, adapt=self._adapt(recipe))
        return Decided(recipe=recipe, decisions=tuple(self.decisions), best=best.fit if best else None, score=score)

    def _held(self, base: dict[str, object]) -> dict[str, object]:
        """Of two numbers of which the flights show the ratio alone, the one that is known better."""
        if self.given.has("fixed") or self.given.has("free"):
            return base
        priors = {d.name: d for d in core_parameters(self.vehicle)}
        held = []
        for one, other, motion in RATIOS:
            a, b = priors[one], priors[other]
            if not (a.sigma > 0 and b.sigma > 0 and a.nominal and b.nominal):
                continue
            better, worse = sorted((a, b), key=lambda d: d.sigma / abs(d.nominal))
            held.append(better.name)
            self.note(
                better.name, f"held at {better.nominal:.4g} {better.unit}",
                f"{motion} shows only its ratio to {worse.name}, which is known less well; its own uncertainty "
                f"({100 * better.sigma / abs(better.nominal):.2g} %) is carried into the errors", "--fixed, --free",
            )
        return base | {"fixed": tuple(held)} if held else base

    def note(self, about: str, choice: str, reason: str, option: str) -> None:
        self.decisions.append(Decision(about=about, choice=choice, reason=reason, option=option))
        self.say(f"  {about}: {choice} ({reason})")

    def _feels_force(self) -> bool:
        return bool(self.facts.sensors & {"position", "velocity", "accelerometer"})

    # ------------------------------------------------------------ pieces

    def pieces(self) -> tuple[Dataset, Dataset] | None:
        """(first parts, parts left out) of enough flights; None where all flights are too short."""
        long = [f for f in self.data if f.duration >= SHORTEST]
        if not long:
            return None
        total = sum(f.duration for f in long)
        every = max(1, int(np.ceil(total / ENOUGH_SECONDS)))
        some = long[::every]
        room = ENOUGH_SECONDS / len(some)
        cut = [_shortened(f, room) for f in some]
        return Dataset(flights=tuple(cut)).split_by_time(FIRST_PART)

    # ------------------------------------------------------------ sets of effects

    def model(self, effects: tuple[str, ...], kinematic: bool) -> PhysicsModel:
        return build_model(
            self.vehicle, self.data.channels, effects, input=self.given.input,
            sample_time=sample_time(self.data), noncausal=self.data.noncausal, kinematic_noise=kinematic,
        )

    def _try(
        self, steps: tuple[Step, ...], kinematic: bool, options: FitOptions, before: _Candidate | None,
        parts: tuple[Dataset, Dataset],
    ) -> _Candidate | None:
        effects = tuple(e for s in steps for e in s.effects)
        own = tuple(n for n in per_flight_parameters(steps, self.vehicle) if n not in options.per_flight)
        options = options.but(per_flight=(*options.per_flight, *own))
        if before is not None:
            start = {n: e.value for n, e in before.fit.parameters.items() if n not in options.values}
            options = options.but(
                values={**options.values, **start}, noise=noise_of(before.fit.model), initialisation="nominal"
            )
        try:
            found = fit(self.model(effects, kinematic), parts[0], options)
            return _Candidate(steps=steps, fit=found, score=foretell(found.model, parts[1]))
        except GreyboxError as error:
            self.say(f"  with {steps[-1].name}: {error}")
            return None

    def _one_set(
        self, steps: tuple[Step, ...], kinematic: bool, base: Mapping[str, object]
    ) -> tuple[tuple[Step, ...], _Candidate | None]:
        parts = self.pieces()
        if parts is None:
            return steps, None
        options = FitOptions.of(None, base).but(solver=QUICK, predictor="innovation", initialisation="equation-error")  # type: ignore[arg-type]
        return steps, self._try(steps, kinematic, options, None, parts)

    def _nested(
        self, kinematic: bool, base: Mapping[str, object]
    ) -> tuple[tuple[Step, ...], _Candidate | None]:
        steps = nested_sets(self.vehicle, self.facts)
        parts = self.pieces()
        if parts is None:
            self.note(
                "effects", ", ".join(steps[0].effects),
                f"every flight is shorter than {SHORTEST:g} s, so that no piece can be left out to compare sets",
                "--effects",
            )
            return steps[:1], None
        options = FitOptions.of(None, base).but(solver=QUICK, predictor="innovation", initialisation="equation-error")  # type: ignore[arg-type]
        tried: list[_Candidate] = []
        for i in range(1, len(steps) + 1):
            got = self._try(steps[:i], kinematic, options, tried[-1] if tried else None, parts)
            if got is not None:
                tried.append(got)
                self.say(f"  with {got.name}: left-out pieces {got.score.mean:.4f} of holding the last value")
        if not tried:
            return steps[:1], None
        best = min(tried, key=lambda c: c.score.mean)
        chosen = best
        for candidate in tried:  # smallest first
            gain, error = best.score.better_by(candidate.score)
            if gain <= error:
                chosen = candidate
                break
        chosen_steps = self._felt_steps(chosen)
        listed = "; ".join(f"{c.name} {c.score.mean:.3f}" for c in tried)
        self.note(
            "effects", ", ".join(e for s in chosen_steps for e in s.effects),
            f"smallest set within one standard error of the best on pieces left out; squared error ahead over that of "
            f"holding the last value, adding step by step: {listed}",
            "--effects, --per-flight",
        )
        return chosen_steps, chosen

    def _felt_steps(self, chosen: _Candidate) -> tuple[Step, ...]:
        """The steps without those (after the base) whose every parameter is nothing within its error."""
        kept = []
        for step in chosen.steps:
            own = [e for n, e in chosen.fit.parameters.items() if n.split(".")[0] in step.effects]
            felt = [
                abs(v) > FELT * s or not np.isfinite(s)
                for e in own
                for v, s in (e.per_flight.values() if e.per_flight else ((e.value, e.std),))
            ]
            if step is chosen.steps[0] or any(felt):
                kept.append(step)
        return tuple(kept)

    # ------------------------------------------------------------ what differs between flights

    def _thrust_per_flight(self, options: FitOptions, best: _Candidate | None) -> FitOptions:
        name = "thrust.c2"
        if self.given.has("per_flight") or best is None or len(self.data) < 2 or name not in best.fit.parameters:
            return options
        parts = self.pieces()
        if parts is None or len(parts[0]) < 2:
            return options
        again = self._try(
            best.steps, bool(best.fit.model.physics.kinematic_noise), options.but(
                per_flight=(name,), solver=QUICK, predictor="innovation", initialisation="equation-error"
            ), best, parts,
        )
        if again is None:
            return options
        each = np.array(list(again.fit.parameters[name].per_flight.values()))
        values, errors = each[:, 0], np.maximum(each[:, 1], 1e-12)
        if not np.isfinite(each).all():
            return options
        weights = errors**-2
        middle = float((weights * values).sum() / weights.sum())
        chi2 = float((weights * (values - middle) ** 2).sum())
        chance = float(scipy.stats.chi2.sf(chi2, len(values) - 1))
        spread = float(values.std(ddof=1) / abs(middle))
        differ = chance < CLEAR and spread > NOTICEABLE
        gain, error = again.score.better_by(best.score)
        differ = differ and gain > -error
        self.note(
            "thrust scale", "one value per flight" if differ else "one value for all flights",
            f"single flights differ by {100 * spread:.1f} % (p = {chance:.2g})", "--per-flight, --shared",
        )
        return options.but(per_flight=(name,)) if differ else options

    # ------------------------------------------------------------ criterion

    def _criterion(self, recipe: Recipe, best: _Candidate | None) -> tuple[Recipe, Score | None]:
        """Multi-step errors in place of the likelihood where that foretells better by a standard error."""
        if self.given.has("predictor") or best is None:
            return recipe, best.score if best else None
        parts = self.pieces()
        assert parts is not None
        options = recipe.options.but(solver=QUICK)
        start = {n: e.value for n, e in best.fit.parameters.items() if n not in options.values}
        try:
            model = self.model(recipe.effects, recipe.kinematic_noise)
            one = fit(
                model, parts[0],
                options.but(values={**options.values, **start}, noise=noise_of(best.fit.model), initialisation="nominal"),
            )
            plain = foretell(one.model, parts[1])
            start = {n: e.value for n, e in one.parameters.items() if n not in recipe.options.values}
            many = fit(
                model, parts[0],
                options.but(
                    values={**recipe.options.values, **start}, noise=noise_of(one.model), predictor="multi-step",
                    initialisation="nominal",
                ),
            )
            ahead = foretell(many.model, parts[1])
        except (FitError, GreyboxError) as error:
            self.say(f"  multi-step: {error}")
            return recipe, best.score
        gain, error = ahead.better_by(plain)
        better = gain > error
        self.note(
            "criterion", "errors up to half a second ahead" if better else "one-step likelihood",
            f"left-out pieces {ahead.mean:.3f} against {plain.mean:.3f} +- {error:.3f}", "--predictor",
        )
        if better:
            options = recipe.options.but(predictor="multi-step", initialisation="innovation")
            return replace(recipe, options=options), ahead
        return recipe, plain

    def _adapt(self, recipe: Recipe) -> float | None:
        if self.given.adapt is not None:
            return self.given.adapt
        model = self.model(recipe.effects, recipe.kinematic_noise)
        own = {d.name for d in model.parameters if d.scope == "flight"} | set(recipe.options.per_flight)
        own -= set(recipe.options.shared) | set(recipe.options.fixed)
        if not own:
            return None
        self.note(
            "adaptation", f"first {ADAPT:g} s of a new flight", f"{len(own)} parameters have a value per flight", "--adapt"
        )
        return ADAPT


def _shortened(flight: Flight, seconds: float) -> Flight:
    begin = float(flight.segments[0].t[0])
    return flight.between(begin, begin + seconds) or flight
