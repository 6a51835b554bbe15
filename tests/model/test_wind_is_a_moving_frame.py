"""Flying at v in a wind w is flying at v - w in still air: forces and moments cannot tell (Galilean
invariance)."""

from __future__ import annotations

import numpy as np
import pytest
from craft import CROOKED, flat, function, model_of, state, vector

from greybox.model.effects.steady_wind import SteadyWind

AIRSPEED = (
    *("rotor_drag", "linear_drag", "parasitic_drag", "blade_flapping"),
    *("axial_inflow", "translational_lift"),
)
SIZES = {
    "rotor_drag__k_x": 3e-5,
    "rotor_drag__k_y": 2e-5,
    "linear_drag__d_x": 0.2,
    "linear_drag__d_y": 0.3,
    "linear_drag__d_z": 0.1,
    "parasitic_drag__c_x": 0.02,
    "parasitic_drag__c_y": 0.03,
    "parasitic_drag__c_z": 0.01,
    "blade_flapping__k_flap": 2e-6,
    "axial_inflow__k_z": 3e-4,
    "translational_lift__k_h": 5e-3,
}
WIND = np.array([4.0, -3.0, 1.5])


def rates(effects, velocity, wind):
    model = model_of(CROOKED, "steady_wind", *effects)
    sizes = {k: v for k, v in SIZES.items() if k.split("__")[0] in effects}
    p = vector(
        model,
        **sizes,
        **dict(zip(("steady_wind__w_x", "steady_wind__w_y", "steady_wind__w_z"), wind)),
    )
    q = np.array([0.8, 0.3, -0.4, 0.2])
    x = state(model, velocity=velocity, attitude=q / np.linalg.norm(q), rate=[1.0, -2.0, 0.5])
    f = flat(function(model, "f")(x, [0.5, 0.6, 0.4, 0.55], p))
    return f[[i for i, n in enumerate(model.states.names) if not n.startswith("position")]]


@pytest.mark.parametrize(
    "effects", [(e,) for e in AIRSPEED] + [AIRSPEED], ids=lambda e: "+".join(e)
)
def test_only_the_airspeed_counts(effects):
    velocity = np.array([1.0, 2.0, -0.5])
    blown = rates(effects, velocity, WIND)
    np.testing.assert_allclose(
        blown, rates(effects, velocity - WIND, [0, 0, 0]), rtol=1e-9, atol=1e-9
    )
    assert np.abs(blown - rates(effects, velocity, [0, 0, 0])).max() > 1e-2


def test_wind_alone_is_not_felt():
    np.testing.assert_array_equal(
        rates((), np.array([1.0, 2.0, -0.5]), WIND), rates((), [1.0, 2.0, -0.5], [0, 0, 0])
    )


def test_no_air_sinks_as_fast_as_wind_blows():
    """A sinking wind of 6 m/s beside a flapping was the name of a damping that remembers."""
    along, across, up = SteadyWind().parameters(CROOKED)
    for d in (along, across):
        assert d.excess(-12.0) < 0
    assert up.excess(-5.94) > 0
    assert up.excess(1.5) < 0
