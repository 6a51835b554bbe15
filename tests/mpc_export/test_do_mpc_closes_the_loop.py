"""do-mpc, from a bundle alone, closes the loop; its commands are IPOPT's and its plant is f_d."""

from __future__ import annotations

import numpy as np
import pytest

from mpc_export.exported import load
from mpc_export.hover import hover
from tests.mpc_export import consumers


@pytest.mark.parametrize("kind", [pytest.param("physics", marks=pytest.mark.slow), "hybrid"])
@consumers.needs("do_mpc")
def test_the_loop_runs_and_every_step_is_solved(kind):
    got = consumers.run(kind, "do_mpc_hover.py", "--horizon", "8", "--steps", "3")
    assert got["solved"]
    assert got["difference"] < 1e-5
    model = load(consumers.bundle(kind), ("f_d", "boxplus"))
    x = hover(model).start
    for u in got["inputs"]:
        assert np.all(np.array(u) >= model.lower - 1e-9) and np.all(
            np.array(u) <= model.upper + 1e-9
        )
        x = model["f_d"](x, u, model.parameter_values).full().ravel()
    np.testing.assert_allclose(got["state"], x, rtol=1e-10, atol=1e-10)


@consumers.needs("do_mpc")
def test_a_linear_model_without_bounds_is_steered_to_its_reference():
    got = consumers.run("linear", "do_mpc_hover.py", "--horizon", "20", "--steps", "12")
    assert got["solved"]
    assert got["difference"] < 1e-5
    assert got["costs"][-1] < 0.1 * got["costs"][0]
