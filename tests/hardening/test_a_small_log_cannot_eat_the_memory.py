"""Small logs that unpack into gigabytes are refused in one line, within a bound and 50 times their
size."""

from __future__ import annotations

import gzip
import io
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from greybox.data.memory import LEAST, PER_BYTE, allowance, bounded

CHILD = """
import sys
from resource import RUSAGE_CHILDREN, getrusage
from greybox.cli import main
from greybox.data import memory
memory.LEAST = int(sys.argv[2])
code = main(["inspect", sys.argv[1]])
# getrusage of a process itself begins with the size of the one that started it.
own = next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(code, own // 1024, getrusage(RUSAGE_CHILDREN).ru_maxrss // 1024)
"""
SMALL = LEAST // 8
"""The bound that is tried: a bomb of 2 GiB takes half a minute to make."""
HUGE = 3 * SMALL


def gzip_bomb(path: Path) -> None:
    """A header and rows of zeros: gzip of gzip members, one after the other."""
    block = gzip.compress(b"0,0,0\n" * (1 << 22), 9)
    path.write_bytes(gzip.compress(b"t,u1,p\n") + block * (HUGE // (6 << 22)))


def mat_bomb(path: Path) -> None:
    """A compressed element that declares, and holds, a matrix of zeros."""
    size = HUGE // 2
    head = (
        struct.pack("<IIIIIIiiI", 6, 8, 6, 0, 5, 8, size // 8, 1, 1)
        + struct.pack("<I", 1)
        + b"x\0\0\0\0\0\0\0"
    )
    head += struct.pack("<II", 9, size)
    packer, out = zlib.compressobj(1), io.BytesIO()
    out.write(packer.compress(struct.pack("<II", 14, len(head) + size) + head))
    zeros = bytes(1 << 24)
    for _ in range(size >> 24):
        out.write(packer.compress(zeros))
    out.write(packer.flush())
    packed = out.getvalue()
    path.write_bytes(
        b"MATLAB 5.0 MAT-file".ljust(124)
        + struct.pack("<HH", 0x0100, 0x4D49)
        + struct.pack("<II", 15, len(packed))
        + packed
    )


def parquet_bomb(path: Path) -> None:
    """Run-length encoded rows: a billion of them in some kilobytes."""
    pa = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    index = pa.array(np.zeros(1 << 20, dtype=np.int32))
    column = pa.DictionaryArray.from_arrays(index, pa.array([0.0]))
    part = pa.table(dict.fromkeys(("t", "u1", "p"), column))
    with parquet.ParquetWriter(path, part.schema, compression="zstd") as writer:
        for _ in range(HUGE // (3 * 8 << 20)):
            writer.write_table(part)


def mcap_bomb(path: Path) -> None:
    """A chunk whose Zstandard frame unpacks to zeros without end."""
    writer_of = pytest.importorskip("mcap.writer")
    zstandard = pytest.importorskip("zstandard")
    with path.open("wb") as stream:
        writer = writer_of.Writer(stream, compression=writer_of.CompressionType.ZSTD)
        writer.start()
        schema = writer.register_schema(name="x", encoding="jsonschema", data=b"{}")
        channel = writer.register_channel(topic="/x", message_encoding="json", schema_id=schema)
        for k in range(100):
            writer.add_message(channel_id=channel, log_time=k, publish_time=k, data=b'{"a": 1}')
        writer.finish()
    content = path.read_bytes()
    at = content.index(b"\x28\xb5\x2f\xfd")  # the frame of the first chunk
    (length,) = struct.unpack("<Q", content[at - 8 : at])
    packer = zstandard.ZstdCompressor(level=1).compressobj(size=HUGE)
    frame = b"".join(packer.compress(bytes(1 << 24)) for _ in range(HUGE >> 24)) + packer.flush()
    place = content.rindex(b"\x06", 0, at)  # opcode of the chunk
    (whole,) = struct.unpack("<Q", content[place + 1 : place + 9])
    head = bytearray(content[:at])
    head[place + 1 : place + 9] = struct.pack("<Q", whole - length + len(frame))
    head[place + 25 : place + 33] = struct.pack("<Q", HUGE)
    head[at - 8 : at] = struct.pack("<Q", len(frame))
    path.write_bytes(bytes(head) + frame + content[at + length :])


BOMBS: dict[str, Callable[[Path], None]] = {
    "flight.csv.gz": gzip_bomb,
    "flight.mat": mat_bomb,
    "flight.parquet": parquet_bomb,
    "flight.mcap": mcap_bomb,
}


@pytest.mark.skipif(sys.platform != "linux", reason="address spaces are bounded on Linux only")
@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_is_one_line(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    BOMBS[name](path)
    done = subprocess.run(
        [sys.executable, "-c", CHILD, str(path), str(SMALL)],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    code, own, child = map(int, done.stdout.split()[-3:])
    assert code == 2, done.stdout
    assert done.stderr.count("\n") == 1
    assert name in done.stderr
    bound = 300 + (SMALL + PER_BYTE * path.stat().st_size) / 2**20
    assert max(own, child) < bound


def test_the_bound_ends_with_the_reader(tmp_path: Path) -> None:
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_AS)
    with bounded(tmp_path), bounded(tmp_path):
        if sys.platform == "linux":
            assert resource.getrlimit(resource.RLIMIT_AS) != before
    assert resource.getrlimit(resource.RLIMIT_AS) == before
    assert allowance(tmp_path / "missing") == LEAST
