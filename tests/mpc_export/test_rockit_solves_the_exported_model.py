"""rockit, from a bundle alone, finds the commands that plain CasADi and IPOPT find."""

from __future__ import annotations

import pytest

from tests.mpc_export import consumers


@pytest.mark.parametrize("kind", ["hybrid", "linear", "own"])
@consumers.needs("rockit")
def test_rockit_agrees_with_ipopt(kind):
    got = consumers.run(kind, "rockit_hover.py", "--steps", "10")
    assert len(got["inputs"]) == 10
    assert got["difference"] < 1e-5
