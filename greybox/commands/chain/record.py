"""What a chain has done, on disk: identify.json, written atomically after every stage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from greybox.errors import FileFormatError
from greybox.files import read_json, write_json
from greybox.model.verdict import VerdictDocument
from greybox.report.identify_document import IdentifyDocument, OutcomeRow, StageRow

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

    def to_dict(self) -> StageRow:
        """Plain values under the names of the fields."""
        return {
            "name": self.name,
            "folder": self.folder,
            "commands": list(self.commands),
            "key": self.key,
            "exit_code": self.exit_code,
            "seconds": self.seconds,
            "cpu_seconds": self.cpu_seconds,
            "lines": list(self.lines),
            "writes": list(self.writes),
            "skipped": self.skipped,
        }

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
    verdict: VerdictDocument | None = None
    stopped: str = ""

    def to_dict(self) -> OutcomeRow:
        """Plain values under the names of the fields."""
        return {
            "line": self.line,
            "exit_code": self.exit_code,
            "model": self.model,
            "why": self.why,
            "verdict": self.verdict,
            "stopped": self.stopped,
        }


def write_record(
    out: Path, outcome: Outcome | None, stages: Mapping[str, StageRecord], command: str
) -> None:
    """Write identify.json. Raises `OutputError`."""
    content: IdentifyDocument = {
        "schema": SCHEMA,
        "command": command,
        "outcome": None if outcome is None else outcome.to_dict(),
        "stages": [s.to_dict() for s in stages.values()],
    }
    write_json(out / FILE, content)


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
