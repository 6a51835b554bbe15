"""A hostile bundle is refused in one line: no code of it runs, no path leads out of it, no declared
size is believed."""

from __future__ import annotations

import copy
import io
import json
import os
import random
import shutil
import time
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from greybox.errors import FileFormatError, GreyboxError
from greybox.files import file_sha256
from mpc_export import verify
from mpc_export.bundle import ExportBundle, write_bundle
from tests.hardening import hostile
from tests.mpc_export import cases

MANY = int(os.environ.get("GREYBOX_FUZZ", "5000"))


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small bundle: a linear model without C."""
    return write_bundle(
        cases.linear(),
        tmp_path_factory.mktemp("bundle") / "box",
        targets=("casadi",),
        use_cache=False,
    ).folder


@pytest.fixture
def bundle(good: Path, tmp_path: Path) -> Path:
    """A copy that a test may spoil."""
    return Path(shutil.copytree(good, tmp_path / "box"))


def rewrite(folder: Path, change: Any) -> None:
    """Changes the manifest, with a checksum that fits."""
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text())
    change(manifest)
    path.write_text(json.dumps(hostile.sealed(manifest)))


def reseal(folder: Path, name: str) -> None:
    """The manifest takes a changed file for its own."""
    rewrite(folder, lambda m: m["files"].update({name: file_sha256(folder / name)}))


def retape(folder: Path, change: Any) -> None:
    """Changes functions.json, with a manifest that fits."""
    path = folder / "python" / "functions.json"
    tape = json.loads(path.read_text())
    change(tape)
    path.write_text(json.dumps(tape))
    reseal(folder, "python/functions.json")


def refused(action: Any) -> bool:
    """Whether it is refused, which must be in one line."""
    line = ""
    try:
        action()
    except GreyboxError as error:
        line = str(error)
    assert len(line.splitlines()) < 2
    assert len(line) < 2000
    return bool(line)


@pytest.mark.parametrize(
    "name", ["../out.txt", "/etc/passwd", "golden/../../out.txt", "..\\out.txt", "a\0b", "x" * 5000]
)
def test_names_that_lead_out_are_refused(name: str, bundle: Path) -> None:
    (bundle.parent / "out.txt").write_text("x")
    rewrite(bundle, lambda m: m["files"].update({name: file_sha256(bundle.parent / "out.txt")}))
    with pytest.raises(FileFormatError):
        ExportBundle.load(bundle)
    assert verify.main([str(bundle), "--no-c"]) == 1


@pytest.mark.parametrize("target", ["/etc/passwd", "/dev/zero", "../out.txt", "README.md"])
def test_links_that_lead_out_or_nowhere_are_refused(target: str, bundle: Path) -> None:
    (bundle.parent / "out.txt").write_text("x")
    (bundle / "README.md").unlink()
    (bundle / "README.md").symlink_to(target)
    with pytest.raises(FileFormatError):
        ExportBundle.load(bundle)


@pytest.mark.parametrize("name", ["../x", "/x", "box; touch y", "a b", "", None, 3, ["x"]])
def test_names_of_bundle_and_functions_are_identifiers(name: Any, bundle: Path) -> None:
    manifest = (bundle / "manifest.json").read_text()
    rewrite(bundle, lambda m: m.update(name=name))
    assert refused(lambda: ExportBundle.load(bundle))
    (bundle / "manifest.json").write_text(manifest)
    rewrite(bundle, lambda m: m["functions"][0].update(name=name))
    assert refused(lambda: ExportBundle.load(bundle))


def test_the_bundles_own_code_is_not_run_by_greybox(bundle: Path) -> None:
    (bundle / "python" / "rebuild.py").write_text(f"open({hostile.MARK!r}, 'w')\n")
    (bundle / "python" / "__init__.py").write_text(f"open({hostile.MARK!r}, 'w')\n")
    reseal(bundle, "python/rebuild.py")
    functions = ExportBundle.load(bundle).rebuild()
    assert "f_d" in functions
    assert not list(bundle.parent.rglob(hostile.MARK))
    assert not Path(hostile.MARK).exists()


def _huge_port(tape: dict[str, Any]) -> None:
    tape["functions"][0]["in"][0].update(rows=10**9, columns=10**6)


def _huge_work(tape: dict[str, Any]) -> None:
    for one in tape["functions"]:
        one["work"] = 10**12


def _negative_port(tape: dict[str, Any]) -> None:
    tape["functions"][0]["out"][0].update(rows=-5)


def _unknown_operation(tape: dict[str, Any]) -> None:
    tape["operations"] = ["__import__"] * len(tape["operations"])


def _no_functions(tape: dict[str, Any]) -> None:
    tape["functions"] = {"f": hostile.CODE[0]}


@pytest.mark.parametrize(
    "change", [_huge_port, _huge_work, _negative_port, _unknown_operation, _no_functions]
)
def test_tapes_that_declare_too_much_or_nonsense_are_refused(change: Any, bundle: Path) -> None:
    retape(bundle, change)
    began = time.perf_counter()
    with pytest.raises(FileFormatError, match="cannot be rebuilt"):
        ExportBundle.load(bundle).rebuild()
    assert time.perf_counter() - began < 5


def test_a_matrix_that_doubles_and_doubles_is_stopped(bundle: Path) -> None:
    port = {"name": "x", "rows": 1, "columns": 1}
    steps = [
        ["INPUT", [], [0], {"argument": 0}],
        *(["VERTCAT", [0, 0], [0], None] for _ in range(60)),
    ]
    names = ["INPUT", "VERTCAT"]

    def bomb(tape: dict[str, Any]) -> None:
        tape["operations"] = names
        tape["functions"] = [
            {
                "name": "f",
                "public": True,
                "kind": "matrix",
                "in": [port],
                "out": [port],
                "instructions": [[names.index(n), a, r, e] for n, a, r, e in steps],
            }
        ]

    retape(bundle, bomb)
    with pytest.raises(FileFormatError, match="more than 4000000 entries"):
        ExportBundle.load(bundle).rebuild()


def test_a_small_archive_that_unpacks_to_much_is_refused(bundle: Path) -> None:
    path = bundle / "python" / "functions.npz"
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        head, {"descr": "<f8", "fortran_order": False, "shape": (65_000_000,)}
    )
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("bomb.npy", "w", force_zip64=True) as f,
    ):
        f.write(head.getvalue())
        for _ in range(520):
            f.write(bytes(1_000_000))
    assert path.stat().st_size < 3_000_000
    reseal(bundle, "python/functions.npz")
    with pytest.raises(FileFormatError, match="unpacks to more than"):
        ExportBundle.load(bundle).rebuild()


def test_pickled_objects_in_an_archive_are_refused(bundle: Path) -> None:
    class Evil:
        def __reduce__(self) -> Any:
            return Path(hostile.MARK).touch, ()

    path = bundle / "python" / "functions.npz"
    with np.load(path) as stored:
        arrays = dict(stored)
    np.savez(path, **{name: np.array([Evil()], dtype=object) for name in arrays})  # type: ignore[arg-type]
    reseal(bundle, "python/functions.npz")
    with pytest.raises(FileFormatError, match="allow_pickle=False"):
        ExportBundle.load(bundle).rebuild()
    assert not Path(hostile.MARK).exists()


def feed(folder: Path, seeds: range, capture: Any) -> int:
    """Hostile manifests, read by greybox and (every twentieth) by the stand-alone verifier. Returns
    how many were read."""
    text = (folder / "manifest.json").read_text()
    tree, read = json.loads(text), 0
    before = sorted(folder.parent.rglob("*"))
    for seed in seeds:
        rng = random.Random(seed)
        path = folder / "manifest.json"
        if rng.random() < 0.25:
            path.write_bytes(hostile.damaged(text.encode(), rng))
        else:
            path.write_text(json.dumps(hostile.sealed(hostile.changed(copy.deepcopy(tree), rng))))
        try:
            read += not refused(lambda: ExportBundle.load(folder))
            if seed % 20 == 0:
                assert verify.main([str(folder), "--no-c"]) in (0, 1, 2)
                assert "Traceback" not in "".join(capture.readouterr())
        except BaseException as error:
            error.add_note(f"seed {seed}")
            raise
    path.write_text(text)
    assert sorted(folder.parent.rglob("*")) == before, "a file wrote something"
    return read


def test_hundreds_of_hostile_manifests(bundle: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert 10 < feed(bundle, range(200), capfd) < 190


@pytest.mark.slow
def test_thousands_of_hostile_manifests(bundle: Path, capfd: pytest.CaptureFixture[str]) -> None:
    print(f"{feed(bundle, range(1000, 1000 + MANY), capfd)} of {MANY} read")
