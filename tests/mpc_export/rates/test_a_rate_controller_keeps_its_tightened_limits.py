"""RateController: it plans with the exported predictor, and stays away from limits by what the
predictor is unsure of."""

from types import SimpleNamespace

import numpy as np
import pytest

from greybox.baselines.linear_predictor import LinearPredictor
from greybox.errors import ModelError
from greybox.model.linear import LinearModel
from greybox.model.matrices import Matrices
from greybox.symbolic import Layout, Signal
from mpc_export.predictors import predictor_model
from mpc_export.rates.controller import RateController, RateProblem
from tests.mpc_export.predictor_cases import hybrid

CHANNELS = {"roll": ((1.0, "u1"), (-1.0, "u2")), "pitch": ((1.0, "u3"), (-1.0, "u4"))}
PROBLEM = RateProblem(limit=1.0, horizon=8, change=0.5, collective=1.0)


def base():
    """Rates that follow commands with a lag, in innovation form."""
    matrices = Matrices(
        np.diag([0.9, 0.85]), np.diag([0.6, 0.5]), np.eye(2), np.zeros((2, 2)), np.diag([0.5, 0.4])
    )
    model = LinearModel(
        name="axes",
        matrices=matrices,
        noise=np.diag([4e-4, 9e-4]),
        dt=0.01,
        inputs=Layout([Signal(name=n, unit="1") for n in CHANNELS]),
        outputs=Layout([Signal(name=n, unit="rad/s") for n in "pq"]),
        delays=(0, 0),
        input_offset=np.zeros(2),
        output_offset=np.zeros(2),
    )
    return LinearPredictor(model=model, outputs=("p", "q"), channels=CHANNELS)


@pytest.fixture(scope="module")
def controllers():
    learned = hybrid(base(), ("p", "q", "phi[t-1]", "u1[t-1]", "u3[t-1]"))
    return {
        "linear": RateController(predictor_model(base()), PROBLEM),
        "hybrid": RateController(predictor_model(learned), PROBLEM),
    }


def settled(pilot, kappa, asked, steps=15):
    """The controller after some samples on its own noiseless prediction."""
    pilot.kappa = kappa
    pilot.start(np.full(4, 0.5))
    y = np.zeros(2)
    for _ in range(steps):
        pilot.sample(y, (0.1, 0.0), asked, 0.5)
        y = pilot.plan.y[0]
    return pilot.plan


@pytest.mark.parametrize("name", ["linear", "hybrid"])
def test_the_plan_is_what_the_exported_predictor_foretells(controllers, name):
    pilot = controllers[name]
    plan = settled(pilot, 0.0, np.array([0.5, -0.3]))
    f, x, found = pilot.functions, pilot.x, []
    for u in plan.u:
        found.append(f["h"](x, u, pilot.p).full().ravel())
        x = f["f_d"](x, u, pilot.p)
    assert plan.solved
    assert plan.y == pytest.approx(np.array(found), abs=2e-3)
    assert plan.y[-1] == pytest.approx([0.5, -0.3], abs=0.05)


@pytest.mark.parametrize("name", ["linear", "hybrid"])
def test_a_tightened_plan_stays_that_many_deviations_inside(controllers, name):
    asked = np.array([2.0, 0.0])
    loose, tight = (settled(controllers[name], k, asked) for k in (0.0, 3.0))
    assert loose.y[1:, 0].max() == pytest.approx(1.0, abs=0.01)
    assert (tight.y[1:, 0] + 3.0 * tight.sigma[1:, 0]).max() == pytest.approx(1.0, abs=0.01)
    assert tight.y[1:, 0].max() < loose.y[1:, 0].max() - 2.5 * tight.sigma[1, 0]


def test_a_breach_that_cannot_be_helped_frees_no_later_stage(controllers):
    """Measured beyond the limit and asked for more: the plan comes back at once and stays
    inside."""
    pilot = controllers["linear"]
    settled(pilot, 0.0, np.array([0.9, 0.0]))
    for _ in range(3):
        pilot.sample(np.array([1.8, 0.0]), (0.0, 0.0), np.array([2.0, 0.0]), 0.5)
    y, limit = pilot.plan.y[:, 0], PROBLEM.limit
    assert pilot.plan.solved and y[0] > limit + 0.2
    assert y[3:].max() < limit + 0.01, y


def test_what_the_process_does_not_know_widens_the_tube(controllers):
    pilot = controllers["hybrid"]
    near, far = (
        (pilot.start(u), pilot._linearised(pilot.nominal)[2])[1]
        for u in (np.full(4, 0.1), np.full(4, 9.0))
    )
    assert (far[-1] > 1.02 * near[-1]).all()
    # The first rates are unsure by one innovation and what the process is unsure of, whatever is
    # planned.
    assert near[0] == pytest.approx(
        np.sqrt(
            pilot.functions["output_covariance"](
                pilot.x, np.full(4, 0.1), pilot.p, np.zeros((pilot.x.size,) * 2)
            )
            .full()
            .diagonal()
        ),
        rel=0.2,
    )


def test_a_missing_rate_is_predicted(controllers):
    pilot = controllers["linear"]
    settled(pilot, 0.0, np.array([0.4, 0.0]))
    before = pilot.x.copy()
    u = pilot.sample(np.array([np.nan, np.nan]), (0.0, 0.0), np.array([0.4, 0.0]), 0.5)
    assert np.isfinite(u).all()
    assert pilot.x == pytest.approx(before, abs=0.1)


def test_nothing_that_is_not_finite_stays(controllers):
    pilot = controllers["hybrid"]
    settled(pilot, 3.0, np.array([0.4, 0.0]))
    nan = np.full(2, np.nan)
    for asked in (np.array([0.4, 0.0]), nan):
        u = pilot.sample(nan, (np.nan, np.nan), asked, 0.5)
        assert np.isfinite(u).all() and (u >= PROBLEM.u_min).all() and (u <= PROBLEM.u_max).all()
    assert not pilot.plan.solved and pilot.failures == 1
    pilot.sample(np.zeros(2), (0.1, 0.0), np.array([0.4, 0.0]), 0.5)
    assert pilot.plan.solved and np.isfinite(pilot.plan.y).all()


def test_a_process_that_looks_at_more_than_the_craft_measures_is_refused():
    learned = hybrid(base(), ("p", "q", "psi[t-1]"))
    with pytest.raises(ModelError, match=r"psi\[t-1\]"):
        RateController(predictor_model(learned), PROBLEM)


@pytest.mark.parametrize(
    "wrong",
    [
        {"limit": 0.0},
        {"limit": 1.0, "horizon": 1},
        {"limit": 1.0, "change": -1.0},
        {"limit": 1.0, "u_min": 2.0},
    ],
)
def test_a_problem_that_makes_no_sense_is_refused(wrong):
    with pytest.raises(ModelError, match="controller: "):
        RateProblem(**wrong)


def test_flights_beyond_are_counted_and_said(tmp_path):
    from mpc_export.rates.campaign import TEXTS, Task, _controller, beyond, verdict

    rates = SimpleNamespace(kappa={"tube": 3.0}, level=0.1, task=Task())
    row = {
        "crashed": False,
        "beyond": 0,
        "samples": 100,
        "worst": [1, 2, 1],
        "rmse": 0.3,
        "away": 0.2,
        "failures": 0,
        "solve_ms": [1.0, 2.0],
    }
    bad = row | {"beyond": 5, "worst": [3, 1, 1]}
    assert not beyond(row) and beyond(bad) and beyond(row | {"crashed": True})
    one = _controller("tube", [row] * 9 + [bad], rates)
    assert one["beyond"]["count"] == 1
    assert one["samples_beyond"] == pytest.approx(5 / 1000)
    assert one["worst"] == 3
    found = {n: _controller(n, [bad] * 10, rates) for n in TEXTS}
    kept = verdict({"level": 0.1, "limit": 2.5, "controllers": found | {"tube": one}})
    assert kept.startswith("The tube kept its promise so far") and "pid in 10 of 10" in kept
    assert verdict({"level": 0.1, "limit": 2.5, "controllers": found}).startswith(
        "The tube broke its promise"
    )
