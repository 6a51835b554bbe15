"""steady_wind: the air moves."""

from __future__ import annotations

import math
from collections.abc import Mapping

import casadi as ca

from greybox.model.effect import Declaration, Effect, Flow, Needs, ReferenceCase, vector_parameters
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr

BREEZE = 4.0
"""Typical wind [m/s], a gentle breeze: 3.4 to 5.4 m/s (World Meteorological Organization, Guide to
Instruments and Methods of Observation, Beaufort scale)."""
RISES = 0.05
"""Its part upwards: near the ground the mean flow is along it, inclined by a third of
`STEEPEST`."""
STEEPEST = math.radians(8.0)
"""Largest inclination of the mean flow [rad] (IEC 61400-1, 6.3)."""
STRONGEST = 30.0
"""Largest wind along one axis [m/s]; no air rises or sinks faster than that so inclined."""


class SteadyWind(Effect):
    """Every airspeed is R^T (v - w), w constant in the world during a flight.

    Wind has no force of its own: without an effect that looks at the airspeed nothing feels it.
    """

    name = "steady_wind"
    stage = "wrench"
    summary = "constant wind, felt through the drag terms"
    formula = "v_a,i = R^T (v - w) + omega x r_i"
    references = (
        "Folk, Paulos and Kumar 2023, RotorPy: a Python-based multirotor simulator with "
        "aerodynamics, arXiv:2306.04485",
    )
    validity = "constant over a flight, the same at every height"
    tags = frozenset({"linear-in-parameters"})
    needs = Needs(
        effects=(
            "rotor_drag",
            "linear_drag",
            "parasitic_drag",
            "blade_flapping",
            "axial_inflow",
            "translational_lift",
        )
    )
    early = frozenset({"wind"})
    case = ReferenceCase(
        parameters={"w_x": 1.0, "w_y": -2.0, "w_z": 0.5},
        flow={},
        expected={"wind": (1.0, -2.0, 0.5)},
        working="the parameters are the wind itself, in world axes",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """w_x, w_y, w_z [m/s] world; scope flight."""
        every: Declaration = {"scope": "flight", "lower": -STRONGEST, "upper": STRONGEST}
        up: Declaration = {**every, "possible": STRONGEST * math.tan(STEEPEST)}
        return tuple(
            parameter
            for letters, scale, of in (("xy", BREEZE, every), ("z", BREEZE * RISES, up))
            for parameter in vector_parameters(
                "w_", letters, unit="m/s", meaning="wind", scale=scale, **of
            )
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """Winds add; the model knows the total before it asks for any airspeed."""
        return {"wind": ca.vertcat(p["w_x"], p["w_y"], p["w_z"])}
