"""Sanity: what estimates say about the model when they are nothing that a craft has.

A search that lacks a cause bends the parameters that it may move until they stand for it: masses
that differ from the scale's, torques of the wrong sign, numbers at their bounds. Each finding is
therefore a sentence about the structure of the model, with what to try. Whether the solver
converged plays no part.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Set
from dataclasses import asdict, dataclass, replace
from typing import Literal, Protocol

import numpy as np

from greybox.estimation.fit import Fit
from greybox.estimation.suspects import DENIED
from greybox.files import Json
from greybox.model.body import margins
from greybox.model.composition import acts_on_speeds
from greybox.model.core_parameters import leading
from greybox.model.effects import CATALOGUE
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import own_parameters, physics_of
from greybox.model.model import PhysicsModel
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.statistics.evidence import FELT

Severity = Literal["impossible", "doubtful"]
Kind = Literal["value", "inertia", "overruled", "bounds", "noise"]

EITHER_SIGN = ("pose_delay.", "rotor_speed_delay.", "disturbance.")
"""Times [s] that are no lag behind a command."""


@dataclass(frozen=True, kw_only=True)
class Limit:
    """A threshold of this page and where it comes from."""

    value: float
    source: str


LIMITS: Mapping[str, Limit] = {
    "sigmas": Limit(
        value=DENIED,
        source="a Gaussian prior is that wrong once in 16 000; bounds of schema /1 stand there",
    ),
    "sigmas, rounded": Limit(value=3.95, source="4, less what the search leaves at a bound"),
    "at bounds": Limit(
        value=3,
        source="one is a wide prior, two a ratio that data leave open; three is a missing cause",
    ),
    "inertia, rounded": Limit(
        value=-0.013, source="margin of 5 % beyond the triangle: the slack of the vehicle reader"
    ),
    "errors": Limit(
        value=2.0,
        source="standard errors of the excess: within them a craft can have it, and nothing is "
        "known to be wrong",
    ),
    "inertia, least": Limit(value=0.01, source="J / (m L^2); limit of greybox.model.plausibility"),
    "inertia, most": Limit(value=3.0, source="J / (m L^2); limit of greybox.model.plausibility"),
    "density, least": Limit(
        value=5.0, source="m / L^3 [kg/m^3]; limit of greybox.model.plausibility"
    ),
    "density, most": Limit(
        value=6000.0, source="m / L^3 [kg/m^3]; limit of greybox.model.plausibility"
    ),
    "motor time": Limit(
        value=0.3, source="s; large propellers take 0.2 s (greybox.model.plausibility: 0.2 s)"
    ),
    "stamps": Limit(value=1e-4, source="s; what stamps of a log can tell, whose clocks jitter"),
    "louder": Limit(
        value=5.0,
        source="times the stated noise of a sensor; mounting and vibration make a few of it",
    ),
    "hover": Limit(
        value=1.3, source="share of the range of commands; effects may raise thrust by 30 %"
    ),
}
"""Every number that decides a finding."""


class Estimated(Protocol):
    """What is asked of an estimate (`greybox.estimation.fit.Estimate` has it)."""

    @property
    def value(self) -> float:
        """Estimate in its unit."""

    @property
    def std(self) -> float:
        """Standard error, NaN where it has none."""

    @property
    def prior(self) -> tuple[float, float] | None:
        """Mean and standard deviation, None where there is no prior."""

    @property
    def at_bound(self) -> bool:
        """Whether the search ended at a bound."""

    @property
    def unit(self) -> str:
        """SI unit."""


Estimates = Mapping[str, Estimated]
Values = Mapping[str, float]


@dataclass(frozen=True, kw_only=True)
class Insane:
    """One finding: what the estimates say (`statement`), why that is probably so, and what to try.

    "impossible": no craft has it, the model is not usable; "doubtful": it may predict and yet be
    wrong inside.
    """

    severity: Severity
    kind: Kind
    parameters: tuple[str, ...]
    statement: str
    likely: str
    attempt: str

    def line(self) -> str:
        """One line for a person."""
        return f"{self.severity}: {self.statement}: {self.likely}; try: {self.attempt}"


@dataclass(frozen=True, kw_only=True)
class Sanity:
    """What `sanity` found, the impossible first."""

    findings: tuple[Insane, ...]

    @property
    def possible(self) -> bool:
        """Whether a craft can have these numbers."""
        return all(f.severity != "impossible" for f in self.findings)

    def lines(self) -> list[str]:
        """One line per finding."""
        return [f.line() for f in self.findings]

    def to_dict(self) -> dict[str, Json]:
        """Plain values."""
        return {"possible": self.possible, "findings": [asdict(f) for f in self.findings]}


def sanity(
    estimates: Mapping[str, Estimated], vehicle: Vehicle, values: Mapping[str, float] | None = None
) -> Sanity:
    """Judge estimates by name. `values` are all parameters of the model, also those that were held
    (else the vehicle's)."""
    known = {n: q.value for n, q in vehicle.quantities.items()} | dict(values or {})
    known |= {n: e.value for n, e in estimates.items()}
    found: list[Insane] = []
    for judge in (_curves, _times, _mass, _inertia, _overruled, _together, _bounds):
        found += judge(estimates, vehicle, known)
    return Sanity(findings=tuple(sorted(found, key=lambda f: f.severity != "impossible")))


def sanity_of(fit: Fit) -> Sanity:
    """Judge a fit of a quadrotor; nothing is said about other models."""
    own = own_parameters(fit.model.dynamics)  # a noise that is not there says nothing of physics
    judged = {n: e for n, e in fit.parameters.items() if n in own or not e.at_bound}
    return _sanity(fit.model, judged, fit.noise)


def sanity_of_model(model: IdentifiedModel) -> Sanity:
    """Judge what a model of a quadrotor keeps of its estimates: values, standard errors and the
    priors that were declared. Bounds and noise are not judged."""
    declared = {d.name: d for d in model.dynamics.parameters}
    errors = model.standard_errors | {n: std for n, (_, std) in model.flight_spread.items()}
    return _sanity(
        model,
        {n: _Kept.of(declared[n], model.values[n], s) for n, s in errors.items() if n in declared},
        {},
    )


@dataclass(frozen=True, kw_only=True)
class _Kept:
    """An estimate as a model file keeps it; fields as in `Estimated`."""

    value: float
    std: float
    prior: tuple[float, float] | None
    unit: str
    at_bound: bool = False

    @classmethod
    def of(cls, declared: Parameter, value: float, std: float) -> _Kept:
        prior = (declared.nominal, declared.sigma) if 0 < declared.sigma < math.inf else None
        return cls(value=value, std=std, prior=prior, unit=declared.unit)


def _sanity(
    model: IdentifiedModel, estimates: Estimates, noise: Mapping[str, tuple[float, float, str]]
) -> Sanity:
    """The estimates of a model, the impossible first, with what was not yet tried."""
    physics = physics_of(model.dynamics)
    if physics is None:
        return Sanity(findings=())
    # Measured rotor speeds may be logged late: they then act before their stamps.
    delays = tuple(f"{e.name}." for e in physics.effects if "delay" in e.early)
    late = delays if physics.input == "speed" else ()
    judged = {n: e for n, e in estimates.items() if not n.startswith(late)}
    beyond = _beyond(judged, model.dynamics.parameters)
    found = sanity(judged, physics.vehicle, model.values).findings
    there = frozenset(model.effects)
    if physics.input == "speed":  # nothing that shapes a command can be added
        there |= {e.name for e in CATALOGUE if not acts_on_speeds(e)}
    return Sanity(
        findings=tuple(
            replace(f, attempt=untried(f.attempt, there))
            for f in (*beyond, *found, *_louder(noise, physics))
        )
    )


def _beyond(estimates: Estimates, declared: Iterable[Parameter]) -> Iterator[Insane]:
    """Estimates beyond what their declaration says that any craft has, by more than their
    errors."""
    for d in declared:
        e = estimates.get(d.name)
        if e is None:
            continue
        error = e.std if math.isfinite(e.std) else 0.0
        if d.excess(e.value) > LIMITS["errors"].value * error:
            yield Insane(
                severity="impossible",
                kind="value",
                parameters=(d.name,),
                statement=f"{d.name} is {e.value:.3g} {d.unit}".rstrip()
                + f" (no craft has more than {d.possible:.3g})",
                likely="it stands for something that these flights do not tell apart from it, or "
                "the log has other axes or units",
                attempt=f"hold it (--fixed {d.name}), log what tells it (a pose); greybox check",
            )


def _louder(
    noise: Mapping[str, tuple[float, float, str]], physics: PhysicsModel
) -> Iterator[Insane]:
    """Sensors that are much noisier than the vehicle file says: what they show is not what the
    model has of them."""
    for sensor in physics.sensors:
        stated = physics.vehicle.noise.get(sensor.name)
        names = [f"noise.sensor.{s.name}" for s in sensor.innovation_signals(physics.vehicle)]
        found = [(*noise[n], n) for n in names if n in noise]
        if stated is None or not found:
            continue
        level, _, unit, name = max(found)
        if level > LIMITS["louder"].value * stated:
            yield Insane(
                severity="doubtful",
                kind="noise",
                parameters=(name,),
                statement=f"noise of {sensor.name} was stated ({stated:.3g} {unit}) but the "
                f"flights want {level:.3g} {unit}, {level / stated:.0f} times as much",
                likely="it has an error that the model lacks (scale, bias, clock), which spoils "
                "other numbers",
                attempt="hold it against the others with greybox check; leave it out (use = false "
                "in [columns])",
            )


def denied(fit: Fit, stated: Collection[str]) -> tuple[str, ...]:
    """What flights deny of the `stated` numbers, and why that may be, a sentence each."""
    found = [f for f in sanity_of(fit).findings if f.kind == "overruled"]
    return tuple(f"{f.statement} ({f.likely})" for f in found if f.parameters[0] in stated)


def impossible(found: Fit, effect: str) -> str:
    """Why an effect of a fit can be no cause of what flights show; empty where it can. An estimate
    at its bound stands in for something else, and one beyond what any craft has is a fault of the
    data."""
    declared = {d.name: d for d in found.model.dynamics.parameters}
    bent: set[str] = set()
    for number, e in found.of_effect(effect).items():
        d = declared[number]
        for value in [v for v, _ in e.per_flight.values()] or [e.value]:
            if d.excess(value) > 0:
                size = f"{value:.3g} {e.unit}".rstrip()
                beyond = f"{number} = {size}, and no craft has more than {d.possible:.3g}"
                why = "a fault of the data (axes, frames, units) is likelier; run greybox check"
                return f"{beyond}: {why}"
            if e.at_bound and value != (d.nominal if d.null is None else d.null):
                bent.add(number)
    return f"{', '.join(sorted(bent))} ran to a bound: it stands in for something else" * bool(bent)


def untried(attempt: str, effects: Set[str]) -> str:
    """An advice without what a model has already: "add A and B; C" is "C" where both are among its
    effects."""
    left = []
    for part in attempt.split("; "):
        names, _, rest = part.removeprefix("add ").partition(" where ")
        missing = [n for n in names.split(" and ") if n not in effects]
        if not part.startswith("add "):
            left.append(part)
        elif missing:
            left.append(f"add {' and '.join(missing)}{f' where {rest}' if rest else ''}")
    return "; ".join(left) or "look at the innovations and at greybox check"


def _curves(estimates: Estimates, vehicle: Vehicle, values: Values) -> Iterator[Insane]:
    """Thrust that carries the craft, and a drag torque against the turn, where it hovers."""
    u_max = vehicle.actuator.u_max
    nu = np.linspace(0.0, LIMITS["hover"].value * u_max, 261)[1:]
    thrust = sum(values[f"thrust.c{k}"] * nu**k for k in range(3))
    weight = values["mass"] * vehicle.gravity / vehicle.n_rotors
    enough = np.flatnonzero(np.asarray(thrust) >= weight)
    free = tuple(n for n in estimates if n.startswith("thrust."))
    if not (np.asarray(thrust) > 0).any() or (not enough.size and free):
        yield Insane(
            severity="impossible",
            kind="value",
            parameters=free or (leading("thrust", values),),
            statement=f"the thrust map carries {max(float(np.max(thrust)), 0.0) / weight:.0%} of "
            "the weight at most",
            likely="thrust per command or the mass stands for something else",
            attempt="hold mass (--fixed mass); check thrust and the command columns of the vehicle "
            "file",
        )
    hover = float(nu[enough[0]]) if enough.size else 0.6 * u_max
    torque = sum(values[f"torque.c{k}"] * hover**k for k in range(3))
    free = tuple(n for n in estimates if n.startswith("torque."))
    if torque < 0 and free:
        yield Insane(
            severity="impossible",
            kind="value",
            parameters=free,
            statement=f"the rotors' drag torque is negative at hover ({torque:.2g} N m)",
            likely="yaw is hardly excited, or spins or motor order are not those of the vehicle "
            "file",
            attempt="check the spins and the order of the rotors; hold torque (--fixed "
            f"{','.join(free)})",
        )


def _times(estimates: Estimates, vehicle: Vehicle, values: Values) -> Iterator[Insane]:
    """Causes before their effects, and motors slower than any."""
    for name, e in estimates.items():
        if name == "rotor_speed_delay.d":
            yield from _shown_early(e, values)
        if e.unit != "s" or name.startswith(EITHER_SIGN):
            continue
        if e.value < 0:
            yield Insane(
                severity="impossible",
                kind="value",
                parameters=(name,),
                statement=f"{name} is negative ({e.value:.3g} s)",
                likely="the craft would answer before the command: the stamps of commands and "
                "sensors are shifted",
                attempt="look at the lead of the commands that `greybox check` measures; shift "
                "them in a mapping file",
            )
        elif name == "motor_lag.tau" and e.value > LIMITS["motor time"].value:
            yield Insane(
                severity="doubtful",
                kind="value",
                parameters=(name,),
                statement=f"motors with a time constant of {e.value:.2g} s",
                likely="the lag stands for another slow part: a filter of the gyro, late stamps, a "
                "wrong inertia",
                attempt="add command_delay or sensor_delay; check which commands are logged (after "
                "the mixer?)",
            )


def _shown_early(late: Estimated, values: Values) -> Iterator[Insane]:
    """Rotor speeds that are earlier than the commands are late, beyond their error."""
    error = late.std if math.isfinite(late.std) else 0.0
    lead = -late.value - values.get("command_delay.d", 0.0)
    if lead > max(FELT * error, LIMITS["stamps"].value):
        yield Insane(
            severity="impossible",
            kind="value",
            parameters=("rotor_speed_delay.d",),
            statement=f"rotor speeds answer {1e3 * lead:.1f} ms before the command",
            likely="they are logged early, or commands and all other sensors late",
            attempt="look at the lead of the rotor speeds that `greybox check` measures; shift "
            "them by delay in [columns.rotor_speed]",
        )


def _mass(estimates: Estimates, vehicle: Vehicle, values: Values) -> Iterator[Insane]:
    """Mass against the size of the craft."""
    if "mass" not in estimates:
        return
    mass, density = values["mass"], values["mass"] / vehicle.arm_length**3
    if not LIMITS["density, least"].value <= density <= LIMITS["density, most"].value:
        yield Insane(
            severity="impossible",
            kind="value",
            parameters=("mass",),
            statement=f"{mass:.3g} kg for arms of {vehicle.arm_length:.2g} m",
            likely="mass and thrust come only as a ratio in these flights",
            attempt="weigh the craft and hold mass (--fixed mass)",
        )


def _inertia(estimates: Estimates, vehicle: Vehicle, values: Values) -> Iterator[Insane]:
    """A body, and one of this size."""
    names = tuple(n for n in estimates if n.startswith(("inertia.", "products_of_inertia.")))
    if not names:
        return
    j = np.array(vehicle.inertia, dtype=np.float64)
    for i, a in enumerate("xyz"):
        j[i, i] = values[f"inertia.{a}{a}"]
    for product, row, column in (("Jxy", 0, 1), ("Jxz", 0, 2), ("Jyz", 1, 2)):
        extra = values.get(f"products_of_inertia.{product}", 0.0)
        j[row, column] += extra
        j[column, row] += extra
    least = float(margins(j)[-1])
    moments = ", ".join(f"{v:.3g}" for v in np.linalg.eigvalsh(j))
    rate = (
        "the moments stand for a part of the rotors' torque: motor lag, arms, thrust per "
        "command, a clock that is late"
    )
    if least <= 0:
        errors = [estimates[n].std for n in names if np.isfinite(estimates[n].std)]
        principal = np.linalg.eigvalsh(j)
        excess = float(2 * principal[-1] - principal.sum())
        known = excess > LIMITS["errors"].value * float(np.linalg.norm(errors))
        yield Insane(
            severity="impossible"
            if known and least < LIMITS["inertia, rounded"].value
            else "doubtful",
            kind="inertia",
            parameters=names,
            statement=f"no body has the principal moments {moments} kg m^2 (the largest exceeds "
            "the sum of the others" + (")" if known else ", by less than their errors)"),
            likely=rate,
            attempt="add motor_lag and command_delay; hold inertia.zz where yaw is hardly excited; "
            "write the vehicle file in schema greybox.vehicle/2",
        )
    scale = values["mass"] * vehicle.arm_length**2
    low, high = LIMITS["inertia, least"].value, LIMITS["inertia, most"].value
    for name in names:
        share = values[name] / scale
        if name.startswith("inertia.") and not low <= share <= high:
            yield Insane(
                severity="impossible",
                kind="inertia",
                parameters=(name,),
                statement=f"{name} of {values[name]:.3g} kg m^2 is {share:.2g} m L^2 (craft have "
                f"{low:g} to {high:g})",
                likely=rate,
                attempt=f"add motor_lag and command_delay; hold it (--fixed {name})",
            )


ADVICE: Mapping[str, tuple[str, str]] = {
    "mass": (
        "thrust per command is probably off",
        "free {thrust}, hold mass (--fixed mass); add battery_sag where the log has the voltage",
    ),
    "thrust": (
        "battery, propellers or the logged commands are not those of the data sheet, or the mass is "
        "not the stated one, as motion shows their ratio",
        "weigh the craft; compare the hover command with `greybox vehicle check`; add battery_sag; one value per "
        "flight (--per-flight)",
    ),
    "torque": (
        "yaw moves by something else: yaw inertia, spins, or a heading reference that drifts",
        "hold inertia.zz (--fixed inertia.zz); check the spins",
    ),
    "inertia": (
        "the rotors' torque is wrong or late: arms, motor lag, delays, thrust per command",
        "add motor_lag and command_delay; measure the arms",
    ),
    "center_of_mass": (
        "it is elsewhere, or a steady torque stands for it: motors or propellers that differ, arms",
        "balance the craft and write down what that says; add rotor_asymmetry",
    ),
}
"""Group of a parameter -> (what probably is wrong with the model, what to try) where the flights
overrule its prior."""

SCALES = ("mass", "inertia", "thrust", "torque")
"""Groups whose members are known within a factor."""

OTHERS = (
    "it stands for an effect that is missing",
    "run `greybox discover` on the flights",
)


def _overruled(estimates: Estimates, vehicle: Vehicle, values: Values) -> Iterator[Insane]:
    """Stated numbers that the flights deny."""
    for name, e in estimates.items():
        if e.prior is None or not e.prior[1] > 0 or not math.isfinite(e.prior[1]):
            continue
        mean, sigma = e.prior
        away = _away(name, e.value, mean, sigma)
        if away <= LIMITS["sigmas"].value and not (
            e.at_bound and away >= LIMITS["sigmas, rounded"].value
        ):
            continue
        likely, attempt = ADVICE.get(name.partition(".")[0], OTHERS)
        attempt = attempt.format(thrust=leading("thrust", values))
        if name == "mass" and leading("thrust", values) in estimates:
            likely = "mass and thrust per command come only as a ratio, and something else moves it"
            attempt = "hold mass (--fixed mass); add battery_sag where the log has the voltage"
        if name == "inertia.zz":
            likely += "; or yaw is hardly excited"
            attempt = f"hold inertia.zz or {leading('torque', values)} (--fixed inertia.zz)"
        stated, wanted = _said(name, mean, sigma, e.value, e.unit)
        wanted += " or beyond (its bound)" if e.at_bound else ""
        verb = "was weighed" if name == "mass" else "was stated"
        yield Insane(
            severity="doubtful",
            kind="overruled",
            parameters=(name,),
            statement=f"{name} {verb} ({stated}) but the flights want {wanted}, {away:.0f} sigma "
            "away",
            likely=f"the vehicle file's {name} is wrong, or {likely}",
            attempt=f"correct it where nobody measured it; {attempt}",
        )


def _together(estimates: Estimates, vehicle: Vehicle, values: Values) -> Iterator[Insane]:
    """A mass that is wrong: flights show forces and moments per mass, so that thrust, drag torque
    and inertia are all off by its factor, each within its own error."""
    own = vehicle.quantities["mass"]
    if not values["mass"] > 0:
        return  # said already
    heavier = math.log(values["mass"] / own.value)
    told = {
        n: (math.log(e.value / mean) - heavier, math.hypot(sigma / mean, e.std / e.value))
        for n, e in estimates.items()
        if n.startswith(("thrust.", "torque.", "inertia.")) and e.prior is not None
        for mean, sigma in [e.prior]
        if min(mean, e.value) > 0 and 0 < sigma < math.inf and math.isfinite(e.std)
    }
    kinds = {n.partition(".")[0] for n in told}
    if not {"thrust", "inertia"} <= kinds:
        return
    logs, errors = np.array(list(told.values())).T
    weights = errors**-2.0
    common = float(weights @ logs / weights.sum())
    away = abs(common) / math.hypot(weights.sum() ** -0.5, own.sigma / own.value)
    alike = bool((np.abs(logs - common) <= LIMITS["errors"].value * errors).all())
    if away <= LIMITS["sigmas"].value or not alike:
        return
    factor = math.exp(common)
    yield Insane(
        severity="doubtful",
        kind="overruled",
        parameters=("mass",),
        statement=f"{', '.join(told)} per mass are all about {factor:.2g} times what was "
        f"stated, {away:.0f} sigma away together",
        likely=f"the vehicle file's mass is wrong (a craft of {own.value / factor:.2g} kg has "
        "the others as stated), or all of them are",
        attempt="weigh the craft",
    )


def _away(name: str, value: float, mean: float, sigma: float) -> float:
    """Distance from what was stated in its standard deviations.

    Of a scale (mass, inertia, thrust, torque) the larger of difference and ratio counts: within
    20 % means neither 1.2 times too much nor 1.2 times too little, and a number that is three times
    too large is less than 4 sigma above the truth for every sigma beyond 17 %.
    """
    linear = abs(value - mean) / sigma
    if name.partition(".")[0] not in SCALES or min(value, mean) <= 0:
        return linear
    return max(linear, abs(math.log(value / mean)) * mean / sigma)


def _said(name: str, mean: float, sigma: float, value: float, unit: str) -> tuple[str, str]:
    """A prior and a value as people say them (grams below half a kilogram)."""
    factor, shown = (1e3, "g") if name == "mass" and mean < 0.5 else (1.0, unit)
    return (
        f"{mean * factor:.4g} +- {sigma * factor:.2g} {shown}".strip(),
        f"{value * factor:.4g} {shown}".strip(),
    )


def _bounds(estimates: Estimates, vehicle: Vehicle, values: Values) -> Iterator[Insane]:
    """Many parameters at their bounds at once."""
    stuck = tuple(n for n, e in estimates.items() if e.at_bound)
    if len(stuck) >= LIMITS["at bounds"].value:
        yield Insane(
            severity="doubtful",
            kind="bounds",
            parameters=stuck,
            statement=f"{len(stuck)} of {len(estimates)} parameters ended at a bound at once "
            f"({', '.join(stuck)})",
            likely="the model lacks a cause that is larger than they may be moved: motor lag, a "
            "delay, wind, wrong commands",
            attempt="add motor_lag and command_delay; --disturbance force,torque; check motor "
            "order and commands",
        )
