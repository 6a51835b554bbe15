"""Every effect of a simulated plant is the identity at its null, and none of them is idle away from
it."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.plants.battery import Battery
from greybox.plants.effects import (
    CATALOGUE,
    AccelerometerBias,
    AccelerometerLeverArm,
    AccelerometerScale,
    AxialInflow,
    BatterySag,
    BladeFlapping,
    CenterOfMassOffset,
    CommandDelay,
    CommandSaturation,
    ConstantForce,
    GroundEffect,
    GyroBias,
    GyroScale,
    ImuMisalignment,
    LinearDrag,
    MocapMisalignment,
    MotorLag,
    MotorLagAsymmetry,
    MotorLagSecond,
    MotorLagSpeed,
    ParasiticDrag,
    PayloadMass,
    PoseDelay,
    PoseLeverArm,
    ProductsOfInertia,
    RotationalDamping,
    RotorAsymmetry,
    RotorDrag,
    RotorGyroscopic,
    RotorSpeedDelay,
    RotorSpeedScale,
    SensorDelay,
    SteadyWind,
    ThrustCurve,
    ThrustLevel,
    TranslationalLift,
)
from greybox.plants.presets import NANO, nano
from greybox.plants.quadrotor import Quadrotor

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
    LinearDrag: LinearDrag(d_x=1e-3),
    ParasiticDrag: ParasiticDrag(c_x=1e-3),
    RotationalDamping: RotationalDamping(d_p=1e-6),
    RotorAsymmetry: RotorAsymmetry(delta=(0.02, -0.02, 0.0, 0.0)),
    RotorDrag: DRAG,
    MotorLagAsymmetry: MotorLagAsymmetry(a=0.4),
    MotorLagSpeed: MotorLagSpeed(hover=0.7, s=0.5),
    MotorLagSecond: MotorLagSecond(b=0.6),
    SteadyWind: SteadyWind(w_x=1.0),
    ThrustCurve: ThrustCurve(f=0.2),
    ThrustLevel: ThrustLevel(s=0.05),
    AccelerometerLeverArm: AccelerometerLeverArm(r_x=0.01),
    AccelerometerScale: AccelerometerScale(s_z=0.02),
    AxialInflow: AxialInflow(k_z=1e-6),
    CommandSaturation: CommandSaturation(a_hi=0.28),
    GroundEffect: GroundEffect(rotor_radius=0.0231, k=2.0),
    GyroScale: GyroScale(s_z=0.02),
    PayloadMass: PayloadMass(mu=0.05),
    PoseDelay: PoseDelay(d=0.007),
    PoseLeverArm: PoseLeverArm(r_x=0.01),
    ProductsOfInertia: ProductsOfInertia(Jxy=1e-6),
    RotorGyroscopic: RotorGyroscopic(J_r=1e-8),
    RotorSpeedDelay: RotorSpeedDelay(d=0.007),
    RotorSpeedScale: RotorSpeedScale(s=(0.05, -0.02, 0.0, 0.01)),
    SensorDelay: SensorDelay(d=0.007),
    TranslationalLift: TranslationalLift(k_h=1e-3),
}


NEEDED = {
    SteadyWind: (DRAG,),
    MotorLagAsymmetry: (MotorLag(tau=0.03),),
    MotorLagSpeed: (MotorLag(tau=0.03),),
    MotorLagSecond: (MotorLag(tau=0.03),),
}
"""What an effect is felt through."""


def flight(*effects):
    plant = Quadrotor(NANO, effects, battery=Battery())
    plant.reset(3, position=(0.0, 0.0, 0.1), velocity=(1.0, -0.5, 0.2), rates=(0.3, -0.2, 0.5))
    rows = []
    for k in range(40):
        u = [0.69 + 0.05 * np.sin(0.3 * k + i) for i in range(4)]
        rows.append(list(plant.measure(u).values()))
        plant.step(u, 0.01)
    return np.array(rows)


def null(kind):
    facts = {
        BatterySag: {"nominal_voltage": 3.8},
        GroundEffect: {"rotor_radius": 0.0231},
        MotorLagSpeed: {"hover": 0.7},
    }
    return kind(**facts.get(kind, {}))


@pytest.mark.parametrize("kind", CATALOGUE, ids=lambda k: k.name)
def test_null_is_identity(kind):
    base = NEEDED.get(kind, ())
    assert np.max(np.abs(flight(*base, null(kind)) - flight(*base))) < 1e-12


@pytest.mark.parametrize("kind", CATALOGUE, ids=lambda k: k.name)
def test_away_from_the_null_it_shows(kind):
    base = NEEDED.get(kind, ())
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
    """A command step arrives late by exactly the delay: compare with the same step commanded
    later."""
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
    assert plant.states()["nu1"] == pytest.approx(
        0.9 + (hover - 0.9) * np.exp(-0.07 / 0.03), abs=1e-14
    )


def test_a_rotor_may_spin_down_more_slowly_than_up():
    plant = Quadrotor(NANO, [MotorLag(tau=0.035), MotorLagAsymmetry(a=3 / 7)])
    hover = NANO.hover_speed
    plant.step([0.9, 0.5, hover, hover], 0.01)
    s = plant.states()
    assert s["nu1"] == pytest.approx(0.9 + (hover - 0.9) * np.exp(-0.5))
    assert s["nu2"] == pytest.approx(0.5 + (hover - 0.5) * np.exp(-0.2))


def test_a_late_pose_is_the_pose_of_that_instant_and_leaves_the_imu_alone():
    late, plain = Quadrotor(NANO, [PoseDelay(d=0.02)]), Quadrotor(NANO)
    seen = []
    for plant in (late, plain):
        plant.reset(0, rates=(1.0, -2.0, 0.5), velocity=(1.0, 0.0, 0.0))
        rows = []
        for k in range(12):
            u = [0.7 + 0.1 * np.sin(k + i) for i in range(4)]
            rows.append(plant.measure(u))
            plant.step(u, 0.01)
        seen.append(rows)
    for name in ("qw", "qx", "qy", "qz", "x", "y", "z", "vx", "vy", "vz"):
        assert [r[name] for r in seen[0][4:]] == pytest.approx(
            [r[name] for r in seen[1][2:-2]], abs=1e-5
        ), name
        assert seen[0][1][name] == pytest.approx(seen[1][0][name], abs=1e-12), (
            "before the flight nothing moved"
        )
    for name in ("p", "q", "r", "ax", "ay", "az"):
        assert [r[name] for r in seen[0]] == pytest.approx([r[name] for r in seen[1]], abs=1e-6), (
            name
        )


def test_a_late_imu_is_the_imu_of_that_instant_and_leaves_the_pose_alone():
    """A delay of one and a half samples: compare with a plant that is measured at half samples."""
    late, plain = (
        Quadrotor(NANO, [SensorDelay(d=0.015), MotorLag(tau=0.04)]),
        Quadrotor(NANO, [MotorLag(tau=0.04)]),
    )
    held, half = [], []
    for k in range(12):
        u = [0.7 + 0.1 * np.sin(k + i) for i in range(4)]
        held.append(late.measure())
        late.step(u, 0.01)
        for _ in range(2):
            half.append(plain.measure())
            plain.step(u, 0.005)
    for name in ("p", "q", "r", "ax", "ay", "az"):
        assert [r[name] for r in held[3:]] == pytest.approx(
            [r[name] for r in half[3:-4:2]], abs=2e-4
        ), name
    assert [r["vz"] for r in held] == pytest.approx([r["vz"] for r in half[::2]], abs=1e-6)


def test_ground_effect_has_its_published_size_and_stays_finite_on_the_floor():
    """One rotor radius above the ground, Cheeseman and Bennett: T / T_out = 1 / (1 - 1/16)."""
    radius = NANO.rotor_radius
    plant, plain = Quadrotor(NANO, [GroundEffect(rotor_radius=radius, k=1.0)]), Quadrotor(NANO)
    for p in (plant, plain):
        p.reset(0, position=(0.0, 0.0, radius))
    assert plant.measure()["az"] == pytest.approx(plain.measure()["az"] / (1.0 - 1.0 / 16.0))
    plant.reset(0, position=(0.0, 0.0, -0.1))
    assert plant.measure()["az"] == pytest.approx(plain.measure()["az"] / (1.0 - 1.0 / 4.0))


def test_climbing_costs_thrust_and_flying_sideways_gains_it():
    hover = Quadrotor(NANO).measure()["az"]
    plant = Quadrotor(NANO, [AxialInflow(k_z=1e-6)])
    plant.reset(0, velocity=(0.0, 0.0, 2.0))
    speed = NANO.speed_max * NANO.hover_speed
    assert plant.measure()["az"] == pytest.approx(hover - 4 * 1e-6 * speed * 2.0 / NANO.mass)
    plant = Quadrotor(NANO, [TranslationalLift(k_h=1e-3)])
    plant.reset(0, velocity=(3.0, 4.0, 0.0))
    assert plant.measure()["az"] == pytest.approx(hover + 4 * 1e-3 * 25.0 / NANO.mass)


def test_the_gyroscopic_moment_does_no_work_and_spinning_up_turns_the_body_the_other_way():
    effect = RotorGyroscopic(J_r=2e-8)
    plant, plain = Quadrotor(NANO, [effect]), Quadrotor(NANO)
    moments = []
    for p in (plant, plain):
        p.reset(0, rates=(2.0, -1.0, 3.0))
        _, _, turning = p.physics.accelerations(
            0.0, p._state, [0.8, 0.6, 0.9, 0.5], [0.0] * 4, 0.0, (0.0,) * 3, (0.0,) * 3
        )
        moments.append(np.array(NANO.inertia) * np.array(turning))
    moment = moments[0] - moments[1]
    total = 2e-8 * NANO.speed_max * (0.8 - 0.6 + 0.9 - 0.5)
    assert moment == pytest.approx(-np.cross([2.0, -1.0, 3.0], [0.0, 0.0, total]), rel=1e-12)
    assert moment @ [2.0, -1.0, 3.0] == pytest.approx(0.0, abs=1e-16)
    lag = MotorLag(tau=0.05)
    spun, idle = Quadrotor(NANO, [lag, effect]), Quadrotor(NANO, [lag])
    for p in (spun, idle):
        p.step([0.9, 0.5, 0.9, 0.5], 0.01)
    assert spun.states()["r"] < idle.states()["r"], (
        "counter-clockwise rotors speed up: the body turns clockwise"
    )


def test_a_saturated_rotor_stays_where_it_is():
    plant = Quadrotor(NANO, [CommandSaturation(a_lo=0.1, a_hi=0.2)])
    plant.step([0.05, 0.5, 0.8, 1.0], 0.01)
    assert [plant.states()[f"nu{i}"] for i in range(1, 5)] == pytest.approx([0.1, 0.5, 0.8, 0.8])


def test_clean_readings_keep_bias_scale_and_delay_but_no_noise():
    plant = nano([AccelerometerBias(b_x=0.1), AccelerometerScale(s_z=0.05)])
    seen, clean = plant.measure(), plant.measure(noise=False)
    assert clean["az"] == pytest.approx(1.05 * 9.80665, abs=0.3)
    assert seen["p"] != clean["p"] == 0.0
    assert plant.measure() == seen, "the noise is drawn once per step"
