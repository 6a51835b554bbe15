"""What is constant in a flight does not pay for a gust that blew before it: adaptation says how
little it knows."""

from __future__ import annotations

import numpy as np

from greybox.estimation.filtering import Filter
from greybox.model.identified import IdentifiedModel
from greybox.model.parameter import ParameterValues
from greybox.validation.adapt import adapt_to_flight
from tests import gusty

SECONDS = 1.0


def truth() -> IdentifiedModel:
    """The model of gusty carts with the time constant and the level of the gusts; b differs between
    flights."""
    dynamics = gusty.model()
    return IdentifiedModel(
        dynamics=dynamics,
        values=ParameterValues({"b": 0.0, "disturbance.v.T": gusty.TIME}),
        process_noise=np.array([gusty.LEVELS[f"noise.process.{n}"] for n in dynamics.noises.names]),
        sensor_noise=dynamics.sensor_scale(),
        weak=np.full(len(dynamics.error_states), 200.0),
        reference_state=dynamics.reference({}),
        reference_inputs=np.zeros(1),
        sample_time=gusty.DT,
        flight_spread={"b": (0.0, 3 * gusty.SIGMA)},
    )


def test_errors_of_adaptation_in_gusts_are_as_large_as_it_says():
    """No ride has a force of its own; half a time constant of gusts cannot say so, and must not
    look as if it could."""
    model = truth()
    settled = Filter(model, use_compiler=False).riccati
    found = [
        adapt_to_flight(model, f, SECONDS, riccati=settled, use_compiler=False)
        for f in gusty.rides(30)
    ]
    off, said = np.array([[a.values["b"], a.std["b"]] for a in found]).T
    assert 0.7 < np.sqrt(np.mean((off / said) ** 2)) < 1.4
    gust = model.dynamics.error_states.names.index("d_disturbance.v")
    starts = np.array([a.x0_sigma[gust] for a in found if a.x0_sigma is not None])
    assert (starts > 0.5 * said).all(), "what b may have of it, the gust may have"
