"""decide: from flights and a vehicle file to the recipe of a fit, every choice with its reason.

1. What the facts decide holds for every fit (`setting`).
2. The nested standard sets of effects (`sets`) are fitted one after the other to the first part of
   every flight, with disturbance states of force and torque, and foretell the part left out: one
   is taken (`trials`).
3. Where innovations are not white and BIC clearly asks for it, sensors of the pose get coloured
   noise, then gyro and accelerometer a low-pass filter and coloured noise: a pose that errs for
   seconds looks like force, a filter that is left out like more lag of the motors, colour that is
   left out like a slower filter. What is not felt with them goes.
4. The thrust scale gets a value per flight where flights differ by more than their errors.
5. Errors up to half a second ahead replace the likelihood where that foretells better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from greybox.automatic.facts import Facts
from greybox.automatic.filters import (
    Part,
    described,
    is_felt,
    lasting_poses,
    offered_parts,
    with_noise_parts,
    without_least_sure,
)
from greybox.automatic.pieces import SHORTEST, first_parts
from greybox.automatic.sets import (
    LATE_POSE,
    TRIMMED,
    Step,
    effects_of,
    lag_is_a_jump,
    listed,
    names_of,
    nested_sets,
    shares_effect,
    without_lag,
)
from greybox.automatic.setting import (
    Given,
    Note,
    Setting,
    demand_known_priors,
    setting_of,
    with_priors_of,
)
from greybox.automatic.trials import Begun, Candidate, Say, Trials, likeliest_of_the_good
from greybox.data import Dataset
from greybox.estimation.fit import noise_of
from greybox.estimation.options import FitOptions
from greybox.estimation.recipe import Decision, Recipe
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt
from greybox.model.core_parameters import core_parameters, leading
from greybox.model.effective_lag import PARTS as IN_A_ROW
from greybox.model.given_values import demand_given
from greybox.model.noise import Coloured, LowPass, part_named
from greybox.model.noise.low_pass import FILTERED
from greybox.model.vehicle import Vehicle
from greybox.statistics.distributions import chi_square_tail
from greybox.statistics.evidence import CLEAR as CLEAR_EVIDENCE
from greybox.validation.adapt import SECONDS

CLEAR = 0.01
"""Probability below which flights count as different in their thrust scale (chi-square test)."""
NOTICEABLE = 0.005
"""... and the spread between them that matters: half a percent of thrust."""
REFINE = LevenbergMarquardt(tolerance=0.2, max_iterations=4)
"""... where one more parameter is tried at an optimum: two steps take it there."""
DIGITS = 3
"""Significant digits of the values that the final fit starts from: a start need not be exact."""
TAKES_LATENESS = frozenset(n.split(".")[0] for n in IN_A_ROW) - {"motor_lag"}
"""Effects that stand for a filter of the gyro where there is none: what is late in its place."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Decided:
    """The recipe and how it came about. `candidate` is the recipe fitted to the first parts of the
    flights (None where every flight is too short)."""

    recipe: Recipe
    decisions: tuple[Decision, ...]
    candidate: Candidate | None
    given: Given = field(default_factory=Given)


def decide(
    vehicle: Vehicle, data: Dataset, facts: Facts, given: Given, *, say: Say = lambda text: None
) -> Decided:
    """The recipe for a fit of `vehicle` to `data`, which has the rate that it is fitted at.

    `say` gets a line per thing done. Raises `DataError`, `ModelError` where no model can be built.
    """
    said = FitOptions.of(None, given.choices)
    for member in (said.chosen_predictor, said.chosen_criterion, said.chosen_solver):
        member()  # a name that there is not is said before anything takes time
    note = _Notes(say=say)
    setting = setting_of(vehicle, data, facts, given, said, note)
    steps = _offered_sets(setting)
    if (
        said.values or said.priors or said.flight_priors
    ):  # before anything takes time; those of noise parts are asked by the fit
        model = setting.model(effects_of(steps))
        declared = {d.name for d in model.parameters}
        demand_given(model, {n: v for n, v in said.values.items() if n in declared})
        demand_known_priors(said, model)
    parts = first_parts(data)
    if parts is None:
        note(
            "effects",
            listed(steps[:1]),
            f"every flight is shorter than {SHORTEST:.2g} s: "
            "no piece can be left out to compare larger sets",
            "--effects",
        )
        return _decided(setting, note, steps[:1], setting.options, None)
    considered = setting.options.considered
    trials = Trials(setting=setting, parts=parts, largest=steps, considered=considered, say=say)
    compared = _Comparison(setting=setting, trials=trials, note=note, say=say).carried_out()
    return _decided(setting, note, *compared)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Notes:
    """What was decided so far, each said at once."""

    say: Say
    decisions: list[Decision] = field(default_factory=list)

    def __call__(self, about: str, choice: str, reason: str, option: str) -> None:
        self.decisions.append(Decision(about=about, choice=choice, reason=reason, option=option))
        self.say(f"  {about}: {choice} ({reason})")


def _offered_sets(setting: Setting) -> tuple[Step, ...]:
    if setting.given.effects is not None:
        return (Step(name="the effects asked for", effects=setting.given.effects),)
    return nested_sets(setting.vehicle, setting.facts, input=setting.input)


def _decided(
    setting: Setting,
    note: _Notes,
    steps: tuple[Step, ...],
    options: FitOptions,
    candidate: Candidate | None,
) -> Decided:
    options = setting.with_flight_values(options, steps)
    options = with_priors_of(options, setting.model(effects_of(steps)))
    recipe = Recipe(
        effects=effects_of(steps),
        input=setting.input,
        kinematic_noise=setting.kinematic_noise,
        options=_trim_of_one_flight(setting, note, options),
    )
    return Decided(
        recipe=replace(recipe, adapt=_adapt(setting, note, recipe)),
        decisions=tuple(note.decisions),
        given=setting.given,
        candidate=candidate,
    )


def _trim_of_one_flight(setting: Setting, note: Note, options: FitOptions) -> FitOptions:
    """The pieces of a single flight share its trim, so that they cannot ask for one per flight.
    What takes it up in their place adapts to a new flight; to the fit it is nearly the same."""
    if "free" in setting.given.choices or len(setting.data) > 1:
        return options
    declared = {d.name: d for d in core_parameters(setting.vehicle)}
    decided = {*options.fixed, *options.shared, *options.per_flight}
    own = [n for n in TRIMMED if declared[n].sigma > 0 and n not in decided]
    if own:
        note(
            ", ".join(own),
            "one value per flight",
            "one flight cannot tell whether its trim stays",
            "--shared",
        )
    return options.but(per_flight=(*options.per_flight, *own))


def _adapt(setting: Setting, note: Note, recipe: Recipe) -> float | None:
    if setting.given.adapt is not None:
        return setting.given.adapt
    model = setting.model(recipe.effects)
    own = {d.name for d in model.parameters if d.scope == "flight"} | set(recipe.options.per_flight)
    own -= set(recipe.options.shared) | set(recipe.options.fixed)
    if not own:
        return None
    note(
        "a new flight",
        f"adapts on its first {SECONDS:g} s",
        f"{len(own)} parameters have one value per flight; of a test flight at most a third",
        "--adapt",
    )
    return SECONDS


@dataclass(frozen=True, kw_only=True, eq=False)
class _Comparison:
    """Sets of effects, noise and criterion, compared on pieces left out."""

    setting: Setting
    trials: Trials
    note: _Notes
    say: Say

    def carried_out(self) -> tuple[tuple[Step, ...], FitOptions, Candidate | None]:
        """(steps, options, the candidate that they are of: None where nothing could be fitted)."""
        steps, options = self.trials.largest, self.setting.options
        self.say(f"  fitting {len(steps)} set(s) of effects, the smallest first")
        first = self.trials.tried(steps[:1], options, None)
        if first is None:
            return steps[:1], options, None
        tried = [*self._lagless(steps[0], options), *self._nested(steps, options, first)]
        chosen = self.trials.without_unfelt(likeliest_of_the_good(tried), options)
        options, posed = self._poses(options, chosen)
        if posed is not chosen:
            chosen = self.trials.without_unfelt(posed, options)
        options, noisy, reason = self._filters(options, chosen)
        if noisy is not chosen:
            chosen = self.trials.without_unfelt(noisy, options)
        self._say_noise(chosen, reason)
        self._say_effects(chosen, tried)
        options, chosen = self._thrust_per_flight(options, chosen)
        options, chosen = self._criterion(options, chosen)
        return chosen.steps, self._started(options, chosen), chosen

    def _lagless(self, base: Step, options: FitOptions) -> list[Candidate]:
        """The base set without a lag, where rotors may have none."""
        asked = self.setting.given.effects is not None or "motor_lag" not in names_of(base)
        if asked or not lag_is_a_jump(self.setting.vehicle):
            return []
        got = self.trials.tried((without_lag(base),), options, None)
        if got is None:
            return []
        self.say(f"  {got.name}: {got.score.mean:.3f} of the last value's squared error")
        return [got]

    def _nested(
        self,
        steps: tuple[Step, ...],
        options: FitOptions,
        first: Candidate,
    ) -> list[Candidate]:
        """`first`, the smallest set, and the larger ones up to all `steps`."""
        tried: list[Candidate] = []
        for i in range(1, len(steps) + 1):
            got = self.trials.tried(steps[:i], options, tried[-1]) if tried else first
            if got is not None:
                tried.append(got)
                self.say(f"  {got.name}: {got.score.mean:.3f} of the last value's squared error")
        return tried

    def _say_effects(self, chosen: Candidate, tried: list[Candidate]) -> None:
        if self.setting.given.effects is not None:
            return
        scores = ", ".join(
            f"{'+ ' * (c is not tried[0])}{c.name} {c.score.mean:.3g}" for c in tried
        )
        self.note(
            "effects",
            listed(chosen.steps),
            "of the sets that foretell pieces left out as well as the best the one with the lowest "
            f"BIC; squared errors ahead, the last value's = 1: {scores}",
            "--effects, --per-flight",
        )

    def _poses(self, options: FitOptions, first: Candidate) -> tuple[FitOptions, Candidate]:
        """(options, candidate) with coloured noise of the sensors of the pose whose innovations are
        not white, where BIC clearly asks for it and pieces left out are foretold better."""
        if "noise_parts" in self.setting.given.choices or "free" in self.setting.given.choices:
            return options, first
        offered = lasting_poses(first.likelihood)
        if offered:
            self.say("  fitting noise of the pose that lasts")
        own, begun, said = self._begun_with_noise(options, first, first.steps, offered)
        if not offered or not said:
            return options, first
        while begun is not None and (rest := without_least_sure(begun.likelihood)):
            # the error of one sensor colours the innovations of the others
            less = self._begun_with_noise(options, first, first.steps, rest)
            if less[1] is None or less[1].likelihood.bic >= begun.likelihood.bic:
                break
            own, begun, said = less
        again, said = self._noise_judged(begun, said, first)
        if again is None or not again.score.mean < first.score.mean:
            self.note("noise of the pose", "white", said, "--noise-parts")
            return options, first
        felt = [p for p in map(part_named, own.noise_parts) if isinstance(p, Coloured)]
        choice = ", ".join(described(p, again.likelihood) for p in felt)
        self.note("noise of the pose", choice, said, "--noise-parts")
        return own, again

    def _filters(self, options: FitOptions, first: Candidate) -> tuple[FitOptions, Candidate, str]:
        """(options, candidate, reason) with filters and colour of gyro and accelerometer where BIC
        clearly asks for them and the last value is still beaten, `first` where not. The effects of
        `first` stay: colour would take what they explain. A pose that is as late as a filtered IMU
        hides it: the two are tried together."""
        if "noise_parts" in self.setting.given.choices:
            return options, first, ""
        # nothing else is estimated then, no time constant either
        named = "free" in self.setting.given.choices
        offered = () if self.setting.kinematic_noise or named else offered_parts(first.likelihood)
        reason = "no time constant is longer than nothing within its error and possible"
        if self.setting.kinematic_noise:
            reason = "the attitude is not the gyro's integral, by more than a filter is late"
        elif named:
            reason = "exactly the parameters that were named are estimated"
        elif not offered:
            reason = "the innovations of the IMU are white"
        steps = first.steps
        if offered and self._pose_may_be_late() and not shares_effect(steps, LATE_POSE):
            clocks = [s for s in self.trials.largest if shares_effect((s,), LATE_POSE)]
            steps = (*steps, *(clocks or [LATE_POSE]))
        own, begun, said = self._begun_with_noise(options, first, steps, offered)
        again, said = self._noise_judged(begun, said, first)
        if again is None:
            return options, first, said or reason
        better = again.score.mean < max(1.0, first.score.mean)
        said += "; a filter that is left out looks like more lag of the motors"
        if better:
            return own, again, said
        return options, first, said

    def _begun_with_noise(
        self,
        options: FitOptions,
        first: Candidate,
        steps: tuple[Step, ...],
        offered: Sequence[Part],
    ) -> tuple[FitOptions, Begun | None, str]:
        """(options, fit by the likelihood, reason) with those of the `offered` parts that are felt
        together; None where none is, or where BIC does not clearly ask for them."""
        while offered:
            own = with_noise_parts(options, offered, first.likelihood)
            # a delay has taken what a filter is late: it lets go, or the search stays where it was
            begun = self.trials.by_likelihood(steps, own, first, afresh=TAKES_LATENESS)
            felt = tuple(offered)
            if begun is not None:
                felt = tuple(p for p in offered if is_felt(p, begun.likelihood))
            if felt != tuple(offered):
                offered = felt
                continue
            if begun is None:
                return options, None, "no fit with one"
            gain = first.likelihood.bic - begun.likelihood.bic
            both = " together with a late pose" if steps != first.steps else ""
            said = (
                f"its innovations are not white; BIC {'falls' if gain > 0 else 'rises'} by "
                f"{abs(gain):.0f}{both}"
            )
            # what evidence refuses is not judged ahead
            return (own, begun, said) if gain > CLEAR_EVIDENCE else (options, None, said)
        return options, None, ""

    def _noise_judged(
        self, begun: Begun | None, said: str, first: Candidate
    ) -> tuple[Candidate | None, str]:
        """(candidate, reason) of a fit with noise parts that evidence asks for; None where there is
        none, or it cannot run on what was left out."""
        if begun is None:
            return None, said
        again = self.trials.judged(begun)
        if again is None:
            return None, "no fit with one"
        return again, (
            f"{said}, the squared error ahead goes from {first.score.mean:.3f} "
            f"to {again.score.mean:.3f} of the last value's"
        )

    def _say_noise(self, chosen: Candidate, reason: str) -> None:
        if "noise_parts" in self.setting.given.choices or not self.setting.facts.has_imu:
            return
        parts = [part_named(n) for n in chosen.likelihood.settings["noise_parts"]]
        of_imu = [p for p in parts if isinstance(p, LowPass | Coloured) and p.sensor in FILTERED]
        said = ", ".join(described(p, chosen.likelihood) for p in of_imu) or "white"
        self.note("noise of the IMU", said, reason, "--noise-parts")

    def _pose_may_be_late(self) -> bool:
        return (
            self.setting.given.effects is None
            and self.setting.facts.has_pose
            and self.setting.facts.has_imu
            and LATE_POSE.name not in self.setting.vehicle.effects
        )

    def _thrust_per_flight(
        self, options: FitOptions, chosen: Candidate
    ) -> tuple[FitOptions, Candidate]:
        thrust = leading("thrust", chosen.fit.model.values)
        open_question = (
            "per_flight" not in self.setting.given.choices
            and "shared" not in self.setting.given.choices
        )
        if (
            not open_question
            or len(self.trials.parts[0]) < 2
            or thrust not in chosen.fit.parameters
        ):
            return options, chosen
        own = options.but(per_flight=(thrust,))
        again = self.trials.tried(chosen.steps, own, chosen, solver=REFINE)
        if again is None:
            return options, chosen
        each = np.array(list(again.fit.parameters[thrust].per_flight.values()))
        chance, spread = _differ(each[:, 0], each[:, 1])
        gain, error = again.score.better_by(chosen.score)
        differ = chance < CLEAR and spread > NOTICEABLE and gain > -error
        self.note(
            "thrust scale",
            "one value per flight" if differ else "one value for all flights",
            f"single flights differ by {100 * spread:.1f} % (p = {chance:.2g})"
            + ": a battery, a load or another craft" * differ,
            "--per-flight, --shared",
        )
        return (options.but(per_flight=(thrust,)), again) if differ else (options, chosen)

    def _criterion(self, options: FitOptions, chosen: Candidate) -> tuple[FitOptions, Candidate]:
        """Multi-step errors in place of the likelihood where that foretells better by its error;
        where the likelihood has its maximum is asked then, too (`two_horizons`)."""
        if "predictor" in self.setting.given.choices:
            return options, chosen
        if chosen.ahead_score is None:
            self.note(
                "criterion",
                "likelihood one step ahead",
                f"it foretells pieces left out: {chosen.score.mean:.3f} of the last value's "
                "squared error",
                "--predictor",
            )
            return options, chosen
        _, error = chosen.ahead_score.better_by(chosen.likelihood_score)
        self.note(
            "criterion",
            "errors up to half a second ahead"
            if chosen.looks_ahead
            else "likelihood one step ahead",
            f"pieces left out: {chosen.ahead_score.mean:.3f} ahead, "
            f"{chosen.likelihood_score.mean:.3f} by "
            f"the likelihood, the difference {_within(error)}",
            "--predictor",
        )
        if not chosen.looks_ahead:
            return options, chosen
        return options.but(predictor="multi-step"), self.trials.ended(chosen, options)

    def _started(self, options: FitOptions, chosen: Candidate) -> FitOptions:
        """The final fit starts where the comparison ended; what ended at its null is held there."""
        said = self.setting.given.choices
        if "initialisation" in said or "values" in said:
            return options
        declared = {d.name: d for d in chosen.fit.model.dynamics.parameters}
        gone = [
            n
            for n, e in chosen.fit.parameters.items()
            if e.at_bound and e.value == declared[n].null
        ]
        if gone and "free" not in said:
            self.note(
                ", ".join(gone),
                "held at nothing",
                "where the comparison ended, at the bound",
                "--fixed",
            )
            options = options.but(fixed=(*options.fixed, *gone))
        start = {n: _rounded(e.value) for n, e in chosen.fit.parameters.items()}
        if "noise" not in said:
            options = options.but(
                noise={n: _rounded(v) for n, v in noise_of(chosen.fit.model).items()}
            )
        return options.but(values=start, initialisation="nominal")


def _within(error: float) -> str:
    return f"+- {error:.3f}" if np.isfinite(error) else "with no error: one block of them"


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")


def _differ(values: np.ndarray, errors: np.ndarray) -> tuple[float, float]:
    """(probability that equal values scatter so, relative spread) of estimates with errors."""
    if not (np.isfinite(values).all() and np.isfinite(errors).all() and (errors > 0).all()):
        return 1.0, 0.0
    weights = errors**-2
    middle = float((weights * values).sum() / weights.sum())
    chi2 = float((weights * (values - middle) ** 2).sum())
    return float(chi_square_tail(chi2, len(values) - 1)), float(values.std(ddof=1) / abs(middle))
