"""What the result of a command depends on: its options, and the contents of files that they name."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest

from greybox.cli import main
from greybox.commands.going_on import given


def of(**options: object) -> dict[str, str]:
    """What is given beside the code and the libraries."""
    return {n: v for n, v in given(argparse.Namespace(**options)).items() if " " not in n[:8]}


def test_options_as_long_as_those_of_a_printed_command_are_no_files() -> None:
    levels = {f"noise.sensor.attitude.{i}": 0.1234567890123456 + i for i in range(60)}
    words = ["--value=" + "x" * 5000, "null\0byte"]
    found = of(noise=levels, value=words)
    assert found["--noise"] == str(levels) and "x" * 5000 in found["--value"]
    assert of(noise=levels | {"noise.sensor.p": 1.0})["--noise"] != found["--noise"]


def test_the_content_of_a_file_counts_and_not_where_it_lies(tmp_path: Path) -> None:
    told = []
    for folder, text in (("one", "a"), ("two", "a"), ("three", "b")):
        place = tmp_path / folder / "log.csv"
        place.parent.mkdir()
        place.write_text(text)
        told.append(given(argparse.Namespace(train=[str(place)])))
    assert told[0] == told[1] != told[2]


@pytest.mark.parametrize("command", [["fit", "--vehicle", "v.toml"], ["discover"]])
def test_results_do_not_write_over_the_model_that_they_start_from(
    command: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("model.json").write_text("{}")
    words = [*command, "--train", "a.csv", "--from", "model.json", "--out"]
    assert main([*words, "."]) == 2
    assert "write over the model that --from names" in capsys.readouterr().err
    assert Path("model.json").read_text() == "{}"
    assert main([*words, "other"]) == 2  # there is no such log
    assert "write over" not in capsys.readouterr().err
