"""Bad input to greybox learn: one clear line, exit code 2, nothing written; good input to the page
and the files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from greybox.cli import main
from greybox.excitation.hover import Hover
from greybox.excitation.injection import rich_excitation
from greybox.model.identified import IdentifiedModel
from greybox.plants.flight_log import fly, member, write_log
from greybox.plants.presets import controller_for
from greybox.residual.files import save_model
from scenarios.studies.recovery import plant
from tests.residual.hybrid_cases import craft, craft_model, hybrid


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("learn")
    true_plant = plant()
    log = fly(
        true_plant,
        controller_for(true_plant),
        Hover(),
        rich_excitation(),
        3.0,
        seed=[1, 2],
        warm_up=0.5,
    )
    for i, name in enumerate("ab"):
        write_log(folder / f"{name}.csv", member(log, i), drop=["omega"])
    model: IdentifiedModel = replace(craft_model(craft()), trained_on=("a",))
    save_model(model, folder / "model.json")
    save_model(craft_model(hybrid()), folder / "hybrid.json")
    (folder / "nan.py").write_text(NAN)
    (folder / "linear.json").write_text('{"schema": "greybox.linear_model/1"}')
    return folder


NAN = """
class Nan:
    name = "nan"

    def features(self, x, y, *, points, seed):
        return {"nothing": lambda s: float("nan") * s}
"""
CASES = {
    "no such model": (["nowhere.json", "--train", "a.csv"], "nowhere.json"),
    "a linear model that was cut off": (["linear.json", "--train", "a.csv"], "checksum"),
    "a hybrid": (["hybrid.json", "--train", "a.csv"], "already"),
    "no such log": (["model.json", "--train", "nowhere.csv"], "nowhere.csv"),
    "train is test": (["model.json", "--train", "a.csv", "--test", "a.csv"], "both train and test"),
    "unknown feature": (
        ["model.json", "--train", "a.csv", "--inputs", "body_velocity.v"],
        "body_velocity",
    ),
    "place and features": (
        ["model.json", "--train", "a.csv", "--place", "--inputs", "p"],
        "--place",
    ),
    "place of a linear model": (["linear.json", "--train", "a.csv", "--place"], "linear model"),
    "a guard of a law": (
        ["linear.json", "--train", "a.csv", "--guard", "--learner", "sparse"],
        "--guard",
    ),
    "unknown kernel": (["model.json", "--train", "a.csv", "--kernel", "rbf"], "se"),
    "no such learner": (["model.json", "--train", "a.csv", "--learner", "nets"], "random-features"),
    "no such file of a learner": (
        ["model.json", "--train", "a.csv", "--learner", "nets.py:Net"],
        "nets.py",
    ),
    "a kernel of a law": (
        ["model.json", "--train", "a.csv", "--learner", "sparse", "--kernel", "matern32"],
        "kernel",
    ),
    "chosen features": (
        ["model.json", "--train", "a.csv", "--learner", "neural", "--points", "auto"],
        "number",
    ),
    "no points": (["model.json", "--train", "a.csv", "--points", "0"], "--points"),
    "points in words": (["model.json", "--train", "a.csv", "--points", "many"], "--points"),
    "no adaptation": (["model.json", "--train", "a.csv", "--adapt", "-1"], "--adapt"),
    "a learner that returns NaN": (
        ["model.json", "--train", "a.csv", "--learner", "nan.py:Nan", "--inputs", "p"],
        "learner nan: nothing is not finite on the training flights",
    ),
    "three seconds": (
        ["model.json", "--train", "a.csv", "--inputs", "p", "--json", "-"],
        "too little flight for a Gaussian process; expected at least 20 stretches",
    ),
    "horizon zero": (["model.json", "--train", "a.csv", "--horizons", "0"], "horizons"),
}


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.replace(" ", "-"))
def test_bad_input_is_one_line(
    case: str,
    files: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    arguments, word = CASES[case]
    monkeypatch.chdir(files)
    out = tmp_path / "out"
    code = main(["learn", *arguments, "--json", "-", "--out", str(out)])
    captured = capsys.readouterr()
    lines = captured.err.strip().splitlines()
    assert code == 2
    assert len(lines) == 1
    assert lines[0].startswith("greybox learn: ")
    assert word in lines[0]
    assert not captured.out
    assert not out.exists()
