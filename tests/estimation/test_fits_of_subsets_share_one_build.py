"""An engine built for many parameters serves fits of any subset: the same cost, gradient, Hessian
and estimates."""

import numpy as np
import pytest

from greybox.errors import UnknownNameError
from greybox.estimation.build import compiler
from greybox.estimation.criteria.gaussian import Gaussian
from greybox.estimation.engine import engine_for
from greybox.estimation.fit import fit
from greybox.estimation.predictors.innovation import Innovation
from greybox.estimation.problem import make_problem
from tests.motor import model, record

SOME = ("R", "J")
EVERY = tuple(p.name for p in model().parameters)


@pytest.mark.parametrize(
    "compiled",
    [pytest.param(True, marks=pytest.mark.skipif(compiler() is None, reason="no cc")), False],
)
def test_value_gradient_and_hessian_are_those_of_an_own_build(compiled: bool):
    data = record(200)
    common = {
        "predictor": Innovation(),
        "criterion": Gaussian(),
        "free": SOME,
        "use_compiler": compiled,
    }
    own = make_problem(model(), data, **common)
    shared = make_problem(model(), data, build=EVERY, **common)
    assert shared.engine.built == EVERY
    assert shared.engine.active == own.engine.active == SOME
    a, b = (p.evaluate(p.start) for p in (own, shared))
    assert b.cost == pytest.approx(a.cost, rel=1e-12)
    np.testing.assert_allclose(
        b.gradient, a.gradient, rtol=1e-8, atol=1e-9 * np.abs(a.gradient).max()
    )
    np.testing.assert_allclose(b.hessian, a.hessian, rtol=1e-8, atol=1e-9 * np.abs(a.hessian).max())


def test_estimates_are_the_same():
    data = record(400, torque_noise=0.001)
    own, shared = (fit(model(), data, free=SOME, build=b) for b in (None, EVERY))
    assert shared.converged
    for name in SOME:
        assert shared[name].value == pytest.approx(own[name].value, rel=1e-7)
        assert shared[name].std == pytest.approx(own[name].std, rel=1e-4)


def test_only_built_parameters_can_be_selected():
    engine = engine_for(model(), SOME)
    assert engine.select(SOME) is engine
    # Another fit in this process may have built more of the same model.
    assert [engine.built[i] for i in engine.select(("J",)).columns] == ["J"]
    with pytest.raises(UnknownNameError, match="active parameter"):
        engine.select(("L",))
