"""What `greybox mpc` writes and its pages show: mpc.json, mpc_own.json, mpc_rates.json, rows of
flights, and traces of those that were watched.

mpc_export writes them; they stand here because a page reads them. NaN and infinity are null.
"""

from __future__ import annotations

from typing import Literal, NotRequired, TypedDict

Risk = Literal["rehearsal", "boole"]
CELL = 0.1
"""A row keeps the least distance to a limit (`nearest`) in cells of this length [s]."""


class Concluded(TypedDict):
    """What every document of predictive control ends with."""

    verdict: str
    next: list[str]
    versions: dict[str, str]


class Counted(TypedDict):
    """How many went beyond: `share` None of none, `interval` its 95 % interval."""

    count: int
    share: float | None
    interval: tuple[float, float]


class AnswerTimes(TypedDict):
    """Median and 99 % of answer times [ms]; None without any."""

    median: float | None
    p99: float | None


class Judged(TypedDict):
    """What a controller's part of a result file says of its promise."""

    beyond: Counted
    p_value: float | None


class Answered(TypedDict):
    """What a row says of its answers: milliseconds of each."""

    solve_ms: list[float]


# ----------------------------------------------------------------- a course: mpc.json


class Crossing(TypedDict):
    """Where a flight was deepest beyond a plane [m], and when [s]."""

    plane: str
    time: float
    depth: float


class EventRow(TypedDict):
    """What the controller did at a time [s]."""

    time: float
    what: str


class Scores(Answered):
    """What every flight is judged by, as `mpc_export.mission.flight.fly` explains it."""

    crashed: bool
    margins: dict[str, float]
    tilt: float
    rmse: float
    cost: float
    late: int
    samples: int
    seconds: float
    events: list[EventRow]
    event_count: int
    event_kinds: dict[str, int]
    descended: bool
    nearest: list[float]
    crossings: list[Crossing]


class PlanPath(TypedDict):
    """A plan of the tube by stages: its time in the flight [s], positions [m], covariances
    (xx, xy, xz, yy, yz, zz) [m^2], distance to the nearest plane and its back-off [m]."""

    time: float
    place: list[list[float]]
    spread: list[list[float]]
    left: list[float | None]
    backoff: list[float]


class PlanTrace(PlanPath):
    """And the standard deviation of every learned output where it begins, and how far that lies
    outside the training data."""

    unsure: list[float]
    outside: float


class FlightTrace(TypedDict):
    """A watched flight: times (n,) [s], path (n, 3) [m], attitude (n, 4), tilt (n,) [rad], commands
    (n, n_u), distance to the nearest plane (n,) [m], plans. Traces of earlier versions have no
    attitude."""

    time: list[float]
    path: list[list[float]]
    attitude: NotRequired[list[list[float]]]
    tilt: list[float]
    commands: list[list[float]]
    nearest: list[float | None]
    plans: list[PlanTrace]


class FlightRow(Scores):
    """A flight as a row of plain values; `controller` and `key` once it belongs to a campaign."""

    seed: int
    pairs: NotRequired[int]
    trace: NotRequired[FlightTrace]
    controller: NotRequired[str]
    key: NotRequired[str]


class What(TypedDict):
    """What was flown, for the report."""

    mode: Literal["demo", "plant", "model"]
    subject: str
    plant: str
    plain: str
    model: str
    model_sha256: str
    learned: list[str]
    trained_on: list[str]
    logs: list[str]
    mass: float | None
    disturbed_by: str


class Rehearsal(TypedDict):
    """How many of the rehearsed flights went beyond a limit at `kappa` standard deviations."""

    kappa: float
    flights: int
    crossed: int


class Tuning(TypedDict):
    """How the back-offs were chosen: limits touched in a training flight (`pairs`), standard
    deviations that Boole's inequality asks for, and that are flown with (`kappa`), the constant
    back-off `moved` [m], and every rehearsal."""

    pairs: float
    boole: float
    moved: float
    flights: int
    rehearsed: list[Rehearsal]
    kappa: float
    risk: Risk


class PlaneRow(TypedDict):
    """A limit: positions with normal (3,) times position above `offset` [m] are beyond it, `where`
    each axis lies in a range."""

    name: str
    normal: list[float]
    offset: float
    where: dict[str, list[float]]


class CoursePart(TypedDict):
    """The course and who plans on it: seconds, radians, metres; `path` (n, 3) in equal steps."""

    duration: float
    pace: float
    lost: float
    tilt_max: float
    command_min: float
    command_max: float
    sample_time: float
    plan_time: float
    horizon: int
    planes: list[PlaneRow]
    path: list[list[float]]


class SolveTimes(AnswerTimes):
    """And how many there were, and the longest."""

    count: int
    worst: float | None


class Late(TypedDict):
    """Samples whose answer took longer than a sample, and all."""

    count: int
    samples: int


class CourseController(TypedDict):
    """What the flights of one controller say together."""

    text: str
    kind: str
    kappa: float
    moved: float
    flights: int
    crossed: Counted
    p_value: float | None
    crashed: int
    tilted: int
    margins: dict[str, float | None]
    crossed_planes: dict[str, int]
    rmse: float | None
    cost: float | None
    solve_ms: SolveTimes
    late: Late
    events: dict[str, int]
    event_count: int
    descended: int


class Difference(TypedDict):
    """Cost of a controller minus that of the tube, with its standard error."""

    mean: float
    error: float | None
    flights: int


class Seeds(TypedDict):
    """Seeds of the flights that judge: from `first` on."""

    first: int
    count: int


class MpcFound(TypedDict):
    """mpc.json without its words."""

    schema: str
    command: str
    what: What
    level: float
    tuning: Tuning
    seeds: Seeds
    jobs: int
    course: CoursePart
    controllers: dict[str, CourseController]
    differences: dict[str, Difference]


class MpcDocument(MpcFound, Concluded):
    """mpc.json."""

    warnings: list[str]


# ------------------------------------------------- a model of the user's own: mpc_own.json


class RunTrace(TypedDict):
    """A watched run: seconds between samples, true outputs (n, n_y), commands (n, n_u), what was
    asked of the outputs, and what every plan expected of the next sample with its standard
    deviation."""

    step: float
    outputs: list[list[float | None]]
    commands: list[list[float | None]]
    asked: list[list[float]]
    planned: list[list[float | None]]
    sigma: list[list[float | None]]


class ByOutput(TypedDict):
    """Largest excess beyond a limit, root mean squares of what was held against what was asked, at
    all times and once settled; None where an output was not finite."""

    excess: dict[str, float | None]
    rmse: dict[str, float | None]
    settled: dict[str, float | None]


class OwnController(Judged, ByOutput):
    """What the runs of one controller say together."""

    text: str
    kappa: float
    runs: int
    samples_beyond: float
    failures: int
    solve_ms: AnswerTimes


class OwnTuning(TypedDict):
    """Limits touched in `runs` training runs, and the standard deviations that follow."""

    touched: float
    kappa: float
    runs: int


class OwnFound(TypedDict):
    """mpc_own.json without its words."""

    schema: str
    command: str
    level: float
    plant: str
    model: str
    model_sha256: str
    dt: float
    seconds: float | None
    horizon: int
    held: dict[str, list[float]]
    limits: dict[str, list[float | None]]
    ranges: dict[str, list[float]]
    units: dict[str, str]
    seeds: Seeds
    tuning: OwnTuning
    controllers: dict[str, OwnController]


class OwnDocument(OwnFound, Concluded):
    """mpc_own.json."""


# ---------------------------------------------------------- body rates: mpc_rates.json


class RatesPlan(TypedDict):
    """Rates (n, 3) of a plan and their standard deviations [rad/s]."""

    y: list[list[float]]
    sigma: list[list[float]]


class RatesTrace(TypedDict):
    """A watched flight: seconds between samples, rates (n, 3) and what was asked [rad/s], plans."""

    step: float
    rates: list[list[float]]
    asked: list[list[float]]
    plans: list[RatesPlan]


class RatesController(Judged):
    """What the flights of one controller say together."""

    text: str
    kappa: float
    flights: int
    crashed: int
    samples_beyond: float
    worst: float | None
    rmse: float | None
    away: float | None
    failures: int
    solve_ms: AnswerTimes


class RatesTuning(TypedDict):
    """Limits touched in `flights` training flights, and the standard deviations that follow."""

    touched: float
    kappa: float
    flights: int


class RatesFound(TypedDict):
    """mpc_rates.json without its words."""

    schema: str
    command: str
    level: float
    plant: str
    model: str
    model_sha256: str
    features: list[str]
    limit: float
    seconds: float
    outputs: list[str]
    seeds: Seeds
    tuning: dict[str, RatesTuning]
    controllers: dict[str, RatesController]


class RatesDocument(RatesFound, Concluded):
    """mpc_rates.json."""
