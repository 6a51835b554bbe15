"""A name stays only if flights that were not searched agree and nothing larger is left where the effect acts."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from greybox.discovery import verify
from greybox.discovery.candidates import candidates
from greybox.discovery.gap import Foresight
from greybox.discovery.leftover import Leftover
from greybox.discovery.nested import Nest
from greybox.discovery.veto import (
    AXES,
    HeldOut,
    ahead_gain,
    likeness,
    misfit,
    misfit_of,
    misread,
    touched_by,
    undone,
    unseen,
    wrench_of,
)
from greybox.errors import FitError
from scenarios.plants.effects import BatterySag, ParasiticDrag, PlantEffect, RotationalDamping
from tests.discovery.small_world import flown, vehicle

LEVELS = {f"{k}.{a}": s for k, s in (("force", 0.1), ("torque", 0.001)) for a in "xyz"}


def law(channel: str, *, rms: float, share: float, gain: float, terms: dict[str, float] | None = None) -> Leftover:
    """An unnamed axis."""
    found = {"north.y": 1.0} if terms is None else terms
    return Leftover(channel=channel, unit="", rms=rms, share=share, terms=found, depends_on=(), gain=gain)


def torque(size: float, n: int = 200) -> np.ndarray:
    """A wrench (n, 6) that is a roll torque of that RMS."""
    out = np.zeros((n, 6))
    out[:, 3] = size * np.sqrt(2) * np.sin(np.arange(n))
    return out


def test_a_law_larger_than_the_effect_takes_its_name_back():
    left = [law("torque.x", rms=0.004, share=0.9, gain=2000)]
    found = misfit(("rotor_asymmetry",), torque(0.001), LEVELS, left, 100)
    assert found is not None
    assert found.effects == ("rotor_asymmetry",)
    assert "torque.x" in found.reason


@pytest.mark.parametrize(
    "left",
    [
        law("torque.x", rms=0.0001, share=0.9, gain=50),  # small against the effect
        law("force.z", rms=9.0, share=0.9, gain=900),  # elsewhere
        law("torque.x", rms=0.004, share=0.1, gain=49),  # no law, and less than half of what the effect explained
    ],
)
def test_little_left_or_left_elsewhere_leaves_the_name_alone(left: Leftover):
    assert misfit(("rotational_damping",), torque(0.001), LEVELS, [left], 100) is None


@pytest.mark.parametrize(
    ("share", "noise", "gone"),
    [(-1.1, 0.2, True), (-0.8, 0.2, True), (-0.3, 0.1, False), (-1.0, 2.0, False), (1.0, 0.2, False), (-20.0, 0.2, False)],
)
def test_a_law_that_undoes_what_a_name_does_to_an_axis_refutes_it(share: float, noise: float, gone: bool):
    """A rotor drag on the arms brakes the yaw; where the yaw is not braked, the drag is none of the rotors'. What is small
    against the law, or the other way round, is another matter."""
    own = torque(0.001)
    laws = share * own + torque(abs(share) * noise * 0.001)[::-1]
    left = law("torque.x", rms=0.001, share=0.8, gain=100)
    found = undone(("rotor_drag",), own, laws, [left])
    assert (found is not None) == gone
    assert found is None or "torque.x" in found.reason
    assert undone(("rotor_drag",), own, laws, [replace(left, channel="torque.y")]) is None
    assert undone(("rotor_drag",), own, laws, [replace(left, terms={})]) is None


def test_axes_that_it_acts_on_may_miss_half_of_what_it_explained_together():
    both = torque(0.001)
    both[:, 4] = both[:, 3]
    left = [law(f"torque.{a}", rms=0.004, share=0.0, gain=30, terms={}) for a in "xy"]
    found = misfit(("battery_sag",), both, LEVELS, left, 100)
    assert found is not None
    assert "half" in found.reason
    assert misfit(("battery_sag",), both, LEVELS, left, 121) is None
    # Only one of the two is its own.
    assert misfit(("battery_sag",), torque(0.001), LEVELS, left, 100) is None


def test_a_lag_may_leave_more_than_half_as_no_force_imitates_it():
    left = [law("torque.x", rms=0.004, share=0.0, gain=300, terms={})]
    assert misfit(("motor_lag", "command_delay"), torque(0.001), LEVELS, left, 100) is None
    assert misfit(("motor_lag",), torque(0.001), LEVELS, [law("torque.x", rms=0.004, share=0.0, gain=501, terms={})], 100)


def test_far_more_left_without_a_law_takes_it_back_too():
    assert misfit(
        ("rotational_damping",), torque(0.001), LEVELS, [law("torque.x", rms=0.1, share=0, gain=600, terms={})], 100
    )


def test_a_small_name_next_to_a_far_larger_force_without_one_is_taken_back():
    # A tether pulls at a point: its torque looks like an offset of the centre of mass, its force has no name.
    left = [law("force.x", rms=0.09, share=0.99, gain=3000)]
    assert misfit(("center_of_mass_offset",), torque(0.001), LEVELS, left, 27) is not None
    assert misfit(("center_of_mass_offset",), torque(0.001), LEVELS, left, 400) is None


def test_an_effect_without_a_wrench_is_not_judged_by_it_but_by_its_sensor():
    left = [law("force.x", rms=1.0, share=0.9, gain=800)]
    assert misfit(("gyro_bias",), torque(0.0), LEVELS, left, 100) is None
    assert misfit_of(("accelerometer_scale",), {"force"}, {}, left, 100) is not None
    assert misfit_of(("gyro_bias",), {"torque"}, {}, left, 100) is None


def test_a_constant_that_is_the_mean_of_a_law_is_no_name():
    size = {f"force.{a}": 1.0 for a in "xyz"}
    left = [law("force.x", rms=0.5, share=0.9, gain=80), law("force.y", rms=0.5, share=0.0, gain=40, terms={})]
    assert misfit_of(("constant_force",), {"force"}, size, left, 100) is not None
    assert misfit_of(("constant_force",), {"force"}, size, left[1:], 100) is None
    assert misfit_of(("rotor_drag",), {"force"}, size, left, 100) is None


def seen(level: float, loglik: float, seed: int = 0, spread: float = 0.0) -> Foresight:
    """Errors of that mean square, twelve seconds of flight, whose log likelihoods sum to `loglik`."""
    rng = np.random.default_rng(seed)
    own = {("rate", h): [level * rng.uniform(0.8, 1.2, 20) for _ in range(12)] for h in (0.0, 0.1, 0.5)}
    logliks = loglik / 12 + spread * np.tile([1.0, -1.0], 6)
    return Foresight(own=own, floor={}, logliks=logliks, samples=1000)


def test_the_gain_ahead_is_the_relative_fall_of_the_mean_square():
    gain, error = ahead_gain(seen(4.0, 0), seen(3.0, 0, seed=1))
    assert gain == pytest.approx(0.25, abs=0.03)
    assert 0 < error < 0.02
    assert ahead_gain(seen(4.0, 0), Foresight(own={}, floor={}, logliks=np.zeros(0))) == (0.0, 0.0)


class Fitted:
    """What the veto looks at of a fit."""

    def __init__(self, effects: tuple[str, ...], stage: str = "wrench", bic: float = 0.0) -> None:
        named = [type("E", (), {"name": e, "stage": stage})() for e in effects]
        physics = type("P", (), {"effects": named})()
        self.bic = -bic
        self.effects, self.fit = effects, type("F", (), {"model": type("M", (), {"physics": physics})()})()


def verdict(old: Foresight, new: Foresight, stage: str = "wrench", gained: float = 80.0) -> Any:
    held = HeldOut(None)  # type: ignore[arg-type]
    before, after = Fitted(()), Fitted(("x",), stage, gained)
    held.foresight = lambda f: old if f is before else new  # type: ignore[method-assign, assignment, return-value]
    return held.withheld(before, after)  # type: ignore[arg-type]


def test_held_out_flights_decide():
    assert verdict(seen(4.0, 0), seen(3.0, 5)) is None
    worse = verdict(seen(4.0, 0), seen(3.0, -1))
    assert worse is not None
    assert worse.loglik_gain == pytest.approx(-1)
    grown = verdict(seen(4.0, 0), seen(6.0, 5))
    assert grown is not None
    assert grown.ahead_gain is not None
    assert grown.ahead_gain < 0
    nothing = verdict(seen(4.0, 0), seen(4.0, 5))
    assert nothing is not None


def test_a_loss_within_the_spread_of_the_flight_is_no_contradiction():
    # Twelve blocks of +-1: the sum is uncertain by 3.6.
    assert verdict(seen(4.0, 0), seen(3.0, -3, spread=1.0)) is None
    assert verdict(seen(4.0, 0), seen(3.0, -8, spread=1.0)) is not None


def test_all_flights_together_must_speak_for_a_name():
    assert verdict(seen(4.0, 0), seen(3.0, -3, spread=1.0), gained=17.0) is None
    assert verdict(seen(4.0, 0), seen(3.0, -3, spread=1.0), gained=15.0) is not None


@pytest.mark.parametrize(
    ("after", "likelier", "effect", "proven"),
    [
        (3.0, 200.0, "rotor_drag", True),
        (3.0, 20.0, "rotor_drag", False),  # of 1000 samples
        (3.9, 200.0, "rotor_drag", False),
        (4.5, 200.0, "rotor_drag", False),
        (3.0, 200.0, "constant_force", False),
    ],
)
def test_flights_that_get_plainly_likelier_and_nearer_prove_a_name(
    after: float, likelier: float, effect: str, proven: bool
):
    held = HeldOut(None)  # type: ignore[arg-type]
    fits = Fitted(()), Fitted((effect,))
    held.foresight = lambda f: seen(4.0, 0) if f is fits[0] else seen(after, likelier, seed=1)  # type: ignore[method-assign, assignment, return-value]
    assert held.proven(*fits) is proven  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("now", "instead", "outdone"),
    [
        (4.0, 3.0, False),
        (4.0, 4.0, False),
        (4.0, 4.2, False),  # by a twentieth
        (4.0, 6.0, True),
        (4.0, None, True),
        (None, 6.0, False),
        (None, None, False),
    ],
)
def test_a_law_that_does_not_hold_on_other_flights_stands_in_for_no_name(
    now: float | None, instead: float | None, outdone: bool
):
    held = HeldOut(None)  # type: ignore[arg-type]
    fits = SimpleNamespace(model="now"), SimpleNamespace(model="instead")

    def foresight(model: str) -> Foresight:
        level = now if model == "now" else instead
        if level is None:
            raise FitError("the prediction is not finite")
        return seen(level, 0, seed=int(level))

    held.of = foresight  # type: ignore[method-assign, assignment]
    assert held.outdoes(*fits) is outdone  # type: ignore[arg-type]


class Told:
    """Held-out flights on which one fit is clearly better than the law."""

    def __init__(self, *better: object) -> None:
        self.better = better

    def outdoes(self, now: object, instead: object) -> bool:
        assert instead.name == "law"  # type: ignore[attr-defined]
        return now in self.better


@pytest.mark.parametrize("better", [(), ("name",), ("name and law",), ("name", "name and law")])
def test_a_proven_name_goes_where_a_law_does_its_work_on_all_flights(monkeypatch: pytest.MonkeyPatch, better: tuple[str]):
    def fitted(name: str, bic: float) -> Any:
        own = {"proposal_torque_x.c_1": 0.0} if "law" in name else {}
        model = SimpleNamespace(dynamics=SimpleNamespace(parameters=[]))
        return SimpleNamespace(name=name, bic=bic, model=model, parameters=own)

    named, both, law_alone, bare = (fitted(*v) for v in (("name", 0), ("name and law", -90), ("law", -80), ("", 50)))
    nest = SimpleNamespace(
        refit=lambda effects, start: SimpleNamespace(fit=bare), candidates=SimpleNamespace(core=(), null={})
    )
    monkeypatch.setattr(verify, "promote", lambda *a, **k: None)
    monkeypatch.setattr(verify, "looked_again", lambda *a, **k: SimpleNamespace(written=law_alone))
    monkeypatch.setattr(verify, "wrench_of", lambda model, *a: torque(0.001) if model is named.model else -torque(0.001))
    monkeypatch.setattr(verify, "white_levels", lambda model: LEVELS)
    gone = verify._replaced(
        nest,  # type: ignore[arg-type]
        SimpleNamespace(fit=named, effects=("rotational_damping",)),  # type: ignore[arg-type]
        SimpleNamespace(effects=("rotational_damping",), delta_bic=60.0),  # type: ignore[arg-type]
        SimpleNamespace(written=both),  # type: ignore[arg-type]
        None,  # type: ignore[arg-type]
        Told(*(f for f in (named, both) if f.name in better)),  # type: ignore[arg-type]
        0,
    )
    assert (gone is None) is bool(better)


def test_errors_ahead_are_not_asked_where_one_step_ahead_is_plain():
    assert verdict(seen(4.0, 0), seen(6.0, 99)) is not None
    assert verdict(seen(4.0, 0), seen(6.0, 101)) is None


def test_an_effect_of_a_sensor_need_not_look_ahead():
    assert verdict(seen(4.0, 0), seen(4.0, 5), stage="sensor") is None


def estimates(**values: tuple[float, float]) -> Any:
    return SimpleNamespace(
        fit=SimpleNamespace(
            parameters={f"gyro_bias.{n}": SimpleNamespace(value=v, std=e) for n, (v, e) in values.items()}
        )
    )


def test_a_name_whose_numbers_are_not_clear_of_none_is_withheld():
    null = {f"gyro_bias.b_{a}": 0.0 for a in "xyz"}
    assert unseen(estimates(b_x=(-33.9, 240.0), b_y=(0.01, 0.02)), ("gyro_bias",), null) is not None
    assert unseen(estimates(b_x=(-33.9, 240.0), b_y=(0.05, 0.02)), ("gyro_bias",), null) is None
    assert unseen(estimates(b_x=(0.0, float("nan"))), ("gyro_bias",), null) is None


def test_an_imus_error_must_explain_twice_what_its_axes_miss():
    left = [law("force.x", rms=1.0, share=0.0, gain=60, terms={})]
    assert misread(("accelerometer_scale",), left, 100) is not None
    assert misread(("accelerometer_scale",), left, 121) is None
    assert misread(("accelerometer_scale",), left, 100, total=49) is None
    assert misread(("gyro_bias",), left, 100) is None
    assert misread(("gyro_bias",), [law("torque.z", rms=1.0, share=0.0, gain=51, terms={})], 100) is not None
    assert misread(("pose_delay",), [*left, law("torque.z", rms=1.0, share=0.0, gain=51, terms={})], 200) is not None
    assert misread(("pose_delay",), [*left, law("torque.z", rms=1.0, share=0.0, gain=51, terms={})], 223) is None


def test_likeness_is_a_correlation_on_the_axes_of_the_first():
    one, other = torque(0.001), torque(0.003)
    other[:, 0] = 5.0 * np.cos(np.arange(len(other)))  # an axis that the first leaves alone
    assert touched_by(one, LEVELS) == {"torque.x"}
    assert likeness(one, other, LEVELS) == pytest.approx(1.0)
    assert likeness(one, -other, LEVELS) == pytest.approx(-1.0)
    other[:, 3] = np.cos(np.arange(len(other)))
    assert abs(likeness(one, other, LEVELS)) < 0.02


@pytest.mark.parametrize(
    ("hidden", "name", "axis", "most"),
    [
        (BatterySag(c_V=1.0, nominal_voltage=11.1), "battery_sag", "force.z", 0.5),
        (RotationalDamping(d_p=4e-3, d_q=4e-3, d_r=4e-3), "rotational_damping", "torque.x", 1.0),
        (ParasiticDrag(c_x=0.03, c_y=0.04, c_z=0.02), "parasitic_drag", "force.y", 1.0),
    ],
    ids=lambda v: v if isinstance(v, str) else None,
)
def test_what_the_core_could_have_done_is_no_part_of_a_wrench(hidden: PlantEffect, name: str, axis: str, most: float):
    """A sagging battery is a smaller thrust first, and then a force along z; damping and drag are what they are, also where
    the mass is free."""
    data = flown(hidden, seconds=8.0)
    loose = replace(vehicle(), mass=replace(vehicle().mass, sigma=0.02 * vehicle().mass.value))
    nest = Nest(candidates=candidates(loose, data.channels, sample_time=0.01), data=data)
    at = nest.refit((name,), start=nest.refit(()))
    null = nest.candidates.null
    whole, rest = (wrench_of(at.fit.model, data, (name,), null, core) for core in ((), nest.candidates.core))
    assert "mass" in nest.candidates.core
    levels = dict(zip(at.fit.model.dynamics.noises.names, at.fit.model.process_noise.tolist(), strict=True))
    share = (rest**2).mean(axis=0) / np.maximum((whole**2).mean(axis=0), 1e-12)
    assert axis in touched_by(rest, levels)
    if most < 1:
        assert share.max() < most
    else:
        assert share[AXES.index(axis)] > 0.5
        assert likeness(rest, whole, levels) > 0.8
