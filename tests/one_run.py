"""Whether a folder ever holds results of two runs: it is looked at after every file that is written
or removed."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

OLD = "of an earlier run"


@contextlib.contextmanager
def results_of_one_run(folder: Path, *names: str) -> Iterator[list[set[str]]]:
    """Put old files of these names into a folder, and demand that whoever is killed at any moment
    inside leaves old ones or new ones, never both. Yields the sets of new ones, in order."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).write_text(OLD)
    seen: list[set[str]] = []
    mixed: list[dict[str, bool]] = []

    def look() -> None:
        there = {
            n: (folder / n).read_bytes() == OLD.encode() for n in names if (folder / n).exists()
        }
        seen.append({n for n, old in there.items() if not old})
        if len(set(there.values())) > 1:
            mixed.append(there)

    with pytest.MonkeyPatch.context() as patch:
        for module, call in ((os, "replace"), (os, "unlink")):
            original = getattr(module, call)

            def watched(*given: Any, _original: Any = original, **more: Any) -> None:
                _original(*given, **more)
                look()

            patch.setattr(module, call, watched)
        yield seen
    assert seen, "nothing was written"
    assert not mixed, f"old (True) beside new: {mixed[0]}"
