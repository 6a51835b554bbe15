"""The tape of a bundle gives the same functions again, with an interpreter that needs casadi and
numpy only."""

from __future__ import annotations

import ast
import fnmatch
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from greybox.errors import ModelError
from mpc_export.functions import model_functions
from mpc_export.rebuild import rebuild
from mpc_export.tape import write_tape
from tests.mpc_export import cases

SOURCE = Path(rebuild.__file__)
KINDS = {"physics": cases.physics, "hybrid": cases.hybrid, "linear": cases.linear}


def put(functions, folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    text, arrays = write_tape(functions)
    (folder / "functions.json").write_text(json.dumps(text))
    np.savez_compressed(folder / "functions.npz", **arrays)
    shutil.copy(SOURCE, folder / "rebuild.py")
    return folder


def arguments(function, point):
    return [
        ca.DM(point[n])[: function.numel_in(i)] if n == "x" else ca.DM(point[n])
        for i, n in enumerate(function.name_in())
    ]


@pytest.mark.parametrize(
    ("kind", "groups", "runtime"),
    [
        ("physics", ("covariance", "filter"), ("mass",)),
        ("hybrid", ("covariance", "hessian"), ("gp.weights",)),
        ("hybrid", ("target",), ()),
        ("linear", ("covariance", "filter", "target"), ()),
    ],
)
def test_every_function_comes_back_bit_by_bit(tmp_path, kind, groups, runtime):
    functions = model_functions(KINDS[kind](), with_=groups, runtime_parameters=runtime)
    back = rebuild.load(put(functions.functions.values(), tmp_path))
    assert list(back) == [n for n in back if n in functions.functions] and set(back) == set(
        functions.functions
    )
    rng = np.random.default_rng(0)
    for spread in (1.0, 1.0, 30.0):
        point = cases.point(functions, rng, spread)
        for name, function in functions.functions.items():
            assert back[name].name_in() == function.name_in()
            assert back[name].name_out() == function.name_out()
            given = arguments(function, point)
            for ours, theirs in zip(function.call(given), back[name].call(given), strict=True):
                np.testing.assert_array_equal(ours.full(), theirs.full(), err_msg=name)


def test_only_what_is_asked_for_is_built(tmp_path):
    functions = model_functions(cases.physics())
    back = rebuild.load(put(functions.functions.values(), tmp_path), names=("f_d",))
    assert list(back) == ["f_d"]


def test_matrix_operations_survive(tmp_path):
    x, y, c = ca.MX.sym("x", 3, 3), ca.MX.sym("y", 2), ca.MX.sym("c")
    sparse = ca.MX.sym("s", ca.Sparsity.lower(3))
    z = ca.MX(x)
    z[[0, 1], 2] = y
    z[1, 1] += c
    results = [
        ca.vertcat(x[0, 1], x[2, 2], y),
        x[[0, 2], [1, 2]],
        ca.if_else(y[0] > 1, y[1], 3),
        z,
        sparse @ x,
        sparse.T + x,
        ca.horzsplit(x, 1)[1] * c,
        ca.vertcat(*ca.vertsplit(x, [0, 1, 3])[::-1]),
        ca.repmat(y, 1, 3),
        ca.norm_2(y),
        ca.mmin(x),
        ca.diagcat(y, c),
        ca.project(x, ca.Sparsity.upper(3)),
        ca.jacobian(ca.sin(x @ x), x),
        sparse[1:, :2],
        ca.norm_1(y) * ca.norm_inf(x),
        ca.atan2(y[0], y[1]) ** 3,
        ca.logic_and(c > 0, y < 0.5),
    ]
    inner = ca.Function("inner", [x, y], [x[:, 1] * y[0], y])
    results += inner(x, y)
    function = ca.Function("f", [x, y, c, sparse], results)
    back = rebuild.load(put([function], tmp_path))["f"]
    rng = np.random.default_rng(1)
    for _ in range(3):
        given = [rng.standard_normal(function.size_in(i)) for i in range(4)]
        given[3] = ca.DM(function.sparsity_in(3), rng.standard_normal(6))
        for ours, theirs in zip(function.call(given), back.call(given), strict=True):
            assert ours.sparsity() == theirs.sparsity()
            np.testing.assert_array_equal(ours.full(), theirs.full())


def test_what_has_no_tape_is_named():
    x = ca.MX.sym("x", 2)
    solved = ca.Function("solved", [x], [ca.solve(ca.DM([[2.0, 1.0], [1.0, 3.0]]) * x[0], x, "qr")])
    with pytest.raises(ModelError, match="solved uses the operation SOLVE"):
        write_tape([solved])


def test_a_foreign_schema_is_refused(tmp_path):
    put([ca.Function("f", [], [1.0])], tmp_path)
    text = json.loads((tmp_path / "functions.json").read_text())
    (tmp_path / "functions.json").write_text(json.dumps({**text, "schema": "greybox.tape/9"}))
    with pytest.raises(ValueError, match=r"greybox\.tape/9"):
        rebuild.load(tmp_path)


def test_the_interpreter_imports_only_casadi_and_numpy():
    found = set()
    for node in ast.walk(ast.parse(SOURCE.read_text())):
        if isinstance(node, ast.Import):
            found |= {a.name.split(".")[0] for a in node.names}
        if isinstance(node, ast.ImportFrom):
            found.add(str(node.module).split(".")[0])
    assert found <= {"casadi", "numpy", "__future__", *sys.stdlib_module_names}


RUN = """
import json, sys
import numpy as np
import casadi as ca
sys.path.insert(0, sys.argv[1])
import rebuild
functions = rebuild.load()
golden = np.load(sys.argv[1] + "/golden.npz")
worst = 0.0
for name, f in functions.items():
    given = [ca.DM(golden[f"{name}_in{i}"]) for i in range(f.n_in())]
    for i, value in enumerate(f.call(given)):
        want = golden[f"{name}_out{i}"]
        if want.size:
            worst = max(worst, float(np.abs(value.full() - want).max() / (1 + np.abs(want).max())))
print(json.dumps({"casadi": ca.__version__, "functions": len(functions), "worst": worst}))
"""


@pytest.mark.slow
@pytest.mark.parametrize("version", ["3.6.7", "3.7.*", "3.8.*"])
def test_other_versions_of_casadi_rebuild_the_same_functions(tmp_path, version):
    functions = model_functions(cases.hybrid(), with_=("covariance", "filter", "target", "hessian"))
    folder = put(functions.functions.values(), tmp_path / "python")
    point, golden = cases.point(functions, np.random.default_rng(2)), {}
    for name, function in functions.functions.items():
        given = arguments(function, point)
        golden |= {f"{name}_in{i}": v.full() for i, v in enumerate(given)}
        golden |= {f"{name}_out{i}": v.full() for i, v in enumerate(function.call(given))}
    np.savez(folder / "golden.npz", **golden)
    own = tmp_path / "own"
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", str(own)]
    install = subprocess.run(
        [*pip, f"casadi=={version}"],
        capture_output=True,
        text=True,
        check=False,
    )
    if install.returncode:
        pytest.skip(
            f"casadi {version} cannot be installed here: {install.stderr.strip().splitlines()[-1:]}"
        )
    run = [sys.executable, "-P", "-c", RUN, folder]
    elsewhere = {**os.environ, "PYTHONPATH": str(own)}
    done = subprocess.run(run, capture_output=True, text=True, check=False, env=elsewhere)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout.splitlines()[-1])
    assert fnmatch.fnmatch(result["casadi"], version)
    assert result["functions"] == len(functions.functions)
    assert result["worst"] < 1e-12
