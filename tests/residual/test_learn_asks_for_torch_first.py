"""A missing PyTorch is said before a model or a log is read."""

from __future__ import annotations

import importlib.util

import pytest

from greybox.cli import main
from greybox.errors import MissingExtraError
from greybox.residual.train import check_extra


@pytest.mark.parametrize("missing", ["torch", "gpytorch"])
def test_learn_says_so_before_it_reads_anything(monkeypatch, capsys, missing):
    real = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda n, *a: None if n == missing else real(n, *a)
    )
    with pytest.raises(MissingExtraError, match=f"no {missing}"):
        check_extra()
    assert main(["learn", "there_is_no_model.json", "--train", "there_is_no_log.csv"]) == 2
    said = capsys.readouterr().err
    assert "PyTorch" in said
    assert "there_is_no" not in said
