"""A bundle is written whole or not at all, only where it may be, says what it holds, and needs
nothing of greybox."""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from greybox.errors import FileFormatError, ModelError, UnknownNameError
from greybox.files import OutputError
from greybox.model.effects import effect_by_name
from greybox.model.model import PhysicsModel
from greybox.model.sensors import SENSORS
from greybox.residual.sparse import variational
from mpc_export import bundle as bundle_module
from mpc_export import bundle_cache, verify
from mpc_export.bundle import ExportBundle, write_bundle
from mpc_export.points import reduced, with_points
from tests.conformance import specimen
from tests.mpc_export import cases, compiled
from tests.residual import hybrid_cases

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def cache(tmp_path, monkeypatch):
    folder = tmp_path / "cache"
    folder.mkdir()
    monkeypatch.setattr(bundle_cache, "cache_root", lambda: folder)
    return folder / "export"


@pytest.fixture(scope="module")
def linear(tmp_path_factory):
    return write_bundle(
        cases.linear(),
        tmp_path_factory.mktemp("linear") / "box",
        with_=("filter",),
        use_cache=False,
    )


def content(folder: Path) -> dict[str, bytes]:
    return {
        p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()
    }


@pytest.mark.parametrize("kind", ["linear", "hybrid"])
def test_the_manifest_follows_its_schema_and_names_every_file(tmp_path, kind):
    model = cases.linear() if kind == "linear" else cases.hybrid()
    made = write_bundle(model, tmp_path / "b", use_cache=False)
    jsonschema.validate(made.manifest, compiled.manifest_schema())
    on_disk = {p.relative_to(made.folder).as_posix() for p in made.folder.rglob("*") if p.is_file()}
    assert on_disk == {*made.manifest["files"], "manifest.json"}
    names = {f["name"] for f in made.manifest["functions"]}
    assert {f"golden/{n}.csv" for n in names} | {f"casadi/{n}.casadi" for n in names} <= on_disk
    assert [s["name"] for s in made.manifest["states"]] == list(made.functions.states.names)
    np.testing.assert_array_equal(made.manifest["noise"]["gain"], made.functions.noise.gain)
    readme = (made.folder / "README.md").read_text()
    assert all(f"`{n}`" in readme for n in names)
    assert all(f"| {s['name']} |" in readme for s in made.manifest["states"])
    assert (made.folder / "LICENSES" / "CasADi-MIT-0.txt").exists()


def test_a_loaded_bundle_rebuilds_its_functions(linear):
    back = ExportBundle.load(linear.folder)
    assert len(repr(back).splitlines()) <= 12
    assert list(back.to_frame()["function"]) == [f["name"] for f in back.manifest["functions"]]
    with pytest.raises(ModelError, match="loaded"):
        _ = back.functions
    f_d = back.rebuild(("f_d",))["f_d"]
    x, u = linear.functions.reference
    np.testing.assert_array_equal(f_d(x, u, []).full(), linear.functions["f_d"](x, u, []).full())


def test_a_changed_file_is_noticed(tmp_path):
    made = write_bundle(cases.linear(), tmp_path / "b", use_cache=False)
    path = made.folder / "golden" / "f_d.csv"
    path.write_text(path.read_text().replace("1", "2", 1))
    with pytest.raises(FileFormatError, match=r"f_d\.csv"):
        ExportBundle.load(made.folder)
    manifest = json.loads((made.folder / "manifest.json").read_text())
    (made.folder / "manifest.json").write_text(json.dumps({**manifest, "sample_time": 0.5}))
    with pytest.raises(FileFormatError, match="checksum"):
        ExportBundle.load(made.folder)


def test_two_exports_are_the_same_bytes(tmp_path):
    one = write_bundle(cases.physics(), tmp_path / "a" / "b", use_cache=False)
    two = write_bundle(cases.physics(), tmp_path / "c" / "b", use_cache=False)
    first, second = content(one.folder), content(two.folder)
    assert first.keys() == second.keys()
    assert [
        n
        for n in first
        if first[n] != second[n] and not n.startswith("casadi/") and n != "manifest.json"
    ] == []


def test_only_a_bundle_is_replaced(tmp_path):
    place = tmp_path / "b"
    write_bundle(cases.linear(), place, use_cache=False)
    again = write_bundle(cases.linear((1, 0)), place, use_cache=False)
    assert again.manifest["delay"]["history"] == {"u": 1}
    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.tex").write_text("years of work")
    with pytest.raises(OutputError, match="something else"):
        write_bundle(cases.linear(), other, name="b", use_cache=False)
    assert content(other) == {"thesis.tex": b"years of work"}
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="not a folder"):
        write_bundle(cases.linear(), tmp_path / "file", use_cache=False)
    (tmp_path / "link").symlink_to(place)
    with pytest.raises(OutputError, match="not a folder"):
        write_bundle(cases.linear(), tmp_path / "link", use_cache=False)


@pytest.mark.parametrize("kept", [False, True], ids=["built", "from the cache"])
def test_a_link_to_an_empty_folder_is_written_through(tmp_path, kept):
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / ".DS_Store").write_bytes(b"\0")
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "b")
    write_bundle(cases.linear(), link, use_cache=kept)
    assert link.is_symlink() and (tmp_path / "b" / "manifest.json").is_file()
    link.unlink()
    link.symlink_to(tmp_path / "nowhere")
    with pytest.raises(OutputError, match="not a folder"):
        write_bundle(cases.linear(), link, use_cache=kept)


@pytest.mark.parametrize("kept", [False, True], ids=["built", "from the cache"])
def test_what_was_changed_or_added_in_a_bundle_is_not_deleted(tmp_path, kept):
    place = tmp_path / "b"
    write_bundle(cases.linear(), place, use_cache=kept)
    (place / "README.md").write_text("mine now")
    (place / "notes").mkdir()
    (place / "notes" / "thesis.tex").write_text("years of work")
    before = content(place)
    with pytest.raises(OutputError) as refused:
        write_bundle(cases.linear(), place, use_cache=kept)
    assert "README.md, notes/thesis.tex" in str(refused.value)
    assert "--force" in str(refused.value)
    assert content(place) == before and os.listdir(tmp_path) == ["b"]
    forced = write_bundle(cases.linear(), place, use_cache=kept, force=True)
    assert "mine now" not in (place / "README.md").read_text(encoding="utf-8")
    assert not (place / "notes").exists() and forced.cached == kept


def test_what_runs_leave_behind_and_what_is_gone_is_replaced(tmp_path):
    place = tmp_path / "b"
    write_bundle(cases.linear(), place, use_cache=False)
    for made in ("build/selftest", "c/build/b.o", "python/__pycache__/rebuild.pyc"):
        (place / made).parent.mkdir()
        (place / made).write_text("")
    (place / "README.md").unlink()
    assert write_bundle(cases.linear(), place, use_cache=False).cached is False
    ExportBundle.load(place)
    manifest = (place / "manifest.json").read_text(encoding="utf-8")
    (place / "manifest.json").write_text(manifest.replace('"u"', '"mine"'), encoding="utf-8")
    with pytest.raises(OutputError, match=r"manifest\.json"):
        write_bundle(cases.linear(), place, use_cache=False)


def test_a_failed_export_leaves_the_old_bundle_and_no_rubbish(tmp_path, monkeypatch):
    place = tmp_path / "b"
    write_bundle(cases.linear(), place, use_cache=False)
    before = content(place)

    def broken(manifest):
        raise RuntimeError("disk on fire")

    monkeypatch.setattr(bundle_module, "readme", broken)
    with pytest.raises(RuntimeError):
        write_bundle(cases.linear((1, 0)), place, use_cache=False)
    assert content(place) == before
    assert os.listdir(tmp_path) == ["b"]


@pytest.mark.parametrize("kept", [False, True], ids=["built", "from the cache"])
def test_a_bundle_is_replaced_from_inside_of_it(tmp_path, cache, monkeypatch, kept):
    place = tmp_path / "b"
    for _ in range(2):
        place.mkdir(exist_ok=True)
        monkeypatch.chdir(place)
        for inside in (".", "python/.."):
            made = write_bundle(cases.linear(), inside, targets=(), use_cache=kept)
            monkeypatch.chdir(place)
        assert made.name == "b" and ExportBundle.load(place).manifest == made.manifest
        assert not list(tmp_path.rglob("*.part"))


@pytest.mark.parametrize("error", [PermissionError(13, "denied"), KeyboardInterrupt()])
@pytest.mark.parametrize("fails", [{2}, {2, 3}], ids=["once", "and when it is put back"])
def test_no_failing_move_costs_the_old_bundle(tmp_path, monkeypatch, error, fails):
    place = tmp_path / "b"
    write_bundle(cases.linear(), place, use_cache=False)
    before, rename, calls = content(place), os.rename, []

    def broken(*paths):
        calls.append(paths)
        if len(calls) in fails:
            raise error
        rename(*paths)

    monkeypatch.setattr(os, "rename", broken)
    with pytest.raises((OutputError, KeyboardInterrupt)) as said:
        write_bundle(cases.linear((1, 0)), place, use_cache=False)
    if len(fails) == 1:
        assert content(place) == before and os.listdir(tmp_path) == ["b"]
        return
    (left,) = tmp_path.glob("*.part/*")
    assert content(left) == before and not place.exists()
    assert str(left) in str(said.value), "whoever lost the place must learn where the bundle is"


def test_the_second_export_comes_from_the_cache(tmp_path, cache):
    first = write_bundle(cases.linear(), tmp_path / "b")
    second = write_bundle(cases.linear(), tmp_path / "other" / "b")
    assert (first.cached, second.cached) == (False, True)
    assert content(first.folder) == content(second.folder)
    assert list(second.functions.functions) == list(first.functions.functions)
    assert not write_bundle(cases.linear(), tmp_path / "b", real="float").cached
    assert not write_bundle(cases.linear((1, 0)), tmp_path / "b").cached
    damaged = next(cache.iterdir())
    for kept in cache.iterdir():
        (kept / "README.md").write_text("rubbish")
    assert damaged.exists()
    assert not write_bundle(cases.linear(), tmp_path / "b").cached


def test_code_of_the_users_own_is_never_taken_from_the_cache(tmp_path, cache):
    class Drag(type(effect_by_name("rotor_drag"))):
        """The same name in a model file, but other code."""

    def export(effect, place):
        dynamics = PhysicsModel(vehicle=specimen.crooked(), effects=(effect,), sample_time=0.01)
        model = replace(hybrid_cases.craft_model(dynamics), reference_state=dynamics.reference({}))
        model = replace(model, reference_inputs=np.full(len(dynamics.inputs), 0.5))
        return write_bundle(model, tmp_path / place, name="b", targets=())

    for effect, known in ((effect_by_name("rotor_drag"), True), (Drag(), False)):
        assert not export(effect, "first").cached
        assert export(effect, "second").cached is known


def test_an_interrupt_between_the_two_moves_keeps_the_old_bundle(tmp_path, monkeypatch):
    place = tmp_path / "b"
    write_bundle(cases.linear(), place, targets=(), use_cache=False)
    before, rename = content(place), os.rename

    def interrupted(source, target):
        if Path(target) == place and Path(source).name != "old":
            raise KeyboardInterrupt
        rename(source, target)

    monkeypatch.setattr(os, "rename", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_bundle(cases.linear((1, 0)), place, targets=(), use_cache=False)
    assert content(place) == before
    assert os.listdir(tmp_path) == ["b"]


@pytest.mark.parametrize("name", ["test", "c", "m", "Install"])
def test_names_that_builds_have_already_are_refused(tmp_path, name):
    with pytest.raises(ModelError, match="taken"):
        write_bundle(cases.linear(), tmp_path / "b", name=name, use_cache=False)


@pytest.mark.parametrize("name", ["9lives", "a-b", "casadi_x", "", "a b", "é"])
def test_names_that_c_does_not_take_are_refused(tmp_path, name):
    with pytest.raises(ModelError, match="C identifier"):
        write_bundle(cases.linear(), tmp_path / "b", name=name, use_cache=False)


def test_unknown_targets_are_refused_before_anything_is_written(tmp_path):
    with pytest.raises(UnknownNameError, match="simulink"):
        write_bundle(cases.linear(), tmp_path / "b", targets=("simulink",), use_cache=False)
    assert os.listdir(tmp_path) == []


def test_golden_vectors_reach_the_edge_and_far_outside(tmp_path):
    made = write_bundle(cases.hybrid(), tmp_path / "b", targets=(), use_cache=False)
    with open(made.folder / "golden" / "gp_distance.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    distance = [float(r["out.distance.0"]) for r in rows]
    assert min(distance) < 0.7 and max(distance) > 0.99
    with open(made.folder / "golden" / "f_d.csv", newline="") as stream:
        last = list(csv.reader(stream))
    assert last[0][0] == "in.x.0" and last[0][-1].startswith("out.x_next.")


def test_a_distance_is_judged_where_the_learned_part_knows_nothing(tmp_path):
    """Length-scales of fifty explain all of typical flight: largest distances of 1e-3 made rounding
    of one minus what is explained a difference."""
    whole = cases.hybrid(points=30, kernel="se")
    posterior = whole.dynamics.posterior
    slow = replace(
        posterior.kernels[0], lengthscales=np.array([0.9, *[50.0] * (len(posterior.inputs) - 1)])
    )
    numbers = variational(slow, posterior.support.T, np.ones(30), 0.1 * np.eye(30))
    assert np.abs(numbers.explained).max() < 1e5
    n_out = len(posterior.outputs)
    calm = replace(
        posterior,
        kernels=(slow,) * n_out,
        weights=np.stack([numbers.weights] * n_out, axis=1),
        explained=np.stack([numbers.explained] * n_out),
        uncertain=np.stack([numbers.uncertain] * n_out),
    )
    model = replace(whole, dynamics=replace(whole.dynamics, posterior=calm))
    made = write_bundle(model, tmp_path / "b", targets=("c",), use_cache=False)
    scales = {
        f["name"]: r["scale"]
        for f in made.manifest["functions"]
        for r in f["results"]
        if r["name"] == "distance"
    }
    assert set(scales) == {"gp_distance", "out_of_domain"} and min(scales.values()) > 0.5
    compiled.needs_compiler()
    assert verify.verify(made.folder)


# ----------------------------------------------------------------------------------- the verifier


def run_verifier(*arguments) -> subprocess.CompletedProcess[str]:
    """As a user would, where neither greybox nor this repository can be imported."""
    script = ROOT / "mpc_export" / "verify.py"
    return subprocess.run(
        [sys.executable, "-I", str(script), *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        cwd="/",
    )


def test_the_verifier_passes_a_good_bundle_and_finds_a_wrong_number(linear, tmp_path):
    compiled.needs_compiler()
    done = run_verifier(linear.folder)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("passed") >= 3
    assert "largest difference" in done.stdout
    copy = tmp_path / "copy"
    shutil.copytree(linear.folder, copy)
    path = copy / "golden" / "f_d.csv"
    lines = path.read_text().splitlines()
    cells = lines[3].split(",")
    cells[-1] = repr(float(cells[-1]) + 1e-6)
    path.write_text("\n".join([*lines[:3], ",".join(cells), *lines[4:]]) + "\n")
    done = run_verifier(copy)
    assert done.returncode == 1
    assert "changed since the export: golden/f_d.csv" in done.stdout
    assert "in f_d (limit 1e-10): FAILED" in done.stdout


def test_the_verifier_finds_wrong_c(linear, tmp_path):
    compiled.needs_compiler()
    copy = tmp_path / "copy"
    shutil.copytree(linear.folder, copy)
    path = copy / "c" / f"{linear.name}.c"
    text = path.read_text()
    assert "casadi_real" in text
    path.write_text(text.replace("return 0;", "return 1;", 1))
    done = run_verifier(copy)
    assert done.returncode == 1
    assert "selftest failed" in done.stderr


def test_the_verifier_says_in_one_line_what_is_no_bundle(tmp_path):
    done = run_verifier(tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1


def sealed(folder: Path, **changes) -> None:
    """Changes the manifest and gives it the checksum that then fits."""
    path = folder / "manifest.json"
    manifest = {**json.loads(path.read_text()), **changes}
    path.write_text(json.dumps({**manifest, "checksum": verify.seal(manifest)}))


def test_a_manifest_that_was_edited_is_found(linear, tmp_path, capsys):
    copy = Path(shutil.copytree(linear.folder, tmp_path / "copy"))
    assert verify.main([str(copy), "--no-c"]) == 0
    path = copy / "manifest.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "tolerance": 1e9}))
    assert verify.main([str(copy), "--no-c"]) == 1
    assert "changed since the export: manifest.json" in capsys.readouterr().out


@pytest.mark.parametrize(
    "damage", ["short row", "no rows", "not numbers", "gone", "tape", "manifest"]
)
def test_damage_ends_in_one_line(linear, tmp_path, capsys, damage):
    copy = Path(shutil.copytree(linear.folder, tmp_path / "copy"))
    golden, tape = copy / "golden" / "f_d.csv", copy / "python" / "functions.json"
    head, first, *_ = golden.read_text().splitlines()
    if damage == "gone":
        golden.unlink()
    elif damage == "tape":
        tape.write_text(tape.read_text()[:-50])
    elif damage == "manifest":
        sealed(copy, functions=[{}])
    else:
        rows = {
            "short row": first.rpartition(",")[0],
            "no rows": "",
            "not numbers": first.replace(".", "x"),
        }[damage]
        golden.write_text(f"{head}\n{rows}".strip() + "\n")
    assert verify.main([str(copy), "--no-c"]) == 1
    said = capsys.readouterr().err
    assert "damaged" in said and len(said.strip().splitlines()) == 1


@pytest.mark.parametrize("name", ["../../evil", "/tmp/evil", "-o", "a b", "", 7])
def test_names_in_a_manifest_lead_nowhere_else(linear, tmp_path, capsys, name):
    copy = Path(shutil.copytree(linear.folder, tmp_path / "copy"))
    functions = linear.manifest["functions"]
    for changes in (
        {"name": name},
        {"functions": [{**functions[0], "name": name}]},
        {"files": {"../secret": "00"}},
    ):
        sealed(copy, **{"name": linear.name, "functions": functions, **changes})
        assert verify.main([str(copy)]) == 1
        out = capsys.readouterr()
        assert "manifest.json: " in out.err and out.out == ""


def test_nothing_compared_is_no_success(linear, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "casadi", None)
    assert verify.main([str(linear.folder), "--no-c"]) == 1
    assert "nothing was compared" in capsys.readouterr().out


def test_a_compiler_that_is_not_there_is_not_replaced_by_another(linear, capsys):
    assert verify.main([str(linear.folder), "--cc", "no-such-cc"]) == 1
    assert "no-such-cc" in capsys.readouterr().err


def odd_model(kind: str):
    """Models with fewer states, other inputs, or of the user's own making."""
    if kind == "own":
        return hybrid_cases.pendulum_model()
    sensors = tuple(
        s for s in SENSORS if s.name in {"imu": ("gyro",), "speed": ("gyro", "attitude")}[kind]
    )
    how = {"imu": {"effects": (effect_by_name("motor_lag"),)}, "speed": {"input": "speed"}}[kind]
    dynamics = PhysicsModel(vehicle=specimen.crooked(), sensors=sensors, sample_time=0.01, **how)
    model = hybrid_cases.craft_model(dynamics)
    level = 400.0 if kind == "speed" else 0.5
    return replace(
        model,
        reference_state=dynamics.reference({}),
        reference_inputs=np.full(4, level),
        covariance_names=(),
        covariance=np.zeros((0, 0)),
    )


@pytest.mark.parametrize("kind", ["imu", "speed", "own"])
def test_models_of_other_shapes_pass_the_verifier(tmp_path, kind, capsys):
    compiled.needs_compiler()
    made = write_bundle(
        odd_model(kind),
        tmp_path / kind,
        real="float",
        with_=("filter", "covariance", "target"),
        use_cache=False,
    )
    jsonschema.validate(made.manifest, compiled.manifest_schema())
    assert verify.verify(made.folder)
    assert "C: largest difference" in capsys.readouterr().out
    if kind == "imu":
        assert not any(s["name"].startswith("attitude") for s in made.manifest["states"])
        assert [s["name"] for s in made.manifest["targets"]] == ["rate.x", "rate.y", "rate.z"]
    if kind == "speed":
        assert made.manifest["inputs"][0]["name"] == "omega1"
        assert made.manifest["inputs"][0]["upper"] > 100.0
    if kind == "own":
        assert made.manifest["inputs"][0]["upper"] is None


def test_limits_and_schema_are_the_same_on_both_sides():
    from mpc_export import manifest

    assert verify.SCHEMA == manifest.SCHEMA
    assert manifest.TOLERANCE == {"double": 1e-10, "float": 1e-4}


# ----------------------------------------------------------------------------------- fewer points


def test_fewer_points_keep_mean_and_variance_where_they_are():
    posterior = cases.hybrid(30, "se").dynamics.posterior
    smaller = reduced(posterior, 12)
    assert smaller.points == 12
    (m1, v1), (m2, v2) = (p.evaluate(smaller.support_points) for p in (posterior, smaller))
    np.testing.assert_allclose(m2, m1, rtol=1e-6, atol=1e-8 * np.abs(m1).max())
    np.testing.assert_allclose(v2, v1, rtol=1e-4, atol=1e-6 * v1.max())


def test_more_points_lose_less_and_the_report_says_so():
    model = cases.hybrid(40, "se")
    errors = [max(with_points(model, m)[1]["mean_error"]) for m in (5, 20, 38)]
    assert errors[0] > errors[1] > errors[2]
    same, report = with_points(model, 40)
    assert same is model and report is None
    with pytest.raises(ModelError, match="learned part"):
        with_points(cases.physics(), 10)
    with pytest.raises(ModelError, match="positive"):
        with_points(model, 0)


def test_the_bundle_states_its_reduction(tmp_path):
    made = write_bundle(cases.hybrid(), tmp_path / "b", points=5, targets=(), use_cache=False)
    assert made.manifest["reduction"]["points"] == 5
    assert made.manifest["domain"]["learned"]["points"] == 5
    jsonschema.validate(made.manifest, compiled.manifest_schema())


def test_another_rate_and_held_commands_are_noted(tmp_path):
    made = write_bundle(
        replace(cases.physics()), tmp_path / "b", dt=0.005, targets=(), use_cache=False
    )
    assert any("identified at 0.01 s" in n for n in made.manifest["notes"])
    assert made.manifest["delay"]["history"]["u1"] == 3
