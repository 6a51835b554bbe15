"""From what was seen around a fit to the likely reason of a bad model, the next step, and the
section that explains it.

Whoever sees something (the checks of a log, a solver's end, a test of physics) says it as a `Hint`;
`likely` picks the one that most often is the cause of the others. One table, in that order.
"""

from __future__ import annotations

import enum
import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from itertools import chain

from greybox.data.checks import CheckReport, Finding
from greybox.errors import DataError
from greybox.estimation.fit import Fit
from greybox.model.absence import not_offered
from greybox.model.effects import effect_by_name
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import own_parameters
from greybox.model.model import PhysicsModel
from greybox.validation.sanity import Sanity, sanity_of, sanity_of_model

PAGE = "docs/bad_fit.md"
"""The page whose sections the anchors name."""
LATE = 0.025
"""Lag [s] of the motion behind the commands from which a model without motor lag is expected to
fail: at 5 Hz, where a small multirotor turns, 25 ms are 45 degrees of phase."""
WANDER = 2.0
"""Samples by which gyro and attitude wander against each other from which `check` warns
(greybox.data.checks.alignment)."""
LAG_EFFECTS = ("motor_lag", "command_delay")
"""Effects that let the motion follow the commands late."""


class Symptom(enum.Enum):
    """What was seen. The value is the section of the page, as an anchor."""

    LOG_FAULT = "a-log-has-a-fault"
    FOR_NAMES = "a-model-that-was-made-to-name"
    DIVERGED = "the-prediction-is-not-finite"
    LATE_MOTORS = "the-motors-answer-late-and-the-model-does-not"
    IMPOSSIBLE = "a-parameter-has-an-impossible-value"
    OVERRULED = "a-measured-number-was-overruled"
    BOUNDS = "several-parameters-at-their-bounds"
    NOT_CONVERGED = "the-fit-did-not-converge"
    START = "the-start-is-off"
    CLOCKS = "the-clocks-wander"
    FLIGHT_DIFFERS = "this-flight-differs-from-the-training-flights"
    SATURATED = "a-command-saturates"
    CALM = "too-calm-to-judge"
    NO_BETTER = "no-better-than-the-last-value"
    POSITION = "position-worse-than-the-last-value"
    VELOCITY = "velocity-worse-than-the-last-value"
    ROTATION = "rotation-worse-than-the-last-value"
    RATE = "rate-worse-than-the-last-value"
    SPECIFIC_FORCE = "specific-force-worse-than-the-last-value"
    TURNING = "one-gain-for-a-whole-record"
    OWN_OUTPUT = "an-output-of-your-own-model"
    LEARNED_WORSE = "worse-than-the-physics-alone"

    @property
    def anchor(self) -> str:
        """Page and section."""
        return f"{PAGE}#{self.value}"


@dataclass(frozen=True, kw_only=True)
class Hint:
    """One thing seen: `detail` says it in words (with names and numbers), "" where the table's
    words do. What was seen of one `flight` ("": of all) is no reason where the model is useful on
    that alone."""

    symptom: Symptom
    detail: str = ""
    flight: str = ""


@dataclass(frozen=True, kw_only=True)
class Advice:
    """The likely reason in words, and what to do next. Where a hint has a detail, it follows the
    reason in brackets."""

    symptom: Symptom
    reason: str
    action: str


ADVICE: tuple[Advice, ...] = (
    Advice(
        symptom=Symptom.LOG_FAULT,
        reason="a log has a fault that a fit cannot repair",
        action="greybox check names it and its repair",
    ),
    Advice(
        symptom=Symptom.FOR_NAMES,
        reason="this model was fitted to tell causes apart, not to foretell",
        action="greybox fit with the effects that were named",
    ),
    Advice(
        symptom=Symptom.LATE_MOTORS,
        reason="the motors answer late and the model does not know it",
        action="--effects motor_lag",
    ),
    Advice(
        symptom=Symptom.IMPOSSIBLE,
        reason="a parameter has a value that physics does not allow, so it stands for something "
        "that is missing",
        action="leave that effect out, or add what is missing (greybox discover)",
    ),
    Advice(
        symptom=Symptom.OVERRULED,
        reason="the fit left a number of the vehicle file that was measured",
        action="hold it with --fixed, and look at what then fits worse",
    ),
    Advice(
        symptom=Symptom.BOUNDS,
        reason="several parameters ran to their bounds: the structure is wrong, not the numbers",
        action="--effects motor_lag,gyro_bias,accelerometer_bias and --disturbance force,torque; "
        "hold with --fixed what was weighed and what the flights do not show",
    ),
    Advice(
        symptom=Symptom.NOT_CONVERGED,
        reason="the fit did not converge",
        action="fewer free parameters (--fixed), or better numbers in the vehicle file",
    ),
    Advice(
        symptom=Symptom.START,
        reason="a sensor errs for seconds, or the start is wrong: dead reckoning from there loses to "
        "the last value too, whatever the forces are",
        action="greybox fit without --noise-parts asks for noise that lasts; greybox check names "
        "other faults",
    ),
    Advice(
        symptom=Symptom.CLOCKS,
        reason="the attitude is not the integral of the gyro",
        action="--kinematic-noise",
    ),
    Advice(
        symptom=Symptom.FLIGHT_DIFFERS,
        reason="this flight differs from those of the fit (battery, trim, range)",
        action="--per-flight thrust.c2 (thrust.c1 where the map is linear), or fly in training "
        "what is flown here",
    ),
    Advice(
        symptom=Symptom.SATURATED,
        reason="commands are at their limits",
        action="fly with more headroom, or add --effects command_saturation",
    ),
    Advice(
        symptom=Symptom.TURNING,
        reason="the filter's one gain serves a whole record and does not suit all of it, so that "
        "the model itself is not judged",
        action="measure the state that turns (a heading), or write states and outputs in axes that "
        "turn with it",
    ),
    Advice(
        symptom=Symptom.DIVERGED,
        reason="the model runs away in open loop",
        action="fewer effects, and --disturbance force,torque",
    ),
    Advice(
        symptom=Symptom.ROTATION,
        reason="torques are wrong: lag, damping or trim of the motors is missing",
        action="--effects motor_lag,rotational_damping,gyro_bias --disturbance torque",
    ),
    Advice(
        symptom=Symptom.RATE,
        reason="torques are wrong: lag or damping is missing, or yaw is not excited",
        action="--effects motor_lag,rotational_damping --disturbance torque",
    ),
    Advice(
        symptom=Symptom.VELOCITY,
        reason="forces are wrong: thrust scale, battery or drag is missing",
        action="--effects battery_sag,rotor_drag,accelerometer_bias --disturbance force",
    ),
    Advice(
        symptom=Symptom.POSITION,
        reason="forces are wrong: thrust scale, battery or drag is missing",
        action="--effects battery_sag,rotor_drag,accelerometer_bias --disturbance force",
    ),
    Advice(
        symptom=Symptom.SPECIFIC_FORCE,
        reason="thrust is wrong, or the accelerometer shakes more than the craft accelerates",
        action="--effects motor_lag,battery_sag,accelerometer_bias",
    ),
    Advice(
        symptom=Symptom.NO_BETTER,
        reason="the commands hardly matter in this model",
        action="greybox check (motor order, excitation), then greybox discover",
    ),
    Advice(
        symptom=Symptom.OWN_OUTPUT,
        reason="something that moves this output is missing in the model",
        action="look at its errors in report.html, add the term to the model's program, or greybox "
        "learn",
    ),
    Advice(
        symptom=Symptom.LEARNED_WORSE,
        reason="what was learned holds for the training flights and not for these",
        action="greybox check the training flights, or learn from flights like these",
    ),
)
"""Causes before consequences: a log that lies spoils everything, a missing lag sends parameters to
their bounds, bounds keep a solver from converging; what only one group shows comes last."""

_OF_GROUP = {
    "position": Symptom.POSITION,
    "velocity": Symptom.VELOCITY,
    "rotation": Symptom.ROTATION,
    "rate": Symptom.RATE,
    "specific_force": Symptom.SPECIFIC_FORCE,
}


def symptom_of_group(group: str) -> Symptom:
    """What it is called when a channel group is worse than the last value. Raises `DataError` for
    another name."""
    try:
        return _OF_GROUP[group]
    except KeyError:
        raise DataError(
            "no symptom for this group", expected=", ".join(_OF_GROUP), got=group
        ) from None


def likely(hints: Iterable[Hint], fallback: Symptom) -> tuple[str, str, str]:
    """(reason, action, anchor) of the likeliest cause among `hints`; of `fallback` where there are
    none."""
    given = list(hints)
    for advice in ADVICE:
        for hint in given:
            if hint.symptom is advice.symptom:
                reason = f"{advice.reason} ({hint.detail})" if hint.detail else advice.reason
                return reason, advice.action, advice.symptom.anchor
    advice = next(a for a in ADVICE if a.symptom is fallback)
    return advice.reason, advice.action, advice.symptom.anchor


def hints_of(
    fit: Fit, reports: Iterable[CheckReport], *, kinematic_noise: bool = False
) -> tuple[Hint, ...]:
    """All that the checks of the logs, physics and the fit itself say about a fit."""
    effects = fit.model.effects
    checks = (hints_of_checks(r, effects=effects, kinematic_noise=kinematic_noise) for r in reports)
    return (*chain(*checks), *hints_of_sanity(sanity_of(fit)), *hints_of_fit(fit))


def hints_of_checks(
    report: CheckReport, *, effects: Collection[str], kinematic_noise: bool = False
) -> tuple[Hint, ...]:
    """What the checks of the logs say about a model with these effects."""
    # Flights are cut at gaps: what is missing costs data and spoils no fit.
    faults = [f for f in report.blocking if f.check != "gaps"]
    out = [_of_flight(Symptom.LOG_FAULT, f) for f in faults]
    lags = [
        float(f.evidence[k])
        for f in report.of("alignment")
        for k in ("p_s", "q_s")
        if k in f.evidence and f.severity != "blocking"
    ]
    if lags and max(lags) > LATE and not set(effects) & set(LAG_EFFECTS):
        out.append(
            Hint(
                symptom=Symptom.LATE_MOTORS,
                detail=f"roll and pitch follow the commands by {1e3 * max(lags):.0f} ms",
            )
        )
    most = max(report.drifts, default=0.0)
    if most > WANDER and not kinematic_noise:
        out.append(
            Hint(symptom=Symptom.CLOCKS, detail=f"their clocks wander by {most:.1f} samples")
        )
    axes = max(report.axes_apart, default=0.0)
    if axes > WANDER and not kinematic_noise:
        out.append(
            Hint(symptom=Symptom.CLOCKS, detail=f"an estimator's axes are {axes:.1f} samples apart")
        )
    # Commands alone: a sensor that clips has no share.
    limited = [f for f in report.of("saturation") if "share" in f.evidence]
    if "command_saturation" not in effects:
        limited.sort(key=lambda f: f.evidence["share"], reverse=True)
        out += [_of_flight(Symptom.SATURATED, f) for f in limited]
    return tuple(out)


def _of_flight(symptom: Symptom, found: Finding) -> Hint:
    return Hint(symptom=symptom, detail=f"{found.flight}: {found.message}", flight=found.flight)


def hints_of_fit(fit: Fit) -> tuple[Hint, ...]:
    """What a fit says about itself: parameters at bounds, a solver that did not arrive."""
    out = []
    own = own_parameters(fit.model.dynamics)
    bound = [n for n, e in fit.parameters.items() if e.at_bound and n in own]
    if len(bound) > 1:
        out.append(Hint(symptom=Symptom.BOUNDS, detail=", ".join(bound)))
    if not fit.converged:
        out.append(Hint(symptom=Symptom.NOT_CONVERGED))
    return tuple(out)


OF_A_FIT = (Symptom.FOR_NAMES, Symptom.OVERRULED, Symptom.BOUNDS, Symptom.NOT_CONVERGED)
"""What a fit says of itself and a model file holds nowhere but in its verdict."""


def hints_of_model(model: IdentifiedModel) -> tuple[Hint, ...]:
    """What a model keeps of what its own fit knew: the reason of its verdict, where the fit itself
    gave it, and what physics says about its values."""
    own = model.verdict
    said = [] if own is None else [a for a in ADVICE if a.symptom.anchor == own.anchor]
    out = [
        Hint(
            symptom=a.symptom,
            detail=own.reason.removeprefix(a.reason).removeprefix(" (").removesuffix(")"),
        )
        for a in said
        if own is not None and a.symptom in OF_A_FIT
    ]
    return (*out, *hints_of_sanity(sanity_of_model(model)))


def hints_of_sanity(sanity: Sanity) -> tuple[Hint, ...]:
    """What physics says about the estimates: impossible values, measured numbers that were
    overruled."""
    return tuple(
        Hint(
            symptom=Symptom.IMPOSSIBLE if f.severity == "impossible" else Symptom.OVERRULED,
            detail=f.line(),
        )
        for f in sanity.findings
        if f.severity == "impossible" or f.kind == "overruled"
    )


def impossible(action: str, model: PhysicsModel, columns: Collection[str]) -> set[str]:
    """The effects that an action names and that logs with these columns cannot judge beside the
    model."""
    named = {n for part in re.findall(r"--effects ([a-z_,]+)", action) for n in part.split(",")}
    return {n for n in named if not_offered(effect_by_name(n), model, columns) is not None}


def lacking(action: str, there: Collection[str]) -> str:
    """An action without the effects and groups of disturbances that the model has already, or that
    cannot be there."""

    def left(match: re.Match[str]) -> str:
        names = [n for n in match.group(2).split(",") if n not in there]
        return f"{match.group(1)} {','.join(names)}" if names else ""

    text = re.sub(r"(--effects|--disturbance) ([a-z_,]+)", left, action)
    if text == action:
        return action
    text = re.sub(r"(?: and)? +(?=[;, ]|$)", "", text)  # what joined a part that is gone
    text = re.sub(r"^(?:[ ;,]|and )+|[ ;,]+$", "", text)
    return text or "greybox discover names what is missing"
