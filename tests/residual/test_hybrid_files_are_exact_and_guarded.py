"""A hybrid file gives back every bit, follows its schema, is refused in one line where damaged, and
needs no PyTorch."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

import casadi as ca
import jsonschema
import numpy as np
import pytest

import greybox as gb
from greybox.cli import main
from greybox.errors import FileFormatError
from greybox.files import checksum, read_json, write_json
from greybox.model.identified import IdentifiedModel
from greybox.residual.files import load_model, save_model
from greybox.residual.hybrid import HybridModel
from tests.residual.hybrid_cases import craft_model, hybrid


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_model(
        craft_model(hybrid(kernel="linear+se")), tmp_path_factory.mktemp("hybrid") / "hybrid.json"
    )


def step_of(model: IdentifiedModel) -> np.ndarray:
    """One step from a lively state, with the learned push in it."""
    d = model.dynamics
    x = model.reference_state + 0.05 * np.sin(np.arange(len(d.states)))
    past, future = d.window
    u = np.repeat(model.reference_inputs[:, None], past + 1 + future, axis=1)
    return np.asarray(
        ca.DM(d.step(0, ca.DM(x), ca.DM(u), ca.DM(model.parameter_vector()), ca.DM.zeros(6), 0.01))
    )


def test_the_round_trip_is_exact(file: Path, tmp_path: Path) -> None:
    first = load_model(file)
    again = load_model(save_model(first, tmp_path / "again.json"))
    assert read_json(file)["checksum"] == read_json(tmp_path / "again.json")["checksum"]
    original = craft_model(hybrid(kernel="linear+se"))
    assert np.array_equal(step_of(first), step_of(original))
    assert np.array_equal(step_of(again), step_of(original))
    assert first.name == original.name
    assert first.trained_on == original.trained_on
    assert np.array_equal(first.process_noise, original.process_noise)


def test_the_model_saves_itself_as_gb_load_reads_it(file: Path, tmp_path: Path) -> None:
    again = gb.load(gb.load(file).save(tmp_path / "own.json"))
    assert isinstance(again.dynamics, HybridModel)
    assert read_json(tmp_path / "own.json")["checksum"] == read_json(file)["checksum"]


def test_the_file_follows_the_published_schema(file: Path) -> None:
    schema = json.loads(resources.files("greybox.schemas").joinpath("model.json").read_text())
    validator = jsonschema.Draft202012Validator(schema)
    validator.check_schema(schema)
    body = read_json(file)
    validator.validate(body)
    validator.validate(body["base"])
    del body["gp"]["arrays"]
    assert not validator.is_valid(body)


def test_horizon_noise_survives(tmp_path: Path) -> None:
    model = craft_model(hybrid())
    calibrated = replace(model, horizon_noise=1.7 * model.process_noise)
    got = load_model(save_model(calibrated, tmp_path / "m.json"))
    assert got.horizon_noise is not None
    assert np.array_equal(got.horizon_noise, 1.7 * model.process_noise)


def signed(
    change: Callable[[dict[str, Any]], object],
) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """A change by somebody who also renews the checksum."""

    def edit(body: dict[str, Any]) -> dict[str, Any]:
        change(body)
        rest = {k: v for k, v in body.items() if k not in ("checksum", "versions")}
        return {**body, "checksum": checksum(rest)}

    return edit


def unsigned(body: dict[str, Any]) -> dict[str, Any]:
    body["gp"]["arrays"]["weights"][0][0] += 1e-9
    return body


def rename(body: dict[str, Any]) -> None:
    body["gp"]["outputs"][0]["name"] = "lift.x"


DAMAGE: dict[str, tuple[Callable[[dict[str, Any]], dict[str, Any]], str]] = {
    "one weight": (unsigned, "checksum"),
    "no gp": (signed(lambda b: b.pop("gp")), "incomplete"),
    "no base": (signed(lambda b: b.pop("base")), "incomplete"),
    "no arrays": (signed(lambda b: b["gp"].pop("arrays")), "posterior"),
    "gp is text": (signed(lambda b: b.update(gp="all of it")), "incomplete"),
    "weights too short": (signed(lambda b: b["gp"]["arrays"]["weights"].pop()), "shape"),
    "unknown channel": (signed(rename), "lift.x"),
    "less variance": (signed(lambda b: b["gp"].update(variance_factor=[1, -1, 1])), "variance 1"),
    "base edited": (signed(lambda b: b["base"]["values"].update(mass=1.0)), "checksum"),
}


@pytest.mark.parametrize("case", DAMAGE, ids=lambda c: c.replace(" ", "-"))
def test_damage_is_one_clear_line(
    case: str, file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change, word = DAMAGE[case]
    broken = write_json(tmp_path / "broken.json", change(read_json(file)))
    code = main(["validate", str(broken), "--log", "nowhere.csv"])
    lines = capsys.readouterr().err.strip().splitlines()
    assert code == 2
    assert len(lines) == 1
    assert lines[0].startswith("greybox validate: ")
    assert word in lines[0]


def test_a_cut_file_is_one_clear_line(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "cut.json").write_text(file.read_text()[:2000])
    assert main(["validate", str(tmp_path / "cut.json"), "--log", "nowhere.csv"]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert "not JSON" in lines[0]


def test_the_physics_reader_sends_you_to_the_right_one(file: Path) -> None:
    with pytest.raises(FileFormatError, match=r"greybox\.load"):
        IdentifiedModel.load(file)


def test_loading_and_predicting_need_no_torch(file: Path) -> None:
    code = f"""
import sys
import casadi as ca
import greybox
model = greybox.load({str(file)!r})
d = model.dynamics
x, u = ca.SX.sym("x", len(d.states)), ca.SX.sym("u", len(d.inputs), sum(d.window) + 1)
p = ca.DM(model.parameter_vector())
step = ca.Function("s", [x, u], [d.step(0, x, u, p, ca.DM.zeros(len(d.noises)), 0.01), d.learned_variance(x, u)])
after, variance = step(model.reference_state, 0.7)
assert float(ca.mmin(variance)) > 0
print("torch" in sys.modules, "gpytorch" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]
