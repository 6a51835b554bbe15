"""Effects from a Python file that the user names: read, and held to the basics that every effect is
held to.

Such a file is code: it runs with the rights of whoever calls `load_effects`, as any script of
theirs. Nothing here reads a file that was not named, and model files hold no code, only the name
and checksum of the effects file they need.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import ModuleType

from greybox.errors import FileFormatError, ModelError
from greybox.model.effect import Effect, EffectSource
from greybox.model.effect_check import check_effect, failed
from greybox.model.effects import CATALOGUE, effect_by_name


def load_effects(path: str | os.PathLike[str]) -> tuple[Effect, ...]:
    """The effects of a Python file: one instance of every class in it that derives from `Effect`,
    in the file's order.

    The same text gives the same instances. Raises `ModelError` with file and line where the file
    cannot be read or run, has no effect, or uses a name of the catalogue. So does an effect that is
    not declared completely, returns what its stage does not know, or does not vanish at its null.
    """
    file = Path(path)
    try:
        text = file.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise ModelError("no such effects file", where=str(path), fix="check the path") from None
    except (OSError, UnicodeDecodeError) as error:
        reason = (isinstance(error, OSError) and error.strerror) or "not a text file"
        raise ModelError(
            f"cannot read: {reason}", where=str(path), fix="name a Python file"
        ) from None
    return _from_text(text, str(path))


OwnEffect = dict[str, str | list[str] | None]
"""What a model file says of an effect that is not in the catalogue: file, sha256, references."""


def own_effects(effects: Iterable[Effect]) -> dict[str, OwnEffect]:
    """What a model file says of the effects that are not in the catalogue: name -> file, sha256 and
    references.

    File and sha256 are null for an effect of the caller's own code.
    """
    out: dict[str, OwnEffect] = {}
    for effect in effects:
        if not any(type(effect) is type(known) for known in CATALOGUE):
            source = effect.source
            out[effect.name] = {
                "file": source.file if source else None,
                "sha256": source.sha256 if source else None,
                "references": list(effect.references),
            }
    return out


def effects_of(
    names: Sequence[str], own: Mapping[str, OwnEffect], given: Iterable[Effect], *, where: str
) -> tuple[Effect, ...]:
    """The effects of a model file by name, those under `own` (see `own_effects`) from the `given`
    ones.

    Raises `FileFormatError` where one is not given or its file has changed, `UnknownNameError` for
    an unknown name.
    """
    have = {e.name: e for e in given}
    _demand_given({n: own[n]["file"] for n in names if n in own and n not in have}, where)
    found = []
    for name in names:
        if name not in own:
            found.append(effect_by_name(name))
            continue
        file, sha256 = own[name]["file"], own[name]["sha256"]
        source = have[name].source
        if sha256 is not None and (source is None or source.sha256 != sha256):
            raise FileFormatError(
                f"the effect {name} is not the one that the model was made with",
                where=where,
                expected=f"{file} with SHA-256 {sha256[:12]}...",
                got=f"{source.file} with {source.sha256[:12]}..."
                if source
                else "one of your own code",
                fix="give the file as it was then, or fit again",
            )
        found.append(have[name])
    return tuple(found)


def _demand_given(missing: Mapping[str, object], where: str) -> None:
    """Raise `FileFormatError` for effects of a model file that are `missing` (name -> file, None for
    code of the caller's own), with all files that have them: those beside it by their path."""
    if not missing:
        return
    beside = [Path(where).parent / str(f) for f in dict.fromkeys(missing.values()) if f]
    files = [str(f if f.is_file() else f.name) for f in beside]
    option = f"--effects-file {' '.join(files)}, in Python " if files else ""
    load = "load_effects(file) of each" if files else "[YourEffect()]"
    of = ", ".join(f"{n} ({f or 'Python code of your own'})" for n, f in missing.items())
    raise FileFormatError(
        f"the model has effects that it does not hold: {of}",
        where=where,
        fix=f"{option}greybox.load(path, effects=...) with {load}",
    )


def _from_text(text: str, path: str) -> tuple[Effect, ...]:
    source = EffectSource(
        file=Path(path).name, sha256=hashlib.sha256(text.encode()).hexdigest(), text=text
    )
    name = f"greybox_effects_{source.sha256[:16]}"
    if name in sys.modules:
        known: tuple[Effect, ...] = sys.modules[name].__dict__["loaded_effects"]
        return known
    module = ModuleType(name)
    module.__file__ = path
    sys.modules[name] = module  # classes look for their module while they are made
    try:
        _run(text, path, module)
        module.__dict__["loaded_effects"] = found = _instances(module, path)
        for effect in found:
            type(effect).source = source
            type(effect).__reduce__ = _reduce  # type: ignore[method-assign, assignment]
            check_effect(effect, where=path)
    except BaseException:
        del sys.modules[name]
        raise
    return found


def _reduce(effect: Effect) -> tuple[object, ...]:
    """Pickled by its text, so that a worker process can make it too."""
    source = effect.source
    assert source is not None
    return _restored, (source.text, source.file, effect.name)


def _restored(text: str, path: str, name: str) -> Effect:
    return next(e for e in _from_text(text, path) if e.name == name)


def _run(text: str, path: str, module: ModuleType) -> None:
    try:
        exec(compile(text, path, "exec"), module.__dict__)
    except SyntaxError as error:
        raise ModelError(f"not valid Python: {error.msg}", where=f"{path}:{error.lineno}") from None
    except Exception as error:
        raise failed("running the file", error, path) from error


def _instances(module: ModuleType, path: str) -> tuple[Effect, ...]:
    classes = [
        v for v in vars(module).values() if isinstance(v, type) and v.__module__ == module.__name__
    ]
    kinds = [kind for kind in dict.fromkeys(classes) if issubclass(kind, Effect)]
    if not kinds:
        raise ModelError(
            "no effect in the file",
            where=path,
            expected="a class derived from greybox.model.effect.Effect",
            fix="see docs/own_effect.md",
        )
    found = []
    for kind in kinds:
        missing = sorted(kind.__abstractmethods__)
        missing += [
            a
            for a in ("name", "stage", "summary", "formula")
            if not isinstance(getattr(kind, a, None), str)
        ]
        if missing:
            raise ModelError(
                f"class {kind.__name__} lacks {', '.join(missing)}", where=path, fix="declare them"
            )
        try:
            found.append(kind())
        except Exception as error:
            raise failed(f"making an instance of {kind.__name__}", error, path) from error
    names = [e.name for e in found]
    for name in names:
        if name in {e.name for e in CATALOGUE}:
            raise ModelError(
                f"effect {name} is in the catalogue already",
                where=path,
                fix="give yours another name, or use that one",
            )
        if names.count(name) > 1:
            raise ModelError(
                f"two effects are named {name}", where=path, fix="give each its own name"
            )
    return tuple(found)
