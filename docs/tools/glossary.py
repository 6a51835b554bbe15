"""The words of greybox: one word per thing, in the field's terms, and the words that are not used
for it.

The table is part of docs/reference.md; a test holds every page and every help text to it.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Word:
    """What a word means, and which other words of the field are not used for the same thing."""

    means: str
    instead_of: tuple[str, ...] = ()


WORDS: dict[str, Word] = {
    "attitude": Word(
        means="how the body is turned against the world: a unit quaternion, or roll, pitch and yaw"
    ),
    "back-off": Word(
        means="by how much a limit is tightened, so that uncertainty does not carry the craft over "
        "it"
    ),
    "bundle": Word(means="the folder that `greybox export` writes for a controller"),
    "coherence": Word(means="share of an output's power at a frequency that an input explains"),
    "command": Word(
        means="what goes to a motor, 0 to 1", instead_of=("throttle", "actuator input")
    ),
    "covariance": Word(means="variances of several numbers and how they go together"),
    "craft": Word(
        means="the multirotor that flew", instead_of=("quadcopter", "UAV", "UAS", "airframe")
    ),
    "dead reckoning": Word(
        means="gyro and accelerometer as measured, integrated: the floor of errors ahead"
    ),
    "discrepancy": Word(
        means="what the physics of a model misses",
        instead_of=("model mismatch", "unmodelled dynamics"),
    ),
    "disturbance": Word(means="force or torque that no command causes, carried along as a state"),
    "dynamics": Word(means="a model as its step, its outputs and its innovations"),
    "e-value": Word(
        means="evidence for a name; 20 or more happens by chance at most once in twenty"
    ),
    "effect": Word(
        means="one named piece of physics that a model has or not",
        instead_of=("submodel", "plug-in"),
    ),
    "floor": Word(means="the error that nothing which sees only commands can be expected to beat"),
    "free parameter": Word(
        means="a number that a fit estimates", instead_of=("degree of freedom of the fit",)
    ),
    "gap": Word(means="how far errors ahead are above the floor"),
    "held-out": Word(
        means="not used in a fit, a search or a training", instead_of=("holdout", "unseen data")
    ),
    "horizon": Word(
        means="how far ahead a prediction looks [s]",
        instead_of=("lookahead", "samples ahead", "steps ahead"),
    ),
    "hybrid": Word(means="a physical model with a learned part"),
    "innovation": Word(
        means="one-step prediction error", instead_of=("prediction residual", "one-step residual")
    ),
    "last value": Word(means="the measurement at the start, held: what a useful model must beat"),
    "log": Word(means="the file of a flight", instead_of=("logfile", "flight record file")),
    "null": Word(means="the value of a parameter at which its effect is not there"),
    "open loop": Word(means="by commands alone, with nothing that was measured after the start"),
    "per-flight parameter": Word(means="a number that each flight has of its own, such as a bias"),
    "plant": Word(means="what is flown in a simulation, with equations of its own"),
    "prediction error method": Word(means="estimation by the smallest innovations (PEM)"),
    "prior": Word(means="what the vehicle file says of a number, with its sigma"),
    "process noise": Word(means="what disturbs the states from sample to sample"),
    "residual": Word(
        means="what a learner learns: force and torque, or outputs, that the model leaves"
    ),
    "sample time": Word(
        means="seconds from one sample to the next", instead_of=("sampling time", "sampling period")
    ),
    "sensor noise": Word(
        means="what disturbs measurements", instead_of=("measurement noise", "observation noise")
    ),
    "specific force": Word(
        means="what an accelerometer measures", instead_of=("proper acceleration",)
    ),
    "standard error": Word(
        means="how far an estimate is off, typically", instead_of=("std error",)
    ),
    "support point": Word(
        means="one of the points that carry a sparse Gaussian process", instead_of=("pseudo-input",)
    ),
    "test flight": Word(
        means="a flight that judges and was not fitted", instead_of=("validation flight",)
    ),
    "training flight": Word(
        means="a flight that is fitted", instead_of=("estimation flight", "identification flight")
    ),
    "tube": Word(means="the set around a plan that the craft stays in at a stated level"),
    "vehicle file": Word(
        means="TOML with what is known of a craft", instead_of=("airframe file", "vehicle config")
    ),
    "verdict": Word(means="the first line of every result: useful how far ahead, or not, and why"),
    "white": Word(means="without memory: the past says nothing of what comes"),
}


def table() -> str:
    """The words as a section of a page."""
    lines = ["## Words", "", "One word per thing. The third column is not used for it here.", ""]
    lines += ["| word | what it means | not |", "|---|---|---|"]
    lines += [f"| {name} | {w.means} | {', '.join(w.instead_of)} |" for name, w in WORDS.items()]
    return "\n".join(lines) + "\n"
