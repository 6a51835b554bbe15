"""The cache of exports: the same model with the same options is the same bundle, as long as the code
and the versions of what it is made with are the same.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable
from importlib import resources
from pathlib import Path

from greybox.errors import FileFormatError, ModelError
from greybox.estimation.cache import cache_root
from greybox.files import checksum
from greybox.model.dynamics import Dynamics
from greybox.model.effects_file import own_effects
from greybox.model.identified import IdentifiedModel, library_versions
from greybox.model.layer import innermost, layers
from greybox.model.linear import LinearModel
from greybox.model.model import PhysicsModel
from greybox.model.noise import Augmented
from greybox.model.sensors import SENSORS
from greybox.residual.hybrid import HybridModel
from mpc_export.place import beside, is_bundle, move

KEPT = 16
"""Bundles that the cache keeps."""


def key_of(model: IdentifiedModel | LinearModel, options: list[object]) -> str | None:
    """All that a bundle depends on, as one word. None for a model that a key cannot tell from
    others: no file form, or code of the user's own in no known file."""
    if _has_unknown_code(model):
        return None
    try:
        body = model.to_dict()
    except ModelError:
        return None
    body = {k: v for k, v in body.items() if k != "versions"}
    return checksum(
        {"model": body, "options": options, "code": _code_digest(), "versions": library_versions()}
    )


def _has_unknown_code(model: IdentifiedModel | LinearModel) -> bool:
    """Whether code shapes the model that neither this package nor the checksum of an effects file
    stands for."""
    dynamics: Dynamics = model.dynamics if isinstance(model, IdentifiedModel) else model
    if any(type(layer) not in (HybridModel, Augmented) for layer in layers(dynamics)):
        return True
    core = innermost(dynamics)
    if type(core) is not PhysicsModel:
        return type(core) is not LinearModel
    known = {type(sensor) for sensor in SENSORS}
    own = own_effects(core.effects).values()
    return any(type(s) not in known for s in core.sensors) or any(e["sha256"] is None for e in own)


@functools.cache
def _code_digest() -> str:
    """SHA-256 of the code that shapes a bundle: another version of it must not find this one's
    bundles."""
    digest = hashlib.sha256()
    for package in ("greybox", "mpc_export"):
        root = Path(str(resources.files(package)))
        shapes = (p for p in root.rglob("*") if p.suffix in (".py", ".c", ".h") or _is_template(p))
        for path in sorted(shapes):
            digest.update(f"{path.relative_to(root)}\0".encode() + path.read_bytes())
    return digest.hexdigest()


def _is_template(path: Path) -> bool:
    return "templates" in path.parts and path.is_file() and "__pycache__" not in path.parts


def fetch(key: str, place: Path, whole: Callable[[Path], object], *, force: bool) -> bool:
    """Put the bundle of a key at its place, if it is kept; `whole` reads it and raises
    `FileFormatError` where it is not."""
    kept = cache_root() / "export" / key
    if not is_bundle(kept):
        return False
    try:
        whole(kept)
    except FileFormatError:
        shutil.rmtree(kept, ignore_errors=True)
        return False
    with beside(place) as part:
        shutil.copytree(kept, part, dirs_exist_ok=True)
        move(part, place, force=force)
    return True


def keep(key: str, part: Path) -> None:
    """Keep a bundle that is whole. A cache that cannot be written is no reason to fail."""
    store = cache_root() / "export"
    with contextlib.suppress(OSError):
        store.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=store, prefix=".part-") as folder:
            shutil.copytree(part, Path(folder) / "bundle")
            with contextlib.suppress(OSError):
                os.rename(Path(folder) / "bundle", store / key)
        entries = sorted(
            (p for p in store.iterdir() if len(p.name) == 64), key=lambda p: p.stat().st_mtime
        )
        for old in entries[:-KEPT]:
            shutil.rmtree(old, ignore_errors=True)
