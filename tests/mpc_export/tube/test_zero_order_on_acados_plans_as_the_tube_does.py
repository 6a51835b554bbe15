"""zoRO on acados behind the controller's filter: without tightening its plan is the tube's, with it
it keeps off a plane."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from mpc_export.acados import session
from mpc_export.tube.controller import TubeController
from mpc_export.tube.on_acados import ZeroOrder
from mpc_export.tube.problem import TubeProblem
from tests.mpc_export import cases, consumers

WALL = np.array([[1.0, 0.0, 0.0, 0.15]])


class Beyond:
    """A place 0.2 m ahead, behind the wall."""

    def sample(self, time):
        zero = np.zeros((len(time), 3))
        place = zero + np.array([0.2, 0.0, 0.0])
        return SimpleNamespace(position=place, velocity=zero, acceleration=zero, yaw=zero[:, 0])


def plans(pilot, count):
    """Positions along x of the last of `count` plans from rest at the origin."""
    place = np.zeros(pilot.functions.sizes["n_x"])
    place[:] = pilot.solver.stages.steady[0]
    place[pilot._rows("position")] = 0.0
    pilot.start(place)
    for k in range(count):
        pilot._decide(k * pilot.problem.dt)
        assert not pilot.events, pilot.events
    return pilot.solver.data["x"][:, pilot._rows("position")[0]].copy()


@pytest.mark.slow
@consumers.needs("acados")
def test_zero_order_on_acados_plans_as_the_tube_does(tmp_path, monkeypatch):
    model = cases.disturbed()
    problem = TubeProblem(dt=model.sample_time, horizon=15, planes=1)
    pilot = TubeController(
        model=model,
        problem=problem,
        reference=Beyond(),
        planes=lambda times: np.tile(WALL, (len(times), 1, 1)),
        kappa=(0.0, 0.0),
    )
    ours = plans(pilot, 60)
    monkeypatch.chdir(tmp_path)
    with session(consumers.ACADOS) as home:
        inner, found = pilot.solver, {}
        for kappa in (0.0, 2.0):
            pilot.solver = ZeroOrder(inner, WALL, kappa, home, tmp_path, optimise="-O0")
            found[kappa] = plans(pilot, 60)
    np.testing.assert_allclose(found[0.0], ours, atol=1e-3)
    assert found[2.0].max() < found[0.0].max()
