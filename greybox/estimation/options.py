"""FitOptions: all choices of a fit in one frozen record, which is handed on whole.

options = FitOptions(predictor="kalman", fixed=("mass",))
fit(model, data, options)
fit(model, data, predictor="kalman", fixed=["mass"])  # the same
options.but(seed=1).command_line()
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Literal, TypedDict, TypeVar, Unpack

from greybox.errors import GreyboxError, ModelError, UnknownNameError
from greybox.estimation.criterion import Criterion
from greybox.estimation.predictor import Predictor
from greybox.estimation.prior import Prior, demand_priors
from greybox.estimation.solver import Solver
from greybox.takes import COUNT, FLAG, ByName, Kind, Named, has, shown, taken_fields

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., object])
Options = TypeVar("Options", bound="DataclassInstance")


def _name_or(*attributes: str) -> Callable[[object], bool]:
    made = has(*attributes)
    return lambda value: isinstance(value, str) or made(value)


_PRIORS = ByName(
    words="names with (mean, sigma)",
    fits=lambda v: isinstance(v, Named),
    fix="{'motor_lag.tau': (0.03, 0.01)}",
    error=ModelError,
)
_KINDS = {
    "priors": _PRIORS,
    "flight_priors": _PRIORS,
    "starts": COUNT,
    "predictor": Kind(words="a name, or a predictor", fits=_name_or("has_noise", "blocks")),
    "criterion": Kind(words="a name, or a criterion", fits=_name_or("evaluate")),
    "solver": Kind(words="a name, or a solver", fits=_name_or("solve")),
    "estimate_noise": Kind(
        words='True, False or "process"',
        fits=lambda v: FLAG.fits(v) or (isinstance(v, str) and v == "process"),
    ),
}
_FLAGS = {
    "predictor": "--predictor",
    "criterion": "--criterion",
    "solver": "--solver",
    "initialisation": "--init",
    "disturbance": "--disturbance",
    "noise_parts": "--noise-parts",
    "free": "--free",
    "fixed": "--fixed",
    "considered": "--considered",
    "per_flight": "--per-flight",
    "shared": "--shared",
    "values": "--value",
    "noise": "--noise",
    "estimate_noise": "--hold-noise",
    "seed": "--seed",
}


PredictorName = Literal[
    "innovation", "kalman", "k-step", "multi-step", "multiple-shooting", "simulation"
]
CriterionName = Literal["gaussian", "least-squares", "robust"]
SolverName = Literal["levenberg-marquardt", "gauss-newton", "scipy-trf", "ipopt", "ipopt-exact"]
Initialisation = Literal["nominal", "noise", "equation-error", "multistart", "innovation"]


class FitChoices(TypedDict, total=False):
    """The keywords of `fit` and `make_problem`: the fields of `FitOptions`, which says what they
    mean."""

    predictor: PredictorName | Predictor[object]
    criterion: CriterionName | Criterion
    solver: SolverName | Solver
    initialisation: Initialisation
    disturbance: Iterable[str]
    noise_parts: Iterable[str]
    free: Iterable[str] | None
    fixed: Iterable[str]
    considered: Iterable[str]
    per_flight: Iterable[str]
    shared: Iterable[str]
    values: Mapping[str, float] | None
    priors: Mapping[str, tuple[float, float] | Prior] | None
    flight_priors: Mapping[str, tuple[float, float] | Prior] | None
    noise: Mapping[str, float] | None
    estimate_noise: bool | Literal["process"]
    held_noise: Iterable[str]
    estimate_initial: bool
    seed: int
    starts: int
    build: Iterable[str] | None
    use_compiler: bool


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """All choices of a fit. Options are equal where all choices are; they hold copies of what was
    given."""

    predictor: str | Predictor[object] = "innovation"
    """Name in `PREDICTORS`, or the object: turns unknowns into residuals."""
    criterion: str | Criterion = "gaussian"
    """Name in `CRITERIA`, or the object: turns residuals into a cost."""
    solver: str | Solver = "levenberg-marquardt"
    """Name in `SOLVERS`, or the object: minimises the cost."""
    initialisation: str = "equation-error"
    """Where the solver starts: "nominal", "noise" (noise levels from the data), "equation-error",
    "multistart" or "innovation" (a maximum likelihood fit in innovation form first)."""
    disturbance: tuple[str, ...] = ()
    """Process-noise groups ("force", "torque") that also get a slowly varying disturbance state."""
    noise_parts: tuple[str, ...] = ()
    """What else of the noise is correlated in time, as kind.sensor: "low_pass.gyro" (a filter),
    "coloured.accelerometer", ... (`greybox.model.noise.KINDS`); start values among `values`."""
    free: tuple[str, ...] | None = None
    """Exactly these parameters are free, less `fixed`; None: those with a prior (sigma > 0)."""
    fixed: tuple[str, ...] = ()
    """Parameters that are held at their value."""
    considered: tuple[str, ...] = ()
    """Of the fixed parameters those whose stated uncertainty widens the errors of the others (they
    have a prior): held, yet not believed to be exact."""
    per_flight: tuple[str, ...] = ()
    """Parameters with one value per flight, besides those whose declared scope is flight."""
    shared: tuple[str, ...] = ()
    """Parameters with one value for all flights, whatever their declared scope."""
    values: Mapping[str, float] = field(default_factory=dict)
    """Start values, and the values of fixed parameters, in SI units."""
    priors: Mapping[str, tuple[float, float] | Prior] = field(default_factory=dict)
    """Parameter -> (mean, sigma), in place of the declared prior; sigma is positive (infinite: no
    prior). What is held is held at the mean, unless `values` says where."""
    flight_priors: Mapping[str, tuple[float, float] | Prior] = field(default_factory=dict)
    """The same for every per-flight copy."""
    noise: Mapping[str, float] = field(default_factory=dict)
    """Noise levels to start from (where they are held: to keep), in SI units, of one component
    ("noise.sensor.p") or a group ("noise.sensor.position"); the longer name wins."""
    estimate_noise: bool | Literal["process"] = True
    """Whether noise levels are unknowns; "process" holds those of the sensors."""
    held_noise: tuple[str, ...] = ()
    """Noise levels that are held besides, by the names that `noise` takes."""
    estimate_initial: bool = True
    """Whether initial states are unknowns."""
    seed: int = 0
    """Seed of random starts."""
    starts: int = 8
    """Random starts of "multistart"."""
    build: tuple[str, ...] | None = None
    """Parameters that sensitivities are built for besides the free ones. Fits of many subsets share
    one build."""
    use_compiler: bool = True
    """Whether the model runs as compiled C where there is a compiler; False: in CasADi's VM."""

    def __post_init__(self) -> None:
        taken_fields(self, **_KINDS)
        for name in ("priors", "flight_priors"):
            demand_priors(name, getattr(self, name))

    @classmethod
    def of(cls, options: FitOptions | None, choices: FitChoices) -> FitOptions:
        """`options` (None: the defaults) with the `choices` in place of its own.

        Raises `UnknownNameError` with the nearest names for a choice that there is not.
        """
        return chosen("option of a fit", cls, options, choices)

    def but(self, **choices: Unpack[FitChoices]) -> FitOptions:
        """These options with other `choices`. Raises `UnknownNameError`."""
        return FitOptions.of(self, choices)

    def chosen_predictor(self) -> Predictor[object]:
        """The predictor itself. Raises `UnknownNameError`."""
        from greybox.estimation.predictors import PREDICTORS

        return member("predictor", PREDICTORS, self.predictor)

    def chosen_criterion(self) -> Criterion:
        """The criterion itself. Raises `UnknownNameError`."""
        from greybox.estimation.criteria import CRITERIA

        return member("criterion", CRITERIA, self.criterion)

    def chosen_solver(self) -> Solver:
        """The solver itself. Raises `UnknownNameError`."""
        from greybox.estimation.solvers import SOLVERS

        return member("solver", SOLVERS, self.solver)

    def to_dict(self) -> dict[str, object]:
        """The choices that differ from the defaults as plain values, objects by their names."""
        plain: dict[str, object] = {}
        for name, value in vars(self).items():
            if value == _DEFAULTS[name]:
                continue
            if name in ("predictor", "criterion", "solver"):
                plain[name] = value if isinstance(value, str) else value.name
            elif isinstance(value, tuple):
                plain[name] = list(value)
            elif isinstance(value, Mapping):
                plain[name] = {k: list(v) if isinstance(v, tuple) else v for k, v in value.items()}
            else:
                plain[name] = value
        return plain

    def command_line(self) -> list[str]:
        """Flags of `greybox fit` for the choices that differ from the defaults.

        What the command has no flag for is left out: priors, starts, build, use_compiler,
        estimate_initial, and the settings of a predictor, criterion or solver that was given as an
        object.
        """
        flags: list[str] = []
        for name, value in self.to_dict().items():
            if name not in _FLAGS or name in ("estimate_noise", "held_noise"):
                continue
            if isinstance(value, list):
                text = ",".join(value)
            elif isinstance(value, dict):
                text = ",".join(f"{k.removeprefix('noise.')}={v!r}" for k, v in value.items())
            else:
                text = str(value)
            flags += [_FLAGS[name], text]
        return flags + self._held_flags()

    def _held_flags(self) -> list[str]:
        """Of the noise levels that are held: all, those of the sensors, or some by name."""
        words = {True: [], "process": ["sensor"], False: ["all"]}[self.estimate_noise]
        words += [n.removeprefix("noise.") for n in self.held_noise]
        return [_FLAGS["estimate_noise"], ",".join(words)] if words else []


_DEFAULTS: Mapping[str, object] = vars(FitOptions())


def chosen(
    kind: str, record: type[Options], options: Options | None, choices: Mapping[str, object]
) -> Options:
    """`options` (None: the defaults of the `record`) with some `choices` in place of its own.

    `kind` is what one of them is called. Raises `UnknownNameError` with the nearest names for a
    choice that is no field, and `GreyboxError` for other options and what a field does not take.
    """
    known = [f.name for f in fields(record)]
    for name in choices:
        if name not in known:
            raise UnknownNameError(kind, name, known)
    if not isinstance(options, record | None):
        raise GreyboxError(
            f"options takes {record.__name__}",
            got=shown(options),
            fix=f"{known[0]}=..., {known[1]}=..., as keywords",
        )
    return replace(options or record(), **choices)


def says_choices(record: type[DataclassInstance]) -> Callable[[F], F]:
    """Decorator of a function that takes **choices: its signature, as `help` shows it, lists the
    fields of `record`."""

    def decorate(function: F) -> F:
        signature = inspect.signature(function)
        own = [
            p for p in signature.parameters.values() if p.kind is not inspect.Parameter.VAR_KEYWORD
        ]
        defaults = record()
        own += [
            inspect.Parameter(
                f.name,
                inspect.Parameter.KEYWORD_ONLY,
                default=vars(defaults)[f.name],
                annotation=f.type,
            )
            for f in fields(record)
        ]
        setattr(function, "__signature__", signature.replace(parameters=own))  # noqa: B010  # functions do not declare it
        return function

    return decorate


def member(kind: str, catalogue: Mapping[str, Callable[..., T]], choice: str | T) -> T:
    """A member by name, or the object itself. Raises `UnknownNameError` with the nearest names."""
    if not isinstance(choice, str):
        return choice
    if choice not in catalogue:
        raise UnknownNameError(kind, choice, catalogue)
    return catalogue[choice]()
