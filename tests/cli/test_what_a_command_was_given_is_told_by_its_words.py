"""What the result of a command depends on: its options, and the contents of files that they name."""

from __future__ import annotations

import argparse
from pathlib import Path

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
