"""The files of a search: what it found, its models and its laws, the same for Python and the command."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from greybox.discovery.document import DiscoveryDocument
from greybox.files import withdraw, write_atomic, write_json
from greybox.residual.laws.effect_file import set_aside_laws

if TYPE_CHECKING:
    from greybox.discovery.result import Discovery

WITH_LAWS = "model_with_laws.json"
"""File of the model that has the laws of the leftover as well."""


def write_found(
    found: Discovery, folder: str | os.PathLike[str], content: DiscoveryDocument
) -> Path:
    """Write model.json, laws as proposal_N.py, model_with_laws.json where there are any, and
    discovery.json (`content`) last; returns the folder. Laws of an earlier search are set aside.
    Where bad data stopped the search it is discovery.json alone. Raises `OutputError`."""
    out = Path(folder)
    if found.fit is not None:
        found.model.save(out / "model.json")
        laws = found.proposals()
        set_aside_laws(out, laws)
        for name, text in laws.items():
            write_atomic(out / name, text)
        if found.lawful is not None:
            found.lawful.save(out / WITH_LAWS)
        else:
            withdraw(out, WITH_LAWS)
    write_json(out / "discovery.json", content)
    return out
