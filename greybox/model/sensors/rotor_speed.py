"""Rotor speed: where a log has it, as a measured output."""

from __future__ import annotations

from greybox.model.clock import ROTOR_CLOCK
from greybox.model.flow import Flow, unit_per_speed
from greybox.model.sensor import Sensor
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr, Signal


class RotorSpeed(Sensor):
    """omega1 .. omegan [rad/s]: Omega_i = speed_max nu_i; nu_i where speed_max is unknown."""

    name = "rotor_speed"
    group = "rotor_speed"
    summary = "speed of every rotor"
    clock = ROTOR_CLOCK
    usual = False

    def signals(self, vehicle: Vehicle) -> tuple[Signal, ...]:
        """omega1 .. omegan."""
        unit = unit_per_speed(vehicle, "rad/s", "-")
        return tuple(
            Signal(name=f"omega{i + 1}", unit=unit, meaning="rotor speed")
            for i in range(len(vehicle.rotors))
        )

    def innovation_signals(self, vehicle: Vehicle) -> tuple[Signal, ...]:
        """omega1 .. omegan."""
        return self.signals(vehicle)

    def typical_noise(self, vehicle: Vehicle) -> float:
        """A hundredth of the largest speed [rad/s]."""
        return 0.01 * float(vehicle.omega_scale)

    def reading(self, flow: Flow, specific_force: Expr) -> Expr:
        """Omega."""
        return flow.rotor_speed
