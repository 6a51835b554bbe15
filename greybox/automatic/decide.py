"""decide: from flights and a vehicle file to the recipe of a fit, every choice with its reason.

1. Of two numbers of which flights show the ratio alone the better known one is held.
2. The nested standard sets of effects (`sets`) are fitted one after the other to the first part of
   every flight, with disturbance states of force and torque, and foretell the part left out. Of
   the sets within one standard error of the best the one with the lowest BIC is taken, less the
   effects that nothing feels: one that is there and left out bends what it is taken for.
3. Where innovations are not white and BIC clearly asks for it, sensors of the pose get coloured
   noise, then gyro and accelerometer a low-pass filter and coloured noise: a pose that errs for
   seconds looks like force, a filter that is left out like more lag of the motors, colour that is
   left out like a slower filter. What is not felt with them goes.
4. The thrust scale gets a value per flight where flights differ by more than their errors.
5. Errors up to half a second ahead replace the likelihood where that foretells better.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

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
    without_noise_of,
)
from greybox.automatic.foretell import Score, foretell
from greybox.automatic.like import lasting
from greybox.automatic.pieces import SHORTEST, first_parts
from greybox.automatic.sets import (
    LATE_POSE,
    TRIMMED,
    Step,
    names_of,
    nested_sets,
    per_flight_parameters,
)
from greybox.data import Dataset
from greybox.data.checks.finding import WANDER
from greybox.errors import GreyboxError, ModelError
from greybox.estimation.fit import fit, noise_of
from greybox.estimation.options import FitChoices, FitOptions
from greybox.estimation.recipe import Decision, Recipe
from greybox.estimation.record import sample_time
from greybox.estimation.result import Fit
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt
from greybox.model.core_parameters import core_parameters
from greybox.model.effect import Effect
from greybox.model.effective_lag import PARTS as IN_A_ROW
from greybox.model.given_values import demand_given
from greybox.model.identified import IdentifiedModel
from greybox.model.model import PhysicsModel, build_model, input_of
from greybox.model.noise import Coloured, LowPass, part_named
from greybox.model.noise.low_pass import FILTERED
from greybox.model.sensors import SENSORS
from greybox.model.vehicle import Vehicle
from greybox.statistics.distributions import chi_square_tail
from greybox.statistics.evidence import CLEAR as CLEAR_EVIDENCE
from greybox.statistics.evidence import FELT

CLEAR = 0.01
"""Probability below which flights count as different in their thrust scale (chi-square test)."""
NOTICEABLE = 0.005
"""... and the spread between them that matters: half a percent of thrust."""
ADAPT = 5.0
"""Seconds of a new flight from which its own parameters are taken."""
QUICK = LevenbergMarquardt(tolerance=0.2, max_iterations=20)
"""Solver of the comparison: ends within about half a standard error of the optimum."""
REFINE = LevenbergMarquardt(tolerance=0.2, max_iterations=4)
"""... where one more parameter is tried at an optimum: two steps take it there."""
WORTH = 0.05
"""Share of its squared error by which a larger set must improve a smaller one: less is worth
nothing."""
POOR = 0.1
"""Share of the last value's squared error (a third of the error) above which the likelihood
foretells poorly, so that errors further ahead are tried for every set."""
DIGITS = 3
"""Significant digits of the values that the final fit starts from: a start need not be exact."""
RATIOS = (("mass", "thrust.c2", "motion"), ("torque.c2", "inertia.zz", "yaw"))
"""Pairs that scale together and change no prediction: force over mass, yaw torque over inertia."""
THRUST = "thrust.c2"
TAKES_LATENESS = frozenset(n.split(".")[0] for n in IN_A_ROW) - {"motor_lag"}
"""Effects that stand for a filter of the gyro where there is none: what is late in its place."""

Say = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class Given:
    """What the user decided; None or absent: open. `choices` are fields of `FitOptions`, `source`
    is a model of a craft like this one."""

    effects: tuple[str | Effect, ...] | None = None
    input: Literal["command", "speed"] | None = None
    kinematic_noise: bool | None = None
    adapt: float | None = None
    source: IdentifiedModel | None = None
    choices: FitChoices = field(default_factory=lambda: FitChoices())


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
class _Begun:
    """A set of effects fitted by the likelihood, not judged yet, with the model and the options of
    that fit."""

    steps: tuple[Step, ...]
    likelihood: Fit
    model: PhysicsModel
    options: FitOptions


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
    return _Decider(vehicle=vehicle, data=data, facts=facts, given=given, say=say).run()


@dataclass(kw_only=True, eq=False)
class _Decider:
    vehicle: Vehicle
    data: Dataset
    facts: Facts
    given: Given
    say: Say
    decisions: list[Decision] = field(default_factory=list)
    input: Literal["command", "speed"] = "command"
    kinematic_noise: bool = False
    largest: tuple[Step, ...] = ()
    considered: tuple[str, ...] = ()

    def run(self) -> Decided:
        said = FitOptions.of(None, self.given.choices)
        for member in (said.chosen_predictor, said.chosen_criterion, said.chosen_solver):
            member()  # a name that there is not is said before anything takes time
        self._input()
        self._kinematics()
        options = self._held(self._noise(self._lasting(self._disturbance(said))))
        self.considered = options.considered
        parts = first_parts(self.data)
        if self.given.effects is not None:
            steps: tuple[Step, ...] = (
                Step(name="the effects asked for", effects=self.given.effects),
            )
        else:
            steps = nested_sets(self.vehicle, self.facts, input=self.input)
        self.largest = steps
        if said.values:  # before anything takes time; those of noise parts are asked by the fit
            model = self._model(_effects(steps))
            declared = {d.name for d in model.parameters}
            demand_given(model, {n: v for n, v in said.values.items() if n in declared})
        if parts is None:
            self._note(
                "effects",
                _listed(steps[:1]),
                f"every flight is shorter than {SHORTEST:g} s: "
                "no piece can be left out to compare larger sets",
                "--effects",
            )
            return self._decided(steps[:1], options, None)
        first = self._try(steps[:1], options, None, parts)
        if first is None:
            return self._decided(steps[:1], options, None)
        tried = self._nested(steps, options, first, parts)
        chosen = self._without_unfelt(likeliest_of_the_good(tried), options, parts)
        options, posed = self._poses(options, chosen, parts)
        if posed is not chosen:
            chosen = self._without_unfelt(posed, options, parts)
        options, noisy, reason = self._filters(options, chosen, parts)
        if noisy is not chosen:
            chosen = self._without_unfelt(noisy, options, parts)
        self._say_noise(chosen, reason)
        self._say_effects(chosen, tried)
        options, chosen = self._thrust_per_flight(options, chosen, parts)
        options, chosen = self._criterion(options, chosen, parts)
        return self._decided(chosen.steps, self._started(options, chosen), chosen)

    def _decided(
        self,
        steps: tuple[Step, ...],
        options: FitOptions,
        candidate: Candidate | None,
    ) -> Decided:
        recipe = Recipe(
            effects=_effects(steps),
            input=self.input,
            kinematic_noise=self.kinematic_noise,
            options=self._trim_of_one_flight(self._with_flight_values(options, steps), steps),
        )
        return Decided(
            recipe=replace(recipe, adapt=self._adapt(recipe)),
            decisions=tuple(self.decisions),
            given=self.given,
            candidate=candidate,
        )

    def _note(self, about: str, choice: str, reason: str, option: str) -> None:
        self.decisions.append(Decision(about=about, choice=choice, reason=reason, option=option))
        self.say(f"  {about}: {choice} ({reason})")

    # ------------------------------------------------------------ from facts

    def _input(self) -> None:
        self.input = self.given.input or input_of(self.data.channels, self.vehicle)
        if self.input == "speed":
            self.facts = self.facts.without({s.name for s in SENSORS if not s.usual})
        if self.input == "speed" and self.vehicle.actuator.speed_max is None:
            raise ModelError(
                "the rotor speeds have no scale",
                expected="actuator.speed_max [rad/s] in the vehicle file",
                fix="add the rotor speed at full command, or log the commands",
            )
        if self.given.input is None and self.input != "command":
            self._note(
                "input",
                "measured rotor speeds",
                "the logs have rotor speeds and no commands",
                "--input",
            )

    def _kinematics(self) -> None:
        if self.given.kinematic_noise is not None:
            self.kinematic_noise = self.given.kinematic_noise
        elif "attitude" in self.facts.sensors:
            self.kinematic_noise = self.facts.wander > WANDER
            self._note(
                "noise on the attitude kinematics",
                "yes" if self.kinematic_noise else "no",
                f"gyro and attitude drift apart by {self.facts.wander:.1f} samples within a flight",
                "--kinematic-noise",
            )

    def _disturbance(self, options: FitOptions) -> FitOptions:
        if "disturbance" in self.given.choices:
            return options
        felt = bool(self.facts.sensors & {"position", "velocity", "accelerometer"})
        groups = ("force", "torque") if felt else ("torque",)
        self._note(
            "disturbance states",
            ", ".join(groups),
            "gusts and what is not modelled push for a while; no parameter shall explain them",
            "--disturbance",
        )
        return options.but(disturbance=groups)

    def _lasting(self, options: FitOptions) -> FitOptions:
        if self.given.source is None:
            return options
        return options.but(
            priors={**lasting(self.given.source, options.disturbance), **options.priors}
        )

    def _noise(self, options: FitOptions) -> FitOptions:
        if "noise" in self.given.choices:
            return options
        levels = {
            f"noise.sensor.{component}": float(f"{level:.3g}")
            for (sensor, component), level in self.facts.noise.items()
            if sensor not in self.vehicle.noise
        }
        if not levels:
            return options
        self._note(
            "sensor noise",
            "starts from the fastest part of each channel and is estimated",
            "the vehicle file states none; third differences of the channels",
            "--noise",
        )
        return options.but(noise=levels)

    def _held(self, options: FitOptions) -> FitOptions:
        """Of two numbers of which the flights show the ratio alone, the one that is known
        better."""
        said = self.given.choices
        if "free" in said or ("fixed" in said and not options.fixed):  # said: nothing is held
            return options
        named = set(said.get("per_flight", ()))
        declared = {d.name: d for d in core_parameters(self.vehicle)}
        held = []
        for pair in RATIOS:
            both = [declared[n] for n in pair[:2]]
            if not all(0 < d.sigma < np.inf and d.nominal for d in both):
                continue
            if set(pair[:2]) & set(said.get("fixed", ())):
                continue
            better, worse = sorted(both, key=lambda d: (d.name in named, d.sigma / abs(d.nominal)))
            held.append(better.name)
            self._note(
                better.name,
                f"held at {better.nominal:.4g} {better.unit}",
                f"{pair[2]} shows only its ratio to {worse.name}, which is known less well; its "
                "own "
                f"{100 * better.sigma / abs(better.nominal):.2g} % are carried into the errors",
                "--fixed, --considered",
            )
        options = options.but(fixed=(*options.fixed, *held))
        return options if "considered" in said else options.but(considered=tuple(held))

    def _adapt(self, recipe: Recipe) -> float | None:
        if self.given.adapt is not None:
            return self.given.adapt
        model = self._model(recipe.effects)
        own = {d.name for d in model.parameters if d.scope == "flight"} | set(
            recipe.options.per_flight
        )
        own -= set(recipe.options.shared) | set(recipe.options.fixed)
        if not own:
            return None
        self._note(
            "a new flight",
            f"adapts on its first {ADAPT:g} s",
            f"{len(own)} parameters have one value per flight",
            "--adapt",
        )
        return ADAPT

    def _started(self, options: FitOptions, chosen: Candidate) -> FitOptions:
        """The final fit starts where the comparison ended; what ended at its null is held there."""
        said = self.given.choices
        if "initialisation" in said or "values" in said:
            return options
        declared = {d.name: d for d in chosen.fit.model.dynamics.parameters}
        gone = [
            n
            for n, e in chosen.fit.parameters.items()
            if e.at_bound and e.value == declared[n].null
        ]
        if gone and "free" not in said:
            self._note(
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

    # ------------------------------------------------------------ comparing on pieces left out

    def _model(self, effects: tuple[str | Effect, ...]) -> PhysicsModel:
        return build_model(
            self.vehicle,
            self.data.channels,
            effects,
            input=self.input,
            sample_time=sample_time(self.data),
            noncausal=self.data.noncausal,
            kinematic_noise=self.kinematic_noise,
        )

    def _with_flight_values(self, options: FitOptions, steps: tuple[Step, ...]) -> FitOptions:
        if "per_flight" in self.given.choices:
            return options
        own = per_flight_parameters(steps, self.vehicle)
        return options.but(per_flight=tuple(dict.fromkeys((*options.per_flight, *own))))

    def _trim_of_one_flight(self, options: FitOptions, steps: tuple[Step, ...]) -> FitOptions:
        """The pieces of a single flight share its trim, so that they cannot ask for one per flight.
        What takes it up in their place adapts to a new flight; to the fit it is nearly the same."""
        if "free" in self.given.choices or len(self.data) > 1:
            return options
        declared = {d.name: d for d in core_parameters(self.vehicle)}
        decided = {*options.fixed, *options.shared, *options.per_flight}
        own = [n for n in TRIMMED if declared[n].sigma > 0 and n not in decided]
        if own:
            self._note(
                ", ".join(own),
                "one value per flight",
                "one flight cannot tell whether its trim stays",
                "--shared",
            )
        return options.but(per_flight=(*options.per_flight, *own))

    def _try(
        self,
        steps: tuple[Step, ...],
        options: FitOptions,
        before: Candidate | None,
        parts: tuple[Dataset, Dataset],
        *,
        solver: LevenbergMarquardt = QUICK,
    ) -> Candidate | None:
        """`steps` fitted and judged, from where `before` ended; None where that is not possible.

        Errors further ahead are tried where the likelihood foretells poorly.
        """
        begun = self._likelihood(steps, options, before, parts, solver=solver)
        return None if begun is None else self._judged(begun, parts)

    def _likelihood(
        self,
        steps: tuple[Step, ...],
        options: FitOptions,
        before: Candidate | None,
        parts: tuple[Dataset, Dataset],
        *,
        solver: LevenbergMarquardt = QUICK,
        afresh: Collection[str] = (),
    ) -> _Begun | None:
        """`steps` fitted by the likelihood; effects begin `afresh` from their nominal values."""
        options = self._with_flight_values(options, steps).but(solver=solver, considered=())
        options = options.but(predictor="innovation")
        if before is None:
            options = options.but(initialisation="equation-error")
        else:
            dropped = {*afresh, *(set(_names(before.steps)) - set(_names(steps)))}
            options = _from(before.likelihood, options, dropped)
        try:
            model, options = self._one_library(steps, options)
            plain = fit(model, parts[0], options)
        except GreyboxError as error:
            self.say(f"  {steps[-1].name}: {error}")
            return None
        return _Begun(steps=steps, likelihood=plain, model=model, options=options)

    def _judged(self, begun: _Begun, parts: tuple[Dataset, Dataset]) -> Candidate | None:
        """The candidate that a fit by the likelihood began, with errors further ahead where it
        foretells poorly; None where it cannot run on what was left out."""
        plain, name = begun.likelihood, begun.steps[-1].name
        try:
            score = foretell(plain.model, parts[1])
        except GreyboxError as error:
            self.say(f"  {name}: {error}")
            return None
        found = Candidate(steps=begun.steps, likelihood=plain, likelihood_score=score)
        if "predictor" in self.given.choices or score.mean <= POOR:
            return found
        options = _from(plain, begun.options, set()).but(predictor="multi-step")
        try:
            many = fit(begun.model, parts[0], options)
            return replace(found, ahead=many, ahead_score=foretell(many.model, parts[1]))
        except GreyboxError as error:
            self.say(f"  {name}, errors ahead: {error}")
            return found

    def _one_library(
        self, steps: tuple[Step, ...], options: FitOptions
    ) -> tuple[PhysicsModel, FitOptions]:
        """The model of the largest set in which what is not among `steps` is held at nothing: the
        same predictions, and one build serves all nested sets."""
        own = set(_names(steps))
        more = [
            replace(s, effects=tuple(e for e in s.effects if _name(e) not in own))
            for s in self.largest
        ]
        model = self._model(_effects((*steps, *more)))
        absent = set(_names(tuple(more)))
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

    def _nested(
        self,
        steps: tuple[Step, ...],
        options: FitOptions,
        first: Candidate,
        parts: tuple[Dataset, Dataset],
    ) -> list[Candidate]:
        """`first`, the smallest set, and the larger ones up to all `steps`."""
        tried: list[Candidate] = []
        for i in range(1, len(steps) + 1):
            got = self._try(steps[:i], options, tried[-1], parts) if tried else first
            if got is not None:
                tried.append(got)
                self.say(f"  {got.name}: {got.score.mean:.3f} of the last value's squared error")
        return tried

    def _without_unfelt(
        self,
        chosen: Candidate,
        options: FitOptions,
        parts: tuple[Dataset, Dataset],
    ) -> Candidate:
        """`chosen` without what nothing feels, if that is `plainer`."""
        kept = _felt_steps(chosen)
        if kept == chosen.steps:
            return chosen
        less = self._try(kept, options, chosen, parts)
        return chosen if less is None else plainer(chosen, less)

    def _say_effects(self, chosen: Candidate, tried: list[Candidate]) -> None:
        if self.given.effects is not None:
            return
        listed = ", ".join(
            f"{'+ ' * (c is not tried[0])}{c.name} {c.score.mean:.3g}" for c in tried
        )
        self._note(
            "effects",
            _listed(chosen.steps),
            "of the sets that foretell pieces left out as well as the best the one with the lowest "
            f"BIC; squared errors ahead, the last value's = 1: {listed}",
            "--effects, --per-flight",
        )

    def _filters(
        self, options: FitOptions, first: Candidate, parts: tuple[Dataset, Dataset]
    ) -> tuple[FitOptions, Candidate, str]:
        """(options, candidate, reason) with filters and colour of gyro and accelerometer where BIC
        clearly asks for them and the last value is still beaten, `first` where not. The effects of
        `first` stay: colour would take what they explain. A pose that is as late as a filtered IMU
        hides it: the two are tried together."""
        if "noise_parts" in self.given.choices:
            return options, first, ""
        named = "free" in self.given.choices  # nothing else is estimated, no time constant either
        offered = () if self.kinematic_noise or named else offered_parts(first.likelihood)
        reason = "no time constant is longer than nothing within its error and possible"
        if self.kinematic_noise:
            reason = "the clocks of gyro and attitude wander by more than a filter is late"
        elif named:
            reason = "exactly the parameters that were named are estimated"
        elif not offered:
            reason = "the innovations of the IMU are white"
        steps = first.steps
        if offered and self._pose_may_be_late() and not _shared(steps, LATE_POSE):
            clocks = [s for s in self.largest if _shared((s,), LATE_POSE)]
            steps = (*steps, *(clocks or [LATE_POSE]))
        own, again, said = self._with_noise(options, first, steps, offered, parts)
        if again is None:
            return options, first, said or reason
        better = again.score.mean < max(1.0, first.score.mean)
        said += "; a filter that is left out looks like more lag of the motors"
        if better:
            return own, again, said
        return options, first, said

    def _poses(
        self, options: FitOptions, first: Candidate, parts: tuple[Dataset, Dataset]
    ) -> tuple[FitOptions, Candidate]:
        """(options, candidate) with coloured noise of the sensors of the pose whose innovations are
        not white, where BIC clearly asks for it and pieces left out are foretold better."""
        if "noise_parts" in self.given.choices or "free" in self.given.choices:
            return options, first
        offered = lasting_poses(first.likelihood)
        own, again, said = self._with_noise(options, first, first.steps, offered, parts)
        if not offered or not said:
            return options, first
        while again is not None and (rest := without_least_sure(again.likelihood)):
            # the error of one sensor colours the innovations of the others
            less = self._with_noise(options, first, first.steps, rest, parts)
            if less[1] is None or less[1].likelihood.bic >= again.likelihood.bic:
                break
            own, again, said = less
        if again is None or not again.score.mean < first.score.mean:
            self._note("noise of the pose", "white", said, "--noise-parts")
            return options, first
        felt = [p for p in map(part_named, own.noise_parts) if isinstance(p, Coloured)]
        choice = ", ".join(described(p, again.likelihood) for p in felt)
        self._note("noise of the pose", choice, said, "--noise-parts")
        return own, again

    def _with_noise(
        self,
        options: FitOptions,
        first: Candidate,
        steps: tuple[Step, ...],
        offered: Sequence[Part],
        parts: tuple[Dataset, Dataset],
    ) -> tuple[FitOptions, Candidate | None, str]:
        """(options, candidate, reason) with those of the `offered` parts that are felt together;
        None where none is, or where BIC does not clearly ask for them."""
        while offered:
            own = with_noise_parts(options, offered, first.likelihood)
            # a delay has taken what a filter is late: it lets go, or the search stays where it was
            begun = self._likelihood(steps, own, first, parts, afresh=TAKES_LATENESS)
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
            if gain <= CLEAR_EVIDENCE:  # what evidence refuses is not judged ahead
                return options, None, said
            again = self._judged(begun, parts)
            if again is None:
                return options, None, "no fit with one"
            return (
                own,
                again,
                f"{said}, the squared error ahead goes from {first.score.mean:.3f} "
                f"to {again.score.mean:.3f} of the last value's",
            )
        return options, None, ""

    def _say_noise(self, chosen: Candidate, reason: str) -> None:
        if "noise_parts" in self.given.choices:
            return
        parts = [part_named(n) for n in chosen.likelihood.settings["noise_parts"]]
        of_imu = [p for p in parts if isinstance(p, LowPass | Coloured) and p.sensor in FILTERED]
        said = ", ".join(described(p, chosen.likelihood) for p in of_imu) or "white"
        self._note("noise of the IMU", said, reason, "--noise-parts")

    def _pose_may_be_late(self) -> bool:
        return (
            self.given.effects is None
            and self.facts.has_pose
            and self.facts.has_imu
            and LATE_POSE.name not in self.vehicle.effects
        )

    def _thrust_per_flight(
        self, options: FitOptions, chosen: Candidate, parts: tuple[Dataset, Dataset]
    ) -> tuple[FitOptions, Candidate]:
        open_question = (
            "per_flight" not in self.given.choices and "shared" not in self.given.choices
        )
        if not open_question or len(parts[0]) < 2 or THRUST not in chosen.fit.parameters:
            return options, chosen
        own = options.but(per_flight=(THRUST,))
        again = self._try(chosen.steps, own, chosen, parts, solver=REFINE)
        if again is None:
            return options, chosen
        each = np.array(list(again.fit.parameters[THRUST].per_flight.values()))
        chance, spread = _differ(each[:, 0], each[:, 1])
        gain, error = again.score.better_by(chosen.score)
        differ = chance < CLEAR and spread > NOTICEABLE and gain > -error
        self._note(
            "thrust scale",
            "one value per flight" if differ else "one value for all flights",
            f"single flights differ by {100 * spread:.1f} % (p = {chance:.2g})",
            "--per-flight, --shared",
        )
        return (options.but(per_flight=(THRUST,)), again) if differ else (options, chosen)

    def _criterion(
        self, options: FitOptions, chosen: Candidate, parts: tuple[Dataset, Dataset]
    ) -> tuple[FitOptions, Candidate]:
        """Multi-step errors in place of the likelihood where that foretells better by its error."""
        if "predictor" in self.given.choices:
            return options, chosen
        if chosen.ahead_score is None:
            self._note(
                "criterion",
                "likelihood one step ahead",
                f"it foretells pieces left out: {chosen.score.mean:.3f} of the last value's "
                "squared error",
                "--predictor",
            )
            return options, chosen
        _, error = chosen.ahead_score.better_by(chosen.likelihood_score)
        self._note(
            "criterion",
            "errors up to half a second ahead"
            if chosen.looks_ahead
            else "likelihood one step ahead",
            f"pieces left out: {chosen.ahead_score.mean:.3f} ahead, "
            f"{chosen.likelihood_score.mean:.3f} by "
            f"the likelihood, the difference {_within(error)}",
            "--predictor",
        )
        return (options.but(predictor="multi-step") if chosen.looks_ahead else options), chosen


def _within(error: float) -> str:
    return f"+- {error:.3f}" if np.isfinite(error) else "with no error: one block of them"


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


def _effects(steps: tuple[Step, ...]) -> tuple[str | Effect, ...]:
    return tuple(e for s in steps for e in s.effects)


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")


def _name(effect: str | Effect) -> str:
    return effect if isinstance(effect, str) else effect.name


def _names(steps: tuple[Step, ...]) -> tuple[str, ...]:
    return tuple(n for s in steps for n in names_of(s))


def _shared(steps: tuple[Step, ...], step: Step) -> bool:
    """Whether an effect of `step` is among those of `steps`."""
    return not set(_names(steps)).isdisjoint(names_of(step))


def _listed(steps: tuple[Step, ...]) -> str:
    return ", ".join(_names(steps)) or "none"


def _felt_steps(candidate: Candidate) -> tuple[Step, ...]:
    """The steps without those of their effects, after the first step, whose every parameter is
    nothing within its error."""
    first, *more = candidate.steps
    kept = [first]
    for step in more:
        felt = tuple(e for e in step.effects if _felt(_name(e), candidate.fit))
        if felt:
            kept.append(replace(step, effects=felt))
    return tuple(kept)


def _felt(effect: str, fitted: Fit) -> bool:
    null = {d.name: d.null for d in fitted.model.dynamics.parameters}
    own = [(n, e) for n, e in fitted.parameters.items() if n.split(".")[0] == effect]
    numbers = [(null[n], *v) for n, e in own for v in (e.per_flight.values() or [(e.value, e.std)])]
    # An estimate at a bound has no error: felt, unless that bound is its null.
    return any(
        v != zero and (not np.isfinite(std) or abs(v) > FELT * std) for zero, v, std in numbers
    )


def _differ(values: np.ndarray, errors: np.ndarray) -> tuple[float, float]:
    """(probability that equal values scatter so, relative spread) of estimates with errors."""
    if not (np.isfinite(values).all() and np.isfinite(errors).all() and (errors > 0).all()):
        return 1.0, 0.0
    weights = errors**-2
    middle = float((weights * values).sum() / weights.sum())
    chi2 = float((weights * (values - middle) ** 2).sum())
    return float(chi_square_tail(chi2, len(values) - 1)), float(values.std(ddof=1) / abs(middle))
