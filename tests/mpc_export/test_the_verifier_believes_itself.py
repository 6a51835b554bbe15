"""`python -m mpc_export.verify` judges by its own limits, scales and list of files, and always
ends."""

from __future__ import annotations

import json
import os
import shutil
import time
from hashlib import sha256

import pytest

from mpc_export import verify
from mpc_export.bundle import ExportBundle, write_bundle
from mpc_export.place import is_bundle
from tests.mpc_export import cases


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return write_bundle(
        cases.linear(), tmp_path_factory.mktemp("good") / "box", use_cache=False
    ).folder


@pytest.fixture
def bundle(good, tmp_path):
    shutil.copytree(good, tmp_path / "box")
    return tmp_path / "box"


def change(folder, what):
    manifest = json.loads((folder / "manifest.json").read_text())
    what(manifest)
    manifest["checksum"] = verify.seal(manifest)
    (folder / "manifest.json").write_text(json.dumps(manifest))


def wrong_golden(folder):
    """One result of one golden point is another, and the manifest's checksum fits."""
    path = folder / "golden" / "f_d.csv"
    rows = path.read_text().splitlines()
    cells = rows[1].split(",")
    cells[-1] = repr(float(cells[-1]) + 1e-3)
    rows[1] = ",".join(cells)
    path.write_text("\n".join(rows) + "\n")
    sign(folder, "golden/f_d.csv")


def sign(folder, name):
    """The manifest lists a file as it is now."""
    digest = sha256((folder / name).read_bytes()).hexdigest()
    change(folder, lambda m: m["files"].update({name: digest}))


def test_a_good_bundle_passes_and_a_wrong_number_does_not(bundle):
    assert verify.main([str(bundle)]) == 0
    wrong_golden(bundle)
    assert verify.main([str(bundle)]) == 1


def test_what_failed_is_not_said_to_be_verified(bundle, capsys):
    wrong_golden(bundle)
    assert verify.main([str(bundle)]) == 1
    said = capsys.readouterr().out
    assert "\n  verified: " not in said
    assert "\n  FAILED: C, rebuild, casadi files\n" in said


def test_a_bundle_cannot_widen_what_it_is_judged_by(bundle, capsys):
    wrong_golden(bundle)
    change(bundle, lambda m: m.update(tolerance=1e9))
    assert verify.main([str(bundle)]) == 1
    assert "FAILED" in capsys.readouterr().out

    def scales(manifest):
        for function in manifest["functions"]:
            for port in function["results"]:
                port["scale"] = 1e9

    change(bundle, scales)
    assert verify.main([str(bundle)]) == 1
    assert "scale" in capsys.readouterr().err


def test_a_file_that_the_manifest_does_not_list_is_named(bundle, capsys):
    (bundle / "c" / "evil.h").write_text("#define sin cos\n")
    assert verify.main([str(bundle), "--no-c"]) == 1
    said = capsys.readouterr().out
    assert "not of the export: c/evil.h" in said
    assert said.endswith("  FAILED: files were changed or added since the export\n")


@pytest.mark.parametrize("name", ["manifest.json", "golden/f_d.csv", "python/rebuild.py", "c/new"])
@pytest.mark.parametrize("kind", ["pipe", "link", "device"])
def test_pipes_links_and_devices_are_refused_and_not_waited_for(bundle, name, kind, capsys):
    path = bundle / name
    path.unlink(missing_ok=True)
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero" if kind == "device" else "box.c")
    begin = time.monotonic()
    assert verify.main([str(bundle)]) in (1, 2)
    assert time.monotonic() - begin < 20
    assert "not a regular file" in capsys.readouterr().err


def test_greybox_does_not_wait_for_a_pipe_either(bundle):
    (bundle / "manifest.json").unlink()
    os.mkfifo(bundle / "manifest.json")
    assert not is_bundle(bundle)
    with pytest.raises(Exception, match="not a file"):
        ExportBundle.load(bundle)


def test_too_much_is_not_read(bundle, capsys, monkeypatch):
    with open(bundle / "golden" / "f_d.csv", "r+b") as stream:
        stream.truncate(verify.LARGEST + 1)
    assert verify.main([str(bundle)]) == 1
    assert "at most" in capsys.readouterr().err


def test_a_compiler_that_never_ends_is_stopped(bundle, tmp_path, monkeypatch, capsys):
    cc = tmp_path / "cc"
    cc.write_text("#!/bin/sh\nexec sleep 1000\n")
    cc.chmod(0o755)
    monkeypatch.setattr(verify, "SECONDS", 0.5)
    assert verify.main([str(bundle), "--cc", str(cc)]) == 1
    assert "did not end" in capsys.readouterr().err


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """A compiler in whose hands nothing is optimised: what is judged is what programs say."""
    cc = tmp_path_factory.mktemp("cc") / "cc"
    cc.write_text('#!/bin/sh\nexec cc "$@" -O0\n')
    cc.chmod(0o755)
    return str(cc)


@pytest.fixture(scope="module")
def flying(tmp_path_factory):
    """C, a tube, flight code and a package for ROS."""
    place = tmp_path_factory.mktemp("flying") / "craft"
    targets = ("c", "casadi", "tube", "ros2")
    return write_bundle(
        cases.disturbed(), place, targets=targets, real="float", horizon=3, use_cache=False
    ).folder


def test_it_builds_and_runs_every_part_and_says_which(flying, quick, capsys):
    assert verify.main([str(flying), "--cc", quick]) == 0
    said = capsys.readouterr().out
    assert "  verified: C, rebuild, casadi files, tube, flight code\n" in said
    assert "tube: passed: craft_tube: 60 samples, commands differ from Python's by " in said
    assert "flight code: passed: 50 samples without measurements" in said
    assert "  not verified: ros2 (colcon does that)\n" in said
    assert verify.main([str(flying), "--no-c"]) == 0
    said = capsys.readouterr().out
    assert "  verified: rebuild, casadi files\n" in said
    for part in ("C", "tube", "flight code"):
        assert f"  not verified: {part} (--no-c)\n" in said


@pytest.mark.parametrize(
    ("part", "file", "text", "by"),
    [
        ("tube", "tube/craft_tube.c", "command_max = ", "command_max = 0.6f * "),
        ("flight code", "c/craft_flight.c", "memcpy(f->u, u_next, sizeof f->u);", "f->u[0] = 9;"),
    ],
)
def test_a_part_that_does_not_do_what_it_should_fails(
    flying, quick, tmp_path, capsys, monkeypatch, part, file, text, by
):
    """It alone is judged: nothing else can be what fails."""
    monkeypatch.setattr(verify, "verify_c", lambda *_: {"f_d": 0.0})
    monkeypatch.setattr(verify, "programs", lambda _: [part])
    shutil.copytree(flying, tmp_path / "craft")
    path = tmp_path / "craft" / file
    assert text in path.read_text()
    path.write_text(path.read_text().replace(text, by))
    sign(tmp_path / "craft", file)
    assert verify.main([str(tmp_path / "craft"), "--cc", quick]) == 1
    assert f"  {part}: FAILED: " in capsys.readouterr().out


def test_a_tube_elsewhere_is_not_run(flying, quick, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(verify, "verify_c", lambda *_: {"f_d": 0.0})
    monkeypatch.setattr(verify, "programs", lambda _: ["tube"])
    shutil.copytree(flying, tmp_path / "craft")
    change(
        tmp_path / "craft", lambda m: m["targets_written"]["tube"].update(folder="../../elsewhere")
    )
    assert verify.main([str(tmp_path / "craft"), "--cc", quick]) == 1
    assert "tube: FAILED: ../../elsewhere/ has no C" in capsys.readouterr().out
