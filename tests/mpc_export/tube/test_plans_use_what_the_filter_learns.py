"""A heavier craft in a steady wind flies without offset once its mass is learned; nothing measured
leaves the physics."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest

from greybox.errors import ModelError
from mpc_export.adaptation import with_flight_spread
from mpc_export.functions import model_functions
from mpc_export.tube.controller import TubeController, integrating
from mpc_export.tube.estimator import flight_filter
from mpc_export.tube.problem import TubeProblem
from tests.mpc_export import cases
from tests.mpc_export.tube.test_controller_flies_and_survives import Hover

PROBLEM = TubeProblem(dt=0.02, horizon=8, planes=2, rate_max=0.05)


@functools.cache
def pilot():
    """Its mass may be off by a tenth of it, one standard deviation."""
    model = cases.disturbed()
    return TubeController(
        model=model,
        problem=PROBLEM,
        reference=Hover(),
        kappa=(2.0, 2.0, 2.0),
        kappa_u=1.0,
        calibrate=True,
        adapt={"mass": 0.1 * model.values["mass"]},
    )


@pytest.mark.slow
def test_a_fifth_more_mass_in_a_steady_wind_leaves_no_offset():
    controller = pilot()
    model = controller.model
    heavy = model_functions(model.with_values({"mass": 1.2 * model.values["mass"]}))
    names = heavy.states.names
    controller.start()
    x, u, path, commands, mass = controller.estimate.copy(), controller.u, [], [], []
    for k in range(400):
        x[names.index("disturbance.force.x")] = 0.1 * 9.81 * model.values["mass"]
        y = heavy["h"](x, u, heavy.parameter_values).full().ravel()
        new = controller.sample(0.01 * k, dict(zip(heavy.outputs.names, y.tolist())))
        x = heavy["f_d"](x, u, heavy.parameter_values).full().ravel()
        u = np.array(new)
        path.append(x[:3])
        commands.append(u)
        mass.append(controller.p[controller.filter.parameters["mass"]] / model.values["mass"])
    away = np.linalg.norm(np.array(path) - [0.0, 0.0, 1.0], axis=1)
    assert away.max() > 0.005, "both were felt"
    assert away[200:].max() < 5e-4
    assert mass[50] == pytest.approx(1.2, rel=0.03), "half a second"
    assert np.min(commands) >= PROBLEM.command_min and np.max(commands) <= PROBLEM.command_max
    assert np.abs(np.diff(commands, axis=0)).max() <= PROBLEM.rate_max + 1e-6


def test_disturbances_that_do_not_decay_start_as_those_identified_do():
    """The filter's own walk has no stationary state: as good as 2 N instead of 3 mN."""
    model = cases.disturbed()
    flown = with_flight_spread(integrating(model), {"mass": 0.1 * model.values["mass"]})
    f = flight_filter(model, flown, calibrate=True, adapt=True)
    at = f.adapted.names.index("error.disturbance.force.x")
    kept = math.exp(-model.sample_time / model.values["disturbance.force.T"])
    levels = dict(zip((w.name for w in model.dynamics.noises), model.process_noise, strict=True))
    start = levels["disturbance.force.x"] ** 2 / (1.0 - kept**2)
    settled = f.noise.covariance.diagonal()[at - len(f.adapted.rows)]
    assert f.adapted.covariance[at, at] == pytest.approx(start - settled, rel=1e-6)
    assert math.sqrt(start) == pytest.approx(2.827e-3, rel=1e-3)


@pytest.mark.slow
def test_no_measurement_takes_parameters_disturbances_or_commands_out_of_their_bounds():
    controller = pilot()
    own, states = controller.filter.adapted, controller.filter.states
    controller.start()
    rng = np.random.default_rng(0)
    for k in range(300):
        wild = {
            n: 10.0 ** rng.uniform(-3, 6) * rng.standard_normal()
            for n in controller.estimator.columns
        }
        wild |= dict.fromkeys(
            rng.choice(controller.estimator.columns, 3), rng.choice([math.nan, math.inf, -math.inf])
        )
        u = controller.sample(0.01 * k, wild if k % 3 else None)
        assert (
            np.isfinite(u).all()
            and u.min() >= PROBLEM.command_min
            and u.max() <= PROBLEM.command_max
        )
        theta = controller.p[list(own.rows)]
        assert (theta >= own.lower).all() and (theta <= own.upper).all()
        assert all(
            abs(controller.estimate[states[n]]) <= most
            for n, most in own.limits.items()
            if n in states.names
        )
        assert np.isfinite(controller.estimator.calibrated.scale).all()


@pytest.mark.parametrize(
    ("adapt", "memory", "words"),
    [
        ({"weight": 0.1}, 10.0, "no parameter weight"),
        ({"mass": 0.0}, 10.0, "above zero"),
        ({}, math.nan, "memory is a time"),
        ({}, 10.0, "no parameter of this model differs"),
    ],
)
def test_what_cannot_be_learned_is_refused_in_one_line(adapt, memory, words):
    with pytest.raises(ModelError, match=words):
        TubeController(
            model=cases.disturbed(), problem=PROBLEM, reference=Hover(), adapt=adapt, memory=memory
        )
