"""What a long command keeps of its fits until it has ended, so that the same command goes on where
it was stopped."""

from __future__ import annotations

import argparse
import contextlib
import secrets
import sys
import sysconfig
from collections.abc import Iterable, Iterator
from importlib import resources
from pathlib import Path

from greybox.commands.command_line import typed
from greybox.commands.console import Console

SHOWN = {"out", "json", "mcap", "ulog", "quiet", "debug", "executor", "kept", "one_file"}
"""Options that say where and how results are shown, and who works."""


@contextlib.contextmanager
def going_on(
    arguments: argparse.Namespace, console: Console, more: Iterable[Path] = ()
) -> Iterator[None]:
    """Fits within are kept in --out until they have all ended, and those that are there already are
    not done again. What was given, own programs among it, has been read; `more` are files that no
    option names. An interrupt adds to what the command says that it has `kept`."""
    from greybox.files import content_sha256
    from greybox.journal import FILE, fits, kept_in

    all_given = given(arguments) | {f"file {p.name}": content_sha256(p) for p in more}
    with kept_in(Path(arguments.out) / FILE, all_given) as journal:
        if journal.going_on:
            console.say(f"  {journal.going_on}")
        try:
            yield
        except KeyboardInterrupt:
            left = [arguments.kept] if arguments.kept else []
            left += [f"{fits(journal.kept)} kept"] if journal.kept else []
            how = "goes on" if journal.kept else "starts again"
            command = f"the same command {how}: {typed(arguments.command)}"
            arguments.kept = f"{', '.join(left)}; {command}" if left else None
            raise


def demand_source_stays(source: str | None, out: Path) -> None:
    """Raise `GreyboxError` where the results in `out` would write over the model that the command
    starts from: the same command again would start from what it made."""
    from greybox.errors import GreyboxError

    if source is not None and Path(source).resolve() == (out / "model.json").resolve():
        raise GreyboxError(
            f"{source}: the results would write over the model that --from names",
            fix="another --out",
        )


def given(arguments: argparse.Namespace) -> dict[str, str]:
    """What the result of a command depends on, name -> text or checksum: its options, the files
    that they name (wherever these lie), the code of greybox and of others' programs, the
    libraries."""
    from greybox.model.identified import library_versions

    out = {"code of greybox": _greybox(), "own code": _own_code()}
    out |= {f"version of {name}": version for name, version in library_versions().items()}
    for name, value in sorted(vars(arguments).items()):
        if name in SHOWN or callable(value):
            continue
        several = isinstance(value, (list, tuple))
        words = [str(v) for v in value] if several else [str(value)]
        for k, word in enumerate(words):
            if (several or isinstance(value, str)) and (content := _content(word)):
                words[k] = Path(word).name
                out[f"file {words[k]}"] = out.get(f"file {words[k]}", "") + content
        out[f"--{name.replace('_', '-')}"] = " ".join(words)
    return out


def _content(word: str) -> str:
    """Checksum of the file or folder that a word names, or FILE:NAME; "" where it names none. A
    pipe is another one every time."""
    from greybox.files import content_sha256

    try:
        named = word if word and Path(word).exists() else word.rpartition(":")[0]
        place = Path(named)
        if not named or not place.exists():
            return ""
    except (OSError, ValueError):  # longer than any name of a file
        return ""
    return content_sha256(place) if place.is_file() or place.is_dir() else secrets.token_hex()


def _greybox() -> str:
    """Checksum of the code of greybox."""
    from greybox.files import checksum, file_sha256

    folder = Path(str(resources.files("greybox")))
    files = sorted(p for ending in ("py", "c") for p in folder.rglob(f"*.{ending}"))
    return checksum([[p.relative_to(folder).as_posix(), file_sha256(p)] for p in files])


def _own_code() -> str:
    """Checksum of all modules that belong neither to greybox nor to an installed package."""
    from greybox.files import checksum, file_sha256

    others = {str(resources.files("greybox")), *sysconfig.get_paths().values(), sys.prefix}
    files = {str(getattr(m, "__file__", None) or "") for m in list(sys.modules.values())}
    own = [Path(f) for f in files if f.endswith(".py") and not f.startswith(tuple(others))]
    return checksum(sorted(file_sha256(p) for p in own if p.is_file()))
