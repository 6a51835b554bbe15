"""Where a bundle goes: it is written beside its place and moved there. A bundle that is there is
replaced as long as every file in it is as an export wrote it."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from greybox.errors import printable
from greybox.files import OutputError, Parsed, file_sha256, own_place
from mpc_export.manifest import SCHEMA
from mpc_export.verify import made_on_the_way, seal

LISTED = 8
"""Files that a refusal names."""
OLD = "old"
"""Where the bundle that is replaced waits, beside the new one."""


def is_bundle(folder: Path) -> bool:
    """Whether a folder holds a manifest of ours."""
    return _manifest(folder) is not None


def _manifest(folder: Path) -> Parsed | None:
    try:
        path = folder / "manifest.json"  # a pipe of that name would never end
        if not path.is_file():
            return None
        said = json.loads(path.read_text(encoding="utf-8"))
        return said if said.get("schema") == SCHEMA else None
    except (OSError, ValueError, AttributeError, RecursionError):
        return None


def not_as_written(folder: Path) -> list[str]:
    """Files of a bundle that an export did not write, or not so. What is missing can be written
    again; what runs and builds leave behind (`made_on_the_way`) is nobody's work."""
    manifest = _manifest(folder) or {}
    written = manifest.get("files")
    digests = written if isinstance(written, dict) else {}
    out = [] if manifest.get("checksum") == _seal(manifest) else ["manifest.json"]
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if (path.is_dir() and not path.is_symlink()) or name == "manifest.json":
            continue
        if name in digests:
            if path.is_symlink() or not path.is_file() or file_sha256(path) != digests[name]:
                out.append(name)
        elif not made_on_the_way(name):
            out.append(name)
    return out


def _seal(manifest: Parsed) -> str | None:
    try:
        return seal(manifest)
    except ValueError:
        return None


def check_place(place: Path, *, force: bool = False) -> None:
    """Raises `OutputError` unless `place` is free, an empty folder, or a bundle, of whose files
    every one is as it was written or may go (`force`)."""
    own_place(place, "manifest.json", SCHEMA, "a bundle")
    if not is_bundle(place):
        return
    if not force and (own := not_as_written(place)):
        more = f" and {len(own) - LISTED} more" if len(own) > LISTED else ""
        raise OutputError(
            f"a new export would delete what was changed or added: "
            f"{', '.join(printable(n) for n in own[:LISTED])}{more}",
            where=str(place),
            fix="move it or choose another --out; --force deletes it",
        )


@contextlib.contextmanager
def beside(place: Path) -> Iterator[Path]:
    """A temporary folder on the same file system, gone afterwards, but never with the only copy of
    an old bundle. Raises `OutputError`, which names a copy that is left."""
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(dir=place.parent, prefix=f".{place.name}.", suffix=".part"))
    except OSError as error:
        raise OutputError(
            f"cannot write: {error.strerror}", where=str(place), fix="choose another --out"
        ) from None
    try:
        (part / "bundle").mkdir()
        yield part / "bundle"
    finally:
        shutil.rmtree(part / "bundle", ignore_errors=True)
        old = part / OLD
        if old.exists() and not os.path.lexists(place):
            raise OutputError(
                "the new bundle did not come into its place, nor the old one back",
                where=str(place),
                fix=f"the old one is {old}: move it there",
            )
        shutil.rmtree(part, ignore_errors=True)


def move(part: Path, place: Path, *, force: bool = False) -> None:
    """Put a finished bundle in its place; the old one is there until the new one is. Raises
    `OutputError`."""
    check_place(place, force=force)
    old = part.parent / OLD
    try:
        if place.exists():
            os.rename(place, old)
        os.rename(part, place)
    except BaseException as error:  # an interrupt between the two must not cost the old one
        if old.exists() and not place.exists():
            os.rename(old, place)
        if not isinstance(error, OSError):
            raise
        raise OutputError(
            f"cannot write: {error.strerror}", where=str(place), fix="choose another --out"
        ) from None
