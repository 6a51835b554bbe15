"""The FMU that CasADi writes is f and h, says fmpy; the same model gives the same bytes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from greybox.errors import ModelError
from mpc_export import fmu
from mpc_export.exported import load
from tests.mpc_export import consumers


@pytest.mark.parametrize("kind", ["physics", "hybrid"])
@consumers.needs("fmpy")
def test_fmpy_simulates_what_f_says(kind):
    got = consumers.run(kind, "fmu_simulate.py")
    assert got["states"] < 1e-5
    assert got["outputs"] < 1e-9


@consumers.needs("fmpy")
def test_its_description_is_valid_and_names_everything():
    import fmpy

    model = load(consumers.bundle("physics"))
    description = fmpy.read_model_description(
        str(consumers.bundle("physics") / "fmu" / "physics_model.fmu"), validate=True
    )
    assert description.fmiVersion == "3.0"
    known = {v.name: v for v in description.modelVariables}
    assert set(model.states[: model.own_states]) | set(model.inputs) | {"mass", "y.az"} <= set(
        known
    )
    assert float(known["mass"].start) == pytest.approx(float(model.parameter_values[0]))
    assert known["mass"].causality == "parameter"
    assert description.numberOfContinuousStates == model.own_states


def test_without_a_binary_the_same_model_gives_the_same_bytes(tmp_path, monkeypatch):
    monkeypatch.setattr(fmu, "_headers", lambda: None)
    model = load(consumers.bundle("physics"))
    for name in ("a.fmu", "b.fmu"):
        assert fmu.write_fmu(model, tmp_path / name) == {"file": name, "binary": False}
    assert (tmp_path / "a.fmu").read_bytes() == (tmp_path / "b.fmu").read_bytes()


@consumers.needs("fmpy")
@pytest.mark.parametrize("name", ["sin", "main", "w"])
def test_its_binary_is_built_whatever_its_name_is(tmp_path, name):
    model = replace(load(consumers.bundle("physics")), name=name)
    assert fmu.write_fmu(model, tmp_path / f"{name}.fmu")["binary"]


def test_a_path_from_the_present_folder_is_one(tmp_path, monkeypatch):
    monkeypatch.setattr(fmu, "_headers", lambda: None)
    model = load(consumers.bundle("physics"))
    monkeypatch.chdir(tmp_path)
    fmu.write_fmu(model, Path("craft") / "fmu" / "a.fmu")
    assert (tmp_path / "craft" / "fmu" / "a.fmu").is_file()


def test_a_discrete_model_has_no_fmu(tmp_path):
    with pytest.raises(ModelError, match="discrete"):
        fmu.write_fmu(load(consumers.bundle("linear")), tmp_path / "x.fmu")
