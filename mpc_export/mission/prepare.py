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
from typing import Any

import numpy as np

from greybox.errors import ModelError
from greybox.files import file_sha256, read_json
from greybox.model.identified import IdentifiedModel
from greybox.model.linear import SCHEMA as LINEAR
from greybox.residual.files import load_model
from greybox.residual.hybrid import HybridModel
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
    tuning: dict[str, Any]
    what: dict[str, Any]
    seeds: tuple[int, ...]
    warnings: tuple[str, ...]


def prepare(
    subject: str,
    out: Path,
    *,
    demo: Demo | None = None,
    plant: str | None = None,
    logs: Sequence[str] = (),
    course: str = OBSTACLES,
    pace: float | None = None,
    risk: str = "rehearsal",
    flights_: int = 20,
    level: float = 0.1,
    seed: int = 0,
    jobs: int = 1,
    say: Say = print,
) -> Flown:
    """Models, plant, controllers and tuned back-offs of `subject`: a model file, or what a `demo`
    is called.

    plant: `module:attribute`; None flies the demo's plant, or the model itself under disturbances
    that are resampled from `logs` or else as identified. pace: how much slower the course is flown;
    None: 1 for the demo, and for a model what its training speeds ask for. risk: how the level
    becomes standard deviations, "rehearsal" or "boole" (see mpc_export/tube/risk.py). Raises
    `ModelError`, `PlantError`, `BuildError`, `FileFormatError`.
    """
    if demo is not None and logs:
        raise ModelError(
            "--log belongs to a model file", got="demo", fix="leave --log out, or name a model.json"
        )
    if plant is not None and logs:
        raise ModelError(
            "--log says what disturbs an identified model",
            got=f"--plant {plant}",
            fix="leave one of them out",
        )
    load_course(course)
    if plant is not None:
        load_plant(plant)
    files: Mapping[str, Path]
    if demo is not None:
        files = demo.identify(out / "models", say)
        main = files.get("hybrid", files["pem"])
    else:
        main = Path(subject)
        files = {"model": main}
    model = _readable(main)
    kept = ""
    if logs:
        kept = str(out / "disturbances.npy")
        write_segments(Path(kept), _disturbances(model, logs))
    if pace is None:
        pace = 1.0 if demo is not None else natural_pace(model, load_course(course))
    used = plant or ("model" if demo is None else demo.plant)
    campaign = Campaign(
        out=out, plant=used, model=str(main), pace=pace, course=course, disturbances=kept
    )
    hangar = Hangar(campaign)
    warnings = [w for w in (_room(model, hangar),) if w]
    for text in warnings:
        say(text)
    plain = Entry(
        name=main.stem if demo is not None else "mean",
        text=TEXTS[main.stem] if demo is not None else "the model, no tightening",
        model=str(main),
    )
    say(f"counting touched limits on {TUNING} training flights")
    rows = flights(
        hangar,
        [plain],
        TRAINING_SEEDS[1 : 1 + TUNING],
        jobs=jobs,
        log="tuning.jsonl",
        near=NEAR,
        say=lambda text: say(f"training flights: {text}"),
    )
    tuning: dict[str, Any] = {**tuned(rows, level), "flights": TUNING, "rehearsed": []}
    tuning |= {"kappa": tuning["boole"], "risk": "boole"}
    if risk == "rehearsal":
        say(
            f"rehearsing {REHEARSALS} flights at each of {len(REHEARSED)} back-offs against the "
            "model itself"
        )
        try:
            found, tuning["rehearsed"] = rehearsed(
                hangar, plain, level, tried=REHEARSED, count=REHEARSALS, jobs=jobs, say=say
            )
            tuning |= {"kappa": found, "risk": "rehearsal"}
        except ModelError as error:
            warnings.append(
                f"Rehearsals do not bound the risk, so that Boole's inequality does: {error}"
            )
    entries = [
        Entry(
            name="tube",
            text=f"{plain.name}, limits tightened by its tube, {100 * level:g} % a flight",
            model=str(main),
            kappa=tuning["kappa"],
        ),
        Entry(
            name="constant",
            text=f"{plain.name}, limits moved by {1e3 * tuning['moved']:.1f} mm",
            model=str(main),
            moved=tuning["moved"],
        ),
        Entry(name="cascade", text="cascade of PID loops", kind="cascade"),
    ]
    before = [
        Entry(name=n, text=TEXTS[n], model=str(f))
        for n, f in files.items()
        if demo is not None and f != main
    ]
    what = {
        "mode": "demo" if demo is not None else "plant" if plant else "model",
        "subject": subject,
        "plant": used,
        "plain": plain.name,
        "model": model.name,
        "model_sha256": file_sha256(main),
        "learned": list(_learned(model)),
        "trained_on": list(model.trained_on),
        "logs": [Path(p).name for p in logs],
        "mass": float(model.values["mass"]) if "mass" in model.values else None,
        "disturbed_by": _disturbed(used, logs),
    }
    return Flown(
        hangar=hangar,
        entries=(*before, plain, *entries),
        tuning=tuning,
        what=what,
        seeds=tuple(judging(flights_, seed)),
        warnings=tuple(warnings),
    )


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


def _disturbances(model: IdentifiedModel, logs: Sequence[str]) -> list[Any]:
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
