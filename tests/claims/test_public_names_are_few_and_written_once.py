"""`dir(greybox)` is the API: at most twenty names, written once; what was public says where it
went."""

from __future__ import annotations

import ast
import importlib
import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import greybox

STUB = ast.parse(Path(greybox.__file__).with_name("__init__.pyi").read_text())
LINES = [node for node in STUB.body if isinstance(node, ast.ImportFrom)]


def test_there_are_at_most_twenty():
    assert 0 < len(greybox.__all__) <= 20
    assert set(dir(greybox)) == {*greybox.__all__, "__version__"}


def test_each_is_an_import_of_the_stub_and_can_be_had():
    """An editor takes a name from a stub only where it is imported as itself."""
    assert sorted(a.asname or "" for node in LINES for a in node.names) == greybox.__all__
    for node in LINES:
        for a in node.names:
            thing = getattr(greybox, a.name)
            here = (
                inspect.ismodule(thing)
                or getattr(importlib.import_module(str(node.module)), a.name) is thing
            )
            assert here, a.name


def test_what_was_public_works_once_more_and_says_where_it_went():
    program = (
        "import sys, warnings, greybox\n"
        "with warnings.catch_warnings(record=True) as said:\n"
        "    warnings.simplefilter('always')\n"
        "    first, second = greybox.Layout, greybox.Layout\n"
        "from greybox.symbolic import Layout\n"
        "assert first is second is Layout\n"
        "(one,) = said\n"
        "print(one.category.__name__, one.filename == '<string>' , one.message)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    wanted = (
        "DeprecationWarning True greybox.Layout goes with 0.2.0; use: from greybox.symbolic "
        "import Layout"
    )
    assert done.stdout.strip() == wanted, done.stderr


@pytest.mark.parametrize("name", sorted(greybox._MOVED))
def test_where_it_went_is_where_it_is(name: str):
    assert hasattr(importlib.import_module(greybox._MOVED[name]), name)
    assert name not in greybox.__all__


def test_a_name_that_never_was_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'fitt'"):
        _ = greybox.fitt
