"""A position that errs for seconds (GPS) gets noise that lasts, and white noise of a position is asked
for none."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.automatic.decide import Decided, decide
from greybox.automatic.facts import facts_of
from greybox.automatic.filters import lasting_poses
from greybox.automatic.fit import prepare
from greybox.automatic.setting import Given
from greybox.data import Dataset
from tests.automatic.craft import IMU, POSE, flight, flown, vehicle

DT, EVERY = 0.01, 5
VELOCITY = ("vx", "vy", "vz")
SIGMA, TIME = 0.3, 15.0
"""Of the error that lasts [m, s]."""


def decided(lasts: bool, **choices: object) -> Decided:
    parts = []
    rng = np.random.default_rng(5)
    for i, columns in enumerate(flown(seeds=(1, 2), seconds=8.0)):
        seen, n = dict(columns), len(columns["t"])
        for c in ("x", "y", "z"):
            error, track = SIGMA * rng.standard_normal(), np.zeros(n)
            kept = np.exp(-DT / TIME)
            for k in range(n):
                error = kept * error + SIGMA * np.sqrt(1 - kept**2) * rng.standard_normal()
                track[k] = error
            seen[c] = seen[c] + (track if lasts else 0.01 * rng.standard_normal(n))
            seen[c][np.arange(n) % EVERY != 0] = np.nan
        for c in VELOCITY:
            seen[c] = seen[c] + 0.05 * rng.standard_normal(n)
            seen[c][np.arange(n) % EVERY != 0] = np.nan
        parts.append(flight(seen, f"run{i}", (*IMU, *POSE, *VELOCITY)).flights[0])
    ready = prepare(vehicle(), Dataset(flights=tuple(parts)))
    given = Given(effects=("motor_lag", "command_delay"), choices=choices)  # type: ignore[arg-type]
    return decide(vehicle(), ready.data, facts_of(ready.data, vehicle(), ready.report), given)


def test_noise_that_lasts_is_found_where_it_is():
    found = decided(lasts=True)
    assert found.recipe.options.noise_parts == ("coloured.position",)
    (one,) = [d for d in found.decisions if d.about == "noise of the pose"]
    assert one.choice.startswith("coloured.position") and one.option == "--noise-parts"
    assert found.candidate is not None
    assert found.candidate.likelihood["coloured.position.T"].value > 2.0


@pytest.mark.slow
def test_pieces_left_out_are_foretold_better_with_it_than_without():
    found, without = (decided(lasts=True, **k).candidate for k in ({}, {"noise_parts": ()}))
    assert found is not None and without is not None
    assert found.score.mean < without.score.mean


def test_a_position_with_white_noise_is_not_asked():
    found = decided(lasts=False)
    assert found.candidate is not None
    assert "coloured.position" not in [p.name for p in lasting_poses(found.candidate.likelihood)]
    assert "coloured.position" not in found.recipe.options.noise_parts
