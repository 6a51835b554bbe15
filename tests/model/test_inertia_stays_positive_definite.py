"""No value within the bounds of products_of_inertia makes an inertia matrix that a body cannot turn
with."""

from __future__ import annotations

import itertools
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from craft import CROOKED, vehicle_of

from greybox.model.effects.products_of_inertia import ProductsOfInertia
from greybox.plants.presets import DUCKIEDRONE, X250

EFFECT = ProductsOfInertia()
LONG = ((2e-3, 9e-4, 0.0), (9e-4, 1.2e-3, -2e-4), (0.0, -2e-4, 2.6e-3))


def increments(vehicle):
    """The increments at every corner and in the middle of every face of the box of bounds."""
    declared = EFFECT.parameters(vehicle)
    for signs in itertools.product((-1, 0, 1), repeat=3):
        own = {d.name: s * d.upper for d, s in zip(declared, signs, strict=True)}
        yield ca.DM(EFFECT.apply(None, own)["inertia_increment"]).full()


@pytest.mark.parametrize(
    "vehicle",
    [
        vehicle_of(X250),
        vehicle_of(CROOKED),
        vehicle_of(DUCKIEDRONE),
        replace(vehicle_of(X250), inertia=LONG),
    ],
    ids=["x250", "crooked", "duckiedrone", "long"],
)
def test_every_corner_of_the_bounds_is_a_body_with_moments_down_to_the_promised_share(vehicle):
    stated = np.array(vehicle.inertia)
    root = np.sqrt(np.diag(stated))
    room = np.linalg.eigvalsh(stated / np.outer(root, root))[0]
    smallest = 1.001 * (1 - room / 2)
    for increment in increments(vehicle):
        np.testing.assert_array_equal(increment, increment.T)
        assert not np.diag(increment).any()
        for shares in itertools.product((smallest, 1.0, 1.5), repeat=3):
            moments = np.diag((np.array(shares) - 1) * np.diag(stated))
            assert np.linalg.eigvalsh(stated + increment + moments)[0] > 0


def test_the_bounds_leave_room():
    """Of a diagonal matrix: a quarter of the moments, as for principal axes that are turned by more
    than ten degrees."""
    limits = [p.upper for p in EFFECT.parameters(vehicle_of(X250))]
    j = np.diag(np.array(vehicle_of(X250).inertia))
    assert limits == pytest.approx(
        [0.25 * np.sqrt(j[a] * j[b]) for a, b in ((0, 1), (0, 2), (1, 2))]
    )
