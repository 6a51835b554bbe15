"""Protocol buffers of recordings: bytes as the specification has them, what Google's library makes
of ours, Foxglove's published types field by field, and damage in one line."""

from __future__ import annotations

import contextlib
import importlib
import math
from pathlib import Path

import numpy as np
import pytest

from greybox.commands.mcap_out import ENUMS, TYPES, plain_names, recording, rows_of
from greybox.data.readers.protobuf import (
    _DESCRIPTIONS,
    Field,
    decode,
    describe,
    described,
    encode,
    fields,
)
from greybox.data.readers.ros import read_ros
from greybox.errors import DataError

EXAMPLE = {
    "test.All": fields(
        "double",
        ("text", "string"),
        ("long", "int64"),
        ("turned", "sint32"),
        ("four", "fixed32"),
        ("yes", "bool"),
        ("inner", "message", "test.Inner"),
        ("raw", "bytes"),
        ("single", "float"),
        Field(name="inners", number=10, kind="message", of="test.Inner", many=True),
    ),
    "test.Inner": fields("x", "y"),
}
CONTENT = {
    "double": -math.pi,
    "text": "Flüge",
    "long": -(2**40),
    "turned": -7,
    "four": 2**32 - 1,
    "yes": 1,
    "inner": {"x": 1.5, "y": math.inf},
    "raw": bytes(range(256)),
    "single": 0.25,
    "inners": [{"x": 0.0, "y": 1.0}, {"x": 2.0, "y": -0.0}],
}


def test_bytes_are_those_of_the_specification() -> None:
    types = {
        "Test": (Field(name="a", number=1, kind="int32"), Field(name="b", number=2, kind="string"))
    }
    assert encode(types, "Test", {"a": 150}) == bytes.fromhex("089601")
    assert encode(types, "Test", {"b": "testing"}) == bytes.fromhex("120774657374696e67")
    packed = {"Test": (Field(name="f", number=6, kind="int32", many=True),)}
    assert decode(packed, "Test", bytes.fromhex("3206038e029ea705")) == {"f": [3, 270, 86942]}


def test_messages_come_back_through_the_types_that_describe_them() -> None:
    data = encode(EXAMPLE, "test.All", CONTENT)
    assert decode(described(describe(EXAMPLE, "test.All")), "test.All", data) == CONTENT
    assert decode(EXAMPLE, "test.All", b"")["long"] == 0  # what is not written is nought


@pytest.mark.parametrize(
    ("syntax", "more", "absent"),
    [
        ("proto3", {}, False),
        ("proto3", {"oneof_index": 0}, True),
        ("proto3", {"proto3_optional": 1}, True),
        ("proto2", {}, True),
        (None, {}, True),
        ("editions", {}, True),
    ],
)
def test_a_number_that_may_be_absent_is_no_nought(
    syntax: str | None, more: dict[str, int], absent: bool
) -> None:
    field = {"name": "height", "number": 1, "label": 1, "type": 1, **more}
    file = {
        "name": "t.proto",
        "message_type": [{"name": "T", "field": [field]}],
        **({"syntax": syntax} if syntax else {}),
    }
    types = described(encode(_DESCRIPTIONS, "set", {"file": [file]}))
    assert decode(types, "T", b"") == ({} if absent else {"height": 0})
    assert decode(types, "T", encode(types, "T", {"height": 0.0})) == {"height": 0.0}


def test_googles_library_reads_them_by_our_description() -> None:
    pool = pytest.importorskip("google.protobuf.descriptor_pool", reason="pip install protobuf")
    from google.protobuf import descriptor_pb2, message_factory

    own = pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(describe(EXAMPLE, "test.All")).file:
        own.Add(file)
    kind = message_factory.GetMessageClass(own.FindMessageTypeByName("test.All"))
    theirs = kind.FromString(encode(EXAMPLE, "test.All", CONTENT))
    assert (theirs.double, theirs.text, theirs.long, theirs.turned) == (
        -math.pi,
        "Flüge",
        -(2**40),
        -7,
    )
    assert (theirs.inner.y, theirs.raw, theirs.inners[1].x) == (math.inf, CONTENT["raw"], 2.0)
    assert decode(EXAMPLE, "test.All", theirs.SerializeToString()) == CONTENT


@pytest.mark.parametrize("name", [n for n in TYPES if n.startswith("foxglove.")])
def test_types_are_those_that_foxglove_publishes(name: str) -> None:
    short = name.partition(".")[2]
    pytest.importorskip("foxglove_schemas_protobuf", reason="pip install foxglove-schemas-protobuf")
    theirs = getattr(
        importlib.import_module(f"foxglove_schemas_protobuf.{short}_pb2"), short
    ).DESCRIPTOR
    kinds = {1: "double", 7: "fixed32", 9: "string", 11: "message", 14: "enum"}
    inner = [
        (f.message_type or f.enum_type).full_name if f.type in (11, 14) else ""
        for f in theirs.fields
    ]
    published = [
        (f.name, f.number, kinds[f.type], of, f.is_repeated) for f, of in zip(theirs.fields, inner)
    ]
    assert [(f.name, f.number, f.kind, f.of, f.many) for f in TYPES[name]] == published
    for e in theirs.enum_types:
        assert ENUMS[e.full_name] == {v.name: v.number for v in e.values}


def test_a_recording_of_another_program_is_read_by_its_own_types(tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    with recording(tmp_path / "f.mcap") as out:
        out.declare(rows_of("greybox.Margin", ("value",), plain_names(["T [K]", "T (K)", "2nd"])))
        for k in range(5):
            out.message(
                "/a",
                "greybox.Margin",
                0.1 * k,
                {"value": {"T__K_": k, "T__K__": 2.0, "_2nd": math.nan}},
            )
    stream = read_ros(tmp_path / "f.mcap").streams["/a"]
    np.testing.assert_allclose(stream.t, 0.1 * np.arange(5))
    np.testing.assert_allclose(stream.fields["value.T__K_"], np.arange(5))
    assert np.isnan(stream.fields["value._2nd"]).all()


def test_damage_ends_in_one_error_or_in_a_message() -> None:
    good = encode(EXAMPLE, "test.All", CONTENT)
    rng, refused = np.random.default_rng(0), 0
    for _ in range(2000):
        bad = bytearray(good[: rng.integers(1, len(good) + 1)])
        for _ in range(3):
            bad[rng.integers(len(bad))] = rng.integers(256)
        with contextlib.suppress(DataError):
            refused += 1
            assert set(decode(EXAMPLE, "test.All", bytes(bad))) <= {
                f.name for f in EXAMPLE["test.All"]
            }
            refused -= 1
    assert 500 < refused < 2000
