"""twin: the files of a model for one or several simulators, and what each of them leaves out."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from greybox.data import Dataset
from greybox.errors import DataError, ModelError
from greybox.files import (
    FileFormatError,
    Json,
    OutputError,
    dump_json,
    own_place,
    read_json,
    write_atomic,
)
from greybox.model.identified import IdentifiedModel
from greybox.model.verdict import demand_usable
from greybox.shown import Cell, Shown
from greybox.simulators.coverage import Covered, coverage, format_table
from greybox.simulators.craft import Craft
from greybox.simulators.draws import Draws, draw
from greybox.simulators.matrix import matrix
from greybox.simulators.push_levels import with_push_levels
from greybox.simulators.push_text import push_text
from greybox.simulators.rest_text import rest_text
from greybox.simulators.sensor_text import sensor_text
from greybox.simulators.statement import Statement, state
from greybox.simulators.target import Target
from greybox.simulators.targets import TARGETS, target_by_name
from greybox.simulators.words import Status
from greybox.takes import FLIGHTS, MODEL, NATURAL, PATH, SIMULATORS, takes

SCHEMA = "greybox.twin/1"
REST = """rest.py has what is folded or lost of forces and moments, to be applied from outside, what was learned of
motion and rotor speeds included; unexplained pushes and effects with a memory are not in it.
"""
PUSHES = """pushes.py has the unexplained pushes that last, to be applied from outside.
"""


@dataclass(frozen=True, kw_only=True, repr=False)
class Twin(Shown):
    """`statements` of every target, in order; `files` maps paths inside the folder to their
    text or bytes."""

    model: str
    data_hash: str
    statements: tuple[Statement, ...]
    files: Mapping[str, str | bytes] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    covered: tuple[Covered, ...] = ()

    def _shown_text(self) -> str:
        """One line per target, then the notes."""
        what = f"{self.model} as {len(self.files)} files of {len(self.statements)} simulators"
        said = [f"  {s.simulator}: {s.headline}" for s in self.statements]
        return "\n".join([what, *said, *self.notes])

    def _shown_rows(self) -> list[dict[str, Cell]]:
        """One row per simulator: how much it says, folds and loses, and what that does together."""
        return [
            {
                "simulator": s.simulator,
                **{k.value: sum(r.word.status is k for r in s.rows) for k in Status},
                "together": "" if s.whole is None else s.whole.text,
            }
            for s in self.statements
        ]

    def summary(self) -> str:
        """The table of every target, and of several one table of effects and targets."""
        table = [matrix(self.statements)] if len(self.statements) > 1 else []
        return "\n\n".join([*(s.text for s in self.statements), *table, *self.notes])

    def to_dict(self) -> dict[str, Json]:
        """Plain values of twin.json (schema "greybox.twin/1")."""
        return {
            "schema": SCHEMA,
            "model": self.model,
            "data_hash": self.data_hash,
            "targets": [s.to_dict() for s in self.statements],
            "files": sorted(self.files),
            "notes": list(self.notes),
            "coverage": [c.to_dict() for c in self.covered],
        }

    def save(self, folder: str | os.PathLike[str], *, force: bool = False) -> Path:
        """Write all files and twin.json into `folder`. Raises `OutputError` where it holds one
        of the files, or something else than a twin, and `force` was not given; then nothing is
        written. With `force`, files go
        that the twin.json of an earlier twin lists and this one has not."""
        place = Path(folder)
        names = [*self.files, "twin.json"]
        there = [n for n in names if (place / n).exists()]
        if there and not force:
            more = f" and {len(there) - 1} more" if len(there) > 1 else ""
            raise OutputError(
                f"{there[0]}{more} exist",
                where=str(place),
                fix="choose another --out, or add --force",
            )
        if not force:
            fix = "choose another --out, or add --force"
            own_place(place, "twin.json", SCHEMA, "a twin", fix=fix)
        for name in _listed(place) - set(names):
            old = place / name
            old.unlink(missing_ok=True)
            if not any(old.parent.iterdir()):
                old.parent.rmdir()
        for name, content in self.files.items():
            write_atomic(place / name, content)
        write_atomic(place / "twin.json", dump_json(self.to_dict()))
        return place


def _listed(place: Path) -> set[str]:
    """Files inside `place` that the twin.json there lists; none where it is no twin's."""
    try:
        names = read_json(place / "twin.json", schema=SCHEMA).get("files", [])
    except FileFormatError:
        return set()
    inside = place.resolve()
    return {
        n
        for n in (names if isinstance(names, list) else [])
        if isinstance(n, str)
        and (place / n).is_file()
        and inside in (place / n).parent.resolve().parents
    }


@takes(model=MODEL, targets=SIMULATORS, train=FLIGHTS, check=FLIGHTS, seed=NATURAL)
@takes(out=PATH, draws=NATURAL)
def twin(
    model: IdentifiedModel,
    targets: Sequence[str | Target] = (),
    *,
    out: str | os.PathLike[str] | None = None,
    force: bool = False,
    even_so: bool = False,
    draws: int | None = None,
    seed: int = 0,
    train: Dataset | None = None,
    check: Dataset | None = None,
) -> Twin:
    """The model as files of `targets`, by name or as they are (all, where none is given): one
    folder each, with sensors.toml and a statement of what the simulator folds or loses. Written to
    `out`, if given. `draws`: also so many craft as uncertain as the fit left them, from `seed`;
    `train`: the flights of the fit, on which is counted how strongly they are pushed about;
    `check`: flights that no fit saw, on which their band is counted.

    Raises `UnknownNameError` for a target, `DataError` for one named twice, `OutputError` for files
    that exist. `ModelError`: no vehicle's model, like no body, with rotors that a named target
    cannot express, or judged NOT USABLE, unless `even_so`.
    """
    demand_usable(model.verdict, model.name, even_so=even_so)
    craft = Craft.of(model)
    chosen = [target_by_name(t) if isinstance(t, str) else t for t in targets or TARGETS]
    _demand_once([t.name for t in chosen])
    sensors, pushes = sensor_text(craft, model.flight_spread), push_text(craft)
    statements, files = list[Statement](), dict[str, str | bytes]()
    notes = [] if craft.speed_known else [_counted(craft)]
    for target in chosen:
        try:
            stated = state(target, craft)
        except ModelError as error:
            said = f"no files for {target.name}: {error.line}"
            if targets:
                raise ModelError(f"nothing is written, {said}") from None
            notes.append(said)
            continue
        statements.append(stated)
        texts = _texts(target, craft, stated, pushes)
        files |= {f"{target.name}/{name}": text for name, text in texts.items()}
        files[f"{target.name}/sensors.toml"] = sensors
    covered: tuple[Covered, ...] = ()
    if draws is not None:
        drawn, told = _drawn(model, draws, seed, train)
        files |= drawn.files()
        notes += [*told, drawn.summary(), *drawn.notes]
        if check is not None:
            covered = coverage(model, drawn, check, seed=seed)
            notes.append(format_table(covered))
    made = Twin(
        covered=covered,
        model=craft.title,
        data_hash=model.data_hash,
        statements=tuple(statements),
        files=files,
        notes=tuple(notes),
    )
    if out is not None:
        made.save(out, force=force)
    return made


def _demand_once(names: Sequence[str]) -> None:
    """Raise `DataError` for a target that is named twice."""
    if double := sorted({n for n in names if names.count(n) > 1}):
        raise DataError(f"target {double[0]} twice", fix="name every target once")


def _drawn(
    model: IdentifiedModel, count: int, seed: int, train: Dataset | None
) -> tuple[Draws, list[str]]:
    """So many craft, pushed about as on the flights of `train`, and what is to be said of
    these."""
    drawn = draw(model, count, seed)
    if train is None:
        return drawn, []
    others = [n for n in train.names if model.trained_on and n not in model.trained_on]
    notes = [_not_of_the_fit(others, model)] if others else []
    return with_push_levels(model, drawn, train, seed=seed), notes


def _texts(
    target: Target, craft: Craft, said: Statement, pushes: str | None
) -> dict[str, str | bytes]:
    """The files of one target: what it flies, what it leaves out, and what is lost."""
    texts: dict[str, str | bytes] = dict(target.files(said.spoken))
    lost = said.text + "\n"
    driven = "commands.py" in texts
    left = rest_text(craft, said.spoken, said.simulator) if driven else None
    if left is not None:
        texts["rest.py"] = left
        lost += REST
    if driven and pushes is not None:
        texts["pushes.py"] = pushes
        lost += PUSHES
    return {**texts, "LOST.txt": lost}


def _not_of_the_fit(others: Sequence[str], model: IdentifiedModel) -> str:
    return (
        f"pushes are counted on {', '.join(others)}, but the model says that it was fitted to "
        f"{', '.join(model.trained_on)}: give those flights as --train"
    )


def _counted(craft: Craft) -> str:
    return (
        f"speed_max is not in the vehicle file: rotor speeds are counted as if full speed were "
        f"{craft.speed_max:g} rad/s. Thrust, torque and drag do not depend on it."
    )
