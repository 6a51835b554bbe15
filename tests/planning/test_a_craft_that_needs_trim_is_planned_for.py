"""A craft whose centre of mass is not where its vehicle file says is flown as an autopilot flies it,
trimmed; and manoeuvres that fail only where they follow each other are made smaller."""

from __future__ import annotations

import importlib
import tomllib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from greybox.errors import FitError, GreyboxError
from greybox.model.parameter import ParameterValues
from greybox.model.vehicle import Vehicle
from greybox.model.vehicle_template import template_text
from greybox.planning import plan
from greybox.planning.excitation_blocks import authority, excitation_blocks
from greybox.planning.limits import Limits, command_range
from greybox.planning.manoeuvres import Manoeuvre, Trial, flown, tried_together, yaw_lever
from greybox.planning.planning_case import planning_case

HOVER = Manoeuvre(name="hover", text="hover", unit="", amplitudes=(0.0,))


def crazyflie(**changes: object) -> Vehicle:
    return Vehicle.from_dict(tomllib.loads(template_text("crazyflie")) | changes)


@pytest.mark.parametrize(
    "values",
    [
        {"center_of_mass.x": 0.003, "center_of_mass.y": -0.002},
        {"rotor_asymmetry.delta_1": 0.1, "rotor_asymmetry.delta_2": -0.05},
        {"thrust_level.s": 0.1},
    ],
)
def test_it_hovers_where_it_should(values):
    effects = {n.split(".")[0] for n in values} - {"center_of_mass"}
    case = planning_case(crazyflie(), effects=effects, values=values)
    log = flown(case.flying, HOVER, 0.0, seconds=4.0)
    assert log is not None
    channels = log.flights[0].segments[0].channels
    for axis, wanted in zip("xyz", (0.0, 0.0, 1.5), strict=True):
        np.testing.assert_allclose(channels[axis], wanted, atol=0.01)


def test_a_plan_for_it_is_made_with_the_defaults_although_it_hovers_near_its_limit():
    craft = crazyflie(mass={"value": 0.051, "sigma": 0.0003}, center_of_mass_sigma=[0.003] * 3)
    found = plan(
        craft,
        values={"center_of_mass.x": 0.0017, "center_of_mass.y": 0.0011},
        seconds=30.0,
        setpoints_only=True,
    )
    assert found.warnings == ()
    assert found.limits.broken(found.log) == []


def test_where_a_flight_fails_is_known():
    case = planning_case(crazyflie())
    jump = Manoeuvre(
        name="jump",
        text="jump",
        unit="m",
        amplitudes=(9.0,),
        path=lambda t, a: (a if t > 1.0 else 0.0, 0.0, 1.5, 0.0),
    )
    (trial,) = tried_together(case.flying, [(jump, 9.0)], seconds=2.0)
    assert trial.log is None
    failed = np.flatnonzero(trial.failed)
    assert failed.size and failed.min() == pytest.approx(100, abs=2)


def test_manoeuvres_that_cannot_be_flown_after_each_other_are_made_smaller(monkeypatch):
    """One that fails in the second piece until this is at half its size."""
    import importlib

    module = importlib.import_module("greybox.planning.plan")
    case = planning_case(crazyflie())
    limits = Limits(command=command_range(case.physics.vehicle))
    pieces = {
        b.name: b for b in excitation_blocks(case.flying, limits, seconds=2.0, setpoints_only=True)
    }
    steps = [(pieces["hover"], 1.0), (pieces["hover"], 1.0), (pieces["turns"], 1.0)]
    honest, seen = module._flown, []

    def fails(wish, limits, split):
        (own,) = split
        seen.append([a for _, a in own])
        (trial,) = honest(wish, limits, split)
        if own[2][1] < 0.5:
            return [trial]
        failed = np.zeros_like(trial.failed)
        failed[450:] = True
        return [Trial(log=None, failed=failed)]

    monkeypatch.setattr(module, "_flown", fails)
    (kept,), log = module._kept(case, limits, [steps])
    assert kept[0][1] == 1.0 and kept[2][1] < 0.5
    assert [a for _, a in kept] == seen[-1]
    assert sum(s.n for f in log.flights for s in f.segments) == 600


@pytest.mark.parametrize("seconds", [60_000.0, 1e9, float("inf")])
def test_milliseconds_are_no_seconds(seconds):
    """Such a plan was worked on for hours."""
    with pytest.raises(GreyboxError, match=r"too long a flight; expected .* <= 3600 s"):
        plan(crazyflie(), seconds=seconds)


def test_a_path_that_is_lost_at_its_last_sample_is_refused_in_one_line(monkeypatch):
    """Samples of a flight are rounded, so that the last one may lie beyond its last piece."""
    plan = importlib.import_module("greybox.planning.plan")
    dt, seconds, flights = 0.0112, 20.0, 6

    def flown(*_):
        failed = [np.zeros(round(seconds / dt), dtype=bool) for _ in range(flights)]
        failed[-1][-1] = True
        return [Trial(log=None, failed=f) for f in failed]

    monkeypatch.setattr(plan, "_flown", flown)
    split = [[(SimpleNamespace(seconds=5.0), 1.0)] * 4] * flights
    with pytest.raises(FitError, match="loses its path"):
        plan._kept(SimpleNamespace(sample_time=dt), None, split)


@pytest.mark.parametrize(
    "shape", [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (0.2, 0.4, 0.4), (-2, 1.5, 1.5)]
)
def test_yaw_has_the_lever_of_the_maps_whatever_power_they_are_of(shape):
    """Of a map that stands on several powers one was taken, and of an offset the wrong sign."""
    plain = planning_case(crazyflie(), effects=(), values={}).flying
    lever = plain.values["torque.c2"] / plain.values["thrust.c2"]
    maps = {
        f"{kind}.c{k}": share * plain.values[f"{kind}.c2"]
        for kind in ("thrust", "torque")
        for k, share in enumerate(shape)
    }
    maps["torque.c0"] = 0.0  # yaw is what torques differ by
    model = replace(plain, values=ParameterValues({**plain.values, **maps}))
    assert yaw_lever(model) == pytest.approx(lever)
    turning = authority(model, Limits(command=(0.0, 1.0)))
    assert turning[2] == pytest.approx(
        turning[3] * model.values["mass"] * 9.81 * lever / model.values["inertia.zz"], rel=0.01
    )
