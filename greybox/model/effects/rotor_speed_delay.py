"""rotor_speed_delay: measured rotor speeds come later than commands and IMU."""

from __future__ import annotations

from collections.abc import Mapping

from greybox.data.drive import LATE_SPEEDS
from greybox.model.clock import ROTOR_CLOCK
from greybox.model.effect import Effect, Flow, Needs, ReferenceCase, delay_parameters
from greybox.model.parameter import Parameter
from greybox.model.sensors import on_clock
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class RotorSpeedDelay(Effect):
    """Measured rotor speeds are those of t - d; commands and all other sensors are those of t.

    Speed controllers report by telemetry, which takes its time. Going back a lag of the rotors
    would let them run away, so rotors that follow the same commands d later are states of their
    own: exact however long d is. A negative d means that commands and IMU are the later ones. Where
    rotor speeds drive the model, command_delay says the same.
    """

    name = "rotor_speed_delay"
    stage = "sensor"
    summary = "measured rotor speeds are seen later than commands and IMU"
    formula = "y_rotors(t) = Omega(t - d)"
    references = (
        "Li and Mourikis 2014, Online temporal calibration for camera-IMU systems, IJRR 33(7)",
    )
    validity = "no rotor shows what was not sent yet: -d is at most the delay of the commands"
    needs = Needs(sensors=on_clock(ROTOR_CLOCK), effects=("motor_lag",))
    order = 5
    early = frozenset({"rotor_speed_delay"})
    case = ReferenceCase(
        parameters={"d": 0.014},
        flow={},
        expected={"rotor_speed_delay": 0.014},
        working="the delay is the parameter itself",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """d [s]."""
        return delay_parameters("delay of the rotor speeds", -LATE_SPEEDS, LATE_SPEEDS)

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """Delays of a clock add."""
        return {"rotor_speed_delay": p["d"]}
