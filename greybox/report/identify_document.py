"""What identify.json (greybox.identify/1) holds: the command writes it after every stage, its page
shows it."""

from __future__ import annotations

from typing import TypedDict

from greybox.model.verdict import VerdictDocument


class StageRow(TypedDict):
    """A stage: its command lines, the checksum of what they were given, how they ended, what they
    said first and wrote; why it was skipped ("": it was not)."""

    name: str
    folder: str
    commands: list[str]
    key: str
    exit_code: int
    seconds: float
    cpu_seconds: float
    lines: list[str]
    writes: list[str]
    skipped: str


class OutcomeRow(TypedDict):
    """How the chain stands, which model came out and why, and where it was stopped ("": not)."""

    line: str
    exit_code: int
    model: str
    why: str
    verdict: VerdictDocument | None
    stopped: str


class IdentifyDocument(TypedDict):
    """identify.json; there is no outcome before the end."""

    schema: str
    command: str
    outcome: OutcomeRow | None
    stages: list[StageRow]
