"""The tube grows where errors of forecasts turn out larger than the model says, and by as much."""

from __future__ import annotations

import numpy as np
import pytest

from mpc_export.tube.calibrated import MOST
from tests.mpc_export.tube.test_controller_flies_and_survives import fly, pilot


@pytest.fixture
def controller():
    return pilot(calibrate=True)


def test_planes_and_tilt_are_tightened_by_the_scales_of_what_they_bound(controller):
    controller.start()
    own = controller.estimator.calibrated
    names = controller.filter.innovations.names
    own.scale[names.index("position.x")] = 3.0
    own.scale[names.index("position.y")] = [1.0, 1.0, 1.25, 2.5, 2.5]
    own.scale[names.index("attitude.y")] = 1.5
    planes = np.zeros((3, 2, 4))
    planes[:, 0, 0], planes[:2, 1, :2] = 1.0, [0.6, -0.8]
    ahead = np.array([0.05, 0.175, 9.0])
    found = own.wider(ahead, planes)
    np.testing.assert_allclose(found[:, 0], 3.0)
    between = 1.25 * np.sqrt(
        2.0
    )  # half way from 0.1 to 0.25 s, where the logarithm is interpolated
    np.testing.assert_allclose(
        found[:2, 1], [np.hypot(0.6 * 3, 0.8), np.hypot(0.6 * 3, 0.8 * between)]
    )
    assert found[2, 1] == 1.0, "no plane there"
    np.testing.assert_allclose(found[:, 2], 1.5)
    own.scale[names.index("attitude.y")] = 20.0
    np.testing.assert_allclose(own.wider(ahead, planes)[:, 2], MOST)
    own.scale[:] = 0.2
    np.testing.assert_array_equal(own.wider(ahead, planes), 1.0, "calm air frees no limit")


def test_noise_of_three_times_its_level_is_met_and_forgotten_by_half_in_46_samples(controller):
    """Of the pose, then none: errors one sample ahead are of the sensor alone, as the plant itself
    has no noise."""
    rng = np.random.default_rng(0)
    sensor = dict(
        zip(controller.filter.innovations.names, controller.filter.noise.sensor, strict=True)
    )
    late: list[float] = []

    def shaken(k, y):
        size = 3.0 if k < 250 else 0.0
        late.append(float(controller.estimator.calibrated.scale[0, 0]))
        return y | {n: y[n] + size * sensor[f"position.{n}"] * rng.standard_normal() for n in "xyz"}

    fly(controller, 300, seen=shaken)
    innovation = np.sqrt(controller.filter.noise.innovation[0, 0])
    assert np.mean(late[150:250]) == pytest.approx(3.0 * sensor["position.x"] / innovation, rel=0.3)
    assert late[-1] / late[-40] == pytest.approx(0.5 ** (39 / 46.2), rel=0.01)
    assert controller.solver.data["wider"][1, -1] > 0.0
    assert not [e for e in controller.events if not e.what.startswith("doubted")]
