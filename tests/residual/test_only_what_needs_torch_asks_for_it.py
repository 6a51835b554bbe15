"""Only what needs PyTorch asks for it, and says so."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from greybox.errors import MissingExtraError
from greybox.residual.train import check_extra, train_gp
from greybox.symbolic import Layout, Signal

BLOCKED = """
import sys
class NoTorch:
    @staticmethod
    def find_spec(name, path=None, target=None):
        if name.split(".")[0] in ("torch", "gpytorch"):
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, NoTorch)
from tests.residual.test_learn_helps_and_does_no_harm import HIDDEN, learned
assert not learned(HIDDEN).null
assert "torch" not in sys.modules
"""


@pytest.mark.parametrize("missing", ["torch", "gpytorch"])
def test_polish_says_what_is_missing(monkeypatch, missing):
    real = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda n, *a: None if n == missing else real(n, *a)
    )
    with pytest.raises(MissingExtraError, match=f"no {missing}"):
        check_extra()
    x = np.linspace(-3.0, 3.0, 60)[:, None]
    one = Layout([Signal(name="x", unit="1")])
    with pytest.raises(MissingExtraError, match="PyTorch"):
        train_gp(x, np.sin(x), inputs=one, outputs=one, points=5, hold_out=0.0, polish=True)
    trained = train_gp(x, np.sin(x), inputs=one, outputs=one, points=5, hold_out=0.0)
    assert trained.posterior.points == 5


def test_learning_needs_no_torch():
    root = Path(__file__).parents[2]
    subprocess.run([sys.executable, "-c", BLOCKED], check=True, cwd=root)
