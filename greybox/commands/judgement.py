"""What the commands that judge have in common: print the findings, write the JSON, give the exit code."""

from __future__ import annotations

from typing import Any


def tell(report: Any, json: str | None) -> int:
    """Print `report` (`summary()`, `to_dict()`, `ok`), or its JSON where `json` is "-"; write it to the file `json`.

    Returns 0, or 1 where something blocks. Raises `OutputError`.
    """
    from greybox.files import dump_json, write_json

    if json == "-":
        print(dump_json(report.to_dict()), end="")
    else:
        if json:
            write_json(json, report.to_dict())
        print(report.summary())
    return 0 if report.ok else 1
