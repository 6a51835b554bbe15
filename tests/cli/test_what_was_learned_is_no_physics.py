"""Commands that take the numbers of the physics refuse a model with a learned part, whose numbers are
not those of the physics alone: a table would call it the physics."""

from __future__ import annotations

from pathlib import Path

import pytest

import greybox as gb
from greybox.cli import main
from greybox.residual.files import save_model
from tests.mpc_export import cases

PHYSICS_ONLY = {
    "profile": "profile MODEL --train LOG --of mass",
    "compare": "compare --vehicle VEHICLE --fitted MODEL --train LOG --test TEST",
    "fit": "fit --vehicle VEHICLE --from MODEL --train LOG",
    "discover": "discover --from MODEL --train LOG",
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
