"""Read a MAT file in a process of its own: a damaged one can crash scipy's compiled parser, and
then only this process.

Run by `matlab.py` as `python -P mat_child.py FILE OUT.npz BYTES`; needs numpy and scipy only.
Writes the vectors and, as JSON, their names and the names of all variables. Exit code 1 and one
line on standard error where it cannot be read.
"""

from __future__ import annotations

import contextlib
import json
import sys
import warnings
from collections.abc import Iterator, Mapping

import numpy as np
import numpy.typing as npt
from scipy.io import loadmat
from scipy.io.matlab import mat_struct

WIDEST = 32
"""A matrix with more columns than this is no set of channels."""

DEEPEST = 4
"""Structs inside structs are followed this far."""


def vectors(
    values: Mapping[str, object], prefix: str, depth: int
) -> Iterator[tuple[str, npt.NDArray[np.float64]]]:
    """Name and numbers of every vector and matrix, those inside structs under dotted names."""
    for name, value in values.items():
        full = prefix + name
        if isinstance(value, mat_struct):
            if depth < DEEPEST:
                yield from vectors(
                    {f: getattr(value, f) for f in value._fieldnames}, full + ".", depth + 1
                )
            continue
        array = np.asarray(value)
        if array.dtype.kind not in "fiub":
            continue
        if array.ndim <= 1:
            yield full, np.atleast_1d(array).astype(np.float64)
        elif array.ndim == 2:
            matrix = (array if array.shape[0] >= array.shape[1] else array.T).astype(np.float64)
            if matrix.shape[1] <= WIDEST:
                for j in range(matrix.shape[1]):
                    yield f"{full}[{j}]", np.ascontiguousarray(matrix[:, j])


def bound(most: int) -> None:
    """This process may take so many more bytes (Linux)."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        with open("/proc/self/statm", encoding="ascii") as stream:
            used = int(stream.read().split()[0]) * resource.getpagesize()
        resource.setrlimit(
            resource.RLIMIT_AS, (used + most, resource.getrlimit(resource.RLIMIT_AS)[1])
        )


def main(source: str, target: str, most: int) -> int:
    """Read `source`, write `target`, take at most `most` bytes. Returns the exit code."""
    warnings.simplefilter("ignore")
    try:
        bound(most)
        content = loadmat(source, squeeze_me=True, struct_as_record=False, chars_as_strings=True)
        content = {k: v for k, v in content.items() if not k.startswith("__")}
        found = dict(vectors(content, "", 0))
    except Exception as error:  # whatever a parser raises on foreign bytes
        print(f"{type(error).__name__}: {' '.join(str(error).split())[:120]}", file=sys.stderr)
        return 1
    names = json.dumps({"vectors": list(found), "variables": list(content)})
    arrays = {f"v{i}": a for i, a in enumerate(found.values())}
    np.savez(target, names=np.frombuffer(names.encode(), dtype=np.uint8), **arrays)  # type: ignore[arg-type]
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2], int(sys.argv[3])))
