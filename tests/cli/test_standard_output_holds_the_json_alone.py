"""The console of all commands: what is said to people never mixes with what a program reads."""

from __future__ import annotations

import argparse
import json

import pytest

from greybox.cli import build_parser
from greybox.commands.console import Console
from greybox.files import OutputError

CONTENT = {"schema": "greybox.some/1", "values": [1.0, 2.5]}


def _commands(
    parser: argparse.ArgumentParser, name: str = ""
) -> list[tuple[str, argparse.ArgumentParser]]:
    inner = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
    if not inner:
        return [(name, parser)]
    return [
        found
        for a in inner
        for key, p in a.choices.items()
        for found in _commands(p, f"{name} {key}".strip())
    ]


def _spoken(console: Console) -> None:
    console.say("a line")
    console.say_when("a line with its time")
    console.share("half", 0.5)
    console.solver(3, 12.5, 0.1)
    console.result(CONTENT, "for people", "and more")


def test_json_alone_on_standard_output_and_silence_beside_it(capsys: pytest.CaptureFixture[str]):
    _spoken(Console("-"))
    out, err = capsys.readouterr()
    assert json.loads(out) == CONTENT and err == ""


def test_a_file_gets_the_same_json_and_people_their_lines(
    capsys: pytest.CaptureFixture[str], tmp_path
):
    _spoken(Console(str(tmp_path / "f.json")))
    out, err = capsys.readouterr()
    assert json.loads((tmp_path / "f.json").read_text()) == CONTENT
    assert out == "for people\nand more\n"
    assert [len(err.splitlines()), " 50 %  half" in err, "iteration   3" in err] == [4, True, True]


def test_nothing_is_written_where_nothing_was_asked_for(capsys: pytest.CaptureFixture[str]):
    _spoken(Console(None))
    assert capsys.readouterr().out == "for people\nand more\n"


def test_every_commands_json_says_that_a_dash_is_standard_output():
    texts = {
        name: action.help or ""
        for name, parser in _commands(build_parser())
        for action in parser._actions
        if "--json" in action.option_strings
    }
    assert len(texts) >= 15
    assert [name for name, text in texts.items() if "standard output" not in text] == []


def test_what_is_said_does_not_wait_for_a_file_that_cannot_be_written(
    capsys: pytest.CaptureFixture[str], tmp_path
):
    with pytest.raises(OutputError):
        Console(str(tmp_path)).result(CONTENT, "for people")
    assert capsys.readouterr().out == "for people\n"
