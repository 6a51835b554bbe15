"""Rows of a benchmark that is run in parts: what was not run again stays."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"


def keep(name: str, rows: Sequence[dict[str, Any]]) -> None:
    """Write `rows`, told apart by their "row" and "cache", into results/NAME.json, with what
    machine this is."""
    path, new = RESULTS / f"{name}.json", {(r["row"], r["cache"]) for r in rows}
    kept = json.loads(path.read_text())["rows"] if path.exists() else []
    about = {
        "python": platform.python_version(),
        "machine": platform.machine(),
        "cores": os.cpu_count(),
    }
    both = [*(r for r in kept if (r["row"], r["cache"]) not in new), *rows]
    path.write_text(json.dumps({"about": about, "rows": both}, indent=1) + "\n")
