"""A rotor without damping of its own that is switched off: d nu / dt = -nu^2 / (2 nu_h tau), which
ends at rest after a long time, not with a division by the rate that is zero there."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.plants.actuators import Actuators
from greybox.plants.effects import MotorLag, MotorLagSpeed


@pytest.mark.parametrize("hover", [0.5, np.array([0.4, 0.6])])
@pytest.mark.parametrize("seconds", [0.01, 0.3])
def test_it_slows_down_as_the_equation_says(hover, seconds):
    tau, start = 0.05, 0.6
    actuators = Actuators((MotorLag(tau=tau), MotorLagSpeed(hover=hover, s=1.0)), 4)
    actuators.reset(start)
    actuators.target = [0.0] * 4
    for speed in actuators.relax(seconds)[0]:
        assert speed == pytest.approx(start / (1.0 + start * seconds / (2.0 * hover * tau)))
