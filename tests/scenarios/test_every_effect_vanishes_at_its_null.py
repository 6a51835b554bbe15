"""Every effect of a simulated plant is the identity at its null, and none of them is idle away from it."""

from __future__ import annotations

import numpy as np
import pytest

from scenarios.plants.battery import Battery
from scenarios.plants.effects import (
    CATALOGUE,
    AccelerometerBias,
    BatterySag,
    BladeFlapping,
    CenterOfMassOffset,
    CommandDelay,
    ConstantForce,
    GyroBias,
    ImuMisalignment,
    MocapMisalignment,
    MotorLag,
    ParasiticDrag,
    RotationalDamping,
    RotorAsymmetry,
    RotorDrag,
    SteadyWind,
    ThrustCurve,
)
from scenarios.plants.presets import NANO
from scenarios.plants.quadrotor import Quadrotor

DRAG = RotorDrag(k_x=1e-6, k_y=1e-6)
AWAY = {
    AccelerometerBias: AccelerometerBias(b_x=0.1),
    BatterySag: BatterySag(nominal_voltage=3.8, c_V=1.0),
    BladeFlapping: BladeFlapping(k_flap=1e-9),
    CenterOfMassOffset: CenterOfMassOffset(c_y=1e-3),
    CommandDelay: CommandDelay(d=0.013),
    ConstantForce: ConstantForce(f_x=0.01),
    GyroBias: GyroBias(b_y=0.02),
    ImuMisalignment: ImuMisalignment(theta_x=0.02),
    MocapMisalignment: MocapMisalignment(theta_y=0.02),
    MotorLag: MotorLag(tau=0.03),
    ParasiticDrag: ParasiticDrag(c_x=1e-3),
    RotationalDamping: RotationalDamping(d_p=1e-6),
    RotorAsymmetry: RotorAsymmetry(delta=(0.02, -0.02, 0.0, 0.0)),
    RotorDrag: DRAG,
    SteadyWind: SteadyWind(w_x=1.0),
    ThrustCurve: ThrustCurve(f=0.2),
}


def flight(*effects):
    plant = Quadrotor(NANO, effects, battery=Battery())
    plant.reset(3, velocity=(1.0, -0.5, 0.2), rates=(0.3, -0.2, 0.5))
    rows = []
    for k in range(40):
        u = [0.69 + 0.05 * np.sin(0.3 * k + i) for i in range(4)]
        rows.append(list(plant.measure(u).values()))
        plant.step(u, 0.01)
    return np.array(rows)


def null(kind):
    return BatterySag(nominal_voltage=3.8) if kind is BatterySag else kind()


@pytest.mark.parametrize("kind", CATALOGUE, ids=lambda k: k.name)
def test_null_is_identity(kind):
    base = () if kind is not SteadyWind else (DRAG,)
    assert np.max(np.abs(flight(*base, null(kind)) - flight(*base))) < 1e-12


@pytest.mark.parametrize("kind", CATALOGUE, ids=lambda k: k.name)
def test_away_from_the_null_it_shows(kind):
    base = () if kind is not SteadyWind else (DRAG,)
    assert np.max(np.abs(flight(*base, AWAY[kind]) - flight(*base))) > 1e-5


def test_small_lag_and_delay_are_continuous_at_zero():
    moved = flight(MotorLag(tau=1e-6))[-1] - flight()[-1]
    assert np.max(np.abs(moved[5:12])) < 1e-4
    moved = flight(CommandDelay(d=1e-6))[-1] - flight()[-1]
    assert np.max(np.abs(moved[5:12])) < 1e-4


def test_wind_without_drag_does_nothing():
    assert np.array_equal(flight(SteadyWind(w_x=3.0)), flight())


def test_asymmetry_must_sum_to_zero():
    with pytest.raises(ValueError, match="thrust map"):
        RotorAsymmetry(delta=(0.1, 0.0, 0.0, 0.0))


def test_a_delay_of_two_samples_and_a_half_is_exact():
    """A command step arrives late by exactly the delay: compare with the same step commanded later."""
    late, early = Quadrotor(NANO, [CommandDelay(d=0.025)]), Quadrotor(NANO)
    hover, up = NANO.hover_speed, 0.8
    for k in range(20):
        late.step([up if k >= 5 else hover] * 4, 0.01)
    for _ in range(15):
        early.step([hover] * 4, 0.005)
    for _ in range(25):
        early.step([up] * 4, 0.005)
    assert late.states()["z"] == pytest.approx(early.states()["z"], abs=1e-10)
    assert late.states()["vz"] == pytest.approx(early.states()["vz"], abs=1e-10)


def test_motor_lag_is_the_exact_exponential():
    plant = Quadrotor(NANO, [MotorLag(tau=0.03)])
    hover = NANO.hover_speed
    for _ in range(7):
        plant.step([0.9] * 4, 0.01)
    assert plant.states()["nu1"] == pytest.approx(0.9 + (hover - 0.9) * np.exp(-0.07 / 0.03), abs=1e-14)


def test_a_rotor_may_spin_down_more_slowly_than_up():
    plant = Quadrotor(NANO, [MotorLag(tau=0.02, tau_down=0.05)])
    hover = NANO.hover_speed
    plant.step([0.9, 0.5, hover, hover], 0.01)
    s = plant.states()
    assert s["nu1"] == pytest.approx(0.9 + (hover - 0.9) * np.exp(-0.5))
    assert s["nu2"] == pytest.approx(0.5 + (hover - 0.5) * np.exp(-0.2))
