"""Commands that take the numbers of the physics refuse a model with a learned part, whose numbers are
not those of the physics alone: a table would call it the physics."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import greybox as gb
from greybox.cli import main
from greybox.data import Dataset
from greybox.errors import ModelError
from greybox.model.identified import IdentifiedModel
from greybox.residual.files import save_model
from tests.mpc_export import cases

PHYSICS_ONLY = {
    "profile": "profile MODEL --train LOG --of mass",
    "compare": "compare --vehicle VEHICLE --fitted MODEL --train LOG --test TEST",
    "fit": "fit --vehicle VEHICLE --from MODEL --train LOG",
    "discover": "discover --from MODEL --train LOG",
    "plan": "plan --model MODEL --seconds 5",
}


@pytest.mark.parametrize("command", PHYSICS_ONLY)
def test_a_model_with_a_learned_part_is_not_taken_for_the_physics(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "hybrid.json", tmp_path / "out"
    save_model(cases.hybrid(), path)
    (tmp_path / "fit.json").write_text("{}")  # that of the physics, in the same folder
    log, test = gb.examples.flight_paths("nanobench")[:2]
    words = {
        "MODEL": path,
        "LOG": log,
        "TEST": test,
        "VEHICLE": gb.examples.vehicle_path("nanobench"),
    }
    line = [str(words.get(w, w)) for w in [*PHYSICS_ONLY[command].split(), "--out", str(out)]]
    assert main(line) == 2
    (said,) = (s for s in capsys.readouterr().err.splitlines() if str(path) in s)
    assert "learned" in said and "the physics alone" in said
    assert "the model file that it was learned for" in said
    assert not out.exists()


def fitted(model: IdentifiedModel) -> SimpleNamespace:
    """What looks like a fit of it."""
    return SimpleNamespace(model=model, problem=None, theta=None, settings={})


Door = Callable[[IdentifiedModel, Dataset], object]
PYTHON: dict[str, Door] = {
    "profile": lambda model, _flight: gb.profile(fitted(model), "mass"),
    "fit": lambda model, flight: gb.fit(model.physics.vehicle, flight, source=model),
    "discover": lambda model, flight: gb.discover(model.physics.vehicle, flight, since=model),
    "plan": lambda model, _flight: gb.plan(model=model, seconds=5.0),
}


@pytest.mark.parametrize("name", PYTHON)
@pytest.mark.parametrize("read", [False, True])
def test_python_says_the_same_line(name: str, read: bool, tmp_path: Path) -> None:
    model, path = cases.hybrid(), tmp_path / "hybrid.json"
    save_model(model, path)
    if read:
        loaded = gb.load(path)
        assert isinstance(loaded, IdentifiedModel)
        model = loaded
    with pytest.raises(ModelError) as of_file:  # what the commands say
        gb.fit(model.physics.vehicle, FLIGHT, source=path)
    with pytest.raises(ModelError) as said:
        PYTHON[name](model, FLIGHT)
    where = str(path) if read else model.name
    assert said.value.line == of_file.value.line.replace(str(path), where)


def test_a_comparison_has_no_row_of_the_physics_from_what_was_learned() -> None:
    vehicle = gb.examples.vehicle_path("nanobench")
    train, test = (
        gb.read_logs([path], vehicle) for path in gb.examples.flight_paths("nanobench")[:2]
    )
    found = gb.compare(
        vehicle, train, test, methods=["nonlinear PEM"], fit=lambda: fitted(cases.hybrid())
    )
    (row,) = found["methods"]
    assert row["status"] == "failed" and "the physics alone" in row["error"]


FLIGHT = gb.dataset_from_arrays(np.arange(3) / 100, {"u1": np.zeros(3)})
