"""rotor_speed_scale: measured rotor speeds read a little too much or too little."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from greybox.model.effect import Effect, Flow, Needs, ReferenceCase, vector_parameters
from greybox.model.effects.gyro_scale import POSSIBLE
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class RotorSpeedScale(Effect):
    """Omega_meas,i = (1 + s_i) Omega_i: pole pairs, the clock of a speed controller, or speed_max.

    Commands say nu, so that thrust and drag torque depend on no speed in rad/s: a share that all
    s_i have in common is that of speed_max as well, which falls with the battery. So every model of
    `greybox discover` has them, for each flight where no log says how full the battery was. Rotor
    speeds that drive the model have no such scale, as their common factor is one of the thrust.
    """

    name = "rotor_speed_scale"
    stage = "sensor"
    summary = "scale error of the measured speed of each rotor"
    formula = "Omega_meas,i = (1 + s_i) Omega_i"
    references = (
        "Betaflight documentation: bidirectional DShot and RPM filter (speeds from the electrical "
        "frequency and the number of magnet poles)",
    )
    validity = "constant over a flight; a share of all rotors may be that of speed_max"
    tags = frozenset({"linear-in-parameters"})
    needs = Needs(vehicle=("actuator.speed_max",), sensors=("rotor_speed",))
    order = 30
    case = ReferenceCase(
        parameters={"s_1": 0.05, "s_2": -0.02, "s_3": 0.0, "s_4": 0.01},
        flow={"measured": (1000.0, 500.0, 800.0, 700.0)},
        expected={"rotor_speed": (1050.0, 490.0, 800.0, 707.0)},
        working="1.05 * 1000, 0.98 * 500, 1 * 800, 1.01 * 700",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """s_1 .. s_n [-]."""
        return vector_parameters(
            "s_",
            [str(i + 1) for i in range(len(vehicle.rotors))],
            unit="-",
            scale=0.02,
            meaning="scale error of rotor",
            lower=-0.5,
            upper=0.5,
            possible=POSSIBLE,
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """One factor for each rotor."""
        scale: Expr = ca.vertcat(*p.values())
        return {"rotor_speed": (1 + scale) * flow.measured["rotor_speed"]}
