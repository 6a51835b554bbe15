"""Hostile copies of good files: values of a JSON or TOML tree replaced, removed, renamed; bytes
flipped, cut, repeated.

A JSON tree is sealed again after it was changed: whoever writes a hostile file computes its
checksums too.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import json
import random
from collections.abc import Iterator
from typing import Any

from greybox.errors import FileFormatError
from greybox.files import checksum
from tests.mpc_export import cases

MARK = "greybox-was-here"
"""Name of the file that hostile text tries to write."""
CODE = (
    f"__import__('pathlib').Path('{MARK}').touch()",
    f"$(touch {MARK})",
    f"; touch {MARK} #",
    f"cos\nsystem\n(S'touch {MARK}'\ntR.",
    "greybox.files.write_atomic",
    "os:system",
)
PATHS = (
    f"../{MARK}",
    f"../../{MARK}",
    f"/tmp/{MARK}",
    "..\\..\\x",
    "/dev/zero",
    "/etc/passwd",
    "a/../../b",
    "",
    ".",
    "..",
    "\0",
)
NUMBERS = (
    *(
        0,
        -1,
        1,
        2**31,
        2**63,
        2**64,
        -(2**63),
        10**400,
        0.0,
        -0.0,
        1e-320,
        1e-300,
        1e-12,
        1e12,
        1e154,
        1e200,
        1e308,
        -1e308,
    ),
    *(float("nan"), float("inf"), float("-inf"), True, False),
)
TEXTS = (
    "",
    "x",
    "a" * 3000,
    "line\nbreak\r\n\x1b[2J",
    "\u202e\u0000",
    "\U0001f681",
    "nan",
    "1e5",
    "__class__",
    "constructor",
)
OTHERS: tuple[Any, ...] = (
    None,
    [],
    {},
    [[]],
    [{}],
    {"": None},
    [None] * 3,
    [0] * 2000,
    [[0.0] * 3] * 3,
    {"value": 1, "sigma": -1},
)


@functools.cache
def model_tree(kind: str) -> str:
    """A small good model file as JSON text."""
    match kind:
        case "physics":
            return json.dumps(cases.physics().to_dict())
        case "disturbed":
            return json.dumps(cases.disturbed().to_dict())
        case "hybrid":
            return json.dumps(cases.hybrid(points=4).to_dict())
        case _:
            return json.dumps(cases.linear().to_dict())


def good_model(kind: str) -> dict[str, Any]:
    """A small good model file as values, free to be changed."""
    tree: dict[str, Any] = json.loads(model_tree(kind))
    return tree


def sealed(tree: dict[str, Any]) -> dict[str, Any]:
    """The tree with checksums that fit, inside first, as its reader computes them."""
    if isinstance(tree.get("base"), dict):
        tree["base"] = sealed(tree["base"])
    leave = (
        ("checksum",)
        if "linear" in str(tree.get("schema")) or "bundle" in str(tree.get("schema"))
        else ("checksum", "versions")
    )
    with contextlib.suppress(
        FileFormatError
    ):  # nested too deeply for any checksum: refused for that
        tree["checksum"] = checksum({k: v for k, v in tree.items() if k not in leave})
    return tree


def places(tree: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths of all values below the root."""
    items = (
        tree.items()
        if isinstance(tree, dict)
        else enumerate(tree)
        if isinstance(tree, list)
        else ()
    )
    for key, value in items:
        yield (*path, key)
        yield from places(value, (*path, key))


def _odd_value(rng: random.Random, old: Any) -> Any:
    if isinstance(old, (int, float)) and rng.random() < 0.5:
        return rng.choice(
            [
                -old,
                old + 1,
                *([float(old) * 1e6, float(old) * 1e-6] if abs(old) < 1e300 else []),
                rng.choice(NUMBERS),
            ]
        )
    return copy.deepcopy(rng.choice([rng.choice(c) for c in (CODE, PATHS, NUMBERS, TEXTS, OTHERS)]))


def _one_change(tree: Any, rng: random.Random) -> None:
    """One change at a random place; keys near the root are as likely as the entries of long
    arrays."""
    parent, depth = tree, 0
    while True:
        keys = list(parent) if isinstance(parent, dict) else range(len(parent))
        if not keys:
            return
        key = rng.choice(list(keys))
        child = parent[key]
        if not isinstance(child, (dict, list)) or not child or rng.random() < 0.15 + 0.02 * depth:
            break
        parent, depth = child, depth + 1
    match rng.randrange(8):
        case 0:
            del parent[key]
        case 1 if isinstance(parent, dict):
            parent[rng.choice([f"{key}x", key.upper(), *CODE, *PATHS, "__class__"])] = parent.pop(
                key
            )
        case 1 | 2 if isinstance(parent, list):
            parent[key : key + 1] = [copy.deepcopy(child) for _ in range(rng.choice([2, 3, 50]))]
        case 2:
            other = rng.choice(list(parent))
            parent[key], parent[other] = parent[other], child
        case 3:
            value: Any = child
            for _ in range(rng.choice([1, 2, 50])):
                value = [value] if rng.random() < 0.5 else {"value": value}
            parent[key] = value
        case _:
            parent[key] = _odd_value(rng, child)


def changed(tree: Any, rng: random.Random) -> Any:
    """The tree itself after one to four changes."""
    for _ in range(rng.choice([1, 1, 1, 2, 4])):
        _one_change(tree, rng)
    return tree


def damaged(content: bytes, rng: random.Random) -> bytes:
    """Cut, flipped, inserted, removed or repeated bytes."""
    data = bytearray(content)
    if rng.random() < 0.1:
        return bytes(data[: rng.randrange(len(data))])
    for _ in range(rng.choice([1, 1, 2, 4, 16])):
        i = rng.randrange(len(data))
        match rng.randrange(5):
            case 0:
                data[i] = rng.randrange(256)
            case 1:
                data[i] = rng.choice(b"0123456789-+.eE[]{},:\"'= \n")
            case 2:
                data[i:i] = rng.randbytes(rng.randrange(1, 9))
            case 3:
                del data[i : i + rng.randrange(1, 30)]
            case _:
                j = rng.randrange(len(data))
                data[i:i] = data[j : j + rng.randrange(1, 200)]
        if not data:
            data = bytearray(b"?")
    return bytes(data)


def to_toml(tree: dict[str, Any]) -> str:
    """TOML of a JSON-like tree, all tables inline. None is left out, as TOML has none."""
    return "".join(f"{_key(k)} = {_toml(v)}\n" for k, v in tree.items() if v is not None)


def _key(key: Any) -> str:
    return json.dumps(str(key)).replace("\x7f", "\\u007f")


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return (
            "{"
            + ", ".join(f"{_key(k)} = {_toml(v)}" for k, v in value.items() if v is not None)
            + "}"
        )
    if isinstance(value, list):
        return "[" + ", ".join(_toml(v) for v in value if v is not None) + "]"
    if isinstance(value, str):
        # TOML has no surrogate pairs: characters beyond the first plane stand as they are.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return json.dumps(value).replace("NaN", "nan").replace("Infinity", "inf")
