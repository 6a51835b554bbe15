"""Protocol buffers as far as recordings need them, both ways: messages from and to mappings, and
the description of their types that a recording carries (FileDescriptorSet). Encoding:
https://protobuf.dev/programming-guides/encoding/

A message is a mapping of field to number, text, bytes, mapping or, of a repeated field, a list of
these.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from greybox.errors import DataError

Message = Mapping[str, Any]
"""Field -> number, text, bytes, message or, of a repeated field, a list of these, as its type
says."""

_KINDS = {
    "double": 1,
    "float": 2,
    "int64": 3,
    "uint64": 4,
    "int32": 5,
    "fixed64": 6,
    "fixed32": 7,
    "bool": 8,
    "string": 9,
    "group": 10,
    "message": 11,
    "bytes": 12,
    "uint32": 13,
    "enum": 14,
    "sfixed32": 15,
    "sfixed64": 16,
    "sint32": 17,
    "sint64": 18,
}
"""Kinds of fields with their numbers in a FieldDescriptorProto."""
_NAMES = {number: name for name, number in _KINDS.items()}
_FIXED = {
    "double": "<d",
    "float": "<f",
    "fixed64": "<Q",
    "sfixed64": "<q",
    "fixed32": "<I",
    "sfixed32": "<i",
}
_LONG = ("string", "message", "bytes")
_ZIGZAG = ("sint32", "sint64")
_REPEATED = 3


@dataclass(frozen=True, kw_only=True)
class Field:
    """A field of a message: `kind` as in a .proto file, "message" or "enum" with the full name of
    the type in `of`. One that is `tracked` and not written is absent, a number that is not tracked
    is 0 then."""

    name: str
    number: int
    kind: str
    of: str = ""
    many: bool = False
    tracked: bool = False

    @property
    def wire(self) -> int:
        """How it is written: 0 varint, 1 eight bytes, 2 with its length, 5 four bytes."""
        if self.kind in _LONG:
            return 2
        return 0 if self.kind not in _FIXED else 1 if struct.calcsize(_FIXED[self.kind]) == 8 else 5


Types = Mapping[str, Sequence[Field]]
"""Fields of message types by their full names, "foxglove.Pose"."""
Enums = Mapping[str, Mapping[str, int]]
"""Numbers of the values of enumerations by their full names, "foxglove.Log.Level"."""


def fields(*named: str | tuple[str, str] | tuple[str, str, str] | Field) -> tuple[Field, ...]:
    """Fields numbered from 1 in this order: name (a double), (name, kind) or (name, kind, of)."""
    found = []
    for i, n in enumerate(named, start=1):
        if isinstance(n, Field):
            found.append(n)
        else:
            name, kind, of = (n, "double", "") if isinstance(n, str) else (*n, "")[:3]
            found.append(Field(name=name, number=i, kind=kind, of=of))
    return tuple(found)


def _many(name: str, number: int, of: str) -> Field:
    return Field(name=name, number=number, kind="message", of=of, many=True)


def _text(name: str, number: int) -> Field:
    return Field(name=name, number=number, kind="string")


def _number(name: str, number: int) -> Field:
    return Field(name=name, number=number, kind="int32")


_DESCRIPTIONS: Types = {
    "set": (_many("file", 1, "file"),),
    "file": (
        _text("name", 1),
        _text("package", 2),
        Field(name="dependency", number=3, kind="string", many=True),
        _many("message_type", 4, "message"),
        _many("enum_type", 5, "enum"),
        _text("syntax", 12),
    ),
    "message": (
        _text("name", 1),
        _many("field", 2, "field"),
        _many("nested_type", 3, "message"),
        _many("enum_type", 4, "enum"),
    ),
    "field": (
        _text("name", 1),
        _number("number", 3),
        _number("label", 4),
        _number("type", 5),
        _text("type_name", 6),
        Field(name="oneof_index", number=9, kind="int32", tracked=True),
        Field(name="proto3_optional", number=17, kind="bool"),
    ),
    "enum": (_text("name", 1), _many("value", 2, "value")),
    "value": (_text("name", 1), _number("number", 2)),
}
"""descriptor.proto, as far as it is read and written here."""


def encode(types: Types, name: str, content: Message) -> bytes:
    """The bytes of a message of type `name`; fields that `content` does not have are left out."""
    out = bytearray()
    for f in types[name]:
        if f.name not in content:
            continue
        for value in content[f.name] if f.many else (content[f.name],):
            out += _varint(f.number << 3 | f.wire)
            if f.kind in _FIXED:
                out += struct.pack(_FIXED[f.kind], value)
            elif f.wire == 0:
                out += _varint(
                    (int(value) << 1 ^ int(value) >> 63) if f.kind in _ZIGZAG else int(value)
                )
            else:
                data = encode(types, f.of, value) if f.kind == "message" else value
                data = data.encode() if isinstance(data, str) else data
                out += _varint(len(data)) + data
    return bytes(out)


def decode(types: Types, name: str, data: bytes) -> Message:
    """A message of type `name`: numbers that are not in it are 0, messages and tracked numbers
    absent. Raises `DataError` for cut bytes."""
    by_number = {f.number: f for f in types[name]}
    out: dict[str, Any] = {
        f.name: 0 for f in types[name] if f.kind not in _LONG and not (f.many or f.tracked)
    }
    for number, wire, value in _parts(data):
        f = by_number.get(number)
        if f is None:
            continue
        # Repeated numbers may be packed into one part.
        if isinstance(value, bytes) and wire == 2 and f.wire != 2:
            values = list(_packed(f, value))
        else:
            values = [_read(types, f, value)]
        if f.many:
            out.setdefault(f.name, []).extend(values)
        elif values:
            out[f.name] = values[-1]
    return out


def describe(types: Types, name: str, enums: Enums | None = None) -> bytes:
    """The FileDescriptorSet of a type and of all that stand in it, a file per package."""
    needed = _closure(types, name)
    packages = dict.fromkeys(n.rpartition(".")[0] for n in needed)
    files = {p: f"{p.replace('.', '/')}.proto" for p in packages}
    uses: dict[str, set[str]] = {p: set() for p in packages}
    for n in needed:
        uses[n.rpartition(".")[0]] |= {
            f.of.rpartition(".")[0] for f in types[n] if f.kind == "message"
        }

    def message(n: str) -> Message:
        listed = [
            {
                "name": f.name,
                "number": f.number,
                "label": _REPEATED if f.many else 1,
                "type": _KINDS[f.kind],
                **({"type_name": f".{f.of}"} if f.of else {}),
            }
            for f in types[n]
        ]
        inner = [
            {
                "name": e.rpartition(".")[2],
                "value": [{"name": k, "number": v} for k, v in values.items()],
            }
            for e, values in (enums or {}).items()
            if e.rpartition(".")[0] == n
        ]
        return {"name": n.rpartition(".")[2], "field": listed, "enum_type": inner}

    # A file stands after those that it uses.
    order = sorted(packages, key=lambda p: (bool(uses[p] - {p}), p))
    listed = [
        {
            "name": files[p],
            "package": p,
            "dependency": [files[u] for u in sorted(uses[p] - {p})],
            "message_type": [message(n) for n in needed if n.rpartition(".")[0] == p],
            "syntax": "proto3",
        }
        for p in order
    ]
    return encode(_DESCRIPTIONS, "set", {"file": listed})


def described(data: bytes) -> dict[str, tuple[Field, ...]]:
    """The message types of a FileDescriptorSet. Raises `DataError`."""
    found: dict[str, tuple[Field, ...]] = {}

    def take(prefix: str, message: Message, tracked: bool) -> None:
        name = f"{prefix}.{message['name']}" if prefix else str(message["name"])
        found[name] = tuple(
            Field(
                name=f["name"],
                number=f["number"],
                kind=_NAMES.get(f["type"], "bytes"),
                of=f.get("type_name", "").removeprefix("."),
                many=f["label"] == _REPEATED,
                tracked=tracked or "oneof_index" in f or bool(f["proto3_optional"]),
            )
            for f in message.get("field", ())
        )
        for nested in message.get("nested_type", ()):
            take(name, nested, tracked)

    for file in decode(_DESCRIPTIONS, "set", data).get("file", ()):
        for message in file.get("message_type", ()):
            # Files of proto2, which need not say so, and of editions track every field.
            take(file.get("package", ""), message, file.get("syntax") != "proto3")
    return found


def _closure(types: Types, name: str) -> list[str]:
    found, left = [], [name]
    while left:
        n = left.pop()
        if n not in found:
            found.append(n)
            left += [f.of for f in types[n] if f.kind == "message"]
    return sorted(found)


def _varint(value: int) -> bytes:
    value &= (1 << 64) - 1
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _parts(data: bytes) -> Iterator[tuple[int, int, int | bytes]]:
    """(number, wire, value) of the parts of a message: int for varints, bytes for all else."""
    at = 0
    while at < len(data):
        key, at = _unvarint(data, at)
        wire = key & 7
        if wire == 0:
            value, at = _unvarint(data, at)
            yield key >> 3, wire, value
            continue
        size = {1: 8, 5: 4}.get(wire)
        if wire == 2:
            size, at = _unvarint(data, at)
        if size is None or at + size > len(data):
            raise DataError(
                "a message that ends early or is no protocol buffer", got=f"{len(data)} bytes"
            )
        yield key >> 3, wire, data[at : at + size]
        at += size


def _unvarint(data: bytes, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(data):
            break
        value |= (data[at] & 0x7F) << shift
        at += 1
        if data[at - 1] < 0x80:
            return value, at
    raise DataError("a number that ends early in a protocol buffer", got=f"{len(data)} bytes")


def _read(types: Types, f: Field, value: int | bytes) -> Any:
    if f.kind in _FIXED:
        if not isinstance(value, bytes) or len(value) != struct.calcsize(_FIXED[f.kind]):
            raise DataError(f"field {f.name} of a protocol buffer has another size than its type")
        return struct.unpack(_FIXED[f.kind], value)[0]
    if f.wire == 0:
        if not isinstance(value, int):
            raise DataError(f"field {f.name} of a protocol buffer has another size than its type")
        if f.kind in _ZIGZAG:
            return value >> 1 ^ -(value & 1)
        return value - (1 << 64) if f.kind in ("int32", "int64", "enum") and value >> 63 else value
    if not isinstance(value, bytes):
        raise DataError(f"field {f.name} of a protocol buffer has another size than its type")
    if f.kind == "message":
        return decode(types, f.of, value) if f.of in types else {}
    return value.decode(errors="replace") if f.kind == "string" else value


def _packed(f: Field, data: bytes) -> Iterator[int | float]:
    at = 0
    size = struct.calcsize(_FIXED[f.kind]) if f.kind in _FIXED else 0
    while at < len(data):
        value: int | bytes
        if size:
            value, at = data[at : at + size], at + size
        else:
            value, at = _unvarint(data, at)
        yield _read({}, f, value)
