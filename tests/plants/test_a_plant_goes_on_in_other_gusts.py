"""`Quadrotor.branch`: a copy that goes on with other noise, or with none."""

from __future__ import annotations

import numpy as np

from greybox.plants.noise import ProcessNoise
from greybox.plants.presets import NANO, nano

HOVER = (0.69,) * 4


def gusty(seed: int = 1):
    """A craft in gusts that last a tenth of a second, after 20 samples."""
    plant = nano(
        process=ProcessNoise(drift_torque=1e-4, drift_force=0.1 * float(NANO.mass), drift_time=0.1)
    )
    plant.reset(seed)
    for _ in range(20):
        plant.step(HOVER)
    return plant


def after(plant, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Rates and torque after so many samples."""
    for _ in range(samples):
        plant.step(HOVER)
    told = plant.states()
    return np.array([told[n] for n in "pqr"]), np.array([told[f"torque_{a}"] for a in "xyz"])


def test_the_plant_itself_goes_on_as_if_nothing_had_branched():
    plant = gusty()
    after(plant.branch(5), 10)
    after(plant.branch(None), 10)
    np.testing.assert_array_equal(after(plant, 10)[0], after(gusty(), 10)[0])


def test_other_draws_are_other_gusts_and_the_same_draws_the_same():
    plant = gusty()
    one, same, other = (after(plant.branch(s), 30)[0] for s in (5, 5, 6))
    np.testing.assert_array_equal(one, same)
    assert np.abs(one - other).max() > 1e-3


def test_without_draws_what_lasts_fades_and_nothing_new_comes():
    plant = gusty()
    start = after(plant, 0)[1]
    np.testing.assert_allclose(after(plant.branch(None), 10)[1], start * np.exp(-1.0), rtol=1e-9)
