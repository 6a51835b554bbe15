"""Excitation signals have the amplitude, band and timing of their design; references are smooth and
start at rest."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.excitation import (
    Chirp,
    Circle,
    Doublets,
    Excitation,
    FigureEight,
    Hover,
    Lemniscate,
    Multichirp,
    Multisine,
    RandomSteps,
    RandomWaypoints,
    RotorForces,
    ThreeTwoOneOne,
    Total,
    Windowed,
    rich_excitation,
)
from greybox.plants.controller import CascadeController, Setpoint
from greybox.plants.presets import DUCKIEDRONE

TIME = 0.01 * np.arange(4000)


def rng(seed=0):
    return np.random.default_rng(seed)


def test_multisine_has_its_rms_and_stays_in_its_band():
    signal = Multisine(rms=2.0, low=0.5, high=5.0)(TIME, rng())
    assert np.sqrt(np.mean(signal**2)) == pytest.approx(2.0, rel=0.05)
    power = np.abs(np.fft.rfft(signal * np.hanning(TIME.size))) ** 2
    frequency = np.fft.rfftfreq(TIME.size, 0.01)
    inside = (frequency > 0.4) & (frequency < 5.1)
    assert power[inside].sum() > 0.999 * power.sum()


def test_mixer_inputs_are_excited_independently():
    mixer, setpoint = rich_excitation().sample(TIME, rng())
    correlation = np.corrcoef(mixer.T) - np.eye(4)
    assert np.max(np.abs(correlation)) < 0.1
    assert not setpoint.any()


def test_naming_one_more_channel_leaves_the_others_as_they_were():
    sines = Multisine(rms=1.0)
    one, _ = Excitation(mixer={"roll": sines}).sample(TIME, rng(3))
    two, _ = Excitation(mixer={"thrust": sines, "roll": sines}).sample(TIME, rng(3))
    assert np.array_equal(one[:, 1], two[:, 1])


def test_unknown_channel_is_refused():
    with pytest.raises(ValueError, match="rol;"):
        Excitation(mixer={"rol": Multisine(rms=1.0)})


def test_doublets_go_up_then_down_and_average_to_zero():
    signal = Doublets(amplitude=3.0, width=0.2, period=2.0)(TIME, rng())
    assert signal[5] == 3.0
    assert signal[25] == -3.0
    assert signal[45] == 0.0
    assert signal[205] == -3.0, "every second one starts downwards"
    assert abs(signal.sum()) < 1e-9


def test_three_two_one_one_has_its_lengths():
    signal = ThreeTwoOneOne(amplitude=1.0, unit=0.1, period=4.0)(TIME[:400], rng())
    edges = np.flatnonzero(np.diff(signal)) + 1
    assert edges.tolist() == [30, 50, 60, 70]


def test_chirp_sweeps_from_low_to_high():
    time = 0.001 * np.arange(20000)
    signal = Chirp(amplitude=1.0, low=0.5, high=8.0, length=20.0)(time, rng())
    crossings = time[1:][np.diff(np.signbit(signal).astype(int)) != 0]
    rate = 0.5 / np.diff(crossings)
    # cycles(t) = (f(t) - low) / k with f growing like exp(k t)
    cycles = 0.75 + 0.5 * np.arange(rate.size - 1)
    assert rate[:-1] == pytest.approx(0.5 + np.log(16.0) / 20.0 * cycles, rel=0.03)
    assert np.max(np.abs(signal)) <= 1.0


@pytest.mark.parametrize(
    "reference",
    [
        Hover(yaw_rate=0.3),
        Circle(),
        FigureEight(heading=0.5),
        Lemniscate(climb=0.2),
        RandomWaypoints(yaw_swing=0.5),
    ],
    ids=lambda r: type(r).__name__,
)
def test_references_start_at_rest_and_their_derivatives_agree(reference):
    path = reference.sample(TIME, rng(1))
    assert path.position.shape == path.velocity.shape == path.acceleration.shape == (4000, 3)
    assert np.linalg.norm(path.velocity[0]) < 0.05
    integrated = path.position[0] + np.cumsum(0.01 * path.velocity, axis=0)
    assert np.max(np.abs(integrated - path.position)) < 0.05
    assert np.max(np.abs(path.acceleration)) < 12.0


def test_waypoints_differ_by_seed_and_stay_in_their_box():
    a, b = (RandomWaypoints().sample(TIME, rng(s)).position for s in (1, 2))
    assert np.max(np.abs(a - b)) > 0.5
    assert np.all(np.abs(a - [0, 0, 1]) <= np.array([1.5, 1.5, 0.4]) + 1e-9)


def test_circle_turns_at_its_radius_and_period():
    path = Circle(radius=1.5, period=4.0, ramp=2.0).sample(TIME, rng())
    late = path.velocity[1000:-1]
    assert np.linalg.norm(late, axis=1) == pytest.approx(2 * np.pi * 1.5 / 4.0, rel=1e-3)


def test_a_multichirp_excites_its_whole_band_at_all_times_and_nothing_else():
    signal = Multichirp(rms=1.5, low=0.5, high=20.0, count=6, sweep=4.0)(TIME, rng(2))
    assert np.sqrt(np.mean(signal**2)) == pytest.approx(1.5, rel=0.1)
    frequency = np.fft.rfftfreq(800, 0.01)
    for start in range(0, 4000, 800):
        power = np.abs(np.fft.rfft(signal[start : start + 800] * np.hanning(800))) ** 2
        bands = [
            power[(frequency >= low) & (frequency < high)].sum()
            for low, high in ((0.5, 2), (2, 7), (7, 21))
        ]
        assert min(bands) > 0.05 * power.sum()
        assert power[frequency > 22.0].sum() < 0.01 * power.sum()


def test_windows_switch_a_signal_on_and_off_and_totals_add_up():
    steady = Windowed(
        signal=RandomSteps(amplitude=1.0), windows=((1.0, 2.0), (10.0, 1.0)), fade=0.0
    )(TIME, rng())
    plain = RandomSteps(amplitude=1.0)(TIME, rng())
    inside = ((TIME > 1.001) & (TIME < 2.999)) | ((TIME > 10.001) & (TIME < 10.999))
    assert np.array_equal(steady[inside], plain[inside])
    assert not steady[(TIME < 0.999) | ((TIME > 3.001) & (TIME < 9.999)) | (TIME > 11.001)].any()
    wave = Multisine(rms=1.0, count=60)
    size = [np.sqrt(np.mean(Total(signals=(wave, wave))(TIME, rng(s)) ** 2)) for s in range(8)]
    assert np.mean(size) == pytest.approx(np.sqrt(2.0), rel=0.1), (
        "two independent draws, not one twice"
    )


def test_random_steps_hold_their_levels_as_long_as_they_promise():
    signal = RandomSteps(amplitude=0.7, shortest=0.5, longest=1.0)(TIME, rng(4))
    lengths = np.diff(np.flatnonzero(np.diff(signal)))
    assert lengths.min() >= 49
    assert lengths.max() <= 101
    assert np.max(np.abs(signal)) <= 0.7


def test_thrust_added_to_one_rotor_reaches_that_rotor_alone():
    """Through the controller's mixer, which knows wrenches only."""

    def push(time, _):
        return np.full_like(time, 0.3)

    def still(time, _):
        return np.zeros_like(time)

    design = RotorForces(airframe=DUCKIEDRONE, rotors=(still, push, still, still))
    mixer, _ = design.sample(TIME[:2], rng())
    level = {"qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0, "z": 1.0} | dict.fromkeys(
        ("x", "y", "vx", "vy", "vz", *"pqr"), 0.0
    )
    goal = Setpoint(position=(0.0, 0.0, 1.0))
    thrusts = []
    for inject in ((0.0,) * 4, tuple(mixer[0])):
        u = CascadeController(DUCKIEDRONE)(level, goal, 0.01, inject)
        thrusts.append(DUCKIEDRONE.thrust[2] * np.square(u))
    assert thrusts[1] - thrusts[0] == pytest.approx([0.0, 0.3, 0.0, 0.0], abs=1e-9)
    with pytest.raises(ValueError, match="4 rotors"):
        RotorForces(airframe=DUCKIEDRONE, rotors=(push,))
