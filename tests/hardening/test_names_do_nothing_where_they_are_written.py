"""A name from a file is a name everywhere: on the terminal, in C, in build files, in pages."""

from __future__ import annotations

import io
import re
from dataclasses import replace

import pytest

from greybox.cli import _PlainText, main
from greybox.data.logs.table import flight_name
from greybox.errors import VehicleError, printable
from greybox.examples import vehicle_path
from greybox.model.vehicle import read_vehicle
from mpc_export import verify
from mpc_export.bundle import write_bundle
from mpc_export.c_model import _comment
from mpc_export.readme import plain
from tests.mpc_export import cases, compiled

EVIL = (
    "a /* b */ c",
    "*/ int evil; /*",
    "line\nnext",
    "\x1b[2J\x1b]0;owned\x07",
    "carriage\rreturn",
    "??/ trigraph",
    "ends in \\",
    "@CMAKE_COMMAND@ ${prefix} $(id) `id`",
    "<script>alert(1)</script>",
    "](javascript:x)",
    "\u202egnp.exe",
    "ünïcode",
    "| cell | cell |",
    "/*/ */*",
    "//",
    "'''",
    '"""',
)
"""Names that somebody could give a craft or a file."""


@pytest.mark.parametrize("name", EVIL)
def test_a_comment_in_c_ends_where_it_should(name):
    text = _comment(name)
    assert text.isascii() and text.isprintable()
    assert not re.search(r"/\*|\*/|\?\?|\\", text)


@pytest.mark.parametrize("name", EVIL)
def test_a_page_shows_the_name_and_no_more(name):
    text = plain(name)
    assert "\n" not in text
    assert text.isprintable()
    assert not re.search(r"(?<!\\)[|<>`\[\]#]", text.replace("\\\\", ""))


@pytest.mark.parametrize("name", EVIL)
def test_a_stream_of_the_command_line_moves_no_cursor(name):
    stream = io.StringIO()
    print(f"first\t{name}\nlast", file=_PlainText(stream))
    shown = stream.getvalue()
    assert all(c.isprintable() or c in "\n\t" for c in shown)
    assert shown.startswith("first\t")
    assert shown.endswith("\nlast\n")
    assert printable(name).isprintable()


def test_a_name_of_a_file_is_escaped_before_it_is_a_name_of_a_flight():
    assert flight_name("logs/a\n\x1b[31mred.csv") == "a\\n\\x1b[31mred"


def test_an_option_of_the_command_line_is_shown_escaped(capfd):
    assert main(["validate", "no\x1b[2J\nfile.json", "--log", "x.csv"]) == 2
    said = capfd.readouterr().err
    assert "\x1b" not in said
    assert said.count("\n") == 1


def test_a_vehicle_cannot_be_named_over_two_lines(tmp_path):
    path = tmp_path / "vehicle.toml"
    good = vehicle_path("nanobench").read_text()
    path.write_text(re.sub(r"(?m)^name = .*$", r'name = "quad\\u001b[2J\\nnext"', good))
    with pytest.raises(VehicleError, match="on one line"):
        read_vehicle(path)


def test_a_bundle_of_a_craft_with_such_a_name_compiles_and_is_verified(tmp_path, capfd):
    """All names at once: strict C, pkg-config, README and the verifier's own words."""
    model = replace(cases.linear(), name=" ".join(EVIL))
    made = write_bundle(model, tmp_path / "box", use_cache=False)
    compiled.compile_objects(made, tmp_path / "work")
    c = made.folder / "c"
    config = (c / "box.pc.in").read_text()
    assert len([line for line in config.splitlines() if line.startswith("Description:")]) == 1
    assert not re.search(r"Description:.*[$@`<]", config)
    first = (made.folder / "README.md").read_text().splitlines()[0]
    assert first.startswith("# box: ")
    assert verify.main([str(made.folder)]) == 0
    said = capfd.readouterr().out
    assert "passed" in said
    assert all(ch.isprintable() or ch == "\n" for ch in said)
