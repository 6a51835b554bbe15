"""Implausible: one thing in a vehicle file that no craft, or hardly any, has."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Severity = Literal["blocking", "warning", "info"]
SEVERITIES: tuple[Severity, ...] = ("blocking", "warning", "info")


@dataclass(frozen=True)
class Implausible:
    """One finding. "blocking": no such craft flies; "warning": check it; "info": worth knowing.
    `where` is the key."""

    severity: Severity
    where: str
    message: str
    expected: str
    got: str
    fix: str

    def line(self) -> str:
        """One line for a person."""
        text = (
            f"{self.severity}: {self.where}: {self.message}; expected {self.expected}, got "
            f"{self.got}"
        )
        return f"{text}. Usual fix: {self.fix}"
