"""The plants of greybox.plants fly the same craft: the one simulator here that we wrote."""

from __future__ import annotations

from greybox.plants.effects import (
    AxialInflow,
    BatterySag,
    CommandDelay,
    MotorLag,
    ParasiticDrag,
    PlantEffect,
    RotorAsymmetry,
    RotorDrag,
    SteadyWind,
)
from greybox.plants.noise import ProcessNoise, SensorNoise
from greybox.plants.quadrotor import Quadrotor
from scenarios.foreign.craft import Craft


def in_house_plant(
    craft: Craft, *, sensors: SensorNoise | None = None, sample_time: float = 0.01
) -> Quadrotor:
    """The craft as a `Quadrotor`; gusts are a Gauss-Markov force and moment of the size that drag
    would give them."""
    frame, air = craft.airframe, craft.air
    effects: list[PlantEffect] = [MotorLag(tau=craft.lag)]
    if air.rotor_drag:
        effects.append(RotorDrag(k_x=air.rotor_drag, k_y=air.rotor_drag))
    if air.inflow:
        effects.append(AxialInflow(k_z=air.inflow))
    if any(air.parasitic):
        effects.append(
            ParasiticDrag(c_x=air.parasitic[0], c_y=air.parasitic[1], c_z=air.parasitic[2])
        )
    if any(air.wind):
        effects.append(SteadyWind(w_x=air.wind[0], w_y=air.wind[1], w_z=air.wind[2]))
    if craft.delay:
        effects.append(CommandDelay(d=craft.delay))
    if any(craft.uneven):
        effects.append(RotorAsymmetry(delta=craft.uneven))
    if craft.sag and frame.nominal_voltage is not None:
        effects.append(BatterySag(nominal_voltage=frame.nominal_voltage, c_V=craft.sag))
    # white noise of s sqrt(2 / T) drives a Gauss-Markov process of standard deviation s and time T
    drive = (2.0 / air.gust_time) ** 0.5
    hover = float(frame.hover_speed) * craft.speed_max
    push = drive * air.gusts * air.rotor_drag * hover * len(frame.rotors)
    xx, yy, zz = (drive * air.swirl * float(j) for j in frame.inertia)
    process = ProcessNoise(drift_force=push, drift_torque=(xx, yy, zz), drift_time=air.gust_time)
    return Quadrotor(
        frame,
        effects,
        battery=craft.battery,
        sensors=sensors,
        process=process,
        sample_time=sample_time,
    )
