"""What a chain has done, on disk: identify.json, written atomically after every stage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from greybox.errors import FileFormatError
from greybox.files import read_json, write_json

SCHEMA = "greybox.identify/1"
FILE = "identify.json"


@dataclass(frozen=True, kw_only=True)
class StageRecord:
    """One stage: its command lines as typed, the checksum (`key`) of what they were given, how they
    ended, and the first lines that they said. `skipped` is why it did nothing ("": it did)."""

    name: str
    folder: str
    commands: tuple[str, ...] = ()
    key: str = ""
    exit_code: int = 0
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    lines: tuple[str, ...] = ()
    writes: tuple[str, ...] = ()
    skipped: str = ""

    @property
    def finished(self) -> bool:
        """Whether it ended by itself: 0 done, 1 done and the answer is no."""
        return self.exit_code in (0, 1)

    @staticmethod
    def from_dict(data: Mapping[str, object]) -> StageRecord:
        """The record of a file. Raises `KeyError`, `TypeError` or `ValueError` for one that is
        none."""
        texts = {n: _texts(data[n]) for n in ("commands", "lines", "writes")}
        return StageRecord(
            name=str(data["name"]),
            folder=str(data["folder"]),
            key=str(data["key"]),
            exit_code=int(str(data["exit_code"])),
            seconds=float(str(data["seconds"])),
            cpu_seconds=float(str(data["cpu_seconds"])),
            skipped=str(data["skipped"]),
            **texts,
        )


def _texts(value: object) -> tuple[str, ...]:
    if not isinstance(value, list):
        raise TypeError("not a list")
    return tuple(str(v) for v in value)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How a chain stands: the first line, the model that came out ("": none) and why that one, the
    verdict as in model files, and the stage in which it was stopped ("": it went to its end)."""

    line: str
    exit_code: int
    model: str = ""
    why: str = ""
    verdict: Mapping[str, object] | None = None
    stopped: str = ""


def write_record(
    out: Path, outcome: Outcome | None, stages: Mapping[str, StageRecord], command: str
) -> None:
    """Write identify.json. Raises `OutputError`."""
    content = {"schema": SCHEMA, "command": command}
    state = None if outcome is None else asdict(outcome)
    write_json(
        out / FILE, {**content, "outcome": state, "stages": [asdict(s) for s in stages.values()]}
    )


def read_record(out: Path) -> dict[str, StageRecord]:
    """Stages of an earlier run in this folder by name, none where there was none.

    Raises `FileFormatError` for a file that is no record: the folder is somebody else's.
    """
    path = out / FILE
    if not path.exists():
        return {}
    content = read_json(path, schema=SCHEMA)
    try:
        found = [StageRecord.from_dict(s) for s in content["stages"]]
    except (KeyError, TypeError, ValueError):
        raise FileFormatError(
            "incomplete record of a chain", where=str(path), fix="another --out, or delete the file"
        ) from None
    return {s.name: s for s in found}
