"""The record of a chain, made by hand."""

from __future__ import annotations

from typing import Any


def identified() -> dict[str, Any]:
    """An identify.json of one stage that went well."""
    verdict = {"outcome": "usable", "judged_on": "left out", "reason": "", "action": ""}
    fit = {
        "name": "fit",
        "folder": "1_fit",
        "skipped": "",
        "lines": ["USABLE"],
        "commands": ["greybox fit"],
        "exit_code": 0,
        "seconds": 3.0,
        "cpu_seconds": 2.0,
    }
    return {
        "command": "greybox identify V.toml a.csv",
        "stages": [fit],
        "outcome": {
            "line": "USABLE",
            "model": "1_fit/model.json",
            "why": "the only one",
            "verdict": verdict,
            "stopped": "",
            "exit_code": 0,
        },
    }
