"""Two identifications: what has changed is listed with what it does, what both fits leave open is
marked, and a model against itself has not changed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from greybox.cli import main
from greybox.residual.files import save_model
from greybox.simulators.compare import compare
from tests.simulators.identified import identified

OLD = {"motor_lag.tau": 0.05, "rotor_drag.k_x": 2e-5, "rotor_drag.k_y": 2e-5}


def test_a_model_against_itself_has_not_changed() -> None:
    found = compare(identified(OLD), identified(OLD))
    assert not found.changes and not found.added and not found.gone
    assert found.force == 0.0


def test_a_heavier_craft_with_a_new_effect_is_told(tmp_path: Path) -> None:
    old = identified(OLD)
    new = identified({**OLD, "mass": 1.1, "rotational_damping.d_p": 0.02, "thrust.c2": 5.01})
    sure = {"covariance_names": ("mass", "thrust.c2"), "covariance": np.diag([1e-4, 1e-2])}
    old, new = replace(old, **sure), replace(new, **sure)
    found = compare(old, new)
    by_name = {c.name: c for c in found.changes}
    assert found.added == ("rotational_damping",)
    assert by_name["mass"].clear and not by_name["thrust.c2"].clear
    assert by_name["mass"].size.thrust[0] == pytest.approx(-0.0909, abs=1e-3)
    assert by_name["rotational_damping.d_p"].size.turning > 1.0
    assert 0.05 < found.share < 0.15
    back = compare(new, old)
    assert back.gone == ("rotational_damping",)


def test_the_command_prints_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = []
    for name, values in (("old", OLD), ("new", {**OLD, "mass": 1.05})):
        paths.append(str(tmp_path / f"{name}.json"))
        save_model(identified(values), paths[-1])
    assert main(["twin", "--compare", *paths]) == 0
    said = capsys.readouterr().out
    assert "mass" in said and "+5.0 %" in said and "of the weight" in said
    assert main(["twin", "--compare", *paths, "--out", str(tmp_path / "x")]) == 2
