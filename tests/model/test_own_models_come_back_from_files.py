"""Claim: the file of a user's own model holds its equations, so that it is read and used without
the program.

Equations come back as the same operations; a program is run only where it is named, and what is
wrong with it is one line.
"""

from __future__ import annotations

import copy
import json
import pickle
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import greybox as gb
from greybox.errors import FileFormatError, ModelError, UnknownNameError
from greybox.estimation.fit import Fit
from greybox.files import checksum
from greybox.model.dynamics import StateSpaceModel
from greybox.model.expressions import read_function, write_function
from greybox.model.own_model import load_own_model, own_from_dict, own_to_dict, same_model
from greybox.model.parameter import Parameter
from greybox.residual.discrepancy import disturbed_model
from greybox.residual.files import load_model, save_model
from tests import motor


def test_every_kind_of_operation_comes_back_bit_by_bit() -> None:
    x, p = ca.SX.sym("x", 3), ca.SX.sym("p", 2)
    values = ca.vertcat(
        ca.tanh(x[0] / 0.05) + ca.if_else(x[0] > 0, p[0] ** 2, ca.atan2(p[1], x[1])),
        ca.sqrt(ca.fabs(x[2])) - p[0] ** 1.5,
        ca.fmax(x[0], x[1]) * ca.exp(-x[2]) + ca.sign(x[1]) * ca.floor(3 * x[0]),
        0.0,
        ca.erf(x[0]) / (1 + ca.sumsqr(x)),
    )
    f = ca.Function("f", [x, p], [values, ca.jacobian(values, x)])
    back = read_function("f", json.loads(json.dumps(write_function(f))))
    for point in np.random.default_rng(0).uniform(0.1, 2, (20, 5)):
        for a, b in zip(f(point[:3], point[3:]), back(point[:3], point[3:]), strict=True):
            assert np.array_equal(a.full(), b.full())


@pytest.mark.parametrize("copied", [lambda m: pickle.loads(pickle.dumps(m)), copy.deepcopy])
def test_what_comes_back_goes_to_another_process(copied, fitted: Fit, tmp_path: Path) -> None:
    back = load_model(save_model(fitted.model, tmp_path / "model.json"))
    again = copied(back)
    assert again.to_dict() == back.to_dict()
    other = motor.record(seed=4, name="other")
    assert gb.validate(again, other).table_text() == gb.validate(back, other).table_text()


def test_a_bound_of_an_own_model_is_no_matter_of_a_vehicle_file() -> None:
    model = motor.model()
    few = tuple(
        replace(p, lower=2.0, nominal=2.5) if p.name == "R" else p for p in model.parameters
    )
    found = gb.fit(replace(model, parameters=few), motor.record())
    (said,) = (w for w in found.warnings if "R is at its bound 2 ohm" in w)
    assert "its prior" in said and "vehicle" not in said


@pytest.fixture(scope="module")
def fitted() -> Fit:
    return gb.fit(motor.model(), motor.record())


def test_a_fitted_model_comes_back_whole(fitted: Fit, tmp_path: Path) -> None:
    fitted.save(str(tmp_path))
    back = load_model(tmp_path / "model.json")
    assert back.to_dict() == fitted.model.to_dict()
    assert isinstance(back.core, StateSpaceModel)
    assert same_model(back.core, motor.model())
    seen, again = (gb.validate(m, motor.record(seed=4, name="other")) for m in (fitted.model, back))
    assert seen.table_text() == again.table_text()


def test_disturbance_states_stay_with_it(fitted: Fit, tmp_path: Path) -> None:
    model = disturbed_model(fitted.model, motor.record())
    assert model.dynamics.states.names == ("current", "speed", "disturbance.speed")
    save_model(model, tmp_path / "model.json")
    assert load_model(tmp_path / "model.json").to_dict() == model.to_dict()


def test_an_edited_file_is_refused(fitted: Fit, tmp_path: Path) -> None:
    body = fitted.model.to_dict()
    body["own"]["dynamics"]["operations"][0][0] = "SYSTEM"
    (tmp_path / "a.json").write_text(json.dumps(body))
    with pytest.raises(FileFormatError, match="checksum"):
        load_model(tmp_path / "a.json")
    body["checksum"] = checksum(
        {k: v for k, v in body.items() if k not in ("checksum", "versions")}
    )
    (tmp_path / "a.json").write_text(json.dumps(body))
    with pytest.raises(FileFormatError, match="expression"):
        load_model(tmp_path / "a.json")


@pytest.mark.parametrize("damage", ["parameters", "dynamics", "noise_states"])
def test_a_file_that_does_not_fit_itself_is_refused(damage: str) -> None:
    body = own_to_dict(motor.model())
    body[damage] = (
        body[damage][:-1] if damage != "dynamics" else body["measurement"] | {"results": [[1, 1]]}
    )
    if damage == "noise_states":
        body[damage] = ["nowhere"]
    with pytest.raises((FileFormatError, UnknownNameError)):
        own_from_dict(body)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"initial_sigma": {"speed": 0.0}}, "initial_sigma of speed; expected a number above zero"),
        ({"sensor_sigma": {"speed": float("nan")}}, "sensor_sigma of speed"),
        ({"initial": {"speed": float("inf")}}, "initial of speed; expected a number"),
        ({"substeps": 0}, "substeps; expected a whole number above zero"),
    ],
)
def test_numbers_that_are_none_are_named(given: dict[str, object], said: str) -> None:
    with pytest.raises(ModelError, match=said):
        replace(motor.model(), **given)  # type: ignore[arg-type]


def test_a_parameter_that_nothing_depends_on_is_named() -> None:
    model = motor.model()
    idle = Parameter(name="spare", unit="-", nominal=1.0)
    with pytest.raises(ModelError, match="nothing depends on the parameter spare"):
        StateSpaceModel(**{**vars(model), "parameters": (*model.parameters, idle)})


PROGRAMS = {
    "nothing here": ("", "own.py:build", "unknown name 'build'"),
    "no function": ("build = 3", "own.py:build", "not a function"),
    "another thing": ("def build():\n    return 3", "own.py:build", "returns a int"),
    "a slip": ("def build():\n    return undefined", "own.py:build", "own.py:2"),
    "no Python": ("def build(:", "own.py:build", "not valid Python"),
    "no file": (None, "own.py:build", "no such model program"),
    "no name": ("", "own.py", "no function named"),
}


@pytest.mark.parametrize("case", PROGRAMS)
def test_a_wrong_program_is_one_line(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text, program, said = PROGRAMS[case]
    monkeypatch.chdir(tmp_path)
    if text is not None:
        Path("own.py").write_text(text)
    with pytest.raises((ModelError, UnknownNameError)) as caught:
        load_own_model(program)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
