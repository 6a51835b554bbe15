"""Of 95 % intervals of the shortest flights that an automatic fit takes, at least 90 % hold the truth.

    GREYBOX_FITS=100 python -m pytest -m slow THIS_FILE -s

Shorter ones are refused (test_too_few_samples_are_refused.py). The plain fit of simulated flights with a
gyro alone; a fit whose own verdict refuses it claims nothing and is counted apart.
"""

from __future__ import annotations

import os
from collections import Counter

import numpy as np
import pytest
from scipy.stats import beta

import greybox as gb
from tests.automatic.craft import flights, plant, vehicle

SECONDS = 4.0
FITS = int(os.environ.get("GREYBOX_FITS", "40"))


def at_most(held: int, of: int, level: float = 0.975) -> float:
    """Upper end of the exact interval of a share (Clopper and Pearson 1934, Biometrika 26(4))."""
    return 1.0 if held == of else float(beta.ppf(level, held + 1, of - held))


@pytest.mark.slow
def test_intervals_of_the_shortest_flights_hold_the_truth() -> None:
    truth = plant().truth()["parameters"]
    held, of, refused = Counter[str](), Counter[str](), 0
    for seed in range(500, 500 + FITS):
        found = gb.fit(vehicle(), flights(seeds=(seed,), seconds=SECONDS))
        refused += found.verdict is not None and found.verdict.refused
        for name, estimate in found.parameters.items():
            if name in truth and estimate.std and np.isfinite(estimate.std):
                of[name] += 1
                held[name] += abs(estimate.value - float(truth[name])) <= 1.96 * estimate.std
        print(f"{seed}: {dict(held)} of {dict(of)}, {refused} refused", flush=True)
    assert of, "no estimate has an error"
    assert sum(of.values()) >= FITS
    for name in of:
        assert at_most(held[name], of[name]) >= 0.9, (name, held[name], of[name])
    assert at_most(sum(held.values()), sum(of.values())) >= 0.9
