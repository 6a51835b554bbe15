"""`--from` takes the numbers of a model with their errors as the prior, and offers its effects no
more."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from greybox.discovery.cause import Causes, offer
from greybox.discovery.evidence import choices
from greybox.estimation.options import FitOptions
from greybox.estimation.prior import Prior
from greybox.model.effects import effect_by_name
from greybox.model.identified import IdentifiedModel
from greybox.model.known import since
from greybox.model.model import build_model
from tests.discovery.small_world import flown, vehicle

EFFECTS = tuple(effect_by_name(n) for n in ("rotational_damping", "payload_mass"))
KNOWN = {"rotational_damping.d_p": (4e-3, 1e-4), "thrust.c2": (1.1e-5, 1e-7)}


class StandIn(SimpleNamespace):
    """A model, as far as its errors go."""

    joint_covariance = IdentifiedModel.joint_covariance


def identified() -> IdentifiedModel:
    """A model with damping, as far as a search looks at it."""
    model: Any = StandIn(
        values={n: v for n, (v, _) in KNOWN.items()} | {"payload_mass.mu": 0.1},
        covariance=np.diag([s**2 for _, s in KNOWN.values()]),
        covariance_names=tuple(KNOWN),
        standard_errors={n: s for n, (_, s) in KNOWN.items()},
        considered={},
        form_errors={},
        per_flight={},
        flight_spread={"payload_mass.mu": (0.1, 0.5)},
        flight_covariance=np.zeros((0, 0)),
        dynamics=build_model(vehicle(), flown().channels, EFFECTS, input="command"),
    )
    return cast(IdentifiedModel, model)


def causes() -> Causes:
    return offer(vehicle(), flown().channels, sample_time=0.01, known=since(identified()))


def test_its_effects_are_in_every_model_and_are_no_causes():
    found = causes()
    assert {"rotational_damping", "payload_mass"} <= {e.name for e in found.built(()).core.effects}
    assert not {"rotational_damping", "payload_mass"} & set(found.offered)
    assert "rotor_drag" in found.offered


def test_its_numbers_with_their_errors_are_the_prior():
    found = causes()
    options = choices(found, FitOptions(), frozenset(), found.built(()))
    for name, prior in KNOWN.items():
        assert options.priors[name] == Prior(*prior)
        assert options.values[name] == prior[0]


def test_what_differs_from_flight_to_flight_is_known_with_that_spread():
    assert causes().known["payload_mass.mu"] == (0.1, 0.5)


def test_the_mass_and_what_the_model_held_are_held():
    model = identified()
    model.values["mass"] = 0.7
    model.values["torque.c2"] = 1e-7
    model.considered = {"mass": (7e-3, {"thrust.c2": 1.5e-5}), "torque.c2": (1e-8, {})}  # type: ignore[misc]
    known = since(model)
    assert known.held == {"mass": 0.7, "torque.c2": 1e-7}
    found = offer(vehicle(), flown().channels, sample_time=0.01, known=known)
    assert not {"mass", "torque.c2"} & set(found.core)
    assert "thrust.c2" in found.core
    assert found.untold == known.untold
