"""Prepare a mission: models, plant, controllers and the back-offs that training flights and
rehearsals ask for.

Controllers have the same solver and the same seeds and differ in what they know:

    mean       the model, no tightening (the demo: nominal, pem and hybrid, see mpc_export/mission/demo.py)
    tube       the model, limits tightened by the covariance of the closed loop
    constant   the model, every plane moved by one constant that training flights ask for
    cascade    a cascade of PID loops that knows the vehicle file
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from greybox.errors import ModelError
from greybox.files import file_sha256, read_json
from greybox.model.identified import IdentifiedModel
from greybox.model.linear import SCHEMA as LINEAR
from greybox.report.mpc_documents import Risk, Tuning, What
from greybox.residual.files import load_model
from greybox.residual.hybrid import HybridModel
from greybox.symbolic import FloatArray
from mpc_export.feedback import NEEDED
from mpc_export.functions import model_functions
from mpc_export.mission import TRAINING_SEEDS, judging
from mpc_export.mission.campaign import (
    NEAR,
    OBSTACLES,
    Campaign,
    Entry,
    Hangar,
    flights,
    rehearsed,
    tuned,
    write_segments,
)
from mpc_export.mission.flight import load_course, load_plant, natural_pace
from mpc_export.mission.headroom import headroom
from mpc_export.mission.model_plant import ModelPlant, real_disturbances

Say = Callable[[str], None]
TEXTS = {
    "nominal": "the data sheet's model",
    "pem": "fitted physics, no tightening",
    "hybrid": "physics and Gaussian process, no tightening",
}
REHEARSED, REHEARSALS = (0.5, 1.0, 1.5), 12
"""Standard deviations that are rehearsed on the model itself, and flights for each."""
OF_A_MODEL = ("mean", "tube", "constant", "cascade")
"""Controllers of a model, above."""
TUNING = 8
"""Training flights on which touched limits are counted and the constant back-off is chosen."""


@dataclass(frozen=True, kw_only=True)
class Demo:
    """Its plant as `module:attribute`, and what writes its models into a folder: name (nominal,
    pem, hybrid) -> file."""

    identify: Callable[[Path, Say], Mapping[str, Path]]
    plant: str


@dataclass(frozen=True, kw_only=True)
class Flown:
    """Everything that a report needs: the campaign's hangar, its controllers, what was tuned, and
    words about it."""

    hangar: Hangar
    entries: tuple[Entry, ...]
    tuning: Tuning
    what: What
    seeds: tuple[int, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class MissionOptions:
    """What is flown, how often, and what may go wrong."""

    plant: str | None = None
    """`module:attribute`; None flies the demo's plant, or the model itself under disturbances that
    are resampled from `logs` or else as identified."""
    logs: tuple[str, ...] = ()
    """Logs that tell what disturbs an identified model."""
    course: str = OBSTACLES
    """`module:attribute` too."""
    pace: float | None = None
    """How much slower the course is flown; None: 1 for the demo, and for a model what its training
    speeds ask for."""
    risk: Risk = "rehearsal"
    """How the level becomes standard deviations (see mpc_export/tube/risk.py)."""
    flights: int = 20
    """Flights that judge."""
    level: float = 0.1
    """Share of the flights that may go beyond a limit."""
    seed: int = 0
    """Seed of the flights that judge."""


@dataclass(frozen=True, kw_only=True)
class _Models:
    """The model files by name; `main` is the one that is flown under tightened limits, `model` its
    content."""

    files: Mapping[str, Path]
    main: Path
    model: IdentifiedModel
    demo: Demo | None

    @property
    def plain(self) -> Entry:
        """The main model without tightening."""
        name = self.main.stem if self.demo else "mean"
        text = TEXTS[name] if self.demo else "the model, no tightening"
        return Entry(name=name, text=text, model=str(self.main))

    @property
    def others(self) -> list[Entry]:
        """Of a demo: what the other models fly."""
        return [
            Entry(name=name, text=TEXTS[name], model=str(file))
            for name, file in self.files.items()
            if self.demo is not None and file != self.main
        ]


def prepare(
    subject: str,
    out: Path,
    options: MissionOptions,
    *,
    demo: Demo | None = None,
    jobs: int = 1,
    say: Say = print,
) -> Flown:
    """Models, plant, controllers and tuned back-offs of `subject`: a model file, or what a `demo`
    is called.

    Raises `ModelError`, `PlantError`, `BuildError`, `FileFormatError`.
    """
    o = options
    _check(o, demo)
    models = _models(subject, demo, out, say)
    hangar = Hangar(_campaign(models, out, o))
    warnings = [w for w in (_room(models.model, hangar),) if w]
    for text in warnings:
        say(text)
    plain = models.plain
    ahead = _ahead(o, len(models.others) + len(OF_A_MODEL))
    say(ahead.words)
    tuning, unbounded = _tuning(hangar, plain, o, ahead, jobs, say)
    return Flown(
        hangar=hangar,
        entries=(*models.others, plain, *_tightened(plain, tuning, o.level)),
        tuning=tuning,
        what=_what(subject, models, hangar.campaign.plant, o),
        seeds=tuple(judging(o.flights, o.seed)),
        warnings=(*warnings, *unbounded),
    )


@dataclass(frozen=True, kw_only=True)
class _Ahead:
    """How many flights prepare and judge, and in `words` what is flown for which reason."""

    rehearsals: int
    judging: int
    words: str


def _ahead(o: MissionOptions, controllers: int) -> _Ahead:
    """What the command will fly. How far to keep away from limits follows from the level: flights
    that ask for it do not become fewer where fewer judge."""
    rehearsals = REHEARSALS * len(REHEARSED) if o.risk == "rehearsal" else 0
    judged = o.flights * controllers
    parts = [f"{TUNING} training flights"]
    if rehearsals:
        parts.append(f"{rehearsals} rehearsals (--risk boole: none)")
    parts.append(f"{o.flights} flight(s) of each of {controllers} controllers")
    total = TUNING + rehearsals + judged
    words = f"{', then '.join(parts)}: {total} flights in all, whose time is said after the first"
    return _Ahead(rehearsals=rehearsals, judging=judged, words=words)


def _check(o: MissionOptions, demo: Demo | None) -> None:
    """Raises `ModelError` for options that exclude each other, and where course or plant are not
    there."""
    if demo is not None and o.logs:
        raise ModelError(
            "--log belongs to a model file", got="demo", fix="leave --log out, or name a model.json"
        )
    if o.plant is not None and o.logs:
        raise ModelError(
            "--log says what disturbs an identified model",
            got=f"--plant {o.plant}",
            fix="leave one of them out",
        )
    load_course(o.course)
    if o.plant is not None:
        load_plant(o.plant)


def _models(subject: str, demo: Demo | None, out: Path, say: Say) -> _Models:
    files: Mapping[str, Path]
    if demo is not None:
        files = demo.identify(out / "models", say)
        main = files.get("hybrid", files["pem"])
    else:
        main = Path(subject)
        files = {"model": main}
    return _Models(files=files, main=main, model=_readable(main), demo=demo)


def _campaign(models: _Models, out: Path, o: MissionOptions) -> Campaign:
    """Where and against what is flown; disturbances of `logs` are written into `out`."""
    kept = ""
    if o.logs:
        kept = str(out / "disturbances.npy")
        write_segments(Path(kept), _disturbances(models.model, o.logs))
    pace = o.pace
    if pace is None:
        pace = 1.0 if models.demo else natural_pace(models.model, load_course(o.course))
    return Campaign(
        out=out,
        plant=o.plant or (models.demo.plant if models.demo else "model"),
        model=str(models.main),
        pace=pace,
        course=o.course,
        disturbances=kept,
    )


def _tuning(
    hangar: Hangar, plain: Entry, o: MissionOptions, ahead: _Ahead, jobs: int, say: Say
) -> tuple[Tuning, list[str]]:
    """What training flights and rehearsals ask for, and a warning where rehearsals do not bound the
    risk."""
    say(f"counting touched limits on {TUNING} training flights, once the controller is compiled")
    rows = flights(
        hangar,
        [plain],
        TRAINING_SEEDS[1 : 1 + TUNING],
        jobs=jobs,
        log="tuning.jsonl",
        near=NEAR,
        later=ahead.rehearsals + ahead.judging,
        say=lambda text: say(f"training flights: {text}"),
    )
    asked = tuned(rows, o.level)
    tuning = Tuning(
        pairs=asked["pairs"],
        boole=asked["boole"],
        moved=asked["moved"],
        flights=TUNING,
        rehearsed=[],
        kappa=asked["boole"],
        risk="boole",
    )
    if o.risk != "rehearsal":
        return tuning, []
    say(
        f"rehearsing {REHEARSALS} flights at each of {len(REHEARSED)} back-offs against the "
        "model itself"
    )
    try:
        found, rehearsals = rehearsed(
            hangar,
            plain,
            o.level,
            tried=REHEARSED,
            count=REHEARSALS,
            jobs=jobs,
            later=ahead.judging,
            say=say,
        )
    except ModelError as error:
        return tuning, [
            f"Rehearsals do not bound the risk, so that Boole's inequality does: {error}"
        ]
    return {**tuning, "rehearsed": rehearsals, "kappa": found, "risk": "rehearsal"}, []


def _tightened(plain: Entry, tuning: Tuning, level: float) -> list[Entry]:
    """The controllers that keep away from limits, and the one that knows none."""
    return [
        Entry(
            name="tube",
            text=f"{plain.name}, limits tightened by its tube, {100 * level:g} % a flight",
            model=plain.model,
            kappa=tuning["kappa"],
        ),
        Entry(
            name="constant",
            text=f"{plain.name}, limits moved by {1e3 * tuning['moved']:.1f} mm",
            model=plain.model,
            moved=tuning["moved"],
        ),
        Entry(name="cascade", text="cascade of PID loops", kind="cascade"),
    ]


def _what(subject: str, models: _Models, plant: str, o: MissionOptions) -> What:
    """What was flown, for the report."""
    model = models.model
    return {
        "mode": "demo" if models.demo else "plant" if o.plant else "model",
        "subject": subject,
        "plant": plant,
        "plain": models.plain.name,
        "model": model.name,
        "model_sha256": file_sha256(models.main),
        "learned": list(_learned(model)),
        "trained_on": list(model.trained_on),
        "logs": [Path(p).name for p in o.logs],
        "mass": float(model.values["mass"]) if "mass" in model.values else None,
        "disturbed_by": _disturbed(plant, o.logs),
    }


def _room(model: IdentifiedModel, hangar: Hangar) -> str:
    """What the model cannot hold within the commands of the course, in words."""
    own, limits = hangar.plant, hangar.task.problem
    flown = own if isinstance(own, ModelPlant) else None
    functions = flown.functions if flown else model_functions(model, with_=("target",))
    seen = flown.disturbances if flown else None
    pushes = None if seen is None else np.concatenate(seen)
    return headroom(functions, pushes, limits.command_min, limits.command_max).words


def _learned(model: IdentifiedModel) -> tuple[str, ...]:
    """Channels of the learned part, in its order; none for physics alone."""
    return (
        tuple(model.dynamics.posterior.outputs.names)
        if isinstance(model.dynamics, HybridModel)
        else ()
    )


def _readable(path: Path) -> IdentifiedModel:
    if path.exists() and read_json(path).get("schema") == LINEAR:
        raise ModelError(
            "the tube needs a model with position and attitude",
            got="a linear model",
            fix="greybox fit",
        )
    model = load_model(path)
    states = model.dynamics.states.names
    missing = [n for n in NEEDED if not any(s.startswith(f"{n}.") for s in states)]
    if missing:
        raise ModelError(
            f"the tube needs a model with {', '.join(missing)}",
            got=model.name,
            fix="fit on flights with pose",
        )
    return model


def _disturbances(model: IdentifiedModel, logs: Sequence[str]) -> list[FloatArray]:
    from greybox.data.logs import read_logs

    return real_disturbances(
        model, read_logs(list(logs), model.physics.vehicle, rate=1.0 / model.sample_time)
    )


def _disturbed(plant: str, logs: Sequence[str]) -> str:
    if plant != "model":
        return "the plant's own gusts and sensor noise"
    if logs:
        return (
            "force and torque that the smoother found in real flights, resampled in blocks, "
            "and the identified noise"
        )
    return "the identified process and sensor noise"
