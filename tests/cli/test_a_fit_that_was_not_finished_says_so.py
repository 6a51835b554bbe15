"""Whatever ends the command after the fit, its files say that they are not finished, and whoever
builds on them says or refuses it."""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path

import jsonschema
import pytest

from greybox.cli import main
from greybox.model.verdict import UNFINISHED
from greybox.plants.flight_log import write_log
from greybox.plants.vehicle_file import write_vehicle
from tests.automatic.craft import RATES, flown, plant

COLUMNS = ("t", "u1", "u2", "u3", "u4", *RATES)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("unfinished")
    (columns,) = flown((1,), 3.0)
    write_log(folder / "a.csv", {k: v for k, v in columns.items() if k in COLUMNS})
    write_vehicle(folder / "v.toml", plant(), sigma={"inertia": 0.2, "thrust.c2": 0.2})
    return folder


AFTER = (
    "greybox.automatic.wanted.with_rivals",
    "greybox.automatic.lasting.with_lasting",
    "greybox.validation.calibration.calibrated",
)


@pytest.mark.parametrize(
    ("error", "step"),
    [
        *((OverflowError, step) for step in AFTER),
        (KeyboardInterrupt, AFTER[0]),
        *(pytest.param(KeyboardInterrupt, s, marks=pytest.mark.slow) for s in AFTER[1:]),
    ],
)
def test_files_of_a_fit_that_was_not_finished_say_so_and_are_refused(
    step: str,
    error: type[BaseException],
    files: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fails(*_: object) -> None:
        raise error

    out, logs = tmp_path / "out", [str(files / "a.csv")]
    given = ["fit", "--vehicle", str(files / "v.toml"), "--train", *logs, "--out", str(out)]
    given += ["--manual", "--max-iterations", "3"]
    with monkeypatch.context() as patch:
        patch.setattr(step, fails)
        if error is KeyboardInterrupt:
            assert main(given) == 130
            said = capsys.readouterr().err
            assert "unfinished, 1 fit kept; the same command goes on: greybox fit" in said
        else:
            with pytest.raises(error):
                main(given)
    for kind in ("fit", "model"):
        content = json.loads((out / f"{kind}.json").read_text())
        schema = json.loads(resources.files("greybox.schemas").joinpath(f"{kind}.json").read_text())
        jsonschema.validate(content, schema)
        assert content["verdict"]["line"] == UNFINISHED.line
    capsys.readouterr()
    model = str(out / "model.json")
    assert main(["export", model, "--out", str(tmp_path / "c")]) == 1
    assert UNFINISHED.line in capsys.readouterr().err
    main(["validate", model, "--log", *logs])
    said = capsys.readouterr()
    assert UNFINISHED.line in said.err and f"warning: {UNFINISHED.line}" in said.out
