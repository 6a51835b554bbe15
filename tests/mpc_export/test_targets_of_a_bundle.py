"""Targets of an export: what each adds, that it stands alone, and what is refused."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import numpy as np
import pytest

from greybox.cli import main
from greybox.errors import ModelError, UnknownNameError
from greybox.model.noise import KINDS, part_named
from greybox.residual.files import save_model
from mpc_export.bundle import ExportBundle, write_bundle
from mpc_export.exported import load, of
from mpc_export.functions import model_functions
from mpc_export.hover import FREE
from mpc_export.options import ExportOptions
from mpc_export.targets import COMMON, CONSUMERS
from tests.mpc_export import cases, consumers

ROOT = Path(__file__).resolve().parents[2] / "mpc_export"
CARRIED = [ROOT / f"{m}.py" for m in (*COMMON, *(c.module for c in CONSUMERS.values())) if m]
CARRIED += [ROOT / "examples" / f"{c.example}.py" for c in CONSUMERS.values()]


@pytest.mark.parametrize("path", CARRIED, ids=lambda p: p.name)
def test_what_a_bundle_carries_imports_nothing_of_ours(path):
    allowed = sys.stdlib_module_names | {
        "casadi",
        "numpy",
        "consumers",
        "acados_template",
        "do_mpc",
        "rockit",
        "fmpy",
    }
    tree = ast.parse(path.read_text(encoding="utf-8"))
    typing_only = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    for node in ast.walk(tree):
        if id(node) in typing_only:
            continue
        names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
        names += [str(node.module)] if isinstance(node, ast.ImportFrom) else []
        assert {n.split(".")[0] for n in names} <= allowed, f"{path.name}: {names}"


def test_functions_that_are_asked_for_come_in_a_form_that_runs():
    """`--target tube --with filter` left the filter's C out without a word."""

    def written(*targets, **choices):
        return ExportOptions(targets=targets, **choices).completed().targets

    assert {"c", "casadi", "tube"} == set(written("tube", with_=("filter",)))
    assert written("tube") == ("tube",)
    assert written("casadi", with_=("filter",)) == ("casadi",)


def test_a_bundle_lists_its_targets_and_carries_their_scripts():
    folder = consumers.bundle("hybrid")
    bundle = ExportBundle.load(folder)
    said = bundle.manifest["targets_written"]
    assert set(said) == set(CONSUMERS)
    for target, entry in said.items():
        assert entry["example"] == f"examples/{CONSUMERS[target].example}.py"
        assert (folder / entry["example"]).is_file()
        assert f"python {entry['example']}" in (folder / "README.md").read_text(encoding="utf-8")
    assert said["acados"]["f_expl_difference"]["rotor.1"] > 0
    assert "nominal" in bundle.manifest["groups"], "l4acados brings the group that it needs"


@pytest.mark.parametrize("kind", ["physics", "hybrid"])
def test_a_loaded_bundle_is_the_model_that_was_exported(kind):
    runtime = ("mass",) if kind == "physics" else ()
    model = {"physics": cases.physics, "hybrid": cases.hybrid}[kind]()
    own, loaded = (
        of(model_functions(model, runtime_parameters=runtime), f"{kind}_model"),
        load(consumers.bundle(kind)),
    )
    for name in (
        "name",
        "dt",
        "states",
        "error_states",
        "inputs",
        "outputs",
        "parameters",
        "units",
        "own_states",
    ):
        assert getattr(loaded, name) == getattr(own, name), name
    arrays = (
        "parameter_values",
        "reference_state",
        "reference_inputs",
        "lower",
        "upper",
        "state_scale",
        "input_scale",
    )
    for name in arrays:
        np.testing.assert_allclose(
            getattr(loaded, name), getattr(own, name), rtol=1e-15, err_msg=name
        )
    assert set(own.functions) <= set(loaded.functions)
    x, u, p = own.reference_state + 0.01, own.reference_inputs, own.parameter_values
    np.testing.assert_allclose(
        loaded["f_d"](x, u, p).full(), own["f_d"](x, u, p).full(), atol=1e-14
    )


def test_the_history_of_a_held_command_is_that_command():
    model = load(consumers.bundle("physics"))
    whole = model.with_history(np.arange(model.own_states), [10.0, 20.0, 30.0, 40.0]).full().ravel()
    assert whole[model.states.index("history.u3.2")] == 30.0
    assert whole[: model.own_states].tolist() == list(range(model.own_states))


def test_unknown_functions_and_targets_are_refused(tmp_path):
    with pytest.raises(ValueError, match="has no function nothing"):
        load(consumers.bundle("physics"))["nothing"]
    with pytest.raises(UnknownNameError, match="do-mpc"):
        write_bundle(cases.physics(), tmp_path / "b", targets=("do_mpc",), use_cache=False)
    with pytest.raises(ModelError, match="learned part"):
        write_bundle(cases.physics(), tmp_path / "b", targets=("l4acados",), use_cache=False)
    assert not (tmp_path / "b").exists()


def test_the_command_line_writes_runnable_scripts(tmp_path):
    save_model(cases.hybrid(), tmp_path / "model.json")
    out = tmp_path / "craft"
    assert (
        main(
            ["export", str(tmp_path / "model.json"), "--out", str(out), "--target", "l4acados,fmu"]
        )
        == 0
    )
    assert sorted(p.name for p in (out / "examples").iterdir()) == [
        "fmu_simulate.py",
        "l4acados_hover.py",
    ]
    assert sorted(p.name for p in (out / "python" / "consumers").iterdir()) == [
        "__init__.py",
        "exported.py",
        "hover.py",
        "l4acados.py",
    ]
    assert (out / "fmu" / "craft.fmu").is_file()
    assert (out / "LICENSES" / "CasADi-MIT-0.txt").is_file()


def test_the_hover_problem_steers_no_noise_of_any_kind():
    """hover.py runs without greybox, so that it has the kinds by name."""
    names = {part_named(f"{kind.kind}.force").name for kind in KINDS}
    assert all(name.startswith(FREE) for name in names)
