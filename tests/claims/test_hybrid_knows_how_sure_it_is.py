"""Claim: on manoeuvres that nobody fitted the hybrid's stated regions cover what they say, and beat
the physics' density."""

from __future__ import annotations

import functools
from collections.abc import Mapping

import pytest

from greybox.residual.learn import Learned
from greybox.validation.horizon_table import GroupErrors
from scenarios.studies.hybrid_calibration import TARGETS, study

pytest.importorskip("gpytorch")


WIDE = {"position", "velocity"}
TOO_WIDE = pytest.mark.xfail(
    strict=True,
    reason="99.7 %, 99 at most are asked: between waypoints, where the noise ahead is calibrated, "
    "positions err by more than on circles and eights; see docs/studies/hybrid.md",
)


@functools.cache
def judged() -> tuple[Learned, Mapping[str, GroupErrors], Mapping[str, GroupErrors]]:
    """What was learned; errors of the physics and of the hybrid on unseen manoeuvres, by group."""
    # Of seeds 0 to 3 the one whose regions are hardest to keep from being too small.
    learned, checked = study(6, 15.0, 3, 40)
    physics, hybrid = checked["physics"].table, checked["hybrid"].table
    assert physics is not None
    assert hybrid is not None
    return learned, physics.groups, hybrid.groups


def missed(half_a_second: bool) -> list[str]:
    """Regions that hold more or less than they may: of positions and velocities half a second
    ahead, or all others."""
    out = []
    for name, own in judged()[2].items():
        assert own.coverage is not None
        for h, (low, high) in TARGETS.items():
            share = own.coverage[0.95][h - 1]
            if half_a_second == (h == 50 and name in WIDE) and not low <= share <= high:
                out.append(f"{name} at {h}: {share:.3f}")
    return out


@pytest.mark.slow
def test_regions_cover_and_errors_fall_on_unseen_manoeuvres() -> None:
    learned, physics, hybrid = judged()
    assert not learned.null
    assert not missed(half_a_second=False)
    for name, own in hybrid.items():
        before = physics[name]
        assert own.coverage is not None
        assert own.nlpd is not None
        assert before.nlpd is not None
        for h in TARGETS:
            assert own.nlpd[h - 1] < before.nlpd[h - 1], f"{name} at {h}"
            assert own.coverage[0.95][h - 1] >= TARGETS[h][0], f"{name} at {h}"
        for h in (10, 50):
            assert own.rmse[h - 1] < before.rmse[h - 1], f"{name} at {h}"


@pytest.mark.slow
@TOO_WIDE
def test_regions_of_positions_half_a_second_ahead_are_not_too_wide() -> None:
    assert not missed(half_a_second=True)
